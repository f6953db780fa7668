"""Gravity and external forces of a scene, and bounds on them for the step (docs/theory.md, 6.5)."""

import math
from collections.abc import Sequence

import numpy as np

from mpmcli.scene import Scene
from mpmcli.scene.quadrature import largest_of
from mpmcli.solver.backend import Backend
from mpmcli.solver.expression_kernels import Clock
from mpmcli.solver.forces import Gravity, GroupForce, build_push, forces_on, tree_of
from mpmcli.solver.particles import ParticleGroup

# Forces are measured with the state, for the steps up to the next measurement: at INSTANTS times where they depend on
# time, and where what depends on time alone is smallest and largest. MARGIN allows for the motion of the particles in
# between.
INSTANTS = 5
MARGIN = 1.5


class ExternalForces:
    """Gravity and forces of a scene, and bounds on them.

    Attributes:
        gravity: for the kernels.
        slope: largest row sum of |da/dx| of the forces, 1/s^2, as last measured, margin included.
    """

    def __init__(self, scene: Scene, groups: Sequence[ParticleGroup], backend: Backend) -> None:
        """Assign forces to groups; call it before kernels are built."""
        self._domain = scene.domain
        clock = Clock()
        self.gravity = Gravity(scene, clock)
        self._constant = scene.domain.gravity_at(0.0)
        self._steady_pull = float(np.linalg.norm(self._constant))
        pushed = [group for group in groups if forces_on(scene, group.bodies)]
        for group in pushed:
            group.push_by(GroupForce(scene, group, clock))
        self._timed = bool(clock.trees)
        self._clock = clock
        self._set_times = clock.allocate(scene.time.end)
        self._measures = [build_push(group, backend) for group in pushed]
        self._push = 0.0
        self.slope = 0.0

    @property
    def pushes(self) -> bool:
        """Whether there are forces beside gravity."""
        return bool(self._measures)

    def save(self) -> dict[str, float]:
        """Return what was last measured, as plain numbers."""
        return {"push": self._push, "slope": self.slope}

    def load(self, saved: dict[str, float]) -> None:
        """Take what `save` returned."""
        self._push, self.slope = saved["push"], saved["slope"]

    def begin_step(self, start: float, end: float) -> None:
        """Set what depends on time alone to its mean over the kick from `start` to `end`, s."""
        if self._timed:
            self._set_times(start, end)

    def gravity_at(self, time: float) -> np.ndarray:
        """Return gravity, (d,), m/s^2."""
        return self._constant if self._domain.steady else self._domain.gravity_at(time)

    def pull(self, start: float, end: float) -> float:
        """Return a bound on the acceleration between two times (s): gravity by its bounds, forces as measured."""
        if self._domain.steady:
            return self._steady_pull + self._push
        return float(np.linalg.norm([largest_of(tree_of(g), start, end) for g in self._domain.gravity])) + self._push

    def measure(self, time: float, ahead: float) -> None:
        """Measure the forces where the particles are, from a time on up to the next measurement, `ahead` s later."""
        if not self._measures:
            return
        times = [time]
        if self._timed and ahead > 0:
            times = [*np.linspace(time, time + ahead, INSTANTS), *self._clock.telling_times(time, time + ahead)]
        found = []
        for instant in times:
            self.begin_step(float(instant), float(instant))
            found += [measure() for measure in self._measures]
        self._push, self.slope = (
            MARGIN * max((value for value in values if math.isfinite(value)), default=0.0)
            for values in zip(*found, strict=True)
        )

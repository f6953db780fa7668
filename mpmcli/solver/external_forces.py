"""Gravity and external forces of a scene, and bounds on them for the step (docs/theory.md, 6.5)."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from mpmcli.scene import Scene
from mpmcli.scene.entry import tree_of
from mpmcli.scene.quadrature import largest_of
from mpmcli.solver.backend import Backend
from mpmcli.solver.forces import ForceTerms, Gravity, GroupForce, build_push, gravity_terms
from mpmcli.solver.particle_arrays import ParticleArrays
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.run_values import DeviceValues, Entries, RunValues

# Forces are measured with the state, for the steps up to the next measurement: at INSTANTS times where they depend on
# time, and where what depends on time alone is smallest and largest. MARGIN allows for the motion of the particles in
# between.
INSTANTS = 5
MARGIN = 1.5

# Measurement of the force on particles of a run, see `build_push`.
Push = Callable[[int, int, int], tuple[float, float]]


def push_on(
    group: ParticleArrays, forces: ForceTerms, room: int, values: DeviceValues, backend: Backend
) -> Push | None:
    """Let forces act on a group, before kernels are built; return their measurement, see `build_push`."""
    if not forces.terms:
        return None
    group.push_by(GroupForce(group.dimension, forces, values, room))
    return build_push(group, backend)


def drive(scene: Scene, groups: Sequence[ParticleGroup], backend: Backend) -> "tuple[Gravity, ExternalForces]":
    """Assign the forces of a scene to the groups of a `Solver`, before kernels are built; return gravity with them."""
    entries = Entries(scene.domain.origin)
    gravity = gravity_terms(scene, entries)
    forces = [ForceTerms.of(scene, group.bodies, entries, several=group.several) for group in groups]
    values = DeviceValues(1, len(entries.found))
    measures = []
    for group, own in zip(groups, forces, strict=True):
        push = push_on(group, own, 0, values, backend)
        if push is not None:
            measures.append(partial(push, group.first, group.count, 0))
    run = RunValues(values, 0, entries.found, scene.time.end)
    return Gravity(gravity, scene.domain.gravity_at(0.0).tolist(), values), ExternalForces(scene, run, measures)


class ExternalForces:
    """Gravity and forces of a scene, and bounds on them.

    Attributes:
        slope: largest row sum of |da/dx| of the forces, 1/s^2, as last measured, margin included.
    """

    def __init__(self, scene: Scene, values: RunValues, measures: Sequence[Callable[[], tuple[float, float]]]) -> None:
        """Keep the numbers of the run, and the measurement of the force on each group that one acts on."""
        self._domain = scene.domain
        self._gravity_pull = float(np.linalg.norm(scene.domain.gravity_at(0.0)))
        self._values, self._measures = values, measures
        self._push = 0.0
        self.slope = 0.0

    @property
    def pushes(self) -> bool:
        """Whether there are forces beside gravity."""
        return bool(self._measures)

    @property
    def steady_pull(self) -> float:
        """A bound on the acceleration, m/s^2, by gravity, if it is steady, and by forces as measured."""
        return (self._gravity_pull if self._domain.steady else 0.0) + self._push

    def save(self) -> dict[str, float]:
        """Return what was last measured, as plain numbers."""
        return {"push": self._push, "slope": self.slope}

    def load(self, saved: dict[str, float]) -> None:
        """Take what `save` returned."""
        self._push, self.slope = saved["push"], saved["slope"]

    def begin_step(self, start: float, end: float) -> None:
        """Set what depends on time alone to its mean over the kick from `start` to `end`, s."""
        if self._values.timed:
            self._values.write(start, end)

    def pull(self, start: float, end: float) -> float:
        """Return a bound on the acceleration between two times (s): gravity by its bounds, forces as measured."""
        if self._domain.steady:
            return self.steady_pull
        return float(np.linalg.norm([largest_of(tree_of(g), start, end) for g in self._domain.gravity])) + self._push

    def measure(self, time: float, ahead: float) -> None:
        """Measure the forces where the particles are, from a time on up to the next measurement, `ahead` s later."""
        if not self._measures:
            return
        times = [time]
        if self._values.timed and ahead > 0:
            times = [*np.linspace(time, time + ahead, INSTANTS), *self._values.telling_times(time, time + ahead)]
        found = []
        for instant in times:
            self.begin_step(float(instant), float(instant))
            found += [measure() for measure in self._measures]
        self._push, self.slope = (
            MARGIN * max((value for value in values if math.isfinite(value)), default=0.0)
            for values in zip(*found, strict=True)
        )

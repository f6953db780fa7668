"""Measures the step at which a scene blows up, and sets it against the bound that the solver predicts."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scenes import block, scene_of

from blow_up.scenes import SPACING, BlowUpScene
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import Backend
from mpmcli.stability.limits import Limit
from mpmcli.stability.transfer_factors import INVERSE_MOMENT

# Size of the perturbation, in cells per predicted step: growth is seen long before anything is nonlinear.
AMPLITUDE = 1e-7
# By how much the energy of a perturbation must grow, and by how much that of a deformed start.
GROWTH, STORED_GROWTH = 1e6, 100.0
# Steps between two readings at most; the first ones are as close as the growth of a strong instability needs.
MOST_UNREAD = 100


@dataclass(frozen=True)
class Run:
    """What a run of a fixed step did.

    Attributes:
        steps: taken.
        blew_up: whether the energy grew beyond all bounds, or the solver stopped.
        largest: kinetic energy about the mean motion, the largest over what the start holds, kinetic or stored.
        late: the largest in the last tenth of the run over the largest in the fifth tenth.
    """

    steps: int
    blew_up: bool
    largest: float
    late: float


class Trial:
    """A scene that can be run again and again with steps of any size: its kernels stay compiled."""

    def __init__(self, scene: BlowUpScene, backend: Backend, knobs: Mapping[str, object] | None = None) -> None:
        """Build the scene, with these knobs of its [solver] table in place of the usual ones."""
        self.scene = scene
        self.dimension = d = scene.position.shape[1]
        self.count = n = len(scene.position)
        density = scene.material["density"]
        body = BodyParticles(
            "body",
            scene.position,
            np.tile(scene.velocity, (n, 1)),
            np.zeros((n, d, d)),
            scene.volume,
            density * scene.volume,
        )
        self.solver = build_run(_scene_of(scene, knobs or {}), backend, [body])
        self._moment = 1 / INVERSE_MOMENT[self.solver.scene.solver.kernel]
        self.predicted = math.inf
        self._start(0.0)
        # What `check` prints: of speeds and of the deformation per step nothing is asked here.
        self.limit: Limit = min(limit for limit in self.solver.limits() if limit.name in ("wave", "viscosity"))
        self.predicted = self.limit.value

    def _start(self, amplitude: float) -> None:
        """Put every particle where it began, with a seeded perturbation of v and of C."""
        n, d, scene = self.count, self.dimension, self.scene
        group = self.solver.groups[0]
        random = np.random.default_rng(0)
        noise = amplitude * SPACING / self.predicted
        F = np.diag(scene.stretches)
        inner = [scene.internal.get(variable.name, variable.at_rest) for variable in group.law.internal]
        group.replace(
            x=scene.position,
            v=scene.velocity + noise * random.standard_normal((n, d)),
            C=noise / SPACING * random.standard_normal((n, d, d)),
            deformation=np.full(n, np.linalg.det(F)) if group.law.deformation == "J" else np.tile(F, (n, 1, 1)),
            internal=np.tile(inner, (n, 1)),
            id=np.arange(n),
        )
        self.solver.state_was_replaced()

    def kinetic_energy(self) -> float:
        """Return sum |v - mean v|^2 + D |C|^2, m^2/s^2: twice the energy per particle's mass; D = h^2/4 is usual."""
        state = self.solver.groups[0].read()
        v, C = state["v"], state["C"]
        v = v - v.mean(axis=0)
        return float((v * v).sum() + self._moment * SPACING**2 * (C * C).sum())

    def _stored_energy(self) -> float:
        """Return what a deformed start holds beside the perturbation, in the units of `kinetic_energy`."""
        if (self.scene.stretches == 1).all():
            return 0.0
        row = self.solver.frame()[1]
        return 2 * row.elastic / (self.scene.material["density"] * self.scene.volume)

    def run(self, dt: float, steps: int) -> Run:
        """Run at a fixed step dt, s, until it blows up or `steps` are taken."""
        self._start(AMPLITUDE)
        first = self.kinetic_energy()
        stored = self._stored_energy()
        deformed = stored > first
        held = stored if deformed else first
        bound = held * (STORED_GROWTH if deformed else GROWTH)
        taken, largest = 0, first / held
        fifth, last = 0.0, 0.0
        try:
            while taken < steps:
                # A fraction of the steps taken: a growth per step that shows at all multiplies by little in between.
                gap = max(1, min(taken // 8, MOST_UNREAD, steps - taken))
                for _ in range(gap):
                    self.solver.step(dt)
                taken += gap
                energy = self.kinetic_energy()
                largest = max(largest, energy / held)
                if not energy < bound:
                    return Run(taken, True, largest, math.inf)
                if 0.4 * steps < taken <= 0.5 * steps:
                    fifth = max(fifth, energy)
                elif taken > 0.9 * steps:
                    last = max(last, energy)
                self._shift_back()
        except UnstableRunError:
            return Run(taken, True, math.inf, math.inf)
        # What has decayed to round-off may double.
        floor = 1e-9 * held
        return Run(taken, False, largest, max(last, floor) / max(fifth, floor))

    def _shift_back(self) -> None:
        """Move a travelling body back by whole cells, so that it never leaves the domain."""
        if not self.scene.velocity.any():
            return
        group = self.solver.groups[0]
        x = group.read()["x"]
        cells = np.round((x - self.scene.position.mean(axis=0)).mean(axis=0) / SPACING)
        if cells.any():
            group.replace(x=x - cells * SPACING)
            self.solver.state_was_replaced()


def _scene_of(scene: BlowUpScene, knobs: Mapping[str, object]) -> Scene:
    """Return the scene: one body whose particles are given, in a box with slip walls, without gravity."""
    d = scene.position.shape[1]
    own = block("body", scene.material, [0.0] * d, [SPACING] * d)
    solver = {"precision": "f64", **knobs}
    return scene_of(own, cells=scene.cells, spacing=SPACING, walls="slip", solver=solver, contact={})

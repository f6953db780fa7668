"""What colliders take in a step in fixed point, for `solver.deterministic` on a GPU (docs/theory.md, 7.3)."""

from collections.abc import Sequence

import numpy as np
import taichi as ti

from mpmcli.boundaries.collider_kind import reach_of
from mpmcli.scene import Scene
from mpmcli.solver.fixed_point import NOTHING, FixedPoint
from mpmcli.solver.fixed_sums import FixedSums

# Faces of a collider that act on a node in turn; nodes that may be folded onto one, per axis.
FACES, FOLDED = 3, 2
# Bits of the lower of two integers: fewer numbers meet than in P2G.
LOW_BITS = 18


@ti.data_oriented
class FixedLoads:
    """Impulses and angular impulses that the nodes of a row give a collider in a step.

    Attributes:
        sums: by rows of nodes and colliders, like `Colliders.taken`.
        most: the largest number that may be added, as scaled: of so many as meet no sum overflows.
        beyond: the smallest index of a node that gave more; NOTHING for none.
    """

    def __init__(self, scene: Scene, fixed: FixedPoint, shape: Sequence[int], turns: int) -> None:
        """Allocate for the colliders of a scene on a grid with `shape` nodes per axis; `turns` as in `Colliders`."""
        d, h = scene.dimension, scene.domain.spacing
        rows = int(np.prod(shape[:-1]))
        self.dimension, self.loads = d, d + turns
        self.sums = FixedSums(self.loads, rows * len(scene.colliders), wide=fixed.wide, low_bits=LOW_BITS)
        # A quarter of what the integers hold, so that rounding counts for nothing.
        self.most = 4 * self.sums.largest / (FACES * shape[-1])
        # A node whose velocity changes by a cell in a step.
        self._impulse = FOLDED**d * fixed.heaviest * h
        self._lever = _lever(scene)
        self._scale = 0.0
        # Scales of impulses and of angular impulses, and the inverse of both.
        self.pace = ti.Vector.field(4, float, shape=())
        self.beyond = ti.field(int, shape=())
        self.forget()

    def set_step(self, step: float) -> None:
        """Choose the scales for steps of which `step`, s, is stable."""
        room = self.sums.largest / self.most
        scale = self.sums.scale(room * self._impulse / step)
        if scale != self._scale:
            self._scale = scale
            turned = self.sums.scale(room * self._impulse * self._lever / step)
            self.pace[None] = [scale, turned, 1 / scale, 1 / turned]

    def forget(self) -> None:
        """Forget what was beyond the sums."""
        self.beyond[None] = NOTHING

    def found_beyond(self) -> int | None:
        """Return the index of a node that gave more than there was room for, None where none did."""
        node = int(self.beyond[None])
        return None if node == NOTHING else node

    @ti.func
    def add(self, place: int, node: int, load: ti.template()):
        """Add what a node gives, with atomics."""
        scaled, fits = load, True
        for a in ti.static(range(self.loads)):
            scaled[a] *= self.pace[None][ti.static(0 if a < self.dimension else 1)]
            # Written so that a NaN does not fit.
            fits = fits and ti.abs(scaled[a]) <= ti.static(self.most)
        if fits:
            self.sums.add(place, scaled)
        else:
            ti.atomic_min(self.beyond[None], node)

    @ti.func
    def settle(self, taken: ti.template(), place: int):
        """Add what was given in this step to the sums of all steps, `Colliders.taken`, and forget it."""
        value = self.sums.value(place)
        for a in ti.static(range(self.loads)):
            taken[place][a] += value[a] * self.pace[None][ti.static(2 if a < self.dimension else 3)]
        self.sums.clear(place)


def _lever(scene: Scene) -> float:
    """Return a bound on the distance of nodes from the pivots of colliders that act on them, m."""
    h, size = scene.domain.spacing, np.array(scene.domain.size)
    levers = [h]
    for collider in scene.colliders:
        reach = reach_of(collider, h)
        # A container acts on all of the domain.
        pivot = np.array(collider.motion.pose(0.0)[0]) - np.array(scene.domain.origin)
        away = np.abs(np.array([pivot, size - pivot])).max(0) + size
        levers.append(float(np.linalg.norm(np.minimum(np.abs(reach).max(0), away))))
    return max(levers)

"""What a `Solver` does with its colliders on the host: their steps, and the loads that they have taken."""

from collections.abc import Sequence

import numpy as np
import taichi as ti

from mpmcli.boundaries.collider_kind import ColliderKind
from mpmcli.boundaries.collider_motion import ColliderMotion
from mpmcli.boundaries.colliders import Colliders
from mpmcli.errors import InputError
from mpmcli.scene import Scene
from mpmcli.scene.expression import names_in
from mpmcli.scene.quadrature import Mean
from mpmcli.stability.limits import collider_limit

# Devices that know single precision only.
WITHOUT_DOUBLES = ("metal",)


class ColliderSteps:
    """The colliders of the only run on a device.

    Attributes:
        colliders, motion: on the device; motion is None where none moves.
    """

    def __init__(
        self, scene: Scene, shape: Sequence[int], first: int, arch: str, *, deterministic: bool = False
    ) -> None:
        """Put those of a scene on a grid with `shape` nodes per axis, whose node `first` is the lower corner.

        Args:
            deterministic: see `Colliders`.

        Raises:
            InputError: one moves, and the device knows single precision only.
        """
        kind = ColliderKind.of(scene)
        if kind.moving and arch in WITHOUT_DOUBLES:
            raise InputError(f"colliders that move need double precision, which --arch {arch} lacks; give --arch cpu")
        in_doubles = arch == "cpu" and not deterministic
        self.colliders = Colliders(
            kind, scene.dimension, shape, first, 1, on_cpu=in_doubles, deterministic=deterministic
        )
        self.colliders.spacing = scene.domain.spacing
        self.colliders.write(scene)
        self.motion = ColliderMotion(self.colliders, 1) if kind.moving else None
        self._means: list[tuple[int, int, Mean]] = []
        if self.motion is not None:
            self.motion.write(scene)
            for m, k in enumerate(kind.moving):
                rates = scene.colliders[k].motion.rates
                self._means += [(m, a, Mean(rate, scene.time.end)) for a, rate in enumerate(rates) if names_in(rate)]

    def begin_step(self, start: float, dt: float) -> None:
        """Put colliders where they are at `start`, s, and let them move for dt, s."""
        if self.motion is not None:
            for m, a, mean in self._means:
                self.motion.rates[m, a] = mean(start, start + dt)
            self.motion.step(dt)

    def fields(self) -> dict[str, ti.Field]:
        """Return what outlives a step, by name."""
        found = {"colliders.taken": self.colliders.taken}
        return found | ({} if self.motion is None else {"colliders.pose": self.motion.pose})


def read_loads(colliders: Colliders, run: int, count: int) -> np.ndarray:
    """Return the impulses and angular impulses that `count` colliders of a run have taken, (count, k), and forget them.

    Rows are summed in order, as the kernel of a batch does.
    """
    size = colliders.rows * colliders.room
    taken = colliders.taken.to_numpy()[run * size : (run + 1) * size].astype(np.float64)
    colliders.clear_taken(run)
    return np.cumsum(taken.reshape(colliders.rows, colliders.room, -1), axis=0)[-1][:count]


def collider_bound(scene: Scene) -> float:
    """Return the step in which no collider of a scene moves more than half a cell, s."""
    speeds = [collider.fastest(scene.domain, scene.time.end) for collider in scene.colliders]
    return collider_limit(scene.domain.spacing, max(speeds, default=0.0))

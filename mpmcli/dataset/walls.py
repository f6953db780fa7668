"""Walls as particles: points on the surfaces of colliders, and of the domain, that move as these do."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from mpmcli.output.header import RunHeader
from mpmcli.scene.collider_surface import collider_surface
from mpmcli.scene.colliders import Collider
from mpmcli.scene.form_surface import form_surface
from mpmcli.scene.motion import Motion
from mpmcli.scene.primitives import Box
from mpmcli.scene.surface_points import surface_points

# Of colliders, or of the domain as well.
Walls = Literal["none", "colliders", "all"]
WALLS: tuple[Walls, ...] = ("none", "colliders", "all")
# The number in place of that of a collider, of the walls of the domain.
DOMAIN = -1
# Distance in spacings to which a point is on a surface.
ON_SURFACE = 0.01


@dataclass(frozen=True, eq=False)
class WallParticles:
    """Particles on the walls of a run.

    Attributes:
        header: of the run; colliders: of it.
        walls: which.
        spacing: between neighbours, m.
    """

    header: RunHeader
    colliders: tuple[Collider, ...]
    walls: Walls
    spacing: float

    @cached_property
    def _parts(self) -> list[tuple[int, np.ndarray, Motion | None]]:
        """Number, points (n, d) and motion of each wall; None for one that rests, whose points lie where they are."""
        found: list[tuple[int, np.ndarray, Motion | None]] = []
        header = self.header
        if self.walls == "none" or header.origin is None:
            return found
        names = header.collider_names
        for collider in self.colliders:
            motion = collider.motion
            points = surface_points(collider_surface(collider, header.origin, header.upper), self.spacing)
            points = points if motion.moves else motion.placed(points, 0.0)
            found.append((names.index(collider.name), points, motion if motion.moves else None))
        if self.walls == "all":
            box = form_surface(Box.model_construct(min=tuple(header.origin), max=tuple(header.upper)))
            points = surface_points(box, self.spacing)
            # Periodic faces are no walls.
            on_face = np.isclose(points, header.origin) | np.isclose(points, header.upper)
            found.append((DOMAIN, points[(on_face & ~header.periodic).any(axis=1)], None))
        return [
            (number, self._seen(number, points) if motion is None else points, motion)
            for number, points, motion in found
        ]

    def _seen(self, number: int, points: np.ndarray) -> np.ndarray:
        """Leave out points (n, d) of a wall at rest that lie inside of another collider at rest."""
        seen = np.ones(len(points), bool)
        for other in self.colliders:
            if not other.motion.moves and self.header.collider_names.index(other.name) != number:
                seen &= other.signed_distance(points) >= -ON_SURFACE * self.spacing
        return points[seen]

    @property
    def count(self) -> int:
        """Number of particles."""
        return sum(len(points) for _, points, _ in self._parts)

    @property
    def numbers(self) -> np.ndarray:
        """The collider of each particle by its number in the scene, (W,) int32; -1 of the domain."""
        return _joined([np.full(len(points), number, np.int32) for number, points, _ in self._parts], np.int32)

    @property
    def moving(self) -> np.ndarray:
        """Whether each particle moves, (W,) bool."""
        return _joined([np.full(len(points), motion is not None) for _, points, motion in self._parts], bool)

    def positions(self, times: Sequence[float]) -> np.ndarray:
        """Return where they are at some times, s: (T, W, d) float64, m."""
        shape = (len(times), self.count, self.header.dimension)
        found = np.empty(shape)
        first = 0
        for _, points, motion in self._parts:
            for k, time in enumerate(times):
                found[k, first : first + len(points)] = points if motion is None else motion.placed(points, time)
            first += len(points)
        return found


def _joined(arrays: Sequence[np.ndarray], kind: type) -> np.ndarray:
    return np.concatenate([np.empty(0, kind), *arrays])

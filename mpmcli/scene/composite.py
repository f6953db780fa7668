"""Unions and differences of forms."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product

import numpy as np

from mpmcli.scene.enclosed_volume import Solid, enclosed_volume
from mpmcli.scene.mesh import Mesh
from mpmcli.scene.polygon import Polygon
from mpmcli.scene.primitives import Ball, Box, Capsule, Cylinder


@dataclass(frozen=True)
class Composite:
    """What lies in any of some forms, and in none of others.

    Attributes:
        added: the former, at least one.
        removed: the latter.
    """

    added: tuple[Solid, ...]
    removed: tuple[Solid, ...] = ()

    @property
    def volume(self) -> float:
        """Exact where no two forms intersect, else by quadrature; see `enclosed_volume` for its error."""
        return _volume(self)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner of the bounding box of what is added, (d,) each, m."""
        lowers, uppers = zip(*(form.bounds() for form in self.added), strict=True)
        return np.min(lowers, axis=0), np.max(uppers, axis=0)

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Say of each point (n, d) whether it lies inside, at least `inset` metres from the surface.

        With an inset, points are left out that are that deep in no single form.
        """
        if inset > 0:
            return self.signed_distance(points) <= -inset
        inside = np.any([form.contains(points) for form in self.added], axis=0)
        for form in self.removed:
            inside[inside] = ~form.contains(points[inside])
        return inside

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, d) from the surface, (n,), m; negative inside.

        The smallest of those of what is added, and the largest of it and what is left by what is removed. No point is
        nearer to the surface; where forms intersect, some are farther.
        """
        distance = np.min([form.signed_distance(points) for form in self.added], axis=0)
        for form in self.removed:
            distance = np.maximum(distance, -form.signed_distance(points))
        return distance


@lru_cache(maxsize=256)
def _volume(form: Composite) -> float:
    # What does not meet the bounding box of anything takes nothing from it.
    removed = [one for one in form.removed if any(_boxes_meet(one, other) for other in form.added)]
    lone = not any(_boxes_meet(*pair) for forms in (form.added, removed) for pair in combinations(forms, 2))
    if lone and all(any(_holds(other, one) for other in form.added) for one in removed):
        return sum(one.volume for one in form.added) - sum(one.volume for one in removed)
    return enclosed_volume(form, fewer=1 if any(isinstance(one, Mesh) for one in (*form.added, *removed)) else 0)


def _boxes_meet(first: Solid, second: Solid) -> bool:
    (a, b), (c, d) = first.bounds(), second.bounds()
    return bool(np.all((b > c) & (d > a)))


def _holds(outer: Solid, inner: Solid) -> bool:
    """Say whether a convex form holds another one as a whole; False where it is not known."""
    if not isinstance(outer, Box | Ball | Capsule | Cylinder):
        return False
    match inner:
        case Ball():
            return bool(outer.contains(np.array([inner.center]), inset=inner.radius).all())
        case Capsule():
            return bool(outer.contains(np.array([inner.start, inner.end]), inset=inner.radius).all())
        case Box():
            return bool(outer.contains(np.array(list(product(*zip(*inner.bounds(), strict=True))))).all())
        case Polygon():
            return bool(outer.contains(np.array(inner.vertices)).all())
    return False

"""What is compiled for the colliders of a run, and what their kernels need of each."""

from dataclasses import dataclass

import numpy as np

from mpmcli.boundaries.distances import DISTANCES
from mpmcli.boundaries.grid_distance import GridDistance, samples_of
from mpmcli.scene import Scene
from mpmcli.scene.colliders import Collider
from mpmcli.scene.polygon import Polygon
from mpmcli.scene.primitives import Box

# Cells outside of a surface up to which it acts on nodes: the outermost of them lies between a quarter of a cell inside
# and three quarters outside, where fluids neither enter nor lose pressure, and what is rough sticks (docs/theory.md,
# 3.8). A little more, so that no node is at that distance by rounding.
REACH = 0.76
# Codes of what a surface does.
SLIP, STICK, SEPARATE = range(3)
WALLS = {"slip": SLIP, "stick": STICK, "separate": SEPARATE}
FORMS = tuple(DISTANCES)
# Of all other forms, by their distances on a grid.
GRID = len(FORMS)
BOX = FORMS.index(Box)


@dataclass(frozen=True)
class ColliderKind:
    """What is compiled for the colliders of a run, and how much room they need.

    Attributes:
        forms: indices into FORMS of the forms that occur, in order, GRID among them.
        moving: which of the colliders move.
        count: number of colliders; numbers, samples: of their forms. All three are upper bounds.
    """

    forms: tuple[int, ...]
    moving: tuple[int, ...]
    count: int
    numbers: int
    samples: int

    @staticmethod
    def of(scene: Scene) -> "ColliderKind":
        """Return the kind of the colliders of a scene."""
        found, h = scene.colliders, scene.domain.spacing
        return ColliderKind(
            tuple(sorted({form_code(collider) for collider in found})),
            tuple(k for k, collider in enumerate(found) if collider.motion.moves),
            len(found),
            sum(len(numbers_of(collider, h)) for collider in found),
            sum(samples_of(collider.form, h)[0].size for collider in found if form_code(collider) == GRID),
        )

    def bytes_needed(self, dimension: int, rows: int) -> int:
        """Return the bytes that the loads on the colliders of a run, and distances on grids, take on the device.

        Args:
            rows: of nodes along the last axis.
        """
        return 8 * self.count * rows * (3 if dimension == 2 else 6) + 4 * self.samples

    def joined(self, other: "ColliderKind") -> "ColliderKind | None":
        """Return the kind that has room for both, None where they need other kernels."""
        if (self.moving, self.count > 0) != (other.moving, other.count > 0):
            return None
        forms = tuple(sorted({*self.forms, *other.forms}))
        rooms = (max(getattr(self, name), getattr(other, name)) for name in ("count", "numbers", "samples"))
        return ColliderKind(forms, self.moving, *rooms)


def form_code(collider: Collider) -> int:
    """Return the index of the form of a collider in FORMS, or GRID."""
    kind = type(collider.form)
    # In the corners of a polygon around the material the normals of a grid are those of both edges.
    around = kind is Polygon and collider.side == "inside"
    return FORMS.index(kind) if kind in FORMS and not around else GRID


def numbers_of(collider: Collider, h: float) -> list[float]:
    """Return the numbers of the form of a collider, relative to its pivot, in a scene with cells of h metres."""
    d, pivot = len(collider.velocity), np.array(collider.center)
    if form_code(collider) == GRID:
        return GridDistance.numbers(collider.form, pivot, h)
    return DISTANCES[type(collider.form)](d).numbers(collider.form, pivot)


def reach_of(collider: Collider, h: float) -> np.ndarray:
    """Return where nodes lie on which a collider may act, relative to its pivot, lower and upper, (2, d), m."""
    d, motion = len(collider.velocity), collider.motion
    radius = np.inf if collider.side == "inside" else collider.radius
    found = np.array([[-radius] * d, [radius] * d])
    if np.isfinite(radius) and not motion.turns and motion.angle == 0.0:
        found = np.array(collider.form.bounds()) - np.array(collider.center)
    found[0] -= h * (REACH + 0.01)
    found[1] += h * (REACH + 0.01)
    return found

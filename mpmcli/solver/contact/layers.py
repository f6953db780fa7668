"""Bodies of a scene with their own velocity fields, and the friction between pairs of them."""

import math
from dataclasses import dataclass, field

import numpy as np

from mpmcli.scene import Scene
from mpmcli.scene.sampling import points_per_cell

# Used instead of a coefficient of friction: both layers have the same velocity at common nodes.
STICKS = -1.0
# Numbers of a layer: P-wave modulus, Pa, sharpness, 1/m, normalisation of the sum over a flat surface, density, kg/m^3,
# area of a surface point, m^(d-1), and from FRICTION on the coefficient of friction with each layer.
MODULUS, SHARPNESS, FLAT, DENSITY, AREA, FRICTION = range(6)


@dataclass(frozen=True)
class Layers:
    """The layers of nodes of a run: each separating body has its own layer with a velocity field.

    Attributes:
        count: number of layers; 1 if all bodies share one velocity field or there is a single body.
        shares: whether layer 0 belongs to all bodies without their own layer.
        per_axis: largest number of particles along the edge of a cell, of all bodies with their own layers.
        numbers: layer of each source.
    """

    count: int
    shares: bool
    per_axis: int
    numbers: tuple[int, ...] = field(compare=False)

    @staticmethod
    def of(scene: Scene) -> "Layers":
        """Return the layers of a scene."""
        sources, own = scene.sources, [scene.separates(source) for source in scene.sources]
        if not any(own):
            return Layers(1, True, 1, (0,) * len(own))
        shares = not all(own)
        numbers = tuple(shares + sum(own[:i]) if one else 0 for i, one in enumerate(own))
        densest = max(points_per_cell(sources[i], scene.domain.spacing) for i, one in enumerate(own) if one)
        return Layers(shares + sum(own), shares, math.ceil(densest ** (1 / scene.dimension)), numbers)

    @property
    def separate(self) -> bool:
        """Whether any body has its own layer, and is in contact with bodies, walls and colliders by its surface."""
        return self.count > 1 or not self.shares

    @property
    def pairs(self) -> int:
        """Number of pairs of layers: (0, 1), (0, 2), (1, 2), (0, 3)..."""
        return math.comb(self.count, 2)

    def has_own(self, source: int) -> bool:
        """Return whether a source has its own layer."""
        return self.numbers[source] > 0 or not self.shares

    def frictions(self, scene: Scene) -> np.ndarray:
        """Return the coefficient of friction of each pair of layers, (count, count), `STICKS` for sticking pairs.

        Of the bodies that share layer 0 the one with the lowest counts, and any that sticks.
        """
        result = np.full((self.count, self.count), np.inf)
        for i, one in enumerate(scene.sources):
            for k, other in enumerate(scene.sources[:i]):
                friction, a, c = scene.friction_between(one, other), self.numbers[i], self.numbers[k]
                result[a, c] = result[c, a] = min(result[a, c], STICKS if friction is None else friction)
        result[np.isinf(result)] = STICKS
        return result


def touched(scene: Scene, layers: Layers) -> bool:
    """Return whether colliders act at points of their surfaces: some do not hold, and bodies share a layer."""
    return layers.shares and any(collider.wall != "hold" for collider in scene.colliders)

"""The layers of nodes of a run: one for each velocity field of its scene."""

import math
from dataclasses import dataclass, field

import numpy as np

from mpmcli.scene import Scene
from mpmcli.scene.contact_table import ContactTable
from mpmcli.scene.sampling import points_per_cell

# Used instead of a coefficient of friction: both layers have the same velocity at common nodes.
STICKS = -1.0
# Numbers of a layer: P-wave modulus, Pa, density, kg/m^3, area of a surface point, m^(d-1), and from FRICTION on the
# coefficient of friction with each layer.
MODULUS, DENSITY, AREA, FRICTION = range(4)


@dataclass(frozen=True)
class Layers:
    """The layers of nodes of a run, after the `ContactTable` of its scene.

    Attributes:
        count: number of layers; 1 if all bodies share one velocity field or there is a single body.
        shares: whether layer 0 belongs to all bodies without their own layer.
        per_axis: largest number of particles along the edge of a cell, of all bodies with their own layers.
        by_points: whether colliders act at points of their surfaces on the bodies that share a layer.
        numbers: layer of each source.
    """

    count: int
    shares: bool
    per_axis: int
    by_points: bool
    numbers: tuple[int, ...] = field(compare=False)

    @staticmethod
    def of(scene: Scene) -> "Layers":
        """Return the layers of a scene."""
        table = ContactTable(scene)
        own = [source for source in scene.sources if table.separates(source)]
        densest = max((points_per_cell(source, scene.domain.spacing) for source in own), default=1.0)
        per_axis = math.ceil(densest ** (1 / scene.dimension))
        return Layers(max(1, len(table.fields)), table.shares, per_axis, table.by_points, table.numbers)

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
        """Return the coefficient of friction of each pair of layers, (count, count), `STICKS` for sticking pairs."""
        table, result = ContactTable(scene), np.full((self.count, self.count), STICKS)
        for a in range(self.count):
            for b in range(a):
                friction, _ = table.between(a, b)
                result[a, b] = result[b, a] = STICKS if friction is None else friction
        return result

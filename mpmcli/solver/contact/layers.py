"""Which bodies of a scene have velocity fields of their own, and what pairs of them do where they meet."""

import math
from dataclasses import dataclass, field

import numpy as np

from mpmcli.errors import InputError
from mpmcli.scene import Scene
from mpmcli.scene.domain import PERIODIC
from mpmcli.scene.sampling import points_per_cell
from mpmcli.solver.grid.sparse_grid import wants_sparse
from mpmcli.solver.machine.backend import Backend

# A node keeps the numbers of the layers that have mass there in bytes; of more than eight the first are forgotten.
MOST_LAYERS = 255
# In place of a coefficient of friction: the two have one velocity at nodes that both reach.
STICKS = -1.0


@dataclass(frozen=True)
class Layers:
    """The layers of nodes of a run: each body that separates has one, and with it a velocity field.

    Attributes:
        count: of layers, 1 where all bodies share one velocity field, or there is one body.
        shares: whether layer 0 belongs to all bodies that have none of their own.
        per_axis: the most particles of a body with a layer of its own along the edge of a cell.
        numbers: the layer of each source.
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
        """Whether any body has a layer of its own, and meets others, walls and colliders by its surface."""
        return self.count > 1 or not self.shares

    @property
    def pairs(self) -> int:
        """How many pairs of layers there are: (0, 1), (0, 2), (1, 2), (0, 3)..."""
        return math.comb(self.count, 2)

    def has_own(self, source: int) -> bool:
        """Return whether a source has a layer of its own."""
        return self.numbers[source] > 0 or not self.shares

    def frictions(self, scene: Scene) -> np.ndarray:
        """Return the coefficient of friction of each pair of layers, (count, count); `STICKS` for those that stick."""
        result = np.full((self.count, self.count), STICKS)
        for i, one in enumerate(scene.sources):
            for k, other in enumerate(scene.sources[:i]):
                friction = scene.friction_between(one, other)
                if friction is not None:
                    a, c = self.numbers[i], self.numbers[k]
                    result[a, c] = result[c, a] = friction
        return result


def require_contact_possible(scene: Scene, backend: Backend) -> None:
    """Refuse a scene whose bodies separate, and whose grid or backend has one velocity field only.

    Raises:
        InputError: says what the scene or the backend has that contact is not available with.
    """
    layers = Layers.of(scene)
    reasons = {
        f"with --arch {backend.arch}": not backend.doubles,
        "with solver.deterministic = true on a GPU": scene.solver.deterministic and not backend.on_cpu,
        'with solver.solids = "total"': scene.solver.solids == "total",
        "on a sparse grid": wants_sparse(scene),
        "in a domain with periodic walls": any(PERIODIC in pair for pair in scene.domain.walls.faces(scene.dimension)),
        f"for more than {MOST_LAYERS} bodies": layers.count > MOST_LAYERS,
    }
    for reason, applies in reasons.items():
        if applies and layers.separate:
            raise InputError(
                f'bodies that separate are not available {reason}; give contact.default = "stick" and no pairs.'
            )

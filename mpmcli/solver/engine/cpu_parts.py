"""The parts of the phases of a step that threads of the CPU do."""

from collections.abc import Callable
from copy import copy
from typing import NamedTuple

# Numbers of a step: its size and its kick, s, the time over which volumes relax, s, and the largest speed squared.
MOVED, KICK, RELAXED, SPEED, VECTORS = range(5)


class PartKind(NamedTuple):
    """The parts of some phases that have one body.

    name: of the phases; group: number of the group of particles. first, after: number of the first phase, and the
    one after the last. body: name of the method. item: what that does for each node or particle, where it says nothing.
    """

    name: str
    group: int
    first: int
    after: int
    body: str
    item: Callable | None


class Part:
    """A part that a thread does, with the view that its run has of the device.

    Attributes:
        grid, nodes, particles, order, group: see `views`; the last two are those of a group of particles.
        item: what is done for each node or particle; atomic: whether sums need atomics, False.
        g: number of the group; w: of the run; turn: of the phase among those of its kind.
        region, part: of the part; t: of the thread.
        numbers, counts, shown: see `Batch`.
    """

    atomic = False

    def __init__(self, run: tuple, kind: PartKind, *variables: object) -> None:
        """Keep a view, and variables of a kernel."""
        g, self.item = kind.group, kind.item
        self.grid, self.nodes, self.particles, orders, groups = run
        self.g, self.group, self.order = g, groups[g], orders[g] if orders else None
        self.w, self.turn, self.region, self.part, self.t, self.numbers, self.counts, self.shown = variables

    def in_layer(self, layer: object, own: object) -> "Part":
        """Return the part for a layer of nodes, by its number and what it has in use, variables of a kernel."""
        if self.grid.layers == 1:
            return self
        view = copy(self)
        view.grid = self.grid.in_layer(layer, own)
        view.nodes = self.nodes.in_layer(view.grid, layer)
        return view

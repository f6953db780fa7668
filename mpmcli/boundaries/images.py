"""Images of nodes at the faces of the domain: where they are, and sums over them (docs/theory.md, 3.1 and 3.6).

A wall mirrors nodes, a periodic face moves them by a period, an open face gives no images.
"""

from collections.abc import Sequence
from copy import copy

from mpmcli.quick_taichi import ti
from mpmcli.scene.domain import OPEN, PASSED, PERIODIC


@ti.data_oriented
class Images:
    """The images of nodes at some faces, known when kernels are compiled.

    They are those of all walls whatever their condition (`Grid.images`), of walls that act on velocities
    (`walls.Walls`), or of periodic faces alone (`by_period`). A node has an image for each set of axes along which it
    has one. Sets are bit masks: bit i is the image along the i-th of `axes`; 0 is the node itself.

    Attributes:
        faces: per axis, the conditions of the lower and the upper face; OPEN for those without images.
        periodic: the axes of periodic faces.
        mirrors, opens: (axis, side) of every face that mirrors, and of every face without images.
        axes: axes whose faces are considered: those with images, or fewer for nodes that are near no other faces.
        first: index of the node plane of the lower faces; also how far from periodic faces nodes have images, which is
            all of the grid beyond.
        last: per axis, that of the upper faces, a variable of a kernel in the view of a run.
    """

    def __init__(self, faces: Sequence[tuple[str, str]], first: int, last: Sequence[int]) -> None:
        self.dimension, self.first, self.last = len(faces), first, tuple(last)
        self._at(faces)

    def _at(self, faces: Sequence[tuple[str, str]]) -> None:
        self.faces = tuple(tuple(pair) for pair in faces)
        self.periodic = tuple(a for a, pair in enumerate(self.faces) if PERIODIC in pair)
        sides = [(a, side) for a in range(self.dimension) for side in (0, 1)]
        self.mirrors = tuple((a, side) for a, side in sides if self.faces[a][side] not in PASSED)
        self.opens = tuple((a, side) for a, side in sides if self.faces[a][side] == OPEN)
        self.axes = tuple(a for a, pair in enumerate(self.faces) if pair != (OPEN, OPEN))

    @property
    def sets(self) -> int:
        """Number of sets of axes."""
        return 2 ** len(self.axes)

    @property
    def by_period(self) -> "Images":
        """The images at periodic faces alone."""
        images = copy(self)
        images._at([pair if PERIODIC in pair else (OPEN, OPEN) for pair in self.faces])
        return images

    @ti.func
    def image_along(self, j: int, axis: ti.template(), reach: ti.template(), n: ti.template()):
        """Return the image of node j along an axis, or j if it has none, its depth, and 1 for the upper wall.

        The depth counts nodes inwards from a wall, and is negative beyond it. At a periodic face it is 1 inside and -1
        beyond, because no node lies on a wall. It is reach + 1 for a node that is more than `reach` nodes inside, or
        has no image.

        Args:
            n: nodes per cell.
        """
        image, depth, upper = j, reach + 1, 0
        first, last = ti.static(self.first * n), self.last[axis] * n
        if ti.static(axis in self.periodic):
            if j <= 2 * first:
                image, depth = j + last - first, ti.select(j < first, -1, 1)
            elif j >= last - first:
                image, depth = j - last + first, ti.select(j >= last, -1, 1)
        if ti.static((axis, 0) in self.mirrors):
            if j <= first + reach:
                image, depth = 2 * first - j, j - first
        if ti.static((axis, 1) in self.mirrors):
            if j >= last - reach:
                image, depth, upper = 2 * last - j, last - j, 1
        return image, depth, upper

    @ti.func
    def inside_along(self, j: int, axis: ti.template()):
        """Return node j, or the node inside the domain of which it is the image along an axis."""
        image, depth, _ = self.image_along(j, axis, 0, 1)
        return ti.select(depth < 0, image, j)

    @ti.func
    def image(self, node: ti.template(), images: int, reach: ti.template()):
        """Return the image of a node for a set of axes, and whether it exists, for walls up to `reach` nodes away."""
        place, exists = node, True
        for i, a in ti.static(enumerate(self.axes)):
            if images >> i & 1 == 1:
                there, depth, _ = self.image_along(node[a], a, reach, 1)
                place[a] = there
                exists = exists and depth <= reach
        return place, exists

    @ti.func
    def image_from_inside(self, node: ti.template(), images: int):
        """Return the same as `image` for a node inside the domain, and no image for one beyond a face."""
        place, exists = self.image(node, images, 1)
        for a in ti.static(self.axes):
            exists = exists and self.inside_along(node[a], a) == node[a]
        return place, exists

    @ti.func
    def sum(
        self,
        nodes: ti.template(),
        entry: ti.template(),
        grid: ti.template(),
        node: ti.template(),
        reach: ti.template(),
    ):
        """Return the sum of an entry of `nodes`, a field of a grid, over a node and its images.

        A node on a wall, whose cell is half outside, counts twice, at an edge or corner of walls 4 or 8 times.
        """
        total = 0.0
        for images in range(ti.static(self.sets)):
            place, exists = self.image(node, images, reach)
            if exists:
                total += nodes[grid.linear_index(place)][entry]
        return total

    @ti.func
    def share_inside(self, node: ti.template(), spline: ti.template()):
        """Return the share of the kernel of a node that is inside of the walls."""
        share = 1.0
        for a, side in ti.static(self.mirrors):
            beyond = self.last[a] - node[a] if ti.static(side) else node[a] - self.first
            share *= spline.share_below(ti.cast(beyond, float))
        return share

"""The periodic axes of a scene (docs/theory.md, 3.6), for particles; `grid.images` has those of nodes.

On the CPU particles are wrapped into the domain when they are sorted. Until then they continue, and scatter, beyond the
face, so that pencils of one colour write disjoint nodes there too. On a GPU every step wraps them. Nodes beyond a face
hold the sums of their images after `MirrorImages` has folded them.
"""

from collections.abc import Sequence
from copy import copy

import numpy as np

from mpmcli.boundaries.feature import Feature
from mpmcli.boundaries.rows import Rows
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.domain import PERIODIC


@ti.func
def opaque(x: float):
    """Return a non-negative single-precision number unchanged, in a form that compilers cannot simplify.

    The compilers of Vulkan and Metal reorder sums and would replace a rounded sum minus its first term by the second.
    """
    return ti.bit_cast(ti.max(ti.bit_cast(x, ti.i32), 0), ti.f32)


@ti.func
def opaque_signed(x: float):
    size = opaque(ti.abs(x))
    return ti.select(x < 0.0, -size, size)


@ti.data_oriented
class Period(Feature):
    """The periodic axes of all runs, and the extent of the domain of each run.

    Attributes:
        axes: the periodic axes.
        at_once: whether every step wraps particles into the domain.
        run: number of the run of a view.
        extent: size of the domain per run and axis, m.
    """

    def __init__(self, faces: Sequence[tuple[str, str]], runs: int = 1, *, at_once: bool) -> None:
        self.dimension = len(faces)
        self.axes = tuple(a for a, pair in enumerate(faces) if PERIODIC in pair)
        self.at_once = at_once
        self.run = 0
        if self.axes:
            self.extent = ti.Vector.field(self.dimension, float, shape=runs)
            self._rows = Rows(self.extent)

    def write(self, scene: Scene, run: int = 0) -> None:
        if self.axes:
            self._rows.write(run, np.array([scene.domain.cells]) * scene.domain.spacing)

    def viewed(self, view: object) -> "Period":
        return self.seen_from(view.w)

    def seen_from(self, run: object) -> "Period":
        view = copy(self)
        view.run = run
        return view

    @ti.func
    def inside(self, x: ti.template()):
        """Return the image of a point that is inside the domain, m."""
        result = x
        for a in ti.static(self.axes):
            extent = self.extent[self.run][a]
            if x[a] < 0.0:
                result[a] = x[a] + extent
            elif x[a] >= extent:
                result[a] = x[a] - extent
        return result

    @ti.func
    def wrap(self, group: ti.template(), p: int):
        """Wrap particle p into the domain; its remainder takes the rounding error (docs/theory.md, 8.3)."""
        for a in ti.static(self.axes):
            after, lost = self.wrapped(group, group.x[p][a], a)
            group.x[p][a] = after
            if ti.static(group.carries):
                group.gradient[p][a, ti.static(self.dimension)] += lost

    @ti.func
    def wrapped(self, group: ti.template(), x: float, axis: ti.template()):
        """Return a coordinate inside the domain and its rounding error, m, 0 for a point beyond the upper face."""
        extent = self.extent[self.run][axis]
        after, lost = x, 0.0
        if x < 0.0:
            after = x + extent
            if ti.static(group.carries):
                lost = x - (opaque(after) - extent)
        elif x >= extent:
            after = x - extent
        return after, lost

    @ti.func
    def moved(self, group: ti.template(), x: float, way: float, extent: float, axis: ti.template()):
        """Return the new coordinate of a particle moved by `way`, its rounding error, m, and 1 if it is lost, else 0.

        Without `at_once` it is lost if it is more than half of the domain beyond a face; a sort is due long before
        that.
        """
        after, lost = x + way, 0.0
        if ti.static(group.carries):
            lost = way - (opaque_signed(after) - x)
        low = -0.5 * extent
        if ti.static(self.at_once):
            inside, taken = self.wrapped(group, after, axis)
            after = inside
            lost += taken
            low = 0.0
        # In this form the condition also reports a NaN as lost.
        out = 1.0
        if after >= low and after <= extent - low:
            out = 0.0
        return after, lost, out

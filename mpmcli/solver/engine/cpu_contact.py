"""The phases on the CPU in which bodies with velocity fields of their own meet, see `contact.body_contact`."""

from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.obstacles import Obstacles
from mpmcli.solver.engine.cpu_parts import MOVED, Part


@ti.data_oriented
class CpuContact:
    """A part of `CpuPhases`."""

    @ti.func
    def layer_count(self, at: ti.template()):
        """Return the number of layers: one that compilers do not know, as they would repeat what is done for each."""
        count = 1
        if ti.static(self.separates):
            count = self.device.contact.surfaces.count[at.w]
        return count

    @ti.func
    def used_by(self, at: ti.template(), layer: int):
        """Return what a layer has in use, as `Grid.box`."""
        own = ti.Matrix.zero(int, 2, self.dimension)
        if ti.static(self.separates):
            for i, a in ti.static(ti.ndrange(2, self.dimension)):
                own[i, a] = self.device.contact.surfaces.used[(at.w * ti.static(at.grid.layers) + layer) * 2 + i, a]
        return own

    @ti.func
    def near_bodies(self, at: ti.template()):
        """Return the box of the nodes where bodies may meet, as `Grid.box`."""
        box = ti.Matrix.zero(int, 2, self.dimension)
        for i, a in ti.static(ti.ndrange(2, self.dimension)):
            box[i, a] = self.device.contact.surfaces.box[at.w * 2 + i, a]
        return box

    @ti.func
    def rows_near_bodies(self, grid: ti.template(), at: ti.template()):
        """Return the first of a part of the rows of nodes where bodies may meet, and the one after the last."""
        first, after = self.places.even_part(grid.row_count(), at.region)
        return self.share(first, after, at.part)

    @ti.func
    def find_bodies(self, at: ti.template()):
        """Find where two bodies meet."""
        box = self.near_bodies(at)
        grid, obstacles = ti.static((at.grid.within(box), obstacles_of(at)))
        first, after = self.rows_near_bodies(grid, at)
        self.device.contact.surfaces.find_rows(grid, obstacles, at.w, first, after)

    @ti.func
    def show_surface(self, at: ti.template()):
        """Find what particles of the g-th group show."""
        box = self.near_bodies(at)
        (grid,) = ti.static((at.grid.within(box),))
        first, after = self.places.even_part(self.device.contact.surfaces.tile_count(grid, at.w), at.region)
        first, after = self.share(first, after, at.part)
        for q in range(first, after):
            self.device.contact.surfaces.show(at.g, grid, at.w, q)

    @ti.func
    def link_surfaces(self, at: ti.template()):
        """Put what particles show into the bins of their nodes, on one thread, in their order."""
        if at.region == 0 and at.part == 0:
            box = self.near_bodies(at)
            (grid,) = ti.static((at.grid.within(box),))
            for q in range(self.device.contact.surfaces.tile_count(grid, at.w)):
                for g in ti.static(self.device.contact.surfaces.surfaced):
                    self.device.contact.surfaces.link(g, grid, at.w, q)

    @ti.func
    def exchange(self, at: ti.template()):
        """Let bodies that meet at nodes exchange momentum, and walls and colliders push them."""
        box, gravity_step = self.near_bodies(at), self.gravity_step(at.w)
        grid, obstacles = ti.static((at.grid.within(box), obstacles_of(at)))
        first, after = self.rows_near_bodies(grid, at)
        thread = at.w * ti.static(self.regions) + at.t
        self.device.contact.exchange_rows(
            grid, obstacles, at.w, thread, first, after, self.values[at.w, MOVED], gravity_step
        )


def obstacles_of(at: Part) -> Obstacles:
    """Return the walls and colliders of the run of a part."""
    return Obstacles(at.nodes.images.walls, at.nodes.colliders, at.grid.spacing)

"""Regions of a run of a batch whose data stay in the cache of one thread: neighbouring pencils, and the nodes there."""

from mpmcli.quick_taichi import ti
from mpmcli.solver.engine.device import Device
from mpmcli.solver.particles.sort import share_start


@ti.data_oriented
class CpuRegions:
    """The regions of the only run; where there are more runs, each is one region.

    regions: their number.
    """

    def __init__(self, device: Device, regions: int) -> None:
        self.device, self.regions, self.dimension = device, regions, device.grid.dimension
        self.groups = tuple(range(len(device.groups)))
        # Of each region but the last: the first pencil after it, per group, and the first row of nodes after it.
        self.pencils = tuple(ti.field(int, shape=max(regions - 1, 1)) for _ in device.groups)
        self.rows = ti.field(int, shape=max(regions - 1, 1))

    @ti.func
    def even_part(self, count: int, region: int):
        """Return the part of a region in a range of `count`, as its first and the first after it."""
        return share_start(count, region, self.regions), share_start(count, region + 1, self.regions)

    @ti.func
    def rows_of(self, grid: ti.template(), region: int):
        """Return the first row of nodes of a region, and the first after it."""
        first, after = 0, grid.row_count()
        if ti.static(grid.sparse):
            first, after = self.even_part(after, region)
        elif ti.static(self.regions > 1):
            if region > 0:
                first = self.rows[region - 1]
            if region < self.regions - 1:
                after = self.rows[region]
        return first, after

    @ti.func
    def particles_of(self, g: ti.template(), w: int, region: int, count: int):
        """Return the first particle of a region of run w, and the first after it, of `count` of the g-th group."""
        first = w * ti.static(self.device.room[g])
        after = first + count
        if ti.static(self.regions > 1):
            if region > 0:
                first = self.device.orders[g].first_particle_of(self.pencils[g][region - 1])
            if region < self.regions - 1:
                after = self.device.orders[g].first_particle_of(self.pencils[g][region])
        return first, after

    @ti.func
    def pencils_of(self, g: ti.template(), region: int):
        """Return the first pencil of a region for the g-th group, and the first after it."""
        first, after = 0, self.device.orders[g].pencils()
        if ti.static(self.regions > 1):
            if region > 0:
                first = self.pencils[g][region - 1]
            if region < self.regions - 1:
                after = self.pencils[g][region]
        return first, after

    @ti.func
    def divide(self, g: ti.template(), count: int):
        """Divide the `count` particles of a group, which were sorted, with about as many in each region."""
        pencils = self.device.orders[g].pencils()
        region = 0
        for r in range(pencils):
            before = self.device.orders[g].first_particle_of(r)
            size = self.device.orders[g].first_particle_of(r + 1) - before
            # The border falls where more than half of the pencil lies beyond the share.
            while region < self.regions - 1 and before + size // 2 >= share_start(count, region + 1, self.regions):
                self.pencils[g][region] = r
                region += 1
        while region < self.regions - 1:
            self.pencils[g][region] = pencils
            region += 1
        for colour in range(ti.static(self.device.orders[g].colours)):
            self.device.orders[g].work[colour, 0] = 0
            self.device.orders[g].work[colour, self.regions] = self.device.orders[g].pencil_count(colour)
            region = 0
            for q in range(self.device.orders[g].pencil_count(colour)):
                pencil = self.device.orders[g].pencil_of(colour, q)
                while region < self.regions - 1 and pencil >= self.pencils[g][region]:
                    self.device.orders[g].work[colour, region + 1] = q
                    region += 1
            while region < self.regions - 1:
                self.device.orders[g].work[colour, region + 1] = self.device.orders[g].pencil_count(colour)
                region += 1

    @ti.func
    def divide_rows(self):
        """Divide the nodes in use as the particles of the first group are."""
        d = ti.static(self.dimension)
        rows, least = 1, 0
        for a in ti.static(range(d - 1)):
            rows *= self.device.grid.box[1, a]
        for region in range(self.regions - 1):
            rest, row, width = self.pencils[0][region], 0, 1
            for b in ti.static(range(d - 1)):
                a = ti.static(d - 2 - b)
                extent = self.device.grid.box[1, a]
                tile = rest % ti.static(self.device.grid.tiles[a])
                node = tile * ti.static(self.device.grid.tile) - self.device.grid.box[0, a]
                row += width * ti.min(ti.max(node, 0), extent - 1)
                width *= extent
                rest = rest // ti.static(self.device.grid.tiles[a])
            # Behind the last tile along the first axis.
            if rest > 0:
                row = rows
            least = ti.max(least, ti.min(row, rows))
            self.rows[region] = least

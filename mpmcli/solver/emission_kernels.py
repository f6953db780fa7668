"""Lets the sheets of emitters enter in a `Solver`."""

import math
from collections.abc import Sequence

import taichi as ti

from mpmcli.scene import Scene, highest_speed
from mpmcli.solver.activity import Comings, Emission, first_ids
from mpmcli.solver.box import box_of
from mpmcli.solver.kernels import Kernels
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.schedule import Schedule
from mpmcli.solver.splines import PAD


class SolverEmission:
    """The emitters of a scene.

    Attributes:
        schedule: when their sheets enter; slowest: the fastest of them, m/s: the least speed that counts.
        sorts: whether all particles have to be sorted after a sheet has entered.
    """

    def __init__(self, scene: Scene, groups: Sequence[ParticleGroup], kernels: Kernels, counts: Sequence[int]) -> None:
        """Put the mouths on the device; `counts` are the particles of each source."""
        comings = Comings.of(scene, [group.law.name for group in groups])
        emission = Emission(comings, scene.dimension)
        self.slowest = max(highest_speed(emitter) for emitter in scene.emitters)
        self.schedule = Schedule(scene, emission.write(scene, first_ids(scene, counts)))
        self.sorts = not kernels.orders[0].on_cpu
        self._members = [groups[g] for _, g in emission.members]
        build = [_kernels_of(emission, e, groups, kernels) for e in range(len(comings.groups))]
        self._occupied = [occupied for occupied, _ in build]
        self._enter = [enter for _, enter in build]

    def enter(self, time: float) -> None:
        """Let all sheets enter that are due at a time, s, and find room."""
        self.schedule.enter(time, lambda e, late: self._occupied[e](late), self._let_in)

    def _let_in(self, e: int, sheet: int, late: float) -> None:
        self._enter[e](sheet, late)
        if not self.sorts:
            self._members[e].active = int(self._members[e].live[None])


def _kernels_of(emission: Emission, e: int, groups: Sequence[ParticleGroup], kernels: Kernels) -> tuple:
    """Return kernels of an emitter: how many of a sheet find no room, and to let the others enter."""
    g = emission.members[e][1]
    own, order, grid = groups[g], kernels.orders[g], kernels.grid
    members, drift = tuple(groups), math.ceil(kernels.drift_allowed)
    found = ti.field(int, shape=())

    @ti.kernel
    def occupied(late: float) -> int:
        ti.loop_config(serialize=True)
        for _ in range(1):
            emission.clear(e, 0)
        for group in ti.static(members):
            for p in range(group.present()):
                emission.mark(e, 0, late, group.x[p])
        ti.loop_config(serialize=True)
        for _ in range(1):
            found[None] = emission.occupied(e, 0)
        return found[None]

    @ti.kernel
    def enter_behind(sheet: int, late: float):
        ti.loop_config(serialize=True)
        for _ in range(1):
            begin = own.live[None]
            end = emission.enter(e, own, 0, sheet, late, begin, own.count)
            own.live[None] = end
            for p in range(begin, end):
                base = order.first_node_of(p)
                for a in ti.static(range(grid.dimension)):
                    last_wall = ti.static(PAD + grid.cells[a])
                    first, last = box_of(grid, a, base[a], base[a], drift, last_wall)
                    low = ti.min(grid.box[0, a], first)
                    grid.box[1, a] = ti.max(grid.box[0, a] + grid.box[1, a] - 1, last) - low + 1
                    grid.box[0, a] = low

    @ti.kernel
    def enter_anywhere(sheet: int, late: float):
        for p in range(own.count):
            if emission.is_next(e, own, 0, p, sheet):
                emission.begin(e, own, 0, p, late)

    return occupied, enter_behind if order.on_cpu else enter_anywhere

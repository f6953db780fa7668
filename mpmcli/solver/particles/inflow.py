"""Particles that come and go: particles waiting for their emitter, and particles that left through an open face.

Each particle has a status. The sort moves active particles to the front of their group, so that all other loops run
only over these, and retires particles beyond an open face. The particles of a sheet of an emitter wait at the mouth
until the sheet enters. They start in front of the mouth, at the distance that they would have moved since the sheet was
due. On the CPU they then follow the sorted particles and are scattered after them by one thread; on a GPU all particles
are sorted again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mpmcli.boundaries.feature import Feature, Phase
from mpmcli.boundaries.rows import Rows
from mpmcli.frames.frame import ACTIVE, BLOCKED, WAITING
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.domain import OPEN
from mpmcli.scene.entry import varies
from mpmcli.scene.sheets import Sheets, fastest_inflow
from mpmcli.solver.particles.sort import entry_count
from mpmcli.solver.transfer.splines import PAD

# Delay before a layer of which half or more is blocked tries again, as a fraction of the time in which a layer enters.
RETRY = 0.25


@dataclass(frozen=True)
class Inflow:
    """Compile-time constants for particles that come and go; runs with equal values share kernels.

    Attributes:
        groups: per emitter, the index of its law among the laws of the run.
        cells: upper bound of the number of cells of the lattice of a mouth.
        opens: (axis, side) of every open face.
        sheets: upper bound of the number of sheets of an emitter whose rate varies; 0 without any.
    """

    groups: tuple[int, ...] = ()
    cells: int = 0
    opens: tuple[tuple[int, int], ...] = ()
    sheets: int = 0

    @staticmethod
    def of(scene: Scene, laws: Sequence[str], sheets: Sequence[Sheets]) -> "Inflow":
        """Return the constants of a scene; `laws` are the names of the laws in order, `sheets` those of emitters."""
        groups = tuple(laws.index(emitter.material.law) for emitter in scene.emitters)
        pairs = zip(scene.emitters, sheets, strict=True)
        cells = max((one.mouth.filled.size for one in sheets), default=0)
        timed = max((one.count for emitter, one in pairs if varies(emitter.rate)), default=0)
        return Inflow(groups, cells, open_faces(scene.domain.walls.faces(scene.dimension)), timed)

    def with_room_for(self, *others: "Inflow") -> "Inflow":
        """Return it with space for others; the code of varying rates is not that of constant ones."""
        cells, sheets = (max(getattr(one, name) for one in others) for name in ("cells", "sheets"))
        return replace(self, cells=cells, sheets=sheets if self.sheets else 0)

    @property
    def any(self) -> bool:
        return bool(self.groups or self.opens)


def open_faces(faces: Sequence[tuple[str, str]]) -> tuple[tuple[int, int], ...]:
    return tuple((a, side) for a, pair in enumerate(faces) for side in (0, 1) if pair[side] == OPEN)


def first_ids(scene: Scene, counts: Sequence[int]) -> list[int]:
    """Return the id of the first particle of each emitter; `counts` are the numbers of particles of all sources."""
    before = np.concatenate([[0], np.cumsum(counts)])
    return before[len(scene.bodies) : len(scene.bodies) + len(scene.emitters)].tolist()


@ti.data_oriented
class Emission:
    """Mouths of all emitters of some runs, on the device.

    Attributes:
        members: per emitter, its index and that of its law.
        ids: (runs, emitters) Vector: first id, particles per sheet, sheets per layer, and particles of all sheets.
        centre: centre of the mouth relative to the origin of the domain, m.
        axes: axes of the mouth as rows, the first along the flow.
        velocity: largest velocity of emitted particles, m/s.
        spacing, low: spacing and lower bound of the lattice along these axes, m.
        cells: number of cells along these axes, 1 along the flow.
        lead: length of the nozzle, m; `centre` is where particles enter it.
        marks: (runs * emitters, cells) int, whether a cell is occupied.
        stretches: (runs, emitters, sheets), time from a sheet to the next one over that at the largest speed; and
            known: the same on the host.
        sheets: `Inflow.sheets`, at least 1.
    """

    def __init__(self, inflow: Inflow, dimension: int, runs: int = 1) -> None:
        """Allocate the mouths of the emitters of a number of runs; no field is empty."""
        self.members = tuple(enumerate(inflow.groups))
        self.dimension, self.runs, d = dimension, runs, dimension
        n = max(1, len(self.members))
        self.ids = ti.Vector.field(4, int, shape=(runs, n))
        self.centre, self.velocity, self.spacing, self.low = (
            ti.Vector.field(d, float, shape=(runs, n)) for _ in range(4)
        )
        self.axes = ti.Matrix.field(d, d, float, shape=(runs, n))
        self.cells = ti.Vector.field(d, int, shape=(runs, n))
        self.lead = ti.field(float, shape=(runs, n))
        self.marks = ti.field(int, shape=(runs * n, max(1, inflow.cells)))
        self._timed, self.sheets = inflow.sheets > 0, max(1, inflow.sheets)
        self.stretches, self.known = ti.field(float, shape=(runs, n, self.sheets)), np.ones((runs, n, self.sheets))
        own = self.velocity, self.spacing, self.low, self.cells, self.lead, self.stretches
        self._rows = Rows(self.ids, self.centre, self.axes, *own)

    def write(self, scene: Scene, found: Sequence[Sheets], ids: Sequence[int], run: int = 0) -> None:
        """Set the mouths of a run, given the sheets and the first id of each of its emitters."""
        mouths = [sheets.mouth for sheets in found]
        pairs = zip(scene.emitters, mouths, strict=True)
        self.known[run] = 1.0
        for e, (emitter, sheets) in enumerate(zip(scene.emitters, found, strict=True)):
            if varies(emitter.rate):
                self.known[run, e, : sheets.count] = sheets.stretches
        self._rows.write(
            run,
            [[[own, one.size, one.per_layer, one.particles] for own, one in zip(ids, found, strict=True)]],
            [[one.mouth.centre - one.lead * one.mouth.direction - np.array(scene.domain.origin) for one in found]],
            [[np.vstack([mouth.direction, mouth.across]) for mouth in mouths]],
            [[mouth.direction * fastest_inflow(one, scene.time.end) for one, mouth in pairs]],
            [[mouth.spacing for mouth in mouths]],
            [[[-0.5 * mouth.spacing[0], *mouth.low] for mouth in mouths]],
            [[[1, *mouth.counts] for mouth in mouths]],
            [[one.lead for one in found]],
            self.known[run : run + 1],
        )

    @ti.func
    def clear(self, e: ti.template(), run: int):
        for k in range(self.marks.shape[1]):
            self.marks[self.row(e, run), k] = 0

    @ti.func
    def mark(self, e: ti.template(), group: ti.template(), run: int, sheet: int, late: float, p: int):
        """Mark the cell occupied by particle p, for the layer that begins with `sheet`, which was due `late` s ago.

        Particles of the previous layer, except for its first sheet, are left out, because they have not moved far
        enough yet.
        """
        if not self.is_due(e, group, run, p, ti.max(sheet - self.ids[run, e][2] + 1, 0), self.ids[run, e][2]):
            moved = late * self.velocity[run, e] / self.stretch(e, run, sheet)
            index, inside = self.cell_of(e, run, group.x[p] - moved)
            if inside:
                self.marks[self.row(e, run), index] = 1

    @ti.func
    def steer(
        self,
        emitters: ti.template(),
        group: ti.template(),
        p: int,
        kick: float,
        push: ti.template(),
        slope: ti.template(),
    ):
        """Return the acceleration, m/s^2, and its gradient, that keep particles of a nozzle in it at their velocity."""
        run, after, gradient = group.run, push, slope
        v, C = group.motion(p)
        for e in ti.static(emitters):
            along, own = self.along(e, run, group.x[p]), group.id[p] - self.ids[run, e][0]
            # Other material that gets there passes.
            inside = own >= 0 and own < self.ids[run, e][3]
            inside = inside and along[0] >= 0.0 and along[0] < self.lead[run, e]
            for a in ti.static(range(1, self.dimension)):
                width = self.cells[run, e][a] * self.spacing[run, e][a]
                inside = inside and along[a] >= self.low[run, e][a] and along[a] <= self.low[run, e][a] + width
            if inside:
                after = (self.velocity[run, e] - v) / ti.max(kick, 1e-30)
                gradient = -C / ti.max(kick, 1e-30)
        return after, gradient

    @ti.func
    def along(self, e: ti.template(), run: int, x: ti.template()):
        """Return the coordinates of a point along the axes of a mouth, m, from where particles enter."""
        result, away, axes = ti.Vector.zero(float, self.dimension), x - self.centre[run, e], self.axes[run, e]
        for a, c in ti.static(ti.ndrange(self.dimension, self.dimension)):
            result[a] += axes[a, c] * away[c]
        return result

    @ti.func
    def cell_of(self, e: ti.template(), run: int, x: ti.template()):
        """Return the cell of the mouth that contains a point or is nearest to it, and whether it contains the point."""
        inside, index = True, 0
        along, low = self.along(e, run, x), self.low[run, e]
        spacing, cells = self.spacing[run, e], self.cells[run, e]
        for a in ti.static(range(self.dimension)):
            place = ti.floor((along[a] - low[a]) / spacing[a])
            last = ti.cast(cells[a] - 1, float)
            inside = inside and place >= 0.0 and place <= last
            index = index * cells[a] + ti.cast(ti.min(ti.max(place, 0.0), last), int)
        return index, inside

    @ti.func
    def row(self, e: ti.template(), run: int):
        return run * ti.static(max(1, len(self.members))) + e

    @ti.func
    def particles_of(self, e: ti.template(), run: int, sheet: int, sheets: int):
        """Return the number of particles of `sheets` sheets of an emitter from `sheet` on."""
        return ti.min((sheet + sheets) * self.ids[run, e][1], self.ids[run, e][3]) - sheet * self.ids[run, e][1]

    @ti.func
    def is_due(self, e: ti.template(), group: ti.template(), run: int, p: int, sheet: int, sheets: int):
        """Return whether particle p of a group belongs to one of `sheets` sheets of an emitter from `sheet` on."""
        q = group.id[p] - self.ids[run, e][0] - sheet * self.ids[run, e][1]
        return q >= 0 and q < self.particles_of(e, run, sheet, sheets)

    @ti.func
    def keeps_out(self, e: ti.template(), group: ti.template(), run: int, p: int, sheet: int):
        """Return whether particle p belongs to the layer that begins with `sheet` and its cell is occupied."""
        result = self.is_due(e, group, run, p, sheet, self.ids[run, e][2])
        if result:
            index, _ = self.cell_of(e, run, group.x[p])
            result = self.marks[self.row(e, run), index] == 1
        return result

    @ti.func
    def count_blocked(self, e: ti.template(), group: ti.template(), run: int, sheet: int, active: int, after: int):
        """Return the number of blocked particles of the layer that begins with `sheet`; see `enter`."""
        blocked, seen, p = 0, 0, active
        size = self.particles_of(e, run, sheet, self.ids[run, e][2])
        while p < after and seen < size:
            if self.is_due(e, group, run, p, sheet, self.ids[run, e][2]):
                seen += 1
                blocked += ti.cast(self.keeps_out(e, group, run, p, sheet), int)
            p += 1
        return blocked

    @ti.func
    def keep_out(self, e: ti.template(), group: ti.template(), run: int, sheet: int, active: int, after: int):
        """Block the particles of the layer that begins with `sheet` whose cells are occupied, permanently."""
        for p in range(active, after):
            if self.keeps_out(e, group, run, p, sheet):
                group.activity[p] = BLOCKED

    @ti.func
    def stretch(self, e: ti.template(), run: int, sheet: int):
        """Return the time from a sheet to the next one over that at the largest speed."""
        result = 1.0
        if ti.static(self._timed):
            result = self.stretches[run, e, sheet]
        return result

    @ti.func
    def begin(self, e: ti.template(), group: ti.template(), run: int, p: int, late: float):
        """Activate particle p of a sheet that was due `late` s ago, whose velocity it has."""
        group.activity[p] = ACTIVE
        for c in ti.static(range(self.dimension)):
            group.x[p][c] += late * group.v[p][c]

    @ti.func
    def enter(self, e: ti.template(), group: ti.template(), run: int, sheet: int, late: float, active: int, after: int):
        """Activate the waiting particles of a sheet, after the active ones, on one thread; return the new end of these.

        Args:
            sheet: the sheet.
            late: time since it was due, s.
            active: end of the active particles before.
            after: the first particle after those of this run.
        """
        end, p, seen = active, active, 0
        size = self.particles_of(e, run, sheet, 1)
        while p < after and seen < size:
            if self.is_due(e, group, run, p, sheet, 1):
                seen += 1
                if group.activity[p] == WAITING:
                    for field in ti.static(group.moved):
                        swap(field, p, end)
                    self.begin(e, group, run, end, late)
                    end += 1
            p += 1
        return end


@ti.func
def hold(at: ti.template(), node: ti.template(), _kick: float):
    """Give a node in the nozzle of a solid, or beside it within a cell, the velocity of the emitter."""
    emission, grid, h = ti.static((at.features.nozzles.emission, at.grid, at.grid.spacing))
    x = ti.cast(node - PAD, float) * h
    for e in ti.static(at.features.nozzles.emitters):
        along, lead = emission.along(e, at.w, x), emission.lead[at.w, e]
        inside = lead > 0.0 and along[0] > -2.0 * h and along[0] <= lead
        for a in ti.static(range(1, emission.dimension)):
            width = emission.cells[at.w, e][a] * emission.spacing[at.w, e][a]
            beside = along[a] - emission.low[at.w, e][a]
            inside = inside and beside > -h and beside < width + h
        if inside:
            index = grid.linear_index(node)
            for a in ti.static(range(emission.dimension)):
                grid.nodes[index][a] = emission.velocity[at.w, e][a]


@ti.data_oriented
class Nozzles(Feature):
    """The nozzles of the emitters of solids, which hang on the nodes there; see docs/theory.md, 5.2."""

    def __init__(self, emission: Emission, emitters: Sequence[int]) -> None:
        self.emission, self.emitters = emission, tuple(emitters)

    def phases(self, **_how: bool) -> tuple[Phase, ...]:
        return (Phase("hold_nozzles", "nodes", "update", body=hold, words="hold solids in nozzles"),)


@ti.func
def swap(field: ti.template(), p: int, q: int):
    if ti.static(entry_count(field) == 1):
        kept = field[p]
        field[p] = field[q]
        field[q] = kept
    else:
        for e in ti.static(range(entry_count(field))):
            place = ti.static(e if field.m == 1 else (e // field.m, e % field.m))
            kept = field[p][place]
            field[p][place] = field[q][place]
            field[q][place] = kept

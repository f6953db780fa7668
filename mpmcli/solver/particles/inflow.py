"""Particles that come and go: those that wait for their emitter, and those that left through an open face.

Each has a status. The sort moves those that take part to the front of their group, so that all other loops run over
them alone, and retires what lies beyond an open face. The particles of a sheet of an emitter lie at the mouth until it
enters, and begin as far in front of it as they would have moved since they were due. On the CPU they then follow those
that were sorted, and are scattered after them by one thread; on a GPU all are sorted again.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.sheets import Sheets, sheets_of
from mpmcli.solver.particles.sort import ACTIVE, WAITING, entry_count

# Periods after which a sheet of which half or more found its place occupied tries again.
RETRY = 0.25


@dataclass(frozen=True)
class Inflow:
    """What is compiled for particles that come and go; runs for which it is equal share kernels.

    Attributes:
        groups: of each emitter, the number of its law among those of the run.
        cells: of the lattice of the largest mouth, an upper bound.
        opens: (axis, side) of every open face.
    """

    groups: tuple[int, ...] = ()
    cells: int = 0
    opens: tuple[tuple[int, int], ...] = ()

    @staticmethod
    def of(scene: Scene, laws: Sequence[str]) -> "Inflow":
        """Return those of a scene; `laws` are the names of the laws in order."""
        groups = tuple(laws.index(emitter.material.law) for emitter in scene.emitters)
        cells = max((sheets_of(emitter, scene).mouth.filled.size for emitter in scene.emitters), default=0)
        return Inflow(groups, cells, open_faces(scene.domain.walls.faces(scene.dimension)))

    @property
    def any(self) -> bool:
        return bool(self.groups or self.opens)


def open_faces(faces: Sequence[tuple[str, str]]) -> tuple[tuple[int, int], ...]:
    return tuple((a, side) for a, pair in enumerate(faces) for side in (0, 1) if pair[side] == "open")


def first_ids(scene: Scene, counts: Sequence[int]) -> list[int]:
    """Return the id of the first particle of each emitter; `counts` are the particles of all sources."""
    before = np.concatenate([[0], np.cumsum(counts)])
    return before[len(scene.bodies) : len(scene.bodies) + len(scene.emitters)].tolist()


@ti.data_oriented
class Emission:
    """The mouths of all emitters of some runs on the device.

    Attributes:
        members: of each emitter its number and that of its law.
        ids: (runs, emitters) Vector: first id, and particles of a sheet.
        centre: of the mouth from the origin of the domain, m; axes: rows, the first one along the flow; velocity: m/s.
        spacing, low: of the lattice along these axes, m; cells: their number across (1 along the flow).
        places: (runs * emitters, cells) int, the cell of each particle of a sheet; marks: whether a cell is occupied.
    """

    def __init__(self, inflow: Inflow, dimension: int, runs: int = 1) -> None:
        self.members = tuple(enumerate(inflow.groups))
        self.dimension, self.runs, d = dimension, runs, dimension
        n = max(1, len(self.members))
        self.ids = ti.Vector.field(2, int, shape=(runs, n))
        self.centre, self.velocity, self.spacing, self.low = (
            ti.Vector.field(d, float, shape=(runs, n)) for _ in range(4)
        )
        self.axes = ti.Matrix.field(d, d, float, shape=(runs, n))
        self.cells = ti.Vector.field(d, int, shape=(runs, n))
        self.places, self.marks = (ti.field(int, shape=(runs * n, max(1, inflow.cells))) for _ in range(2))

    def write(self, scene: Scene, ids: Sequence[int], run: int = 0) -> list[Sheets]:
        """Set the mouths of a run, whose emitters have these first ids; return their sheets."""
        found = [sheets_of(emitter, scene) for emitter in scene.emitters]
        for e, (sheets, emitter) in enumerate(zip(found, scene.emitters, strict=True)):
            mouth = sheets.mouth
            self.ids[run, e] = [ids[e], len(sheets.places)]
            self.centre[run, e] = (mouth.centre - np.array(scene.domain.origin)).tolist()
            self.axes[run, e] = np.vstack([mouth.direction, mouth.across]).tolist()
            self.velocity[run, e] = list(emitter.velocity)
            self.spacing[run, e] = mouth.spacing.tolist()
            self.low[run, e] = [-0.5 * mouth.spacing[0], *mouth.low.tolist()]
            self.cells[run, e] = [1, *mouth.counts]
            row = np.zeros(self.places.shape[1], np.int32)
            row[: len(sheets.places)] = np.flatnonzero(mouth.filled)
            self._fill(run * max(1, len(self.members)) + e, row)
        return found

    @ti.kernel
    def _fill(self, place: int, row: ti.types.ndarray(ti.i32, 1)):
        for k in range(row.shape[0]):
            self.places[place, k] = row[k]

    @ti.func
    def clear(self, e: ti.template(), run: int):
        for k in range(self.marks.shape[1]):
            self.marks[self.row(e, run), k] = 0

    @ti.func
    def mark(self, e: ti.template(), run: int, late: float, x: ti.template()):
        """Note the cell that a point lies in, of the sheet that was due `late` s ago."""
        d = ti.static(self.dimension)
        inside, index = True, 0
        away = x - self.centre[run, e] - late * self.velocity[run, e]
        axes, low, spacing, cells = self.axes[run, e], self.low[run, e], self.spacing[run, e], self.cells[run, e]
        for a in ti.static(range(d)):
            along = 0.0
            for c in ti.static(range(d)):
                along += axes[a, c] * away[c]
            place = (along - low[a]) / spacing[a]
            if not (place >= 0.0 and place < ti.cast(cells[a], float)):
                inside = False
            if inside:
                index = index * cells[a] + ti.cast(place, int)
        if inside:
            self.marks[self.row(e, run), index] = 1

    @ti.func
    def occupied(self, e: ti.template(), run: int):
        """Return how many particles of the sheet find their cell occupied."""
        found = 0
        for q in range(self.ids[run, e][1]):
            found += self.marks[self.row(e, run), self.places[self.row(e, run), q]]
        return found

    @ti.func
    def row(self, e: ti.template(), run: int):
        return run * ti.static(max(1, len(self.members))) + e

    @ti.func
    def is_next(self, e: ti.template(), group: ti.template(), run: int, p: int, sheet: int):
        """Return whether particle p of a group waits in this sheet, and its cell is free."""
        ids, result = self.ids[run, e], False
        q = group.id[p] - ids[0] - sheet * ids[1]
        if group.activity[p] == WAITING and q >= 0 and q < ids[1]:
            result = self.marks[self.row(e, run), self.places[self.row(e, run), q]] == 0
        return result

    @ti.func
    def begin(self, e: ti.template(), group: ti.template(), run: int, p: int, late: float):
        """Let particle p take part, of a sheet that was due `late` s ago."""
        group.activity[p] = ACTIVE
        velocity = self.velocity[run, e]
        for c in ti.static(range(self.dimension)):
            group.x[p][c] += late * velocity[c]
            group.v[p][c] = velocity[c]

    @ti.func
    def enter(self, e: ti.template(), group: ti.template(), run: int, sheet: int, late: float, active: int, after: int):
        """Let what has room of a sheet enter behind those that take part; return where these end now; on one thread.

        active: where they ended; after: the first particle that is not of this run.
        """
        end, p, last = active, active, active + self.ids[run, e][1] - self.occupied(e, run)
        while p < after and end < last:
            if self.is_next(e, group, run, p, sheet):
                for field in ti.static(group.moved):
                    swap(field, p, end)
                self.begin(e, group, run, end, late)
                end += 1
            p += 1
        return end


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

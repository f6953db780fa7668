"""Particle fields of one law on the device, accessors for kernels, and copies from and to the host."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import KW_ONLY, InitVar, dataclass

import numpy as np

from mpmcli.boundaries.rows import Rows
from mpmcli.materials.law import Law
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.grid.period import Period
from mpmcli.solver.particles.columns import (
    Column,
    column_of,
    columns_of,
    entry_of_field,
    fields_of,
    set_entry,
)

# Particles per launch of a read: with up to 27 numbers each, entries stay within 32-bit indices and need half a
# gigabyte on a GPU.
MOST_READ = 2**22
# Columns that a read returns, before the labels.
READ = ("x", "v", "C", "deformation", "internal")
# Columns of the per-body table: mass, volume, and the first constant of the law.
MASS, VOLUME, CONSTANTS = 0, 1, 2
# Spare numbers after the last field.
SPARE = 16


@ti.data_oriented
@dataclass(eq=False, repr=False)
class ParticleArrays:
    """Fields of the particles of one law, of one or several runs, each with a contiguous range of particles.

    The same entry of neighbouring particles is contiguous in memory, so that a CPU can load and store whole vector
    registers, and a GPU the entries of neighbouring threads at once. A few entries beyond the last particle may be
    read.

    The fields are listed in `columns.fields_of`, each with the attribute that has it.

    Attributes:
        law: the constitutive law.
        capacity: number of particles n.
        table: per body, a row of particle mass, particle volume and the constants of the law; made of these numbers of
            rows and columns.
        layers: number of layers of the grid.
        many_bodies: whether particles have a row of the table each.
        serial: whether loops that copy particles from and to the host run on one thread, as for few particles.
        keeps_initial: whether initial positions are stored, because a force needs them or the group is `total`.
        total: whether the grid is that of the state at rest (total Lagrangian), see `total_solids`.
        uses_f_bar: whether particles of a cell share their change of volume (`transfer.volume`).
        levels: whether they take their mean volume in some steps; `averages`: whether either holds.
        has_wall_friction: whether particles slip on walls with friction.
        particle_count_varies: whether particles are active in a part of the run only.
        known, held: the fields that particles may have, and those that they have.
        moved: the fields that sorts move.
        columns: the columns by name.
        reals, labels: the names of the columns, of real numbers and of integers, that outlive a step.
        internal: the internal variables of the law, (n) each.
        dimension: d.
        carries: whether particles store the rounding error of x, see `ParticleUpdate.moved`; true in single precision.
        evened: whether particles take the mean growth of their cell in G2P, because they change cells: `uses_f_bar` and
            not `total`.
        eased: whether the law of the group `eases`.
        surfaced: whether bodies may have their own layers.
        layer: per row of the table, the layer of nodes of the body.
        force: the forces on the particles, if the group `has_body_force`.
        mouths, emitters: the mouths of emitters, and the indices of those that emit particles of the group.
        run: number of the run of a view.
        kept: per body, the fraction of its motion that it keeps in this step, see `kept_motion`.
        real: NumPy type of real numbers.
    """

    law: Law
    capacity: int
    table: InitVar[tuple[int, int]]
    layers: InitVar[Layers]
    _: KW_ONLY
    many_bodies: bool
    serial: bool
    keeps_initial: bool
    total: bool
    uses_f_bar: bool
    levels: bool
    has_wall_friction: bool
    particle_count_varies: bool

    def __post_init__(self, table: tuple[int, int], layers: Layers) -> None:
        """Allocate the fields and the table."""
        self.dimension = self.law.dimension
        self.real = np.float64 if ti.lang.impl.current_cfg().default_fp == ti.f64 else np.float32
        self.carries, self.eased = self.real == np.float32, bool(self.law.eases)
        self.averages, self.evened = self.uses_f_bar or self.levels, self.uses_f_bar and not self.total
        self.keeps_initial = self.keeps_initial or self.total
        self.layers, self.surfaced = layers.count, layers.separate and self.law.surfaced
        self.known = fields_of(self)
        self.held = {one: one.allocated(self.capacity) for one in self.known if one.present}
        for one in self.known:
            setattr(self, one.attribute, self.held.get(one))
        self.internal = tuple(field for one, field in self.held.items() if one.attribute == "internal")
        self.moved = tuple(self.fields().values())
        self.has_body_force, self.force, self.run = False, None, 0
        self.mouths: object = None
        self.emitters: tuple[int, ...] = ()
        self.repeats = False
        self.period: Period | None = None
        self.table = ti.Vector.field(table[1], float, shape=table[0])
        self.kept = ti.field(float, shape=table[0])
        self.layer = ti.field(int, shape=table[0]) if self.layers > 1 else None
        self.rows = Rows(self.table, *([self.layer] if self.layers > 1 else []))
        # Taichi stores fields one after the other, so that reads beyond the last particle fall into the next fields.
        self.spare = ti.field(float, shape=SPARE)
        self.columns = columns_of(self)
        self.reals, self.labels = self._lasting(float), self._lasting(int)

    @property
    def bytes_by_name(self) -> dict[str, int]:
        """Bytes of each field of a particle."""
        sizes = {float: np.dtype(self.real).itemsize, int: 4}
        return {one.shown or one.name: math.prod(one.shape) * sizes[one.kind] for one in self.held}

    def push_by(self, force: object) -> None:
        self.has_body_force, self.force = True, force

    def pour_from(self, mouths: object, emitters: tuple[int, ...]) -> None:
        self.mouths, self.emitters = mouths, emitters

    @property
    def is_pushed(self) -> bool:
        """Whether forces or nozzles accelerate particles."""
        return self.has_body_force or len(self.emitters) > 0

    def repeat(self, period: Period) -> None:
        self.period, self.repeats = period, len(period.axes) > 0

    def seen_from(self, run: object) -> "ParticleArrays":
        """Return the view for a run; forces are evaluated with its number, a variable of a kernel."""
        view = copy(self)
        view.run = run
        if self.repeats:
            view.period = self.period.seen_from(run)
        return view

    def column(self, name: str) -> Column:
        """Return the column of a name.

        They are the attributes of fields, "place" (the position on the grid), C, "remainder" (of x), "deformation"
        (J - 1 or F - I), "inner" (internal variables), and "row", the row of the table.
        """
        return self.columns[name]

    def distinct(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return some columns without "place" where x, which is the same, is among them."""
        return tuple(name for name in names if name != "place" or self.total or "x" not in names)

    def fields(self) -> dict[str, ti.Field]:
        """Return, by name, all fields that outlive a step."""
        return {one.name: field for one, field in self.held.items() if one.lasts}

    def _lasting(self, kind: type) -> tuple[str, ...]:
        """Return the names of all columns of a kind that outlive a step."""
        lasting = (one for one in self.held if one.lasts and one.kind is kind)
        names = dict.fromkeys(name for one in lasting for name in one.columns or (one.attribute,))
        return tuple(name for name in names if self.columns[name].entries)

    def entries(self, names: Sequence[str]) -> tuple[tuple[ti.Field, tuple[int, ...]], ...]:
        """Return all numbers of some columns, each as a field and the entry of it."""
        return tuple(entry for name in names for entry in self.columns[name].entries)

    @property
    def rest(self) -> np.ndarray:
        """J or F at rest."""
        return np.array(1, self.real) if self.displacement_gradient is None else np.eye(self.dimension, dtype=self.real)

    def read(self, first: int, count: int, bodies: Sequence[int], row: int = 0) -> dict[str, np.ndarray]:
        """Return x, v, C, deformation, internal, (n, k), and id, body and activity, (n), for a range of particles.

        One launch reads all fields, because one per field would dominate the time of a frame of few particles.

        Args:
            first: the first particle.
            count: number of particles.
            bodies: index in the scene of each body of the group.
            row: row of the first of these bodies in the table.
        """
        ends = np.cumsum([len(self.columns[name].entries) for name in READ])
        reals, labels = np.empty((count, ends[-1]), self.real), np.empty((count, len(self.labels)), np.int32)
        for begin in range(0, count, MOST_READ):
            rows = slice(begin, begin + MOST_READ)
            self._read(first + begin, reals[rows], labels[rows])
        parts = zip(READ, np.split(reals, ends[:-1], axis=1), strict=True)
        found = {name: part.reshape(count, *self.columns[name].shape) for name, part in parts}
        found["deformation"] = self.rest + found["deformation"]
        found |= zip(self.labels, labels.T, strict=True)
        found["body"] = np.array(bodies, np.int32)[np.broadcast_to(found.get("body", row), count) - row]
        return found

    def write(self, first: int, found: Mapping[str, np.ndarray], row: np.ndarray) -> None:
        """Set a range of particles from columns by name, those that are not in `found` to 0; table rows to `row`, (n).

        The deformation is J or F, as `read` returns it.
        """
        given = {**found, "deformation": found["deformation"] - self.rest, "body": row}

        def joined(names: Sequence[str], kind: type) -> np.ndarray:
            parts = (np.broadcast_to(given.get(name, 0), (len(row), *self.columns[name].shape)) for name in names)
            return np.concatenate([part.reshape(len(row), -1).astype(kind) for part in parts], axis=1)

        self._write(first, joined(self.reals, self.real), joined(self.labels, np.int32))

    @ti.kernel
    def _read(self, first: int, reals: ti.types.ndarray(), labels: ti.types.ndarray()):
        """Copy the columns READ, and the labels, of particles from `first` on to rows."""
        ti.loop_config(serialize=self.serial)
        for q in range(reals.shape[0]):
            for k, entry in ti.static(enumerate(self.entries(READ))):
                reals[q, k] = entry_of_field(entry, first + q)
            for k, entry in ti.static(enumerate(self.entries(self.labels))):
                labels[q, k] = entry_of_field(entry, first + q)

    @ti.kernel
    def _write(self, first: int, reals: ti.types.ndarray(), labels: ti.types.ndarray()):
        """Set the columns that outlive a step, and the labels, of particles from `first` on from rows."""
        ti.loop_config(serialize=self.serial)
        for q in range(reals.shape[0]):
            for k, entry in ti.static(enumerate(self.entries(self.reals))):
                set_entry(entry, first + q, reals[q, k])
            for k, entry in ti.static(enumerate(self.entries(self.labels))):
                entry[0][first + q] = labels[q, k]

    @ti.func
    def stored(self, p: int):
        """Return J, or F as a d x d matrix, of particle p."""
        return self.whole(self.deformation(p))

    @ti.func
    def whole(self, deformation: ti.template()):
        """Return J or F, given J - 1 or F - I."""
        if ti.static(self.law.deformation == "F"):
            return ti.Matrix.identity(float, self.dimension) + deformation
        else:
            return 1.0 + deformation

    @ti.func
    def inner(self, p: int):
        return column_of(self, "inner", p)

    @ti.func
    def deformation(self, p: int):
        """Return J - 1, or F - I as a d x d matrix, of particle p."""
        return column_of(self, "deformation", p)

    @ti.func
    def store(self, p: int, deformation: ti.template(), inner: ti.template()):
        """Replace J or F of particle p and its internal variables; unchanged values keep all digits."""
        self.change(p, deformation - self.stored(p), inner)

    @ti.func
    def change(self, p: int, change: ti.template(), inner: ti.template()):
        """Add a change to J or F of particle p, and replace its internal variables."""
        if ti.static(self.law.deformation == "F"):
            for i, j in ti.static(ti.ndrange(self.dimension, self.dimension)):
                self.displacement_gradient[p][i, j] += change[i, j]
        else:
            self.J_minus_1[p] += change
        for i in ti.static(range(len(self.internal))):
            self.internal[i][p] = inner[i]

    @ti.func
    def constants(self, p: int):
        return constants_of(self.row(p))

    @ti.func
    def motion(self, p: int):
        """Return the velocity, d, and the affine velocity C, d x d, of particle p."""
        return column_of(self, "v", p), column_of(self, "C", p)

    @ti.func
    def place(self, p: int):
        """Return the position of particle p in the domain, m; on the CPU x may be beyond a periodic face."""
        result = self.x[p]
        if ti.static(self.repeats):
            inside = self.period.inside(result)
            for c in ti.static(range(self.dimension)):
                result[c] = inside[c]
        return result

    @ti.func
    def on_grid(self, p: int):
        return column_of(self, "place", p)

    @ti.func
    def row(self, p: int):
        return self.table[self.row_number(p)]

    @ti.func
    def row_number(self, p: int):
        row = 0
        if ti.static(self.many_bodies):
            row = self.body[p]
        return row

    @ti.func
    def layer_of(self, p: int):
        """Return the layer of nodes of particle p."""
        layer = 0
        if ti.static(self.layers > 1):
            layer = self.layer[self.row_number(p)]
        return layer


@ti.func
def constants_of(row: ti.template()):
    """Return the constants of the law in a row of the table."""
    return ti.Vector([row[CONSTANTS + c] for c in ti.static(range(row.n - CONSTANTS))])

"""The fields of particles of one law on the device, and what kernels read of a particle."""

from copy import copy

import numpy as np
import taichi as ti

from mpmcli.materials.elementary import exp
from mpmcli.materials.law import Law
from mpmcli.solver.particle_exchange import ParticleExchange
from mpmcli.solver.period import Period

# Entries of the per-body table that come before the constants of the law.
MASS, VOLUME, CONSTANTS = 0, 1, 2
# Numbers behind the last field.
SPARE = 16


def gradient_width(dimension: int, precision: str) -> int:
    """Return the numbers in a row of `ParticleArrays.gradient`."""
    return dimension + (precision == "f32")


def _vectors(n: int, count: int) -> ti.MatrixField:
    return ti.Vector.field(n, float, shape=count, layout=ti.Layout.SOA)


def _matrices(rows: int, columns: int, count: int) -> ti.MatrixField:
    return ti.Matrix.field(rows, columns, float, shape=count, layout=ti.Layout.SOA)


@ti.data_oriented
class ParticleArrays(ParticleExchange):
    """Fields of particles of one law, of one run or of several, each of which has a contiguous range.

    The same entry of neighbouring particles lies together in memory, so that a CPU loads and stores as many at once as
    a vector register holds, and a GPU those of neighbouring threads. A few places behind the last particle may be read.

    Attributes:
        law: the constitutive law; capacity: particles n.
        dimension: d.
        x: position relative to the origin of the domain, (n) Vector(d), m.
        v: velocity, (n) Vector(d), m/s.
        gradient: of the velocity, (n) matrix of d rows, 1/s: row a holds dv/dx_a, the transpose of C, and then the
            remainder of x along a, m, where the group `carries` one.
        carries: whether particles carry what rounding takes from x, see `ParticleUpdate.moved`: in single precision.
        displacement_gradient: F - I, (n) matrix d x d; None where the law keeps J.
        J_minus_1: J - 1, (n); None where the law keeps F. Both are stored as the difference from rest: a step adds
            strains of 1e-6 and less, which single precision would round off next to 1.
        internal: the law's internal variables, (n) each.
        id: (n) int, row of the particle in every frame.
        body: (n) int, row of its body in the table; None where `several` is false.
        several: whether particles may belong to more than one body.
        serial: whether loops that copy particles from and to the host run on one thread, which few particles need.
        total: whether the body is on the grid of its state at rest, see `reference_grid`.
        initial: position at the start as x, (n) Vector(d), m, of groups that keep it (`keeps_initial`) for a force, or
            since they are `total`.
        averaged: whether particles of a cell share their change of volume (`volume_average`): then each has its `cell`,
            (n), and `to_mean`, (n), ln J during P2G, and where a frame is read what it lacks to the mean of its cell.
        slip: how far a particle has slipped on the wall that pushes it, (n) Vector(d), m, where there is friction
            (`slips`), see `particle_friction`.
        activity: (n) int, whether each waits, takes part or has left (`solver.activity`); None where all take part
            always (`comes_and_goes` is false).
        force: what acts on the particles of groups that are `pushed`; run: number of the run that a view is for.
        table: per body a row of particle mass, particle volume and the constants of the law.
        real: numpy's type of the real fields.
    """

    def __init__(
        self,
        law: Law,
        dimension: int,
        count: int,
        table: tuple[int, int],
        *,
        several: bool,
        serial: bool,
        keeps_initial: bool = False,
        total: bool = False,
        averaged: bool = False,
        slips: bool = False,
        comes_and_goes: bool = False,
    ) -> None:
        """Allocate.

        Args:
            count: particles n; table: rows and columns of the table.
        """
        self.law = law
        self.dimension = d = dimension
        self.capacity = count
        self.x = _vectors(d, count)
        self.v = _vectors(d, count)
        self.real = np.float64 if ti.lang.impl.current_cfg().default_fp == ti.f64 else np.float32
        self.carries = self.real == np.float32
        self.gradient = _matrices(d, gradient_width(d, "f32" if self.carries else "f64"), count)
        keeps_F = law.deformation == "F"
        self.displacement_gradient = _matrices(d, d, count) if keeps_F else None
        self.J_minus_1 = None if keeps_F else ti.field(float, shape=count)
        self.internal = tuple(ti.field(float, shape=count) for _ in law.internal)
        self.id = ti.field(int, shape=count)
        self.several = several
        self.serial = serial
        self.body = ti.field(int, shape=count) if several else None
        self.total = total
        self.keeps_initial = keeps_initial or total
        self.initial = _vectors(d, count) if self.keeps_initial else None
        self.averaged = averaged
        self.cell, self.to_mean = (ti.field(kind, shape=count) if averaged else None for kind in (int, float))
        self.slips = slips
        self.slip = _vectors(d, count) if slips else None
        self.comes_and_goes = comes_and_goes
        self.activity = ti.field(int, shape=count) if comes_and_goes else None
        self.pushed = False
        self.force = None
        self.period: Period | None = None
        self.repeats = False
        self.run = 0
        self.table = ti.Vector.field(table[1], float, shape=table[0])
        # Taichi lays fields out one after the other: what is read beyond the last particle lies in the next ones.
        self.spare = ti.field(float, shape=SPARE)

    def push_by(self, force: object) -> None:
        """Let a force act on the particles, see `forces.GroupForce`."""
        self.pushed, self.force = True, force

    def repeat(self, period: Period) -> None:
        """Let the domain repeat along the periodic axes, if there are any."""
        self.period, self.repeats = period, len(period.axes) > 0

    def seen_from(self, run: object) -> "ParticleArrays":
        """Return the view that a run has: its number, a variable of a kernel, counts where forces are evaluated."""
        view = copy(self)
        view.run = run
        if self.repeats:
            view.period = self.period.seen_from(run)
        return view

    @property
    def state(self) -> tuple[ti.Field, ...]:
        """Every real field that the sort must move."""
        initial = () if self.initial is None else (self.initial,)
        deformation = self.J_minus_1 if self.displacement_gradient is None else self.displacement_gradient
        slip = (self.slip,) if self.slips else ()
        return (self.x, self.v, self.gradient, deformation, *self.internal, *initial, *slip)

    @property
    def labels(self) -> tuple[ti.Field, ...]:
        """Every integer field that the sort must move."""
        return tuple(label for label in (self.id, self.body, self.activity) if label is not None)

    @property
    def moved(self) -> tuple[ti.Field, ...]:
        """Every field that moves with a particle from place to place."""
        return (*self.state, *self.labels)

    def fields(self) -> dict[str, ti.Field]:
        """Return every field of the particles that changes during a run or is sorted, by name."""
        names = ["position", "velocity", "velocity_gradient", "deformation", *(v.name for v in self.law.internal)]
        initial = ["initial_position"] * self.keeps_initial + ["slip"] * self.slips
        labels = ["id"] + ["body"] * (self.body is not None) + ["activity"] * self.comes_and_goes
        return dict(zip([*names, *initial, *labels], (*self.state, *self.labels), strict=True))

    @ti.func
    def stored(self, p: int):
        """Return J, or F as a d x d matrix, of particle p."""
        if ti.static(self.law.deformation == "F"):
            F = ti.Matrix.identity(float, self.dimension)
            for i in ti.static(range(self.dimension)):
                for j in ti.static(range(self.dimension)):
                    F[i, j] += self.displacement_gradient[p][i, j]
            return F
        else:
            return 1.0 + self.J_minus_1[p]

    @ti.func
    def seen(self, p: int):
        """Return what the law sees of the deformation of particle p, where a frame is read."""
        if ti.static(self.averaged):
            return self.stored(p) * exp(self.to_mean[p] * ti.static(1.0 / self.dimension))
        else:
            return self.stored(p)

    @ti.func
    def inner(self, p: int):
        """Return the internal variables of particle p; one 0 where the law has none."""
        values = ti.Vector.zero(float, ti.static(max(len(self.internal), 1)))
        for i in ti.static(range(len(self.internal))):
            values[i] = self.internal[i][p]
        return values

    @ti.func
    def store(self, p: int, deformation: ti.template(), inner: ti.template()):
        """Replace what particle p stores of its deformation, and its internal variables."""
        # Adds the difference, so that a deformation that the law did not change keeps every digit.
        change = deformation - self.stored(p)
        if ti.static(self.law.deformation == "F"):
            for i in ti.static(range(self.dimension)):
                for j in ti.static(range(self.dimension)):
                    self.displacement_gradient[p][i, j] += change[i, j]
        else:
            self.J_minus_1[p] += change
        for i in ti.static(range(len(self.internal))):
            self.internal[i][p] = inner[i]

    @ti.func
    def constants(self, p: int):
        """Return the constants of the law for particle p."""
        row = self.row(p)
        return ti.Vector([row[CONSTANTS + c] for c in ti.static(range(row.n - CONSTANTS))])

    @ti.func
    def motion(self, p: int):
        """Return the velocity, d, and the affine velocity C, d x d, of particle p."""
        d = ti.static(self.dimension)
        v = ti.Vector.zero(float, d)
        C = ti.Matrix.zero(float, d, d)
        for c in ti.static(range(d)):
            v[c] = self.v[p][c]
            for a in ti.static(range(d)):
                C[c, a] = self.gradient[p][a, c]
        return v, C

    @ti.func
    def place(self, p: int):
        """Return where particle p is in the domain, m: on the CPU one may have left a periodic one since the sort."""
        result = self.x[p]
        if ti.static(self.repeats):
            inside = self.period.inside(result)
            for c in ti.static(range(self.dimension)):
                result[c] = inside[c]
        return result

    @property
    def place_on_grid(self) -> ti.Field:
        """Where particles are on the grid, m."""
        return self.initial if self.total else self.x

    @ti.func
    def on_grid(self, p: int):
        """Return where particle p is on the grid, m."""
        return self.place_on_grid[p]

    @ti.func
    def motion_on_grid(self, p: int):
        """Return the velocity of particle p, and its gradient with respect to places on the grid."""
        v, C = self.motion(p)
        if ti.static(self.total):
            # Entry by entry: Taichi loses matrices that are assigned as a whole here.
            at_rest = C @ self.stored(p)
            for i, j in ti.static(ti.ndrange(self.dimension, self.dimension)):
                C[i, j] = at_rest[i, j]
        return v, C

    @ti.func
    def row(self, p: int):
        """Return the row of the table that particle p reads."""
        row = 0
        if ti.static(self.several):
            row = self.body[p]
        return self.table[row]

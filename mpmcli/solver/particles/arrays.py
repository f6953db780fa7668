"""The fields of particles of one law on the device, what kernels read of them, and copies from and to the host."""

from collections.abc import Sequence
from copy import copy

import numpy as np

from mpmcli.materials.elementary import exp
from mpmcli.materials.law import Law
from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.period import Period

# Particles of a launch that reads them: with up to 27 numbers each, their entries stay within 32-bit indices, and a GPU
# needs half a gigabyte for them.
MOST_READ = 2**22


# Entries of the per-body table that come before the constants of the law.
MASS, VOLUME, CONSTANTS = 0, 1, 2
# Numbers behind the last field.
SPARE = 16


def particle_fields(
    deformation: str,
    internal: Sequence[str],
    dimension: int,
    precision: str,
    *,
    many_bodies: bool,
    keeps_initial: bool = False,
    uses_f_bar: bool = False,
    total: bool = False,
    has_wall_friction: bool = False,
    comes_and_goes: bool = False,
    surfaced: bool = False,
) -> dict[str, tuple[type, int, int]]:
    """Return the fields of particles by name: float or int, rows and columns; options as of `ParticleArrays`."""
    d = dimension
    fields = {"position": (float, d, 1), "velocity": (float, d, 1)}
    # In single precision a column more, see `ParticleArrays.gradient`.
    fields["velocity_gradient"] = (float, d, d + (precision == "f32"))
    if deformation == "F":
        fields["deformation_gradient"] = (float, d, d)
    else:
        fields["volume_ratio"] = (float, 1, 1)
    fields |= {name: (float, 1, 1) for name in internal}
    fields |= {"initial_position": (float, d, 1)} if keeps_initial else {}
    fields |= {"volume_to_mean": (float, 1, 1), "cell": (int, 1, 1)} if uses_f_bar else {}
    fields |= {"volume_growth": (float, 1, 1)} if uses_f_bar and not total else {}
    fields |= {"slip": (float, d, 1)} if has_wall_friction else {}
    fields |= {"surface": (float, d + 1, 1)} if surfaced else {}
    fields |= {"id": (int, 1, 1)} | ({"body": (int, 1, 1)} if many_bodies else {})
    return fields | ({"activity": (int, 1, 1)} if comes_and_goes else {})


def _field(count: int, kind: type, rows: int, columns: int) -> ti.Field:
    if columns > 1:
        return ti.Matrix.field(rows, columns, kind, shape=count, layout=ti.Layout.SOA)
    return ti.field(kind, shape=count) if rows == 1 else ti.Vector.field(rows, kind, shape=count, layout=ti.Layout.SOA)


@ti.data_oriented
class ParticleArrays:
    """Fields of particles of one law, of one run or of several, each of which has a contiguous range.

    The same entry of neighbouring particles lies together in memory, so that a CPU loads and stores as many at once as
    a vector register holds, and a GPU those of neighbouring threads. A few places behind the last particle may be read.

    Attributes:
        law: the constitutive law; capacity: particles n; dimension: d.
        x: position relative to the origin of the domain, (n) Vector(d), m; v: velocity, (n) Vector(d), m/s.
        gradient: of the velocity, (n) matrix of d rows, 1/s: row a holds dv/dx_a, the transpose of C, and then the
            remainder of x along a, m, where the group `carries` one.
        carries: whether particles carry what rounding takes from x, see `ParticleUpdate.moved`: in single precision.
        displacement_gradient: F - I, (n) matrix d x d; None where the law keeps J.
        J_minus_1: J - 1, (n); None where the law keeps F. Both are stored as the difference from rest: a step adds
            strains of 1e-6 and less, which single precision would round off next to 1.
        internal: the law's internal variables, (n) each; id: (n) int, row of the particle in every frame.
        body: (n) int, row of its body in the table; None unless particles may belong to `many_bodies`.
        serial: whether loops that copy particles from and to the host run on one thread, which few particles need.
        total: whether the body is on the grid of its state at rest, see `total_solids`.
        initial: position at the start as x, (n) Vector(d), m, of groups that keep it (`keeps_initial`) for a force, or
            since they are `total`.
        uses_f_bar: whether particles of a cell share their change of volume (`transfer.volume`): then each has its
            `cell`, (n), and `to_mean`, (n), ln J during P2G, and for a frame what it lacks to the mean of its cell.
        growth: by which ln J of such a particle grew in the last step, (n); None unless the group is `evened`: where
            particles change cells they take the mean growth of their cell in G2P.
        slip: how far a particle has slipped on the wall that pushes it, (n) Vector(d), m, where there is friction
            (`has_wall_friction`), see `total_solids`.
        carried: (n) Vector(d + 1), the normal to the nearest face of the body at rest, and the depth below it, m, of
            groups whose bodies may have layers of their own (`surfaced`), see `contact.surfaces`.
        layers: of the grid; layer: per row of the table, the layer of nodes of its body.
        activity: (n) int, whether each waits, takes part or has left (`particles.sort`); None where all take part
            always (`comes_and_goes` is false).
        force: what acts on the particles where the group `has_body_force`; run: number of the run that a view is for.
        table: per body a row of particle mass, particle volume and the constants of the law; kept: per body the share
            that it keeps of its motion in this step, see `kept_motion`; real: numpy's type.
    """

    def __init__(
        self,
        law: Law,
        dimension: int,
        count: int,
        table: tuple[int, int],
        *,
        many_bodies: bool,
        serial: bool,
        keeps_initial: bool = False,
        total: bool = False,
        uses_f_bar: bool = False,
        has_wall_friction: bool = False,
        comes_and_goes: bool = False,
        layers: int = 1,
        surfaced: bool = False,
    ) -> None:
        """Allocate for `count` particles, and a table of these rows and columns."""
        self.law, self.capacity = law, count
        self.dimension = d = dimension
        self.real = np.float64 if ti.lang.impl.current_cfg().default_fp == ti.f64 else np.float32
        self.carries = self.real == np.float32
        self.many_bodies, self.serial, self.total, self.uses_f_bar = many_bodies, serial, total, uses_f_bar
        self.keeps_initial, self.evened = keeps_initial or total, uses_f_bar and not total
        self.has_wall_friction, self.comes_and_goes = has_wall_friction, comes_and_goes
        self.layers, self.surfaced = layers, surfaced
        wanted = particle_fields(
            law.deformation,
            names := [variable.name for variable in law.internal],
            d,
            "f32" if self.carries else "f64",
            many_bodies=many_bodies,
            keeps_initial=self.keeps_initial,
            uses_f_bar=uses_f_bar,
            total=total,
            has_wall_friction=has_wall_friction,
            comes_and_goes=comes_and_goes,
            surfaced=self.surfaced,
        )
        made = {name: _field(count, *shape) for name, shape in wanted.items()}
        self.x, self.v, self.gradient = made["position"], made["velocity"], made["velocity_gradient"]
        self.displacement_gradient, self.J_minus_1 = made.get("deformation_gradient"), made.get("volume_ratio")
        self.internal = tuple(made[name] for name in names)
        self.initial, self.slip, self.carried = (made.get(name) for name in ("initial_position", "slip", "surface"))
        self.cell, self.to_mean, self.growth = (made.get(name) for name in ("cell", "volume_to_mean", "volume_growth"))
        self.id, self.body, self.activity = made["id"], made.get("body"), made.get("activity")
        self.has_body_force, self.force, self.run = False, None, 0
        self.repeats = False
        self.period: Period | None = None
        self.table = ti.Vector.field(table[1], float, shape=table[0])
        self.kept = ti.field(float, shape=table[0])
        self.layer = ti.field(int, shape=table[0]) if layers > 1 else None
        # Taichi lays fields out one after the other: what is read beyond the last particle lies in the next ones.
        self.spare = ti.field(float, shape=SPARE)

    def push_by(self, force: object) -> None:
        self.has_body_force, self.force = True, force

    def repeat(self, period: Period) -> None:
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
        more = tuple(field for field in (self.slip, self.growth, self.carried) if field is not None)
        return (self.x, self.v, self.gradient, deformation, *self.internal, *initial, *more)

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
        initial = (
            ["initial_position"] * self.keeps_initial
            + ["slip"] * self.has_wall_friction
            + ["volume_growth"] * self.evened
        )
        initial += ["surface"] * self.surfaced
        labels = ["id"] + ["body"] * (self.body is not None) + ["activity"] * self.comes_and_goes
        return dict(zip([*names, *initial, *labels], (*self.state, *self.labels), strict=True))

    def read(self, first: int, count: int, bodies: Sequence[int], row: int = 0) -> dict[str, np.ndarray]:
        """Return x, v, C, deformation, internal, (n, k), id and body, (n), of a range of particles.

        All fields by one launch: one per field would take most of the time of a frame of few particles.

        bodies: index in the scene of each body of the group; row: of the first of them in the table.
        """
        d = self.dimension
        widths = {"x": d, "v": d, "C": d * d, "deformation": self._deformation_width, "internal": len(self.internal)}
        reals, labels = np.empty((count, sum(widths.values())), self.real), np.empty((count, 3), np.int32)
        for begin in range(0, count, MOST_READ):
            rows = slice(begin, begin + MOST_READ)
            self._read(first + begin, reals[rows], labels[rows])
        found, end = {}, 0
        for name, width in widths.items():
            found[name] = reals[:, end : end + width]
            end += width
        found["C"] = found["C"].reshape(count, d, d)
        if self.J_minus_1 is None:
            found["deformation"] = np.eye(d, dtype=self.real) + found["deformation"].reshape(count, d, d)
        else:
            found["deformation"] = 1 + found["deformation"].reshape(count)
        found["id"] = labels[:, 0]
        found["body"] = np.array(bodies, np.int32)[labels[:, 1] - row]
        if self.comes_and_goes:
            found["activity"] = labels[:, 2]
        return found

    def write(self, first: int, found: dict[str, np.ndarray], row: np.ndarray) -> None:
        """Set a range of particles to what `read` returned, `initial` beside it, and the `row` of each in the table."""
        count = len(found["x"])
        rest = np.eye(self.dimension) if self.J_minus_1 is None else 1.0
        parts = (found["x"], found["v"], found["C"], found["deformation"] - rest, found["internal"])
        if self.keeps_initial:
            parts = (*parts, found["initial"])
        if self.surfaced:
            parts = (*parts, found["surface"])
        reals = np.concatenate([part.reshape(count, -1).astype(self.real) for part in parts], axis=1)
        labels = np.stack([found["id"], row, np.broadcast_to(found.get("activity", 1), count)], axis=1).astype(np.int32)
        self._write(first, np.ascontiguousarray(reals), np.ascontiguousarray(labels))

    @property
    def _deformation_width(self) -> int:
        return self.dimension**2 if self.J_minus_1 is None else 1

    @ti.kernel
    def _read(self, first: int, reals: ti.types.ndarray(), labels: ti.types.ndarray()):
        ti.loop_config(serialize=self.serial)
        for q in range(reals.shape[0]):
            d = ti.static(self.dimension)
            p = first + q
            for c in ti.static(range(d)):
                reals[q, c] = self.x[p][c]
                reals[q, d + c] = self.v[p][c]
                for a in ti.static(range(d)):
                    reals[q, (2 + c) * d + a] = self.gradient[p][a, c]
            start = ti.static((2 + d) * d)
            if ti.static(self.law.deformation == "F"):
                for i, j in ti.static(ti.ndrange(d, d)):
                    reals[q, start + i * d + j] = self.displacement_gradient[p][i, j]
            else:
                reals[q, start] = self.J_minus_1[p]
            for i in ti.static(range(len(self.internal))):
                reals[q, start + self._deformation_width + i] = self.internal[i][p]
            labels[q, 0] = self.id[p]
            # Every entry is written: a GPU does not get the zeros of the host.
            if ti.static(self.many_bodies):
                labels[q, 1] = self.body[p]
            else:
                labels[q, 1] = 0
            if ti.static(self.comes_and_goes):
                labels[q, 2] = self.activity[p]

    @ti.kernel
    def _write(self, first: int, reals: ti.types.ndarray(), labels: ti.types.ndarray()):
        ti.loop_config(serialize=self.serial)
        for q in range(reals.shape[0]):
            d = ti.static(self.dimension)
            width = ti.static(self.v.n)
            p = first + q
            for c in ti.static(range(d)):
                self.x[p][c] = reals[q, c]
            for c in ti.static(range(width)):
                self.v[p][c] = reals[q, d + c] if ti.static(c < d) else 0.0
            for a, c in ti.static(ti.ndrange(d, self.gradient.m)):
                self.gradient[p][a, c] = reals[q, (2 + c) * d + a] if ti.static(c < d) else 0.0
            start = ti.static((2 + d) * d)
            if ti.static(self.law.deformation == "F"):
                for i, j in ti.static(ti.ndrange(d, width)):
                    if ti.static(j < d):
                        self.displacement_gradient[p][i, j] = reals[q, start + i * d + j]
                    else:
                        self.displacement_gradient[p][i, j] = 0.0
            else:
                self.J_minus_1[p] = reals[q, start]
            for i in ti.static(range(len(self.internal))):
                self.internal[i][p] = reals[q, start + self._deformation_width + i]
            if ti.static(self.keeps_initial):
                for c in ti.static(range(d)):
                    self.initial[p][c] = reals[q, start + self._deformation_width + ti.static(len(self.internal)) + c]
            if ti.static(self.has_wall_friction):
                for c in ti.static(range(d)):
                    self.slip[p][c] = 0.0
            if ti.static(self.evened):
                self.growth[p] = 0.0
            if ti.static(self.surfaced):
                for c in ti.static(range(d + 1)):
                    self.carried[p][c] = reals[q, reals.shape[1] - ti.static(d + 1) + c]
            self.id[p] = labels[q, 0]
            if ti.static(self.many_bodies):
                self.body[p] = labels[q, 1]
            if ti.static(self.comes_and_goes):
                self.activity[p] = labels[q, 2]

    @ti.func
    def stored(self, p: int):
        """Return J, or F as a d x d matrix, of particle p."""
        if ti.static(self.law.deformation == "F"):
            F = ti.Matrix.identity(float, self.dimension)
            for i, j in ti.static(ti.ndrange(self.dimension, self.dimension)):
                F[i, j] += self.displacement_gradient[p][i, j]
            return F
        else:
            return 1.0 + self.J_minus_1[p]

    @ti.func
    def seen(self, p: int):
        """Return what the law sees of the deformation of particle p, where a frame is read."""
        if ti.static(self.uses_f_bar):
            return self.stored(p) * exp(self.to_mean[p] * ti.static(1.0 / self.dimension))
        else:
            return self.stored(p)

    @ti.func
    def inner(self, p: int):
        values = ti.Vector.zero(float, ti.static(max(len(self.internal), 1)))
        for i in ti.static(range(len(self.internal))):
            values[i] = self.internal[i][p]
        return values

    @ti.func
    def deformation(self, p: int):
        """Return J - 1, or F - I as a d x d matrix, of particle p."""
        if ti.static(self.law.deformation == "F"):
            H = ti.Matrix.zero(float, self.dimension, self.dimension)
            for i, j in ti.static(ti.ndrange(self.dimension, self.dimension)):
                H[i, j] = self.displacement_gradient[p][i, j]
            return H
        else:
            return self.J_minus_1[p]

    @ti.func
    def store(self, p: int, deformation: ti.template(), inner: ti.template()):
        """Replace J or F of particle p, and its internal variables; what is unchanged of them keeps every digit."""
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
        row = self.row(p)
        return ti.Vector([row[CONSTANTS + c] for c in ti.static(range(row.n - CONSTANTS))])

    @ti.func
    def motion(self, p: int):
        """Return the velocity, d, and the affine velocity C, d x d, of particle p."""
        d = ti.static(self.dimension)
        v, C = ti.Vector.zero(float, d), ti.Matrix.zero(float, d, d)
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
        return self.initial if self.total else self.x

    @ti.func
    def on_grid(self, p: int):
        return self.place_on_grid[p]

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

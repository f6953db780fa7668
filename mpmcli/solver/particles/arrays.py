"""Particle fields of one law on the device, accessors for kernels, and copies from and to the host."""

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np

from mpmcli.boundaries.rows import Rows
from mpmcli.frames.frame import WAITING
from mpmcli.materials.elementary import exp
from mpmcli.materials.law import Law
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.grid.period import Period

# Particles per launch of a read: with up to 27 numbers each, entries stay within 32-bit indices and need half a
# gigabyte on a GPU.
MOST_READ = 2**22


# Columns of the per-body table: mass, volume, and the first constant of the law.
MASS, VOLUME, CONSTANTS = 0, 1, 2
# Spare numbers after the last field.
SPARE = 16


def _field(count: int, kind: type, rows: int, columns: int) -> ti.Field:
    if columns > 1:
        return ti.Matrix.field(rows, columns, kind, shape=count, layout=ti.Layout.SOA)
    return ti.field(kind, shape=count) if rows == 1 else ti.Vector.field(rows, kind, shape=count, layout=ti.Layout.SOA)


class Column(NamedTuple):
    """What an operation reads or writes of a particle, see `loop`.

    Attributes:
        shape: its shape, () for a number.
        entries: for each of its numbers, row by row, a field and the entry of it; empty for the row of the table.
    """

    shape: tuple[int, ...]
    entries: tuple[tuple[ti.Field, tuple[int, ...]], ...]


@ti.data_oriented
class ParticleArrays:
    """Fields of the particles of one law, of one or several runs, each with a contiguous range of particles.

    The same entry of neighbouring particles is contiguous in memory, so that a CPU can load and store whole vector
    registers, and a GPU the entries of neighbouring threads at once. A few entries beyond the last particle may be
    read.

    Attributes:
        law: the constitutive law.
        capacity: number of particles n.
        bytes_by_name: bytes of each field of a particle.
        dimension: d.
        x: position relative to the origin of the domain, (n) Vector(d), m.
        v: velocity, (n) Vector(d), m/s.
        gradient: velocity gradient, (n) matrix with d rows, 1/s: row a is dv/dx_a (the transpose of C), followed by the
            remainder of x along a, m, if the group `carries` remainders.
        carries: whether particles store the rounding error of x, see `ParticleUpdate.moved`; true in single precision.
        displacement_gradient: F - I, (n) matrix d x d; None if the law stores J.
        J_minus_1: J - 1, (n); None if the law stores F. Both are stored as the difference from rest, because a step
            adds strains of 1e-6 and less, which single precision would lose next to 1.
        internal: the internal variables of the law, (n) each.
        id: (n) int, row of the particle in every frame.
        body: (n) int, row of the body in the table; None unless `many_bodies`.
        serial: whether loops that copy particles from and to the host run on one thread, as for few particles.
        total: whether the grid is that of the state at rest (total Lagrangian), see `total_solids`.
        initial: initial position relative to the origin, (n) Vector(d), m; stored (`keeps_initial`) if a force needs it
            or the group is `total`.
        uses_f_bar: whether particles of a cell share their change of volume (`transfer.volume`).
        levels: whether they take their mean volume in some steps; `averages`: whether either holds.
        cell, to_mean: with `averages`, the cell of each particle, (n), and its ln J during P2G, (n), or for a frame
            the mean of ln J over the cell minus its own.
        growth: growth of ln J in the last step, (n); None unless the group is `evened`.
        evened: whether particles take the mean growth of their cell in G2P, because they change cells: `uses_f_bar` and
            not `total`.
        eased: whether the law of the group `eases`.
        borne: the share of its stress that a particle bears, (n); None unless the group is `eased`, see `easing`.
        slip: slip of a particle on the wall that pushes it, (n) Vector(d), m; stored with friction
            (`has_wall_friction`), see `total_solids`.
        carried: (n) Vector(d + 1), the normal to the nearest face of the body, and the depth below it, m, at rest or,
            if the law projects F, at present; stored in groups whose bodies may have their own layers (`surfaced`), see
            `contact.surfaces`.
        layers: number of layers of the grid.
        layer: per row of the table, the layer of nodes of the body.
        activity: (n) int, status of each particle: waiting, active, retired or blocked (`particles.sort`); None if all
            are always active (`particle_count_varies` is false).
        force: the forces on the particles, if the group `has_body_force`.
        mouths, emitters: the mouths of emitters, and the indices of those that emit particles of the group.
        run: number of the run of a view.
        table: per body, a row of particle mass, particle volume and the constants of the law.
        kept: per body, the fraction of its motion that it keeps in this step, see `kept_motion`.
        real: NumPy type of real numbers.
    """

    def __init__(
        self,
        law: Law,
        count: int,
        table: tuple[int, int],
        layers: Layers,
        *,
        many_bodies: bool,
        serial: bool,
        keeps_initial: bool,
        total: bool,
        uses_f_bar: bool,
        levels: bool,
        has_wall_friction: bool,
        particle_count_varies: bool,
    ) -> None:
        """Allocate fields for `count` particles, and a table with these numbers of rows and columns."""
        self.law, self.capacity, self.dimension = law, count, law.dimension
        self.real = np.float64 if ti.lang.impl.current_cfg().default_fp == ti.f64 else np.float32
        self.carries = self.real == np.float32
        self.many_bodies, self.serial, self.total, self.uses_f_bar = many_bodies, serial, total, uses_f_bar
        self.levels, self.averages = levels, uses_f_bar or levels
        self.keeps_initial, self.evened = keeps_initial or total, uses_f_bar and not total
        self.has_wall_friction, self.particle_count_varies = has_wall_friction, particle_count_varies
        self.eased = bool(law.eases)
        self.layers, self.surfaced = layers.count, layers.separate and law.surfaced
        wanted = self._wanted()
        sizes = {float: np.dtype(self.real).itemsize, int: 4}
        self.bytes_by_name = {name: rows * columns * sizes[kind] for name, (kind, rows, columns) in wanted.items()}
        made = {name: _field(count, *shape) for name, shape in wanted.items()}
        self.x, self.v, self.gradient = made["position"], made["velocity"], made["velocity_gradient"]
        self.displacement_gradient, self.J_minus_1 = made.get("deformation_gradient"), made.get("volume_ratio")
        self.internal = tuple(made[variable.name] for variable in law.internal)
        self.initial, self.slip, self.carried = (made.get(name) for name in ("initial_position", "slip", "surface"))
        self.cell, self.to_mean, self.growth = (made.get(name) for name in ("cell", "volume_to_mean", "volume_growth"))
        self.borne = made.get("borne")
        self.id, self.body, self.activity = made["id"], made.get("body"), made.get("activity")
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

    def _wanted(self) -> dict[str, tuple[type, int, int]]:
        """Return kind (float or int), rows and columns of each field of particles by name."""
        d = self.dimension
        fields = {"position": (float, d, 1), "velocity": (float, d, 1)}
        # One more column in single precision, see `gradient`.
        fields["velocity_gradient"] = (float, d, d + self.carries)
        if self.law.deformation == "F":
            fields["deformation_gradient"] = (float, d, d)
        else:
            fields["volume_ratio"] = (float, 1, 1)
        fields |= {variable.name: (float, 1, 1) for variable in self.law.internal}
        fields |= {"initial_position": (float, d, 1)} if self.keeps_initial else {}
        fields |= {"volume_to_mean": (float, 1, 1), "cell": (int, 1, 1)} if self.averages else {}
        fields |= {"volume_growth": (float, 1, 1)} if self.evened else {}
        fields |= {"borne": (float, 1, 1)} if self.eased else {}
        fields |= {"slip": (float, d, 1)} if self.has_wall_friction else {}
        fields |= {"surface": (float, d + 1, 1)} if self.surfaced else {}
        fields |= {"id": (int, 1, 1)} | ({"body": (int, 1, 1)} if self.many_bodies else {})
        return fields | ({"activity": (int, 1, 1)} if self.particle_count_varies else {})

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

        They are x, "place" (the position on the grid), v, C, "remainder" (of x), "deformation" (J - 1 or F - I),
        "inner" (internal variables), "growth", "borne", and "row", the row of the table.
        """
        d = self.dimension
        along, square, number = tuple(np.ndindex(d)), tuple(np.ndindex(d, d)), ((),)
        changes = self.displacement_gradient, (d, d), square
        found = {
            "x": (self.x, (d,), along),
            "place": (self.place_on_grid, (d,), along),
            "v": (self.v, (d,), along),
            "C": (self.gradient, (d, d), tuple((a, c) for c, a in square)),
            "remainder": (self.gradient, (d,), tuple((c, d) for c in range(d))),
            "deformation": (self.J_minus_1, (), number) if self.displacement_gradient is None else changes,
            "growth": (self.growth, (), number),
            "borne": (self.borne, (), number),
            "row": (None, (self.table.n,), ()),
        }
        if name == "inner":
            return Column((max(len(self.internal), 1),), tuple((one, ()) for one in self.internal))
        field, shape, entries = found[name]
        return Column(shape, tuple((field, entry) for entry in entries))

    def distinct(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return some columns without "place" where x, which is the same, is among them."""
        return tuple(name for name in names if name != "place" or self.total or "x" not in names)

    @property
    def state(self) -> tuple[ti.Field, ...]:
        """All real fields that the sort moves."""
        initial = () if self.initial is None else (self.initial,)
        deformation = self.J_minus_1 if self.displacement_gradient is None else self.displacement_gradient
        more = tuple(field for field in (self.slip, self.growth, self.carried, self.borne) if field is not None)
        return (self.x, self.v, self.gradient, deformation, *self.internal, *initial, *more)

    @property
    def labels(self) -> tuple[ti.Field, ...]:
        """All integer fields that the sort moves."""
        return tuple(label for label in (self.id, self.body, self.activity) if label is not None)

    @property
    def moved(self) -> tuple[ti.Field, ...]:
        """All fields that the sort moves."""
        return (*self.state, *self.labels)

    def fields(self) -> dict[str, ti.Field]:
        """Return, by name, all particle fields that change during a run or are sorted."""
        names = ["position", "velocity", "velocity_gradient", "deformation", *(v.name for v in self.law.internal)]
        initial = (
            ["initial_position"] * self.keeps_initial
            + ["slip"] * self.has_wall_friction
            + ["volume_growth"] * self.evened
        )
        initial += ["surface"] * self.surfaced + ["borne"] * self.eased
        labels = ["id"] + ["body"] * (self.body is not None) + ["activity"] * self.particle_count_varies
        return dict(zip([*names, *initial, *labels], (*self.state, *self.labels), strict=True))

    def read(self, first: int, count: int, bodies: Sequence[int], row: int = 0) -> dict[str, np.ndarray]:
        """Return x, v, C, deformation, internal, (n, k), id and body, (n), for a range of particles.

        One launch reads all fields, because one per field would dominate the time of a frame of few particles.

        Args:
            first: the first particle.
            count: number of particles.
            bodies: index in the scene of each body of the group.
            row: row of the first of these bodies in the table.
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
        if self.particle_count_varies:
            found["activity"] = labels[:, 2]
        return found

    def write(self, first: int, found: dict[str, np.ndarray], row: np.ndarray) -> None:
        """Set a range of particles from the result of `read`, extended by `initial`, and from table rows, (n)."""
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
            # Every entry is written, because a GPU does not receive the zeros of the host.
            if ti.static(self.many_bodies):
                labels[q, 1] = self.body[p]
            else:
                labels[q, 1] = 0
            if ti.static(self.particle_count_varies):
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
            if ti.static(self.eased):
                # A particle that waits enters beside few others.
                share = 1.0
                if labels[q, 2] == WAITING:
                    share = 1.0 / self.law.relief
                self.borne[p] = share
            if ti.static(self.surfaced):
                for c in ti.static(range(d + 1)):
                    self.carried[p][c] = reals[q, reals.shape[1] - ti.static(d + 1) + c]
            self.id[p] = labels[q, 0]
            if ti.static(self.many_bodies):
                self.body[p] = labels[q, 1]
            if ti.static(self.particle_count_varies):
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
    def carry_surface(self, p: int, C: ti.template(), dt: float):
        """Change the normal and the depth of particle p, whose law projects F, to (I + dt C)^-T n and D, over |n|."""
        d = ti.static(self.dimension)
        N = ti.Vector.zero(float, d)
        for c in ti.static(range(d)):
            N[c] = self.carried[p][c]
        n = (ti.Matrix.identity(float, d) + dt * C).inverse().transpose() @ N
        for c in ti.static(range(d)):
            self.carried[p][c] = n[c] / n.norm()
        self.carried[p][d] /= n.norm()

    @ti.func
    def seen(self, p: int):
        """Return the deformation that the law of particle p receives, after `to_mean` was set for a frame."""
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
        """Return the position of particle p in the domain, m; on the CPU x may be beyond a periodic face."""
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

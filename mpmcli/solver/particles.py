"""Particles of one law: their fields on the device, and what each body contributes."""

from collections.abc import Sequence

import numpy as np
import taichi as ti

from mpmcli.materials.law import Law
from mpmcli.scene import BodyParticles

# Entries of the per-body table that come before the constants of the law.
MASS, VOLUME, CONSTANTS = 0, 1, 2


@ti.data_oriented
class ParticleGroup:
    """All particles of one law, contiguous, in the solver's own order.

    Attributes:
        law: the constitutive law.
        bodies: index in the scene of each body of the group.
        several: whether there is more than one.
        count: number of particles n.
        x: position relative to the origin of the domain, (n) Vector(d), m.
        v: velocity, (n) Vector, m/s, as wide as a node of the grid; the first d entries count.
        gradient: of the velocity, (n) matrix of d rows as wide, 1/s: row a holds dv/dx_a, the transpose of C.
        displacement_gradient: F - I, (n) matrix of d rows, each as wide as a node; None where the law keeps J.
        J_minus_1: J - 1, (n); None where the law keeps F. Both are stored as the difference from rest: a step adds
            strains of 1e-6 and less, which single precision would round off next to 1.
        internal: the law's internal variables, (n) each.
        id: (n) int, row of the particle in every frame.
        body: (n) int, place in `bodies`; None where the group has one body.
        real: numpy's type of the real fields.
        initial: position at the start as x, (n) Vector(d), m, of groups that keep it (`keeps_initial`) for a force.
        force: what acts on the particles of groups that are `pushed`.
        table: per body a row of particle mass, particle volume and the constants of the law; `rows` is its host copy.
    """

    def __init__(
        self,
        law: Law,
        bodies: Sequence[int],
        particles: Sequence[BodyParticles],
        first_ids: Sequence[int],
        origin: np.ndarray,
        width: int,
        layout: ti.Layout,
        *,
        keeps_initial: bool = False,
    ) -> None:
        self.law = law
        self.bodies = tuple(bodies)
        self.count = n = sum(len(b.position) for b in particles)
        self.dimension = d = particles[0].position.shape[1]
        self.x = ti.Vector.field(d, float, shape=n, layout=layout)
        self.v = ti.Vector.field(width, float, shape=n, layout=layout)
        self.gradient = ti.Matrix.field(d, width, float, shape=n, layout=layout)
        keeps_F = law.deformation == "F"
        self.displacement_gradient = ti.Matrix.field(d, width, float, shape=n, layout=layout) if keeps_F else None
        self.J_minus_1 = None if keeps_F else ti.field(float, shape=n)
        self.internal = tuple(ti.field(float, shape=n) for _ in law.internal)
        self.id = ti.field(int, shape=n)
        self.several = len(self.bodies) > 1
        self.body = ti.field(int, shape=n) if self.several else None
        self.keeps_initial = keeps_initial
        self.initial = ti.Vector.field(d, float, shape=n, layout=layout) if keeps_initial else None
        self.pushed = False
        self.force = None
        rows = [(b.mass, b.volume, *law.constants(p)) for b, p in zip(particles, law.members, strict=True)]
        self.table = ti.Vector.field(len(rows[0]), float, shape=len(rows))

        self.real = host = np.float64 if ti.lang.impl.current_cfg().default_fp == ti.f64 else np.float32
        self.rows = np.array(rows, dtype=host)
        self.table.from_numpy(self.rows)
        self.x.from_numpy(np.concatenate([b.position - origin for b in particles]).astype(host))
        self.set_motion(np.concatenate([b.velocity for b in particles]), np.concatenate([b.affine for b in particles]))
        if self.initial is not None:
            initial = [b.position if b.initial is None else b.initial for b in particles]
            self.initial.from_numpy((np.concatenate(initial) - origin).astype(host))
        rest = np.ones(1) if law.deformation == "J" else np.eye(d)[None]
        self.set_deformation(
            np.concatenate(
                [np.repeat(rest, len(b.position), 0) if b.deformation is None else b.deformation for b in particles]
            )
        )
        for variable, values in zip(law.internal, self.internal, strict=True):
            values.fill(variable.at_rest)
        ids = [first + np.arange(len(b.position)) for b, first in zip(particles, first_ids, strict=True)]
        self.id.from_numpy(np.concatenate(ids).astype(np.int32))
        if self.body is not None:
            place = [np.full(len(b.position), i) for i, b in enumerate(particles)]
            self.body.from_numpy(np.concatenate(place).astype(np.int32))

    def fields(self) -> dict[str, ti.Field]:
        """Return every field of the particles that changes during a run or is sorted, by name."""
        names = ["position", "velocity", "velocity_gradient", "deformation", *(v.name for v in self.law.internal)]
        initial = ["initial_position"] * self.keeps_initial
        labels = ["id", "body"][: len(self.labels)]
        return dict(zip([*names, *initial, *labels], (*self.state, *self.labels), strict=True))

    @property
    def state(self) -> tuple[ti.Field, ...]:
        """Every real field that the sort must move."""
        initial = () if self.initial is None else (self.initial,)
        deformation = self.J_minus_1 if self.displacement_gradient is None else self.displacement_gradient
        return (self.x, self.v, self.gradient, deformation, *self.internal, *initial)

    @property
    def labels(self) -> tuple[ti.Field, ...]:
        """Every integer field that the sort must move."""
        return (self.id,) if self.body is None else (self.id, self.body)

    def push_by(self, force: object) -> None:
        """Let a force act on the particles, see `forces.GroupForce`."""
        self.pushed, self.force = True, force

    def set_motion(self, velocity: np.ndarray, C: np.ndarray) -> None:
        """Set the velocity, (n, d), and the affine velocity C, (n, d, d), of all particles."""
        d, width = self.dimension, self.v.n
        v = np.zeros((self.count, width), self.real)
        v[:, :d] = velocity
        gradient = np.zeros((self.count, d, width), self.real)
        gradient[:, :, :d] = C.transpose(0, 2, 1)
        self.v.from_numpy(v)
        self.gradient.from_numpy(gradient)

    def to_numpy(self) -> dict[str, np.ndarray]:
        """Return x, v, C, deformation, internal, (n, k), id and body, (n), in the solver's order, by one launch.

        A launch per field would take most of the time of a frame of few particles.
        """
        d, n = self.dimension, self.count
        widths = {"x": d, "v": d, "C": d * d, "deformation": d * d if self.J_minus_1 is None else 1}
        widths["internal"] = len(self.internal)
        reals, labels = np.empty((n, sum(widths.values())), self.real), np.empty((n, 2), np.int32)
        self._copy(reals, labels)
        ends = np.cumsum(list(widths.values()))
        found = {
            name: np.ascontiguousarray(reals[:, end - width : end])
            for (name, width), end in zip(widths.items(), ends, strict=True)
        }
        found["C"] = found["C"].reshape(n, d, d)
        if self.J_minus_1 is None:
            found["deformation"] = np.eye(d, dtype=self.real) + found["deformation"].reshape(n, d, d)
        else:
            found["deformation"] = 1 + found["deformation"].reshape(n)
        found["id"] = np.ascontiguousarray(labels[:, 0])
        found["body"] = np.array(self.bodies, np.int32)[labels[:, 1]]
        return found

    @ti.kernel
    def _copy(self, reals: ti.types.ndarray(), labels: ti.types.ndarray()):
        for p in range(self.count):
            d = ti.static(self.dimension)
            for c in ti.static(range(d)):
                reals[p, c] = self.x[p][c]
                reals[p, d + c] = self.v[p][c]
                for a in ti.static(range(d)):
                    reals[p, (2 + c) * d + a] = self.gradient[p][a, c]
            first = ti.static((2 + d) * d)
            width = ti.static(d * d if self.law.deformation == "F" else 1)
            if ti.static(self.law.deformation == "F"):
                for i, j in ti.static(ti.ndrange(d, d)):
                    reals[p, first + i * d + j] = self.displacement_gradient[p][i, j]
            else:
                reals[p, first] = self.J_minus_1[p]
            for i in ti.static(range(len(self.internal))):
                reals[p, first + width + i] = self.internal[i][p]
            labels[p, 0] = self.id[p]
            # Every entry is written: a GPU does not get the zeros of the host.
            if ti.static(self.several):
                labels[p, 1] = self.body[p]
            else:
                labels[p, 1] = 0

    def motion_to_numpy(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the velocity, (n, d), and the affine velocity C, (n, d, d), in the solver's order."""
        d = self.dimension
        gradient = self.gradient.to_numpy()[:, :, :d]
        return np.ascontiguousarray(self.v.to_numpy()[:, :d]), np.ascontiguousarray(gradient.transpose(0, 2, 1))

    def set_deformation(self, deformation: np.ndarray) -> None:
        """Set J, (n,), or F, (n, d, d), of all particles, in the solver's order."""
        if self.displacement_gradient is None:
            self.J_minus_1.from_numpy((deformation - 1).astype(self.real))
        else:
            values = np.zeros((self.count, self.dimension, self.displacement_gradient.m), self.real)
            values[:, :, : self.dimension] = deformation - np.eye(self.dimension)
            self.displacement_gradient.from_numpy(values)

    def deformation_to_numpy(self) -> np.ndarray:
        """Return J, (n,), or F, (n, d, d), in the solver's order."""
        if self.displacement_gradient is None:
            return 1 + self.J_minus_1.to_numpy()
        values = self.displacement_gradient.to_numpy()
        return np.eye(self.dimension, dtype=self.real) + values[:, :, : self.dimension]

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
    def row(self, p: int):
        """Return the row of the table that particle p reads."""
        place = 0
        if ti.static(self.several):
            place = self.body[p]
        return self.table[place]

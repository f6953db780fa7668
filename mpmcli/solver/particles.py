"""Particles of one law: their fields on the device, and what each body contributes."""

from collections.abc import Sequence

import numpy as np
import taichi as ti

from mpmcli.materials.law import Law
from mpmcli.scene import BodyParticles
from mpmcli.scene.material import MaterialParameters

# Entries of the per-body table that come before the constants of the law.
MASS, VOLUME, CONSTANTS = 0, 1, 2


@ti.data_oriented
class ParticleGroup:
    """All particles of one law, contiguous, in the solver's own order.

    Attributes:
        law: the constitutive law.
        bodies: index in the scene of each body of the group.
        several: whether there is more than one.
        parameters: of each body's material.
        count: number of particles n.
        x: position relative to the origin of the domain, (n) Vector(d), m.
        v: velocity, (n) Vector(d), m/s.
        C: affine velocity, (n) d x d, 1/s.
        deformation: J (n) or F (n) d x d, as the law says.
        id: (n) int, row of the particle in every frame.
        body: (n) int, place in `bodies`; None where the group has one body.
        table: per body a row of particle mass, particle volume and the constants of the law.
    """

    def __init__(
        self,
        law: Law,
        bodies: Sequence[int],
        parameters: Sequence[MaterialParameters],
        particles: Sequence[BodyParticles],
        first_ids: Sequence[int],
        origin: np.ndarray,
        layout: ti.Layout,
    ) -> None:
        self.law = law
        self.bodies = tuple(bodies)
        self.parameters = tuple(parameters)
        self.count = n = sum(len(b.position) for b in particles)
        self.dimension = d = particles[0].position.shape[1]
        self.x = ti.Vector.field(d, float, shape=n, layout=layout)
        self.v = ti.Vector.field(d, float, shape=n, layout=layout)
        self.C = ti.Matrix.field(d, d, float, shape=n, layout=layout)
        if law.deformation == "F":
            self.deformation = ti.Matrix.field(d, d, float, shape=n, layout=layout)
        else:
            self.deformation = ti.field(float, shape=n)
        self.id = ti.field(int, shape=n)
        self.several = len(self.bodies) > 1
        self.body = ti.field(int, shape=n) if self.several else None
        rows = [(b.mass, b.volume, *law.constants(p)) for b, p in zip(particles, parameters, strict=True)]
        self.table = ti.Vector.field(len(rows[0]), float, shape=len(rows))

        real = ti.f64 if ti.lang.impl.current_cfg().default_fp == ti.f64 else ti.f32
        host = np.float64 if real == ti.f64 else np.float32
        self.table.from_numpy(np.array(rows, dtype=host))
        self.x.from_numpy(np.concatenate([b.position - origin for b in particles]).astype(host))
        self.v.from_numpy(np.concatenate([b.velocity for b in particles]).astype(host))
        self.C.from_numpy(np.concatenate([b.affine for b in particles]).astype(host))
        rest = np.ones(n) if law.deformation == "J" else np.tile(np.eye(d), (n, 1, 1))
        self.deformation.from_numpy(rest.astype(host))
        ids = [first + np.arange(len(b.position)) for b, first in zip(particles, first_ids, strict=True)]
        self.id.from_numpy(np.concatenate(ids).astype(np.int32))
        if self.body is not None:
            place = [np.full(len(b.position), i) for i, b in enumerate(particles)]
            self.body.from_numpy(np.concatenate(place).astype(np.int32))

    @property
    def state(self) -> tuple[ti.Field, ...]:
        """Every real field that the sort must move."""
        return (self.x, self.v, self.C, self.deformation)

    @property
    def labels(self) -> tuple[ti.Field, ...]:
        """Every integer field that the sort must move."""
        return (self.id,) if self.body is None else (self.id, self.body)

    @ti.func
    def row(self, p: int):
        """Return the row of the table that particle p reads."""
        place = 0
        if ti.static(self.several):
            place = self.body[p]
        return self.table[place]

    def body_index(self) -> np.ndarray:
        """Return the scene's body index of each particle, (n,) int32, in the solver's order."""
        place = np.zeros(self.count, np.int32) if self.body is None else self.body.to_numpy()
        return np.array(self.bodies, np.int32)[place]

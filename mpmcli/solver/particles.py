"""Particles of one law in one run: their fields on the device, and what each body contributes."""

from collections.abc import Iterator, Sequence

import numpy as np
import taichi as ti

from mpmcli.materials.law import Law
from mpmcli.scene import BodyParticles
from mpmcli.solver.particle_arrays import ParticleArrays

# Particles that the device takes at once.
PART = 2**15


def table_of(law: Law, particles: Sequence[BodyParticles]) -> np.ndarray:
    """Return the rows of `ParticleArrays.table` for the members of a law, (bodies, columns)."""
    return np.array([(b.mass, b.volume, *law.constants(p)) for b, p in zip(particles, law.members, strict=True)])


def initial_states(
    law: Law, particles: Sequence[BodyParticles], first_ids: Sequence[int], origin: np.ndarray
) -> Iterator[tuple[int, dict[str, np.ndarray], np.ndarray]]:
    """Yield the particles of some bodies, PART at a time, which bounds the memory.

    Args:
        first_ids: id of the first particle of each body.
        origin: of the domain, (d,), m.

    Yields:
        The number of those before, and what `ParticleArrays.write` takes; its rows count from the first body.
    """
    rest = np.ones(1) if law.deformation == "J" else np.eye(len(origin))[None]
    at_rest = [float(variable.at_rest) for variable in law.internal]
    before = 0
    for place, (body, first_id) in enumerate(zip(particles, first_ids, strict=True)):
        count = len(body.position)
        for first in range(0, count, PART):
            own = slice(first, min(first + PART, count))
            n = own.stop - first
            position = body.position[own] - origin
            found = {
                "x": position,
                "initial": position if body.initial is None else body.initial[own] - origin,
                "v": body.velocity[own],
                "C": body.affine[own],
                "deformation": np.repeat(rest, n, 0) if body.deformation is None else body.deformation[own],
                "internal": np.tile(at_rest, (n, 1)),
                "id": first_id + np.arange(first, own.stop),
                "activity": 0 if body.waits else 1,
            }
            yield before + first, found, np.full(n, place)
        before += count


@ti.data_oriented
class ParticleGroup(ParticleArrays):
    """All particles of one law in one run, in the solver's own order.

    Attributes:
        bodies: index in the scene of each body of the group.
        first: index of its first particle in the fields; count: number of particles n.
        active: number of those that take part, which come first; live: the same on the device, None where all do.
        floor: the least maxima of a measurement, where particles may come in; None elsewhere.
        rows: host copy of `table`.
    """

    def __init__(
        self,
        law: Law,
        bodies: Sequence[int],
        particles: Sequence[BodyParticles],
        first_ids: Sequence[int],
        origin: np.ndarray,
        *,
        serial: bool,
        keeps_initial: bool = False,
        total: bool = False,
        averaged: bool = False,
        slips: bool = False,
        comes_and_goes: bool = False,
        floor: np.ndarray | None = None,
    ) -> None:
        self.bodies = tuple(bodies)
        self.first, self.count = 0, sum(len(b.position) for b in particles)
        self.active, self.floor = sum(len(b.position) for b in particles if not b.waits), floor
        rows = table_of(law, particles)
        super().__init__(
            law,
            len(origin),
            self.count,
            rows.shape,
            several=len(self.bodies) > 1,
            serial=serial,
            keeps_initial=keeps_initial,
            total=total,
            averaged=averaged,
            slips=slips,
            comes_and_goes=comes_and_goes,
        )
        self.live = ti.field(int, shape=()) if comes_and_goes else None
        if comes_and_goes:
            self.live[None] = self.active
        self.rows = rows.astype(self.real)
        self.table.from_numpy(self.rows)
        for first, found, row in initial_states(law, particles, first_ids, origin):
            self.write(first, found, row)

    @ti.func
    def present(self):
        """Return the number of particles that take part."""
        if ti.static(self.comes_and_goes):
            return self.live[None]
        else:
            return self.count

    def set_active(self, count: int) -> None:
        """Let the first `count` particles take part."""
        self.active = count
        self.live[None] = count

    def set_motion(self, velocity: np.ndarray, C: np.ndarray) -> None:
        """Set the velocity, (n, d), and the affine velocity C, (n, d, d), of all particles."""
        d, width = self.dimension, self.v.n
        v = np.zeros((self.count, width), self.real)
        v[:, :d] = velocity
        gradient = np.zeros((self.count, d, self.gradient.m), self.real)
        gradient[:, :, :d] = C.transpose(0, 2, 1)
        self.v.from_numpy(v)
        self.gradient.from_numpy(gradient)

    def to_numpy(self) -> dict[str, np.ndarray]:
        """Return x, v, C, deformation, internal, (n, k), id and body, (n), in the solver's order."""
        return self.read(0, self.count, self.bodies)

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

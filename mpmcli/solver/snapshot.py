"""Reads the device: frames in the particles' original order, and the conserved quantities of the ledger."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.tensors import determinant
from mpmcli.solver.observe import Observation
from mpmcli.solver.particle_arrays import MASS, VOLUME
from mpmcli.solver.particles import ParticleGroup

# Fields that need the stress of every particle.
STRESSES = ("stress", "pressure")
# Particles whose sums are formed at once, which bounds the memory.
ROWS = 65_536


@dataclass(frozen=True)
class Snapshot:
    """Host copies of one group's state, in the solver's order.

    Attributes:
        x: (n, d) relative to the origin of the domain, m; v: (n, d); C: (n, d, d); deformation: (n) or (n, d, d).
        internal: (n, k), the internal variables of the law.
        id, body: (n) int.
    """

    group: ParticleGroup
    x: np.ndarray
    v: np.ndarray
    C: np.ndarray
    deformation: np.ndarray
    internal: np.ndarray
    id: np.ndarray
    body: np.ndarray

    @cached_property
    def volume_ratio(self) -> np.ndarray:
        """J of each particle as stored, (n,)."""
        return self.deformation if self.deformation.ndim == 1 else determinant(self.deformation)

    def per_body(self, column: int) -> np.ndarray:
        """Return an entry of the group's table for every particle, (n,) float64."""
        return self.group.rows[:, column].astype(np.float64)[np.searchsorted(self.group.bodies, self.body)]


def read_group(group: ParticleGroup) -> Snapshot:
    """Copy one group from the device."""
    return Snapshot(group, **group.to_numpy())


def _full_gradient(deformation: np.ndarray, dimension: int) -> np.ndarray:
    """Return F, (n, d, d); a law that keeps J has the isotropic F of that volume."""
    if deformation.ndim == 3:
        return deformation
    return deformation[:, None, None] ** (1 / dimension) * np.eye(dimension, dtype=deformation.dtype)


def _volume_ratio(snapshot: Snapshot, seen: Observation) -> np.ndarray:
    """Return volume over volume at rest, (n,)."""
    J = seen.deformation if seen.deformation.ndim == 1 else determinant(seen.deformation)
    return snapshot.group.law.total_volume_ratio(J, seen.internal)


def _field(name: str, snapshot: Snapshot, seen: Observation, at_rest: dict[str, float]) -> np.ndarray:
    group = snapshot.group
    match name:
        case "volume_ratio":
            return _volume_ratio(snapshot, seen)
        case "density":
            return snapshot.per_body(MASS) / snapshot.per_body(VOLUME) / _volume_ratio(snapshot, seen)
        case "mass":
            return snapshot.per_body(MASS)
        case "affine":
            return snapshot.C.reshape(group.count, -1)
        case "deformation_gradient":
            return _full_gradient(seen.deformation, group.dimension).reshape(group.count, -1)
        case "stress":
            return (seen.tau / _volume_ratio(snapshot, seen)[:, None, None]).reshape(group.count, 9)
        case "pressure":
            return -np.trace(seen.tau, axis1=1, axis2=2) / (3 * _volume_ratio(snapshot, seen))
    return seen.internal[name] if name in seen.internal else np.full(group.count, at_rest[name])


def build_frame(
    snapshots: Sequence[Snapshot],
    seen: Sequence[Observation],
    fields: Sequence[str],
    origin: np.ndarray,
    position_type: type,
    initial: np.ndarray | None,
    index: int,
    time: float,
    step: int,
) -> Frame:
    """Put the groups together, each particle in the row of its id.

    Args:
        position_type: numpy's of the positions.
        initial: (n, d) positions at the start, m, where the field initial_position is among the fields.
    """
    ids = np.concatenate([s.id for s in snapshots])

    def ordered(parts: Sequence[np.ndarray]) -> np.ndarray:
        joined = np.concatenate(parts)
        result = np.empty_like(joined)
        result[ids] = joined
        return result

    def of_field(name: str) -> np.ndarray:
        if name == "initial_position":
            return initial.astype(position_type)
        return ordered([_field(name, s, o, at_rest).astype(real) for s, o in zip(snapshots, seen, strict=True)])

    # What particles of other laws show of an internal variable.
    at_rest = {variable.name: variable.at_rest for s in snapshots for variable in s.group.law.internal}
    real = snapshots[0].x.dtype
    return Frame(
        index=index,
        time=time,
        step=step,
        position=ordered([(s.x.astype(np.float64) + origin).astype(position_type) for s in snapshots]),
        velocity=ordered([s.v for s in snapshots]),
        body=ordered([s.body for s in snapshots]),
        material=ordered([np.full(len(s.id), m, np.int32) for m, s in enumerate(snapshots)]),
        fields={name: of_field(name) for name in fields if name != "velocity"},
    )


def measure(
    snapshots: Sequence[Snapshot],
    seen: Sequence[Observation],
    gravity: np.ndarray,
    spacing: float,
    dt: float,
    moment: float = 0.25,
) -> dict[str, float | tuple[float, ...]]:
    """Sum what a run conserves; the affine velocity carries energy and angular momentum too (Jiang et al. 2017).

    Leapfrog has its velocities half a step dt (s) before its positions. All energies are taken there, where their sum
    is second order in the step; with the positions as they are it would swing by v dt/2 times the force.

    Args:
        moment: D / h^2, see `stability.transfer_factors.affine_moment`.

    Returns:
        The entries of a `LedgerRow` that belong to the state alone, by name, summed in float64.
    """
    d = len(gravity)
    sums = np.zeros((1 + 2 * d + d * d,) * 2)
    elastic = 0.0
    for s, o in zip(snapshots, seen, strict=True):
        sums += _weighted_products(s)
        elastic += float(s.per_body(VOLUME) @ o.energy.astype(np.float64))
    mass, inertia = sums[0, 0], moment * spacing**2
    x, v, C = slice(1, 1 + d), slice(1 + d, 1 + 2 * d), slice(1 + 2 * d, None)
    linear, by_place, affine = sums[0, v], sums[x, v], sums[0, C].reshape(d, d)
    kinetic = 0.5 * (sums[v, v].trace() + inertia * sums[C, C].trace())
    potential = -((sums[0, x] - 0.5 * dt * linear) @ gravity)
    # The axial vector of C pairs the same indices.
    pairs = [(0, 1)] if d == 2 else [(1, 2), (2, 0), (0, 1)]
    angular = [by_place[a, b] - by_place[b, a] + inertia * (affine[b, a] - affine[a, b]) for a, b in pairs]
    J = [_volume_ratio(s, o) for s, o in zip(snapshots, seen, strict=True)]
    return {
        "mass": float(mass),
        "kinetic": float(kinetic),
        "elastic": elastic,
        "potential": float(potential),
        "linear_momentum": tuple(linear.tolist()),
        "angular_momentum": tuple(map(float, angular)),
        "speed_max": float(np.sqrt(max(float(np.einsum("pc,pc->p", s.v, s.v).max()) for s in snapshots))),
        "volume_ratio_min": float(min(j.min() for j in J)),
        "volume_ratio_max": float(max(j.max() for j in J)),
    }


def _weighted_products(snapshot: Snapshot) -> np.ndarray:
    """Return sum m a a^T over the particles with a = (1, x, v, C), in float64."""
    count, d = snapshot.x.shape
    sums = np.zeros((1 + 2 * d + d * d,) * 2)
    mass = snapshot.per_body(MASS)
    for first in range(0, count, ROWS):
        rows = slice(first, first + ROWS)
        parts = (snapshot.x[rows], snapshot.v[rows], snapshot.C[rows].reshape(-1, d * d))
        a = np.concatenate([np.ones((len(parts[0]), 1)), *parts], axis=1)
        sums += (a * mass[rows, None]).T @ a
    return sums


def ledger_row(sums: dict, time: float, taken: Sequence[tuple[float, float, str]]) -> LedgerRow:
    """Return the row of a frame: what `measure` returned, and the steps (size, Courant number, limit) taken to it."""
    smallest = min(taken, default=(0.0, 0.0, ""))
    return LedgerRow(
        time=time,
        steps=len(taken),
        step_min=smallest[0],
        step_max=max(taken, default=(0.0,))[0],
        limit=smallest[2],
        courant_max=max((courant for _, courant, _ in taken), default=0.0),
        **sums,
    )

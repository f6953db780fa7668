"""Reads the device: frames in the particles' original order, and the conserved quantities of the ledger."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.tensors import determinant
from mpmcli.solver.frame_reader import FrameArrays
from mpmcli.solver.observe import Observation
from mpmcli.solver.particle_arrays import MASS, VOLUME
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.sums import Sums, axis_pairs, ledger_sums

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


def build_arrays(snapshots: Sequence[Snapshot], real: type) -> FrameArrays:
    """Put what every frame has in the order of the ids."""
    count, dimension = sum(len(s.id) for s in snapshots), snapshots[0].x.shape[1]
    arrays = FrameArrays.empty(count, dimension, real)
    for material, s in enumerate(snapshots):
        arrays.x[s.id], arrays.v[s.id] = s.x, s.v
        arrays.labels[s.id, 0], arrays.labels[s.id, 1] = s.body, material
    return arrays


def build_fields(
    snapshots: Sequence[Snapshot], seen: Sequence[Observation], names: Sequence[str], real: type
) -> dict[str, np.ndarray]:
    """Return further fields by name, in the order of the ids."""
    ids = np.concatenate([s.id for s in snapshots])
    # What particles of other laws show of an internal variable.
    at_rest = {variable.name: variable.at_rest for s in snapshots for variable in s.group.law.internal}
    fields = {}
    for name in names:
        joined = np.concatenate(
            [_field(name, s, o, at_rest).astype(real) for s, o in zip(snapshots, seen, strict=True)]
        )
        fields[name] = np.empty_like(joined)
        fields[name][ids] = joined
    return fields


def measure(
    snapshots: Sequence[Snapshot],
    seen: Sequence[Observation],
    gravity: np.ndarray,
    spacing: float,
    dt: float,
    moment: float = 0.25,
) -> dict[str, float | tuple[float, ...]]:
    """Return the entries of a `LedgerRow` that belong to the state alone; see `ledger_sums`."""
    sums = [_sums(s, o) for s, o in zip(snapshots, seen, strict=True)]
    ratios = [_volume_ratio(s, o) for s, o in zip(snapshots, seen, strict=True)]
    return ledger_sums(sums, ratios, gravity, spacing, dt, moment)


def _sums(snapshot: Snapshot, seen: Observation) -> Sums:
    """Sum over the particles of a law, by the products sum m a a^T with a = (1, x, v, C)."""
    count, d = snapshot.x.shape
    products = np.zeros((1 + 2 * d + d * d,) * 2)
    mass = snapshot.per_body(MASS)
    for first in range(0, count, ROWS):
        rows = slice(first, first + ROWS)
        parts = (snapshot.x[rows], snapshot.v[rows], snapshot.C[rows].reshape(-1, d * d))
        a = np.concatenate([np.ones((len(parts[0]), 1)), *parts], axis=1)
        products += (a * mass[rows, None]).T @ a
    x, v, C = slice(1, 1 + d), slice(1 + d, 1 + 2 * d), slice(1 + 2 * d, None)
    turning, affine = products[x, v], products[0, C].reshape(d, d)
    pairs = axis_pairs(d)
    return Sums(
        mass=products[0, 0],
        place=products[0, x],
        momentum=products[0, v],
        motion=products[v, v].trace(),
        affine=products[C, C].trace(),
        turning=np.array([turning[a, b] - turning[b, a] for a, b in pairs]),
        spin=np.array([affine[b, a] - affine[a, b] for a, b in pairs]),
        elastic=float(snapshot.per_body(VOLUME) @ seen.energy.astype(np.float64)),
        speed_squared=float(np.einsum("pc,pc->p", snapshot.v, snapshot.v).max()),
    )


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

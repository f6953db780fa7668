"""Host copies of the particles on a device, for what numpy computes of them: frames of a GPU, and diagnoses."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from mpmcli.materials.tensors import determinant
from mpmcli.solver.frame_arrays import FrameArrays
from mpmcli.solver.observe import Observation
from mpmcli.solver.ordering import ACTIVE
from mpmcli.solver.particle_arrays import MASS, VOLUME
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.sums import Sums, axis_pairs

# Particles whose sums are formed at once, which bounds the memory.
ROWS = 65_536


@dataclass(frozen=True)
class Snapshot:
    """Host copies of one group's state, in the solver's order.

    Attributes:
        x: (n, d) relative to the origin of the domain, m; v: (n, d); C: (n, d, d); deformation: (n) or (n, d, d).
        internal: (n, k), the internal variables of the law.
        id, body: (n) int.
        activity: (n) int, see `solver.activity`; None where all particles take part.
    """

    group: ParticleGroup
    x: np.ndarray
    v: np.ndarray
    C: np.ndarray
    deformation: np.ndarray
    internal: np.ndarray
    id: np.ndarray
    body: np.ndarray
    activity: np.ndarray | None = None

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


def fill(arrays: FrameArrays, snapshots: Sequence[Snapshot], seen: Sequence[Observation], *, by_id: bool) -> list[Sums]:
    """Fill all rows of one time, and return the sums over the particles of each law, as `build_frame_reader` does.

    Args:
        by_id: whether sums are formed in the order of the ids, not in the solver's, which on a GPU differs from run to
            run.
    """
    result = []
    for snapshot, observed in zip(snapshots, seen, strict=True):
        _fill(arrays, snapshot, observed)
        energy = observed.energy
        if by_id:
            order = np.argsort(snapshot.id)
            snapshot, energy = _reordered(snapshot, order), energy[order]
        result.append(_sums(snapshot, energy))
    return result


def _reordered(snapshot: Snapshot, order: np.ndarray) -> Snapshot:
    values = {field.name: getattr(snapshot, field.name) for field in fields(snapshot) if field.name != "group"}
    kept = {name: None if value is None else value[order] for name, value in values.items()}
    return Snapshot(snapshot.group, **kept)


def _fill(arrays: FrameArrays, snapshot: Snapshot, seen: Observation) -> None:
    rows, d, first = snapshot.id, arrays.columns.dimension, arrays.columns.first
    keeps_F = seen.deformation.ndim == 3
    arrays["x"][0, rows], arrays["v"][0, rows], arrays["energy"][0, rows] = snapshot.x, snapshot.v, seen.energy
    arrays["J"][0, rows] = determinant(seen.deformation) if keeps_F else seen.deformation
    for i, values in enumerate(seen.internal.values()):
        arrays["internal"][0, rows, i] = values
    if first["affine"] >= 0:
        arrays["affine"][0, rows] = snapshot.C.reshape(-1, d * d)
    if first["gradient"] >= 0:
        F = seen.deformation if keeps_F else seen.deformation[:, None, None] ** (1 / d) * np.eye(d)
        arrays["gradient"][0, rows] = F.reshape(-1, d * d)
    if first["tau"] >= 0:
        arrays["tau"][0, rows] = seen.tau
    if first["activity"] >= 0:
        arrays["activity"][0, rows] = snapshot.activity


def _sums(snapshot: Snapshot, energy: np.ndarray) -> Sums:
    """Sum over the particles of a law, by the products sum m a a^T with a = (1, x, v, C)."""
    count, d = snapshot.x.shape
    products = np.zeros((1 + 2 * d + d * d,) * 2)
    spins = np.zeros((d, d))
    mass, volume = snapshot.per_body(MASS), snapshot.per_body(VOLUME)
    if snapshot.activity is not None:
        # What waits or has left weighs nothing, and its energy does not count.
        takes_part = snapshot.activity == ACTIVE
        mass, volume = mass * takes_part, volume * takes_part
    for first in range(0, count, ROWS):
        rows = slice(first, first + ROWS)
        C = snapshot.C[rows].astype(np.float64)
        spin = C
        if snapshot.group.total:
            # Nodes lie at F (X_i - X_p) from the particle, and move by C F (X_i - X_p).
            F = snapshot.deformation[rows].astype(np.float64)
            C, spin = C @ F, C @ F @ F.transpose(0, 2, 1)
        spins += np.tensordot(mass[rows], spin, 1)
        parts = (snapshot.x[rows], snapshot.v[rows], C.reshape(-1, d * d))
        a = np.concatenate([np.ones((len(parts[0]), 1)), *parts], axis=1)
        products += (a * mass[rows, None]).T @ a
    x, v, C = slice(1, 1 + d), slice(1 + d, 1 + 2 * d), slice(1 + 2 * d, None)
    turning = products[x, v]
    pairs = axis_pairs(d)
    return Sums(
        mass=products[None, 0, 0],
        place=products[None, 0, x],
        momentum=products[None, 0, v],
        motion=np.array([products[v, v].trace()]),
        affine=np.array([products[C, C].trace()]),
        turning=np.array([[turning[a, b] - turning[b, a] for a, b in pairs]]),
        spin=np.array([[spins[b, a] - spins[a, b] for a, b in pairs]]),
        elastic=np.array([volume @ energy.astype(np.float64)]),
        speed_squared=np.array([np.einsum("pc,pc->p", snapshot.v, snapshot.v).max()], np.float64),
    )

"""What a run of the soak must obey: its energy, its mass, its rest, and the bytes of the run before."""

from collections.abc import Iterator, Sequence
from hashlib import sha256
from itertools import pairwise

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from soak.scenes import TURNING, SoakScene

# Growth of energy without a source, relative to the energy turned over: rounding in single precision.
GROWTH = 1e-3
# Masses are summed in double precision.
MASS = 1e-9
# Drift of the highest particle at rest, in cells.
DRIFT = 0.1


def broken_laws(case: SoakScene, frames: Sequence[Frame], rows: Sequence[LedgerRow]) -> Iterator[str]:
    """Yield a sentence for each law that a run has broken."""
    scene = case.loaded.scene
    if len(frames) != scene.time.frames + 1:
        yield f"{case.name}: {len(frames)} of {scene.time.frames + 1} frames were stored."
        return
    if not all(np.isfinite(array).all() for frame in frames for array in (frame.position, frame.velocity)):
        yield f"{case.name}: a position or a velocity is not a number."
    growth = energy_growth(case, rows)
    if growth > GROWTH:
        yield f"{case.name}: the energy grew by {growth:.2e} of what was turned over, more than {GROWTH:.0e}."
    start = rows[0].mass - (rows[0].emitted_mass or 0.0)
    for row in rows:
        expected = start + (row.emitted_mass or 0.0) - (row.retired_mass or 0.0)
        if abs(row.mass - expected) > MASS * rows[0].mass:
            yield f"{case.name}: the mass at {row.time:.4g} s is {row.mass!r} kg and not {expected!r} kg."
            break
    if case.rest is not None:
        speed = resting_speed(rows)
        if speed > case.rest:
            yield f"{case.name}: a speed in the last quarter is {speed:.2e} m/s, more than {case.rest:.0e} m/s."
        drift = surface_drift(frames) / scene.domain.spacing
        if drift > DRIFT:
            yield f"{case.name}: the surface moved by {drift:.3f} cells in the last quarter, more than {DRIFT} cells."


def energy_growth(case: SoakScene, rows: Sequence[LedgerRow]) -> float:
    """Return the largest rise of the energy above an earlier value, less the work of colliders, over that turned over.

    A collider that turns about its pivot at a constant rate does the work -torque rate dt on the material, where the
    ledger has the torque on the collider as the mean between two frames.
    """
    if not case.energy:
        return 0.0
    energy = np.array([row.energy for row in rows])
    if case.energy == "driven":
        work = [-TURNING * now.collider_torque[0][0] * (now.time - before.time) for before, now in pairwise(rows)]
        energy = energy - np.concatenate([[0.0], np.cumsum(work)])
    parts = [np.array([getattr(row, name) for row in rows]) for name in ("kinetic", "elastic", "potential")]
    turned_over = max(np.ptp(part) for part in parts) + 1e-4 * max(np.abs(part).max() for part in parts)
    return float(np.max(energy - np.minimum.accumulate(energy)) / turned_over)


def resting_speed(rows: Sequence[LedgerRow]) -> float:
    """Return the largest speed in the last quarter, m/s."""
    return max(row.speed_max for row in rows[-len(rows) // 4 :])


def surface_drift(frames: Sequence[Frame]) -> float:
    """Return how far the highest particle moves in the last quarter, m."""
    heights = [float(frame.position[:, -1].max()) for frame in frames[-len(frames) // 4 :]]
    return max(heights) - min(heights)


def digest(frames: Sequence[Frame], rows: Sequence[LedgerRow]) -> str:
    """Return SHA-256 of all numbers of a run."""
    found = sha256(repr(rows).encode())
    for frame in frames:
        for array in (frame.position, frame.velocity, *frame.fields.values()):
            found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()

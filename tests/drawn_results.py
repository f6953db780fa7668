"""Results made by hand, of particles whose place on a picture is known."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scenes import body

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output import Result, SegmentStore, open_result

WATER = {"law": "fluid", "density": 1000.0, "viscosity": 0.001}
JELLY = {"law": "neo_hookean", "density": 1020.0, "youngs_modulus": 5e4, "poissons_ratio": 0.45}


def row(time: float, d: int) -> LedgerRow:
    """A ledger's row of particles at rest."""
    zeros = (0.0,) * 8
    return LedgerRow(time, 1, 1e-3, 1e-3, "wave", *zeros, (0.0,) * d, (0.0,) * (2 * d - 3))


def header(
    size: Sequence[float],
    spacing: float,
    materials: Sequence[dict[str, Any]],
    colliders: Sequence[dict[str, Any]] = (),
    **more: Any,
) -> dict[str, Any]:
    """The header of a run with one body of each material, "body 0", "body 1", ..., and with colliders."""
    d = len(size)
    names = [f"body {k}" for k in range(len(materials))]
    box = {"box": {"min": [0.0] * d, "max": [float(length) for length in size]}}
    scene = {
        "title": "Drawn by hand",
        "domain": {"size": list(size), "spacing": spacing, "gravity": [*[0.0] * (d - 1), -9.81]},
        "time": {"end": 1.0, "frames": 10},
        "bodies": [
            body(name, material, box, particles_per_cell=2**d) for name, material in zip(names, materials, strict=True)
        ],
    }
    if colliders:
        scene["colliders"] = list(colliders)
    laws = sorted({material["law"] for material in materials})
    facts = {
        "title": scene["title"], "dimension": d, "spacing": spacing, "origin": [0.0] * d, "size": list(size),
        "bodies": names, "materials": laws,
        "laws": [{"deformation": "J" if law == "fluid" else "F", "coherent": False} for law in laws],
        "precision": "f32", "scene": tomli_w.dumps(scene),
    }  # fmt: skip
    return {**facts, **more}


def frame(
    k: int, position: np.ndarray, body: np.ndarray | int = 0, velocity: np.ndarray | None = None, **fields: np.ndarray
) -> Frame:
    """Frame k, at t = k/100 s."""
    position = np.asarray(position, dtype=np.float32)
    n = len(position)
    still = np.zeros_like(position)
    return Frame(
        index=k,
        time=0.01 * k,
        step=10 * k,
        position=position,
        velocity=still if velocity is None else np.asarray(velocity, dtype=np.float32),
        body=np.full(n, body, dtype=np.int32) if np.isscalar(body) else np.asarray(body, dtype=np.int32),
        material=np.zeros(n, dtype=np.int32),
        fields={name: np.asarray(values, dtype=np.float32) for name, values in fields.items()},
    )


def write(directory: Path, facts: dict[str, Any], frames: Sequence[Frame], *, finish: bool = True) -> Result:
    """Store frames as a run does, and open the result."""
    store = SegmentStore(directory, facts)
    for entry in frames:
        store.write(entry, row(entry.time, facts["dimension"]))
    if finish:
        store.finish()
    return open_result(directory)


def lattice(low: Sequence[float], high: Sequence[float], distance: float) -> np.ndarray:
    """Particles in the middle of cells of this size that fill a box."""
    lines = [np.arange(a + distance / 2, b, distance) for a, b in zip(low, high, strict=True)]
    return np.stack([axis.ravel() for axis in np.meshgrid(*lines, indexing="ij")], axis=1)

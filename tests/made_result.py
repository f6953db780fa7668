"""Results that no solver made: two bodies in free fall, one of which meets the floor, by closed forms."""

from pathlib import Path
from unittest import mock

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output import SegmentStore

GRAVITY = 9.81
MASS, STEP, PAUSE = 2.0, 0.002, 0.02
LIMITS = ("wave", "speed", "viscosity")
SCENE = """\
title = "Two that fall"
domain = {{ size = [{size}], spacing = 0.05, gravity = [{gravity}] }}
time = {{ end = 0.1, frames = 5 }}
{more}
"""


def made_header(dimension: int, *, driven: bool = False) -> dict:
    """Return the header of the run; the floor is at 0 of the last axis, and the domain has 1 m along each."""
    gravity = ", ".join(["0.0"] * (dimension - 1) + [f"-{GRAVITY}"])
    more = '[[forces]]\nacceleration = ["1.0"]' if driven else ""
    return {
        "title": "Two that fall", "dimension": dimension, "spacing": 0.05, "origin": [0.0] * dimension,
        "size": [1.0] * dimension, "bodies": ["left", "right"], "materials": ["fluid"],
        "laws": [{"deformation": "J", "coherent": False, "projects": False}], "precision": "f32",
        "scene": SCENE.format(more=more, size=", ".join(["1.0"] * dimension), gravity=gravity),
    }  # fmt: skip


def made_frame(k: int, dimension: int) -> Frame:
    """Return four particles of two bodies that fall from rest; those on the right lie on the floor."""
    position = np.full((4, dimension), 0.5)
    position[:, 0] = (0.1, 0.2, 0.7, 0.9)
    velocity = np.zeros((4, dimension))
    position[:2, -1] = 0.8 - GRAVITY * (k * PAUSE) ** 2 / 2
    velocity[:2, -1] = -GRAVITY * k * PAUSE
    position[2:, -1] = 0.05
    body = np.array([0, 0, 1, 1], np.int32)
    still = np.zeros(4, np.int32)
    position, velocity = position.astype(np.float32), velocity.astype(np.float32)
    return Frame(k, k * PAUSE, 10 * k, position, velocity, body, still)


def made_row(k: int, dimension: int, **changes: object) -> LedgerRow:
    """Return the row of a frame, with other values if given: half of the mass falls freely, half lies."""
    time = k * PAUSE
    # Velocities are those of the middle of the last step.
    speed = GRAVITY * max(time - STEP / 2, 0.0)
    momentum = (*[0.0] * (dimension - 1), -MASS / 2 * speed)
    values = {
        "time": time, "steps": 10 if k else 0, "step_min": STEP * (0.9 if k == 2 else 1.0) if k else 0.0,
        "step_max": STEP * (1.1 if k == 2 else 1.0) if k else 0.0, "limit": LIMITS[k % len(LIMITS)] if k else "",
        "speed_max": speed, "courant_max": 0.01 * k, "volume_ratio_min": 1.0 - 0.01 * k,
        "volume_ratio_max": 1.0 + 0.02 * k, "mass": MASS, "kinetic": MASS / 4 * speed**2, "elastic": 0.1 * k,
        "potential": 20.0 - MASS / 4 * (GRAVITY * time) ** 2, "linear_momentum": momentum,
        "angular_momentum": (0.3 * k,) if dimension == 2 else (0.1 * k, 0.2 * k, 0.3 * k),
    }  # fmt: skip
    return LedgerRow(**(values | changes))


def write_made(
    directory: Path,
    form: str = "packed",
    *,
    dimension: int = 2,
    frames: int = 6,
    driven: bool = False,
    changes: dict[int, dict[str, object]] | None = None,
) -> Path:
    """Store the run as "packed" or "segments", with other values in some rows, and return the directory."""
    header, hold = made_header(dimension, driven=driven), np.inf if form == "packed" else 0.0
    store = SegmentStore(directory, header, hold=hold)
    # Nothing of it needs to outlive a power cut.
    with mock.patch("os.fsync"):
        for k in range(frames):
            store.write(made_frame(k, dimension), made_row(k, dimension, **(changes or {}).get(k, {})))
        if form != "segments":
            store.finish()
    return directory

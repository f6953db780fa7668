"""Set-ups that the hard cases share: scenes in few words, runs of them, and what is read from them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scenes import scene_of

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import start_backend, stop_backend

GRAVITY = 9.81


def scene(
    bodies: Sequence[dict],
    cells: Sequence[int],
    spacing: float,
    *,
    gravity: float = 0.0,
    origin: float = 0.0,
    fields: Sequence[str] = ("velocity", "volume_ratio", "affine"),
    **keys: object,
) -> Scene:
    """Return a scene of these cells, gravity (m/s^2) downwards and the lower corner at `origin` on each axis."""
    d = len(cells)
    return scene_of(
        *bodies,
        domain={"cells": cells, "spacing": spacing, "gravity": [0.0] * (d - 1) + [-gravity], "origin": [origin] * d},
        fields=list(fields),
        contact={},
        **keys,
    )


def start(asked: Scene, particles: list[BodyParticles] | None = None) -> Run:
    """Return a run on a backend of its own, one thread of the CPU; earlier runs die."""
    stop_backend()
    return build_run(asked, start_backend("cpu", 1, asked.solver.precision), particles)


def sound(frame: Frame, row: LedgerRow) -> bool:
    """Return whether every number of a frame is finite."""
    arrays = [frame.position, frame.velocity, *frame.fields.values()]
    return all(np.isfinite(values).all() for values in arrays) and bool(np.isfinite(row.energy))


@dataclass(frozen=True)
class Record:
    """A run to its end, or to the error that stopped it: all frames, their ledger rows, and whether all are finite."""

    frames: list[Frame]
    rows: list[LedgerRow]
    sound: bool
    stopped: UnstableRunError | None

    @property
    def energy(self) -> np.ndarray:
        """Total energy of each frame, J."""
        return np.array([row.energy for row in self.rows])

    @property
    def ratios(self) -> tuple[float, float]:
        """Smallest and largest volume ratio of the run."""
        return min(row.volume_ratio_min for row in self.rows), max(row.volume_ratio_max for row in self.rows)

    @property
    def last(self) -> Frame:
        """The last frame."""
        return self.frames[-1]


def run(run: Run) -> Record:
    """Let a run go on to its end."""
    frames, rows, fine, stopped = [], [], True, None
    try:
        for frame, row in run.frames():
            frames.append(frame)
            rows.append(row)
            fine = fine and sound(frame, row)
    except UnstableRunError as error:
        stopped = error
    return Record(frames, rows, fine, stopped)


def with_springs(rows: Sequence[LedgerRow]) -> np.ndarray:
    """Return the energy of rows, J, with that of the springs of contact, which is not in the sum."""
    return np.array([row.energy for row in rows]) - np.cumsum([row.contact_work or 0.0 for row in rows])


def growth(energy: np.ndarray) -> float:
    """Return the largest rise of an energy above what it was at any time before."""
    return float((energy - np.minimum.accumulate(energy)).max())


def nearest(position: np.ndarray) -> np.ndarray:
    """Return the distance from each particle to its nearest neighbour, (n,); for some thousands of particles."""
    return np.array([np.sort(((position - x) ** 2).sum(1))[1] for x in position]) ** 0.5

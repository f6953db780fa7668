"""Frames of trajectories as those of a run, for what draws results."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from mpmcli.dataset.dataset import Trajectory
from mpmcli.frames.ledger import Ledger
from mpmcli.output.layout import POSITION, STANDARD, FrameIndex, FrameLayout
from mpmcli.output.result import Result
from mpmcli.scene.colliders import Collider


class TrajectoryFrames(Result):
    """Some frames of trajectories of a dataset, with the header of the first; fields are those common to all."""

    kind = "packed"

    def __init__(self, path: Path, frames: Sequence[tuple[Trajectory, int]], numbers: Sequence[int]) -> None:
        """Take frames, each of a trajectory and its index in that; `numbers` are their numbers here."""
        self._frames = frames
        self._trajectories = list({id(each): each for each, _ in frames}.values())
        layouts, first = [each.layout() for each in self._trajectories], self._trajectories[0]
        ledgers = {id(each): each.ledger for each in self._trajectories}
        names = dict.fromkeys((POSITION, *STANDARD, *layouts[0].arrays))
        common = [name for name in names if all(name in each.arrays for each in layouts)]
        index = FrameIndex(
            FrameLayout(first.header.dimension, {name: layouts[0].arrays[name] for name in common}),
            first.header.stored,
            np.array([each.times[k] for each, k in frames]),
            np.array(numbers),
            np.array([each.steps[k] for each, k in frames]),
            np.zeros(len(frames), np.int64),
            np.array([each.particle_count for each, _ in frames]),
            Ledger(ledgers[id(each)][k] for each, k in frames),
        )
        super().__init__(path, index)

    @cached_property
    def colliders(self) -> tuple[Collider, ...]:
        """The colliders of all trajectories."""
        return tuple(collider for each in self._trajectories for collider in each.colliders)

    def _read(self, k: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Return arrays of the k-th frame in the form in a file."""
        trajectory, frame = self._frames[k]
        stored = {}
        for name in names:
            if name == "id":
                array = np.arange(trajectory.particle_count)
            elif name in ("body", "material"):
                array = trajectory.read(name)
            else:
                array = trajectory.read("position" if name == POSITION else name, slice(frame, frame + 1))[0]
            stored[name] = self.index.layout.arrays[name].pad(array)
        return stored

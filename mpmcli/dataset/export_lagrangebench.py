"""Export for LagrangeBench: train.h5, valid.h5 and test.h5, as its class H5Dataset reads them.

Source: github.com/tumaer/lagrangebench, lagrangebench/data/data.py, utils.py (NodeType) and
data_gen/lagrangebench_data/gen_dataset.py. Trajectory k of a split is the group f"{k:05d}" with `position`,
(T, N, d) float32, and `particle_type`, (N,) int64; all have the same T.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpmcli.dataset.facts import (
    by_split,
    learning_facts,
    notes_on_domains,
    particle_types,
    require_alike,
    type_numbers,
    wall_types,
)
from mpmcli.dataset.thinned import ThinnedTrajectory
from mpmcli.output.durable import ask_for

FORM = "LagrangeBench"
# Its own types are 0 fluid, 1 solid wall, 2 moving wall, 3 rigid body, -1 padding, out of 9.
USUAL = {"fluid": 0, "sand": 4, "viscoplastic": 5, "snow": 6, "von_mises": 7, "fixed_corotated": 8}
FREE = (8, 7, 6, 5, 4)
WALL, MOVING_WALL = 1, 2


def check(trajectories: Sequence[ThinnedTrajectory]) -> None:
    """Refuse what the format cannot hold.

    Raises:
        InputError: as `require_alike` and `type_numbers`.
    """
    require_alike(trajectories, FORM)
    type_numbers(trajectories, USUAL, FREE, FORM)


def size(trajectories: Sequence[ThinnedTrajectory]) -> int:
    """Return the bytes of the files before compression."""
    return sum(each.whole_count * (4 * each.layout.dimension * each.frame_count + 8) for each in trajectories)


def write(
    directory: Path, trajectories: Sequence[ThinnedTrajectory], tick: Callable[[], None]
) -> tuple[dict[str, Any], list[str]]:
    """Write the files, and return their part of the metadata, and notes."""
    types = type_numbers(trajectories, USUAL, FREE, FORM)
    statistics, notes = learning_facts(trajectories)
    splits, left_out = by_split(trajectories, ".h5")
    for name, chosen in splits.items():
        ask_for(directory / name, size(chosen))
        with h5py.File(directory / name, "w") as file:
            for k, each in enumerate(chosen):
                _write_trajectory(file.create_group(f"{k:05d}"), each, types)
                tick()
    # As there, the frame that only serves as the last target does not count.
    length = trajectories[0].frame_count - 1
    facts = {
        "solver": "MPM",
        "case": trajectories[0].source.header.title,
        "sequence_length_train": length,
        "sequence_length_test": length,
        "particle_types": types | wall_types(trajectories, WALL, MOVING_WALL),
        **statistics,
    }
    return facts, [*notes, *left_out, *notes_on_domains(trajectories)]


def _write_trajectory(group: h5py.Group, trajectory: ThinnedTrajectory, types: dict[str, int]) -> None:
    shape = (trajectory.frame_count, trajectory.whole_count, trajectory.layout.dimension)
    # Loaders read windows of some frames: a chunk is one.
    position = group.create_dataset("position", shape, np.float32, chunks=(1, *shape[1:]), compression="gzip")
    first = 0
    for block in trajectory.whole_blocks():
        position[first : first + len(block)] = block
        first += len(block)
    group.create_dataset("particle_type", data=particle_types(trajectory, types, WALL, MOVING_WALL))

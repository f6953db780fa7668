"""Export as results: one temporal VTKHDF file for each trajectory, as `mpmcli simulate` packs it."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.dataset.shard import LABELS, group_name
from mpmcli.dataset.thinned import ThinnedTrajectory
from mpmcli.errors import InputError
from mpmcli.output.durable import ask_for
from mpmcli.output.layout import POSITION
from mpmcli.output.vtkhdf import VtkhdfWriter
from mpmcli.output.vtkhdf_parts import file_size


def check(trajectories: Sequence[ThinnedTrajectory]) -> None:
    """Refuse particles on walls: a result holds those of bodies.

    Raises:
        InputError: there are some.
    """
    if any(each.walls.walls != "none" for each in trajectories):
        raise InputError("--walls is for learners and numpy: mpmcli render draws the colliders of a vtkhdf itself.")


def size(trajectories: Sequence[ThinnedTrajectory]) -> int:
    """Return the bytes of the files."""
    return sum(file_size(each.layout, [each.particle_count] * each.frame_count) for each in trajectories)


def write(
    directory: Path, trajectories: Sequence[ThinnedTrajectory], tick: Callable[[], None]
) -> tuple[dict[str, Any], list[str]]:
    """Write the files, and return their part of the metadata, and notes."""
    for each in trajectories:
        _write_trajectory(directory / f"{group_name(each.source.number)}.vtkhdf", each)
        tick()
    thinned = any(
        (e.particle_count, e.frame_count) != (e.source.particle_count, e.source.frame_count) for e in trajectories
    )
    note = "The headers and ledgers stay those of the whole runs: mpmcli check finds frames or particles missing."
    return {}, [note] if thinned else []


def _write_trajectory(path: Path, trajectory: ThinnedTrajectory) -> None:
    n, frames, layout = trajectory.particle_count, trajectory.frame_count, trajectory.layout
    # The same for all frames.
    fixed = {name: trajectory.label(name) for name in LABELS} | {"id": np.arange(n, dtype=layout.arrays["id"].dtype)}
    ask_for(path, file_size(layout, [n] * frames))
    with VtkhdfWriter(path, layout, [n] * frames) as writer:
        for name, array in layout.arrays.items():
            if name in fixed:
                for _ in range(frames):
                    writer.append(name, array.pad(fixed[name]))
                continue
            for block in trajectory.blocks("position" if name == POSITION else name):
                joined = block.reshape(len(block) * n, *block.shape[2:])
                writer.append(name, array.pad(joined))
        header = trajectory.source.header.stored
        writer.finish(trajectory.times, trajectory.frames, trajectory.steps, trajectory.ledger(), header)

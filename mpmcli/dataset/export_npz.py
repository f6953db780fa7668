"""Export as plain arrays: one compressed .npz for each trajectory, which numpy reads without pickles."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.dataset.facts import LEAST_FRAMES, learning_facts
from mpmcli.dataset.npz_file import write_npz
from mpmcli.dataset.shard import LABELS, MOVING, group_name
from mpmcli.dataset.thinned import ThinnedTrajectory


def check(trajectories: Sequence[ThinnedTrajectory]) -> None:
    """Refuse nothing: trajectories may differ in all but their dimension."""


def size(trajectories: Sequence[ThinnedTrajectory]) -> int:
    """Return the bytes of the files before compression."""
    particles = sum(e.particle_count * e.layout.bytes_per_particle * e.frame_count for e in trajectories)
    return particles + sum(e.walls.count * (8 * e.layout.dimension * e.frame_count + 4) for e in trajectories)


def write(
    directory: Path, trajectories: Sequence[ThinnedTrajectory], tick: Callable[[], None]
) -> tuple[dict[str, Any], list[str]]:
    """Write the files, and return their part of the metadata, and notes."""
    for each in trajectories:
        tables = {
            "time": each.times,
            "step": np.asarray(each.steps, np.int64),
            "frame": np.asarray(each.frames, np.int64),
        }
        names = (*MOVING, *each.source.field_names)
        arrays = [(name, lambda name=name, each=each: each.read(name)) for name in names]
        arrays += [(name, lambda name=name, each=each: each.label(name)) for name in LABELS]
        if each.walls.count:
            positions = each.walls.positions(each.times).astype(each.layout.arrays["Points"].dtype)
            tables |= {"wall_position": positions, "wall_collider": each.walls.numbers}
        arrays += [(name, lambda table=table: table) for name, table in tables.items()]
        write_npz(directory / f"{group_name(each.source.number)}.npz", ((name, read()) for name, read in arrays))
        tick()
    facts: dict[str, Any] = {
        "laws": {group_name(e.source.number): [law.name for law in e.source.header.laws] for e in trajectories},
        "bodies": {group_name(e.source.number): list(e.source.header.body_names) for e in trajectories},
        "colliders": {group_name(e.source.number): list(e.source.header.collider_names) for e in trajectories},
        "draws": {group_name(e.source.number): e.source.draws for e in trajectories},
    }
    if min(each.frame_count for each in trajectories) < LEAST_FRAMES:
        return facts, ["Some trajectories have fewer than three frames: metadata.json has no statistics of motion."]
    statistics, notes = learning_facts(trajectories)
    return facts | statistics, notes

"""What formats that store all arrays of each trajectory share: the arrays, their facts, and files of limited size."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mpmcli.dataset.formats.format import Format, Written
from mpmcli.dataset.metadata import LEAST_FRAMES, learning_facts, outruns_periods
from mpmcli.dataset.shard import LABELS, MOVING, SPLITS
from mpmcli.dataset.subsample import SubsampledTrajectory
from mpmcli.frames.ledger import RIGID
from mpmcli.output.layout import POSITION
from mpmcli.scene.colliders import Motion

# Bytes of arrays in one file, so that the file stays below 500 MB with what its format adds.
FILE_BYTES = 400_000_000


@dataclass(frozen=True, eq=False)
class ExportedArray:
    """An array of a trajectory, read on demand as consecutive blocks along its first axis."""

    dtype: np.dtype
    shape: tuple[int, ...]
    blocks: Callable[[], Iterable[np.ndarray]]

    def read(self) -> np.ndarray:
        """Read all of it."""
        return np.concatenate(list(self.blocks()))


def arrays_of(trajectory: SubsampledTrajectory) -> dict[str, ExportedArray]:
    """Return all arrays by name: those of the dataset, then those of walls, moving colliders and rigid bodies."""
    source, layout = trajectory.source, trajectory.layout.arrays
    whole = (trajectory.frame_count, trajectory.particle_count)
    found = {}
    for name in (*MOVING, *source.field_names):
        kind = layout[POSITION if name == "position" else name]
        found[name] = ExportedArray(np.dtype(kind.dtype), whole + kind.shape, partial(trajectory.blocks, name))
    known = {name: trajectory.label(name) for name in LABELS} | {"time": trajectory.times}
    known |= {"step": np.asarray(trajectory.steps, np.int64), "frame": np.asarray(trajectory.frames, np.int64)}
    if trajectory.walls.count:
        known["wall_position"] = trajectory.walls.positions(trajectory.times).astype(layout[POSITION].dtype)
        known["wall_collider"] = trajectory.walls.numbers
    driven = [one for one in source.colliders if isinstance(one.motion, Motion) and one.motion.moves]
    if driven:
        names = source.header.collider_names
        known["collider_pose"] = np.stack([one.motion.poses(trajectory.times) for one in driven], axis=1)
        known["collider_number"] = np.array([names.index(one.name) for one in driven], np.int32)
    rows = trajectory.ledger()
    if rows[0].rigid_pose:
        known |= {name: np.array([getattr(row, name) for row in rows]) for name in RIGID}
    return found | {name: ExportedArray(a.dtype, a.shape, partial(iter, [a])) for name, a in known.items()}


class ArraysFormat(Format):
    """All arrays of each trajectory; all must have the same d."""

    @abstractmethod
    def write_arrays(self, directory: Path, tick: Callable[[], None]) -> None:
        """Write the files, and call `tick` after each trajectory."""

    def size(self) -> int:
        return sum(map(self._bytes, self.trajectories))

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        """Write the arrays; return the statistics of motion, or a note on why there are none."""
        self.write_arrays(directory, tick)
        why = ""
        if min(each.frame_count for each in self.trajectories) < LEAST_FRAMES:
            why = "Some trajectories have fewer than three frames"
        elif any(outruns_periods(each) for each in self.trajectories):
            why = "Particles cross half of a periodic domain between two exported frames"
        try:
            statistics, notes = ({}, []) if why else learning_facts(self.trajectories)
        except ValueError:
            why, statistics, notes = "A trajectory has no particle that is active in three frames", {}, []
        return statistics, [f"{why}: metadata.json has no statistics of motion."] if why else notes

    @staticmethod
    def _bytes(trajectory: SubsampledTrajectory) -> int:
        frames, layout = trajectory.frame_count, trajectory.layout
        walls = trajectory.walls.count * (8 * layout.dimension * frames + 4)
        return trajectory.particle_count * layout.bytes_per_particle * frames + walls

    def parts(self) -> Iterator[tuple[str, list[SubsampledTrajectory]]]:
        """Yield a name and trajectories for each file: "train-00000-of-00002", as many as fit in FILE_BYTES."""
        for split in SPLITS:
            files: list[list[SubsampledTrajectory]] = []
            room = 0
            for each in self.trajectories:
                if each.source.split == split:
                    size = self._bytes(each)
                    if not files or size > room:
                        files.append([])
                        room = FILE_BYTES
                    files[-1].append(each)
                    room -= size
            for k, chosen in enumerate(files):
                yield f"{split}-{k:05d}-of-{len(files):05d}", chosen

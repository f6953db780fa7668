"""Files of NumPy: one .npz per trajectory; and how an .npz is written."""

import pickle
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.dataset.formats.format import Format, Written
from mpmcli.dataset.metadata import LEAST_FRAMES, learning_facts, outruns_periods
from mpmcli.dataset.shard import LABELS, MOVING, group_name
from mpmcli.dataset.subsample import SubsampledTrajectory
from mpmcli.frames.ledger import RIGID
from mpmcli.scene.colliders import Motion


class Npz(Format):
    """One .npz per trajectory, which numpy reads without pickles; all must have the same d."""

    files = r"\d{6,}\.npz"

    def size(self) -> int:
        particles = sum(e.particle_count * e.layout.bytes_per_particle * e.frame_count for e in self.trajectories)
        walls = sum(e.walls.count * (8 * e.layout.dimension * e.frame_count + 4) for e in self.trajectories)
        return particles + walls

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        facts: dict[str, Any] = {"laws": {}, "bodies": {}, "colliders": {}, "draws": {}}
        for each in self.trajectories:
            name, header = group_name(each.source.number), each.source.header
            write_npz(directory / f"{name}.npz", self._arrays(each))
            facts["laws"][name] = [law.name for law in header.laws]
            facts["bodies"][name] = list(header.body_names)
            facts["colliders"][name] = list(header.collider_names)
            facts["draws"][name] = each.source.draws
            tick()
        why = ""
        if min(each.frame_count for each in self.trajectories) < LEAST_FRAMES:
            why = "Some trajectories have fewer than three frames"
        elif any(outruns_periods(each) for each in self.trajectories):
            why = "Particles cross half of a periodic domain between two exported frames"
        try:
            statistics, notes = ({}, []) if why else learning_facts(self.trajectories)
        except ValueError:
            why, statistics, notes = "A trajectory has no particle that is active in three frames", {}, []
        return facts | statistics, [f"{why}: metadata.json has no statistics of motion."] if why else notes

    @staticmethod
    def _arrays(trajectory: SubsampledTrajectory) -> Iterable[tuple[str, np.ndarray]]:
        rows = trajectory.ledger()
        for name in (*MOVING, *trajectory.source.field_names):
            yield name, trajectory.read(name)
        for name in LABELS:
            yield name, trajectory.label(name)
        yield "time", trajectory.times
        yield "step", np.asarray(trajectory.steps, np.int64)
        yield "frame", np.asarray(trajectory.frames, np.int64)
        if trajectory.walls.count:
            dtype = trajectory.layout.arrays["Points"].dtype
            yield "wall_position", trajectory.walls.positions(trajectory.times).astype(dtype)
            yield "wall_collider", trajectory.walls.numbers
        driven = [one for one in trajectory.source.colliders if isinstance(one.motion, Motion) and one.motion.moves]
        if driven:
            names = trajectory.source.header.collider_names
            yield "collider_pose", np.stack([one.motion.poses(trajectory.times) for one in driven], axis=1)
            yield "collider_number", np.array([names.index(one.name) for one in driven], np.int32)
        if rows[0].rigid_pose:
            for name in RIGID:
                yield name, np.array([getattr(row, name) for row in rows])


def write_npz(path: Path, arrays: Iterable[tuple[str, np.ndarray]]) -> None:
    """Write an .npz as numpy does, but with one array in memory at a time and without a timestamp.

    Compression would take two thirds of the time of an export and save a seventh of its bytes.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays:
            # Entries opened by name have the date 1980-01-01.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                if array.dtype == object:
                    header = np.lib.format.header_data_from_array_1_0(array)
                    np.lib.format.write_array_header_1_0(entry, header)
                    _Pickler(entry, protocol=3).dump(array)
                else:
                    np.lib.format.write_array(entry, array, allow_pickle=False)


class _Pickler(pickle.Pickler):
    """Pickles arrays by public names: numpy itself writes `numpy._core`, which versions before 1.26 lack."""

    def reducer_override(self, obj: Any) -> Any:
        """Return how an array is made, and NotImplemented for any other object."""
        return (np.ndarray, ((0,), "b"), obj.__reduce__()[2]) if isinstance(obj, np.ndarray) else NotImplemented

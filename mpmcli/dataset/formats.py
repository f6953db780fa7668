"""The formats of an export: LagrangeBench and GNS for training code, npz for NumPy, vtkhdf for ParaView."""

import math
import pickle
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np

from mpmcli.dataset.metadata import (
    LEAST_FRAMES,
    RADIUS_IN_SPACINGS,
    domain_around,
    learning_facts,
    outruns_periods,
    require_alike,
)
from mpmcli.dataset.shard import LABELS, MOVING, SPLITS, group_name
from mpmcli.dataset.subsample import KINDS, SubsampledTrajectory
from mpmcli.errors import InputError
from mpmcli.frames.ledger import RIGID
from mpmcli.output.collider_files import pvd_text
from mpmcli.output.durable import ask_for
from mpmcli.output.layout import POSITION
from mpmcli.output.series import series_size, write_vtu
from mpmcli.output.vtkhdf import VtkhdfWriter, file_size
from mpmcli.scene.colliders import Motion
from mpmcli.scene.problem import listed

# Entries of a format in metadata.json, and notes for the user.
Written = tuple[dict[str, Any], list[str]]


class Format(ABC):
    """Writes trajectories of one dimension as files of a format."""

    def __init__(self, trajectories: Sequence[SubsampledTrajectory], features: tuple[str, ...] | None = None) -> None:
        """`features` are the material parameters that GNS gets, None for those that differ."""
        self.trajectories, self._features = trajectories, features

    def check(self) -> None:  # noqa: B027
        """Raise an InputError for trajectories that the format cannot store."""

    @abstractmethod
    def size(self) -> int:
        """Return the bytes of the files before compression."""

    @abstractmethod
    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        """Write the files, and call `tick` after each trajectory."""


class TrainingFormat(Format):
    """One file per split; laws get particle types from `usual`, then `free`; `KINDS` are the types of walls."""

    name: ClassVar[str]
    suffix: ClassVar[str]
    usual: ClassVar[Mapping[str, int]]
    free: ClassVar[Sequence[int]]
    wall: ClassVar[int]
    moving_wall: ClassVar[int]
    rigid_body: ClassVar[int]
    parameters: Sequence[str] = ()

    @abstractmethod
    def facts(self) -> Written:
        """Return the entries of this format alone."""

    @abstractmethod
    def write_split(self, path: Path, chosen: Sequence[SubsampledTrajectory], tick: Callable[[], None]) -> None:
        """Write the file of a split."""

    def size(self) -> int:
        return sum(map(self._bytes, self.trajectories))

    def _bytes(self, trajectory: SubsampledTrajectory) -> int:
        position = 4 * trajectory.layout.dimension * trajectory.frame_count
        return trajectory.whole_count * (position + 8 + 8 * len(self.parameters))

    def check(self) -> None:
        require_alike(self.trajectories, self.name)
        _ = self.types

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        statistics, notes = learning_facts(self.trajectories)
        facts, more = self.facts()
        notes += more
        for split in SPLITS:
            file = f"{split}{self.suffix}"
            if chosen := [each for each in self.trajectories if each.source.split == split]:
                self.write_split(directory / file, chosen, tick)
            else:
                notes.append(f"No trajectory is of the split {split}: {file} is left out, as loaders need one.")
        # The metadata has one entry for all domains.
        if self._domains_differ:
            notes.append("The domains of the trajectories differ: bounds is the box around all of them.")
        return facts | {"particle_types": self.types | self._wall_types(), **statistics}, notes

    @property
    def _domains_differ(self) -> bool:
        headers = [each.source.header for each in self.trajectories]
        return len({(tuple(header.origin), tuple(header.upper), tuple(header.periodic)) for header in headers}) > 1

    @cached_property
    def types(self) -> dict[str, int]:
        """The particle type of each law; InputError: there are more laws than types."""
        laws = sorted({law.name for each in self.trajectories for law in each.source.header.laws})
        taken = self._wall_types().values()
        types = {name: self.usual[name] for name in laws if self.usual.get(name, -1) not in {-1, *taken}}
        others = [name for name in laws if name not in types]
        left = [number for number in self.free if number not in {*types.values(), *taken}]
        if others[len(left) :]:
            law = others[len(left)]
            raise InputError(f"{self.name} has no particle type left for {law}, the law of some of the particles.")
        return types | dict(zip(others, left, strict=False))

    def _wall_types(self) -> dict[str, int]:
        found = {KINDS[k] for each in self.trajectories for k in np.unique(each.walls.kinds)}
        known = {name: getattr(self, name) for name in KINDS if name in found}
        return {"wall" if number == self.wall else name: number for name, number in known.items()}

    def particle_types(self, trajectory: SubsampledTrajectory) -> np.ndarray:
        """Return the type of each particle, and then of each on walls, (N + W,) int64."""
        laws = np.array([self.types[law.name] for law in trajectory.source.header.laws], np.int64)
        walls = np.array([getattr(self, name) for name in KINDS], np.int64)[trajectory.walls.kinds]
        return np.concatenate([laws[trajectory.label("material")], walls])


class LagrangeBench(TrainingFormat):
    """train.h5, valid.h5 and test.h5, as the class H5Dataset of LagrangeBench reads them.

    Source: github.com/tumaer/lagrangebench, lagrangebench/data/data.py, utils.py (NodeType) and
    data_gen/lagrangebench_data/gen_dataset.py. Trajectory k of a split is the group f"{k:05d}" with `position`,
    (T, N, d) float32, and `particle_type`, (N,) int64; all have the same T.

    Its search for neighbours sorts positions into cells from 0 to below the extent of bounds, and repeats either no
    axis or all of them (case_setup/case.py; tumaer/jax-sph, jax_md/partition.py): positions are relative to the lower
    corner of the domain, below the upper one, and bounds leave a gap behind walls where another axis is periodic.
    """

    name, suffix = "LagrangeBench", ".h5"
    # Its own types are 0 fluid, 1 solid wall, 2 moving wall, 3 rigid body, -1 padding, out of 9.
    usual: ClassVar = {"fluid": 0, "sand": 4, "viscoplastic": 5, "snow": 6, "von_mises": 7, "fixed_corotated": 8}
    free = (8, 7, 6, 5, 4)
    wall, moving_wall, rigid_body = 1, 2, 3

    def check(self) -> None:
        super().check()
        periodic = np.any([each.source.header.periodic for each in self.trajectories])
        if periodic and self._domains_differ:
            raise InputError(
                "the trajectories differ in their domain or its periodic faces, of which LagrangeBench has one for "
                "all: export them apart, or --to npz."
            )
        fast = next((each for each in self.trajectories if outruns_periods(each)), None) if periodic else None
        if fast is not None:
            raise InputError(
                f"particles of trajectory {fast.source.number} cross half of the periodic domain between two exported "
                "frames, so that LagrangeBench cannot tell which way they went: take a smaller --stride, or store "
                "more frames."
            )

    @cached_property
    def _box(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower corner of all domains, their extent, and that with the gaps behind walls: (d,), m."""
        lower, upper = domain_around([each.source.header for each in self.trajectories])
        for each in self.trajectories:
            if each.walls.count:
                # A collider may extend or move out of the domain.
                points = each.walls.positions(each.times)
                lower, upper = np.minimum(lower, points.min(axis=(0, 1))), np.maximum(upper, points.max(axis=(0, 1)))
        periodic = self.trajectories[0].source.header.periodic
        # Two radii: neighbour lists may use a search radius larger than one.
        gap = 2 * RADIUS_IN_SPACINGS * max(each.spacing for each in self.trajectories)
        return lower, upper - lower, upper - lower + np.where(periodic.any() & ~periodic, gap, 0.0)

    def facts(self) -> Written:
        first = self.trajectories[0]
        lower, extent, box = self._box
        place = {"bounds": [[0.0, side] for side in box.tolist()], "origin": lower.tolist()}
        notes = []
        if (box > extent).any():
            notes.append("LagrangeBench repeats all axes or none: bounds reach beyond the walls of the others.")
        # As in LagrangeBench, the frame that is only the last target does not count.
        length = first.frame_count - 1
        lengths = {"sequence_length_train": length, "sequence_length_test": length}
        return {"solver": "MPM", "case": first.source.header.title, **lengths, **place}, notes

    def write_split(self, path: Path, chosen: Sequence[SubsampledTrajectory], tick: Callable[[], None]) -> None:
        ask_for(path, sum(map(self._bytes, chosen)))
        with h5py.File(path, "w") as file:
            for k, each in enumerate(chosen):
                self._write_trajectory(file.create_group(f"{k:05d}"), each)
                tick()

    def _write_trajectory(self, group: h5py.Group, trajectory: SubsampledTrajectory) -> None:
        # The layout of the file depends on the time at which objects are closed: before the next group is made.
        shape = (trajectory.frame_count, trajectory.whole_count, trajectory.layout.dimension)
        # Loaders read windows of several frames: a chunk is one window.
        position = group.create_dataset("position", shape, np.float32, chunks=(1, *shape[1:]), compression="gzip")
        first, (lower, extent, _) = 0, self._box
        periodic = self.trajectories[0].source.header.periodic
        for block in trajectory.whole_blocks():
            placed = block.astype(np.float64) - lower
            placed = np.where(periodic, np.mod(placed, extent), placed)
            # A position on an upper face is moved below it by a few rounding errors of the quotient that determines its
            # cell.
            position[first : first + len(block)] = np.clip(placed, 0.0, extent * (1 - 2.0**-20)).astype(np.float32)
            first += len(block)
        group.create_dataset("particle_type", data=self.particle_types(trajectory))


class Gns(TrainingFormat):
    """train.npz, valid.npz and test.npz, as the particle data loader of GNS reads them.

    Source: github.com/geoelements/gns, gns/data_loader.py, gns/train.py and docs/gns_data.md. Each entry is an object
        array of (positions (T, N, d) float32, particle type (N,) int64), and, if parameters differ within a law, (N,)
        or (N, m) float64 with the parameters.
    """

    name, suffix = "GNS", ".npz"
    # As in the data of DeepMind's "Learning to simulate": 5 water, 6 sand, 7 goop; 3 is for particles with prescribed
    # motion, here those on walls, and 0 for rigid bodies.
    usual: ClassVar = dict(fluid=5, sand=6, viscoplastic=7, fixed_corotated=0, neo_hookean=1, snow=2, von_mises=4)
    free = (8, 4, 2, 1, 0, 7)
    wall = moving_wall = 3
    rigid_body = 0

    def check(self) -> None:
        for each in self.trajectories:
            if each.source.header.periodic.any():
                raise InputError(
                    f"trajectory {each.source.number} has periodic faces, which GNS does not support: velocities would "
                    "jump there, and particles at them lack neighbours; --to lagrangebench and --to npz take them."
                )
        super().check()
        known = [*self._differing]
        if self._features is None and len(known) > 1:
            raise InputError(
                f"{listed(known, 'and')} differ between bodies of one law, and the loader of GNS takes one parameter: "
                f"give --features {known[0]}, several with commas for a loader whose np.full has the shape (N, m), or "
                "--features none."
            )
        for name in self._features or ():
            if name not in known:
                has = f"; {listed(known, 'and')} {'do' if len(known) > 1 else 'does'}" if known else ""
                raise InputError(f'--features: "{name}" does not differ between bodies of one law{has}.')

    @property
    def parameters(self) -> list[str]:
        """Names of the material parameters that particles have."""
        return self._differing if self._features is None else list(self._features)

    @cached_property
    def _differing(self) -> list[str]:
        """Names of numeric parameters that scenes state differently for bodies of one law, over all trajectories."""
        values: dict[tuple[str, str], set[float]] = {}
        for each in self.trajectories:
            for body in each.source.header.bodies:
                for name, value in body.material.items():
                    # A modulus that mpmcli has chosen follows from the scene.
                    if isinstance(value, int | float) and math.isfinite(value) and name not in body.chosen:
                        values.setdefault((str(body.material.get("law")), name), set()).add(float(value))
        return sorted({name for (_, name), different in values.items() if len(different) > 1})

    def facts(self) -> Written:
        names, d = self.parameters, self.trajectories[0].layout.dimension
        notes = [
            f"Each particle has {len(names)} parameters of its material ({', '.join(names)}): the loader of GNS takes "
            "one, unless np.full in it is given the shape (N, m)."
        ]
        values = np.concatenate([self._parameters_of_bodies(each) for each in self.trajectories])
        return {
            # Every frame counts: a rollout is compared with all frames after the first six.
            "sequence_length": self.trajectories[0].frame_count,
            # Per particle: the last 5 velocities, the distances to 2 d walls, and an embedding of its type in 16
            # numbers.
            "nnode_in": 5 * d + 2 * d + 16 + len(names),
            "nedge_in": d + 1,
            "material_feature_len": len(names),
            "material_feature_names": names,
            "material_feature_min": np.min(values, axis=0).tolist(),
            "material_feature_max": np.max(values, axis=0).tolist(),
        }, notes if len(names) > 1 else []

    def _parameters_of_bodies(self, trajectory: SubsampledTrajectory) -> np.ndarray:
        """Return the parameters of each body, (bodies, m), in the units of scenes; 0 if a law has no such parameter."""
        bodies = trajectory.source.header.bodies
        rows = [[body.material.get(name, 0.0) for name in self.parameters] for body in bodies]
        numbers = [[float(value) if isinstance(value, int | float) else 0.0 for value in row] for row in rows]
        return np.array(numbers).reshape(len(bodies), len(self.parameters))

    def write_split(self, path: Path, chosen: Sequence[SubsampledTrajectory], tick: Callable[[], None]) -> None:
        def entries() -> Iterable[tuple[str, np.ndarray]]:
            m = len(self.parameters)
            for each in chosen:
                positions = np.concatenate([block.astype(np.float32) for block in each.whole_blocks()])
                parts = [positions, self.particle_types(each)]
                if m:
                    # The loader broadcasts a single parameter to (N,), which fails with (N, 1).
                    properties = self._parameters_of_bodies(each)[each.label("body")]
                    properties = np.concatenate([properties, np.zeros((each.walls.count, m))])
                    parts.append(properties[:, 0] if m == 1 else properties)
                # numpy would try to convert a tuple of arrays to one numeric array, and fail.
                entry = np.empty(len(parts), object)
                for k, part in enumerate(parts):
                    entry[k] = part
                yield f"trajectory_{each.source.number:06d}", entry
                tick()

        write_npz(path, entries())


class Npz(Format):
    """One .npz per trajectory, which numpy reads without pickles; all must have the same d."""

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


class Vtkhdf(Format):
    """One temporal VTKHDF file per trajectory, as packed by `mpmcli simulate`."""

    def check(self) -> None:
        if any(each.walls.walls != "none" for each in self.trajectories):
            raise InputError(
                "--walls is for training code and NumPy; of files for VTK mpmcli render draws the colliders."
            )

    def size(self) -> int:
        return sum(file_size(each.layout, [each.particle_count] * each.frame_count) for each in self.trajectories)

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        for each in self.trajectories:
            path = directory / f"{group_name(each.source.number)}.vtkhdf"
            n, frames, layout = each.particle_count, each.frame_count, each.layout
            fixed = _fixed(each)
            ask_for(path, file_size(layout, [n] * frames))
            with VtkhdfWriter(path, layout, [n] * frames) as writer:
                for name, array in layout.arrays.items():
                    if name in fixed:
                        for _ in range(frames):
                            writer.append(name, array.pad(fixed[name]))
                        continue
                    for block in each.blocks("position" if name == POSITION else name):
                        writer.append(name, array.pad(block.reshape(len(block) * n, *block.shape[2:])))
                writer.finish(each.times, each.frames, each.steps, each.ledger(), each.source.header.stored)
            tick()
        whole = all(
            (each.particle_count, each.frame_count) == (each.source.particle_count, each.source.frame_count)
            for each in self.trajectories
        )
        note = "The headers and ledgers stay those of the whole runs: mpmcli check finds frames missing."
        return {}, [] if whole else [note]


def _fixed(trajectory: SubsampledTrajectory) -> dict[str, np.ndarray]:
    """Return the arrays that are the same in all frames."""
    ids = np.arange(trajectory.particle_count, dtype=trajectory.layout.arrays["id"].dtype)
    return {name: trajectory.label(name) for name in LABELS} | {"id": ids}


class Vtk(Vtkhdf):
    """A .vtu file for each frame and a .pvd that lists those of a trajectory, for ParaView before 5.12."""

    def size(self) -> int:
        return sum(series_size(each.layout, [each.particle_count] * each.frame_count) for each in self.trajectories)

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        for each in self.trajectories:
            name, arrays, fixed = group_name(each.source.number), each.layout.arrays, _fixed(each)
            streams = {
                array: (frame for block in each.blocks("position" if array == POSITION else array) for frame in block)
                for array in arrays
                if array not in fixed
            }
            times = zip(each.times.tolist(), each.frames, strict=True)
            listed = [(time, 0, f"{name}_{frame:06d}.vtu") for time, frame in times]
            for *_, file in listed:
                own = fixed | {array: next(stream) for array, stream in streams.items()}
                write_vtu(directory / file, {array: layout.pad(own[array]) for array, layout in arrays.items()})
            (directory / f"{name}.pvd").write_text(pvd_text(listed), encoding="utf-8", newline="\n")
            tick()
        return {}, []


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


FORMATS: dict[str, type[Format]] = {
    "lagrangebench": LagrangeBench,
    "gns": Gns,
    "npz": Npz,
    "vtkhdf": Vtkhdf,
    "vtk": Vtk,
}

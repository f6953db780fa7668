"""Files of VTK, for ParaView and all commands of mpmcli: temporal VTKHDF, and a series of .vtu."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from mpmcli.dataset.formats.format import Format, Written
from mpmcli.dataset.shard import LABELS, group_name
from mpmcli.dataset.subsample import SubsampledTrajectory
from mpmcli.errors import InputError
from mpmcli.output.collider_files import pvd_text
from mpmcli.output.durable import ask_for
from mpmcli.output.layout import POSITION
from mpmcli.output.series import series_size, write_vtu
from mpmcli.output.vtkhdf import VtkhdfWriter, file_size


class Vtkhdf(Format):
    """One temporal VTKHDF file per trajectory, as packed by `mpmcli simulate`."""

    files = r"\d{6,}\.vtkhdf"

    def check(self) -> None:
        if any(each.walls.walls != "none" for each in self.trajectories):
            raise InputError(
                "--walls is for training code and NumPy; mpmcli render draws the colliders; --to usd and ply have them."
            )

    def size(self) -> int:
        return sum(file_size(each.layout, [each.particle_count] * each.frame_count) for each in self.trajectories)

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        """Write a VTKHDF file per trajectory; a note tells that frames or particles were left out."""
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


def stored_frames(trajectory: SubsampledTrajectory) -> Iterator[tuple[float, int, dict[str, np.ndarray]]]:
    """Yield time (s), number and arrays of each frame, padded to 3D as in files for VTK."""
    layouts, fixed = trajectory.layout.arrays, _fixed(trajectory)
    streams = {
        name: (frame for block in trajectory.blocks("position" if name == POSITION else name) for frame in block)
        for name in layouts
        if name not in fixed
    }
    for time, number in zip(trajectory.times.tolist(), trajectory.frames.tolist(), strict=True):
        own = fixed | {name: next(stream) for name, stream in streams.items()}
        yield time, number, {name: layout.pad(own[name]) for name, layout in layouts.items()}


class Vtk(Vtkhdf):
    """A .vtu file for each frame and a .pvd that lists those of a trajectory, for ParaView before 5.12."""

    files = r"\d{6,}(_\d{6,}\.vtu|\.pvd)"

    def size(self) -> int:
        return sum(series_size(each.layout, [each.particle_count] * each.frame_count) for each in self.trajectories)

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        for each in self.trajectories:
            name, listed = group_name(each.source.number), []
            for time, frame, arrays in stored_frames(each):
                listed.append((time, 0, f"{name}_{frame:06d}.vtu"))
                write_vtu(directory / listed[-1][2], arrays)
            (directory / f"{name}.pvd").write_text(pvd_text(listed), encoding="utf-8", newline="\n")
            tick()
        return {}, []

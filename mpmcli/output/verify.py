"""Verifies a result: reads every byte and compares it with its checksum."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import h5py
import numpy as np

from mpmcli.errors import InputError
from mpmcli.output.checksums import (
    DAMAGE,
    NAME,
    SUMS,
    FrameChecksums,
    checksum_is_right,
    gaps_of,
    item_checksums,
    load_checksums,
    sums_faults,
)
from mpmcli.output.collider_files import MOVING, RESTING, expected_files
from mpmcli.output.directory import SCENE
from mpmcli.output.durable import number_of
from mpmcli.output.layout import PACKED, SEGMENTS, FrameIndex, sealed_segments
from mpmcli.output.result import open_result, result_place
from mpmcli.output.run_record import read_record
from mpmcli.output.vtkhdf import open_vtkhdf, read_blocks, read_index
from mpmcli.plain_text import counted


@dataclass
class Verification:
    """Numbers of files and frames read, and a sentence for each fault."""

    path: Path
    files: int = 0
    frames: int = 0
    faults: list[str] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        """Whether there are no faults."""
        return not self.faults

    def add(self, other: "Verification") -> "Verification":
        """Add the outcome for another file, and return that outcome."""
        self.files += other.files
        self.frames += other.frames
        self.faults += other.faults
        return other

    def as_dict(self) -> dict:
        """Return it for JSON."""
        return {**asdict(self), "path": str(self.path), "ok": self.sound}

    def text(self) -> str:
        """Return the outcome, and a line for each fault."""
        read = f"{counted(self.files, 'file')}, {counted(self.frames, 'frame')}"
        outcome = counted(len(self.faults), "fault") if self.faults else "ok"
        return "\n".join([f"{self.path}: {read}: {outcome}", *self.faults])


def verify_result(path: Path) -> Verification:
    """Compare a result and its accompanying files with their checksums; InputError: no result of mpmcli."""
    path = result_place(path)
    found = Verification(path)
    directory = path if path.is_dir() else path.parent
    if path.is_dir():
        files = [path / PACKED] if (path / PACKED).exists() else sealed_segments(path)
        if not files:
            open_result(path)
        counts = [found.add(verify_file(file)).frames for file in files]
        _verify_count(directory, files, counts, found)
    else:
        if not path.exists():
            raise InputError(f"{path} does not exist: give a {PACKED} or its directory.")
        found.add(verify_file(path))
    if path.is_dir() or path.name == PACKED:
        for name in (RESTING, MOVING):
            if (directory / name).exists():
                found.add(verify_file(directory / name, frames=False))
        if (directory / SUMS).exists():
            files, faults = sums_faults(directory)
            found.files += files
            found.faults += faults
    if found.faults or not (path.is_dir() or path.name == PACKED):
        return found
    # Compare scene.toml, and the set of collider files, with the scene stored with the frames.
    header, scene = open_result(directory).header, directory / SCENE
    text, colliders = header.stored.get("scene"), header.read_colliders({})
    if scene.exists() and text is not None:
        found.files += 1
        if scene.read_bytes() != text.encode("utf-8"):
            found.faults.append(f"{scene} is not the scene of the frames: it has changed since it was written.")
    if (directory / PACKED).exists() and colliders and None not in colliders and directory == path:
        missing = [name for name in expected_files(header.stored, colliders) if not (directory / name).exists()]
        found.faults += [f"{directory / name} is missing: the scene has colliders." for name in missing]
    return found


def verify_file(path: Path, *, frames: bool = True, stop: Callable[[], bool] = lambda: False) -> Verification:
    """Compare a VTKHDF file with its checksums; `frames` is False for colliders.

    KeyboardInterrupt: `stop` returned True.
    """
    found = Verification(path, files=1)
    try:
        with open_vtkhdf(path) as file:
            checksums = load_checksums(file, "mpmcli")
            items = item_checksums(file, checksums.arrays, f"mpmcli/{NAME}")
            found.faults += map(str, checksums.differences(items))
            if frames:
                index = read_index(file)
                found.frames = len(index.times)
                for k, name in sorted(_damaged_arrays(file, index, stop)):
                    found.faults.append(f"{path} is damaged: {name} of frame {index.frames[k]} has changed.")
            gaps = gaps_of([file[name] for name in checksums.arrays])
        if found.sound and not checksum_is_right(path, gaps):
            found.faults.append(f"{path} is damaged: it has changed between its data sets, or at its end.")
    except InputError as error:
        found.faults.append(str(error))
    return found


def _damaged_arrays(file: h5py.File, index: FrameIndex, stop: Callable[[], bool]) -> Iterator[tuple[int, str]]:
    """Yield each frame with the name of an array that has changed."""
    for column, name in enumerate(index.layout.arrays):
        found = FrameChecksums([name], index.counts)
        try:
            for block in read_blocks(file, name, int(index.counts.sum())):
                if stop():
                    raise KeyboardInterrupt
                found.add(name, block)
        except DAMAGE:
            yield found.frame(name), name
        else:
            for k in np.flatnonzero(found.table[:, 0] != index.checksums[:, column]).tolist():
                yield k, name


def _verify_count(directory: Path, files: Sequence[Path], counts: Sequence[int], found: Verification) -> None:
    """Compare the numbers of the frames with their positions, and with the number of sealed frames in the record."""
    if found.faults:
        return
    written = (read_record(directory) or {}).get("frames_written")
    if files[0].name != PACKED:
        frames = 0
        for file, count in zip(files, counts, strict=True):
            first = number_of(file)
            if first != frames:
                told = f"lacks the frames {frames} to {first - 1}" if first > frames else f"holds frame {first} twice"
                found.faults.append(f"{directory / SEGMENTS} {told}.")
                return
            frames += count
    if isinstance(written, int) and found.frames < written:
        there = counted(found.frames, "frame")
        found.faults.append(f"{directory} holds {there}, but its run has written {written}.")

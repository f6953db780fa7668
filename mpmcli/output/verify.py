"""Whether a result has changed since it was written: every byte is read, and compared with its checksum."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path

import h5py

from mpmcli.errors import InputError
from mpmcli.output.checksums import (
    NAME,
    SUMS,
    checksum,
    checksum_is_right,
    gaps_of,
    item_checksums,
    load_checksums,
    sums_faults,
)
from mpmcli.output.collider_files import MOVING, RESTING, expected_files
from mpmcli.output.directory import SCENE
from mpmcli.output.durable import number_of
from mpmcli.output.guarded_read import held
from mpmcli.output.layout import FrameIndex
from mpmcli.output.result import open_result, result_place
from mpmcli.output.run_record import read_record
from mpmcli.output.segments import PACKED, SEGMENTS, sealed_segments
from mpmcli.output.vtkhdf import open_vtkhdf, read_array, read_index
from mpmcli.plain_text import counted

# What h5py raises on damaged files.
HDF5_ERRORS = (OSError, RuntimeError, ValueError, KeyError, TypeError, AttributeError, IndexError, MemoryError)


@dataclass
class Verification:
    """Files and frames that were read, a sentence for each fault, and `unchecked` files of an older version."""

    path: Path
    files: int = 0
    frames: int = 0
    faults: list[str] = field(default_factory=list)
    unchecked: list[str] = field(default_factory=list)

    def as_dict(self) -> dict:
        """Return it as JSON can hold it."""
        return {**asdict(self), "path": str(self.path), "ok": not self.faults}

    def text(self) -> str:
        """Return the outcome, and a line for each fault."""
        read = f"{counted(self.files, 'file')}, {counted(self.frames, 'frame')}"
        outcome = counted(len(self.faults), "fault") if self.faults else "ok"
        lines = [f"{path} has no checksums: an older version of mpmcli wrote it." for path in self.unchecked]
        if self.unchecked and not self.faults:
            outcome = "all of it can be read"
        return "\n".join([f"{self.path}: {read}: {outcome}", *self.faults, *lines])


def verify_result(path: Path) -> Verification:
    """Compare a result and all that lies beside it with its checksums; InputError: there is none of mpmcli."""
    path = result_place(path)
    found = Verification(path)
    directory = path if path.is_dir() else path.parent
    if path.is_dir():
        files = [path / PACKED] if (path / PACKED).exists() else sealed_segments(path)
        if not files:
            open_result(path)
        counts = [_verify_file(file, found) for file in files]
        _verify_count(directory, files, counts, found)
    else:
        if not path.exists():
            raise InputError(f"{path} does not exist: give a {PACKED} or its directory.")
        _verify_file(path, found)
    if path.is_dir() or path.name == PACKED:
        for name in (RESTING, MOVING):
            if (directory / name).exists():
                _verify_file(directory / name, found, frames=False)
        if (directory / SUMS).exists():
            files, faults = sums_faults(directory)
            found.files += files
            found.faults += faults
        if not found.faults:
            _verify_beside(directory, found)
    return found


@dataclass
class FileVerdict:
    """What a comparison of a file with its checksums has found: its frames, and a sentence for each fault."""

    frames: int = 0
    faults: list[str] = field(default_factory=list)
    checked: bool = True

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.faults


def verify_file(path: Path, *, frames: bool = True) -> FileVerdict:
    """Compare all of a VTKHDF file with its checksums: of particles, or of colliders, which has no `frames` of ours."""
    found = FileVerdict()
    try:
        with closing(open_vtkhdf(path) if frames else h5py.File(path, "r", locking=False)) as file:
            found.checked = held(file, "mpmcli").attrs.get("format", 1) != 1
            if frames:
                index = read_index(file)
                found.frames = len(index.times)
            if found.checked:
                checksums = load_checksums(file, "mpmcli")
                items = item_checksums(file, checksums.arrays, f"mpmcli/{NAME}")
                found.faults += map(str, checksums.differences(items))
            for k in range(found.frames):
                for name in _damaged_arrays(file, index, k):
                    found.faults.append(f"{path} is damaged: {name} of frame {index.frames[k]} has changed.")
            gaps = gaps_of([held(file, key) for key in checksums.arrays]) if found.checked and found.sound else []
        if found.checked and found.sound and not checksum_is_right(path, gaps):
            found.faults.append(f"{path} is damaged: it has changed between its data sets, or at its end.")
    except HDF5_ERRORS as error:
        said = (str(error).splitlines() or [type(error).__name__])[0].strip("'\"")
        found.faults.append(f"{path} is damaged: it cannot be read ({said}).")
    except InputError as error:
        found.faults.append(str(error))
    return found


def _damaged_arrays(file: h5py.File, index: FrameIndex, k: int) -> list[str]:
    """Return the names of the arrays of a frame that are not as they were written, or, without checksums, cut off."""
    found = []
    for column, name in enumerate(index.layout.arrays):
        try:
            rows = read_array(file, name, int(index.offsets[k]), int(index.counts[k]))
            right = len(rows) == index.counts[k]
            if right and index.checksums is not None:
                right = checksum(rows) == index.checksums[k, column]
        except HDF5_ERRORS:
            right = False
        if not right:
            found.append(name)
    return found


def _verify_file(path: Path, found: Verification, *, frames: bool = True) -> int:
    """Note what `verify_file` finds, and return the number of frames."""
    verdict = verify_file(path, frames=frames)
    found.files += 1
    found.frames += verdict.frames
    found.faults += verdict.faults
    if not verdict.checked:
        found.unchecked.append(str(path))
    return verdict.frames


def _verify_count(directory: Path, files: Sequence[Path], counts: Sequence[int], found: Verification) -> None:
    """Compare the numbers of the frames with their places, and with the record, which counts what was sealed."""
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


def _verify_beside(directory: Path, found: Verification) -> None:
    """Compare scene.toml, and which colliders have files, with what the frames say of the scene."""
    header, path = open_result(directory).header, directory / SCENE
    text, colliders = header.stored.get("scene"), header.read_colliders({})
    if path.exists() and text is not None:
        found.files += 1
        if path.read_bytes() != text.encode("utf-8"):
            found.faults.append(f"{path} is not the scene of the frames: it has changed since it was written.")
    if (directory / PACKED).exists() and colliders and None not in colliders and directory == found.path:
        missing = [name for name in expected_files(header.stored, colliders) if not (directory / name).exists()]
        found.faults += [f"{directory / name} is missing: the scene has colliders." for name in missing]

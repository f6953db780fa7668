"""Checkpoints: complete states of a run that goes on, from which it can be resumed. The two newest ones are kept."""

import io
import json
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli import __version__
from mpmcli.output.durable import numbered_files, remove_numbered, require_free_space, sealed, sync_directory
from mpmcli.output.guarded_read import DAMAGE

CHECKPOINTS = "checkpoints"
CHECKPOINT_NAME = re.compile(r"step_\d{9,}\.npz")
FORMAT = 1
KEPT = 2
# Member with the facts, as JSON.
FACTS = "facts"
# Facts about the backend.
BACKEND = {"arch", "precision"}
# What a damaged archive raises.
ARCHIVE_DAMAGE = (*DAMAGE, EOFError, struct.error, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True)
class Checkpoint:
    """A run at rest: `frame` is the first not stored, `forced` time.step as it was, `arrays` are taken one by one."""

    frame: int
    step: int
    time: float
    backend: Mapping[str, str]
    forced: bool
    numbers: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]
    version: str = __version__


def write_checkpoint(directory: Path, checkpoint: Checkpoint, size: int) -> Path:
    """Seal a checkpoint, whose arrays have `size` bytes, and remove older ones; RunError or OSError: no room."""
    folder = directory / CHECKPOINTS
    facts = {name: value for name, value in vars(checkpoint).items() if name != "arrays"}
    text = np.frombuffer(json.dumps({"format": FORMAT, **facts}).encode("utf-8"), np.uint8)
    size += text.nbytes + 1024 * (1 + len(checkpoint.arrays))
    require_free_space(directory, size, "a checkpoint", "the frames are kept")
    if not folder.is_dir():
        folder.mkdir()
        sync_directory(directory)
    path = folder / f"step_{checkpoint.step:09d}.npz"
    with sealed(path, size) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        _add(archive, FACTS, text)
        for name in checkpoint.arrays:
            _add(archive, f"state/{name}", checkpoint.arrays[name])
    for older in _paths(directory)[KEPT:]:
        older.unlink(missing_ok=True)
    return path


def read_checkpoints(directory: Path) -> Iterator[Checkpoint]:
    """Yield the sound checkpoints of a directory that this version can read, the newest first."""
    for path in _paths(directory):
        with suppress(*ARCHIVE_DAMAGE):
            yield _read(path)


def remove_checkpoints(directory: Path) -> None:
    """Remove all checkpoints, and their folder unless something else lies in it."""
    remove_numbered(directory / CHECKPOINTS, CHECKPOINT_NAME)


def _add(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    """Write an array as `numpy.savez` does."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)


def _paths(directory: Path) -> list[Path]:
    return numbered_files(directory / CHECKPOINTS, CHECKPOINT_NAME)[::-1]


def _read(path: Path) -> Checkpoint:
    with zipfile.ZipFile(path) as file:
        members = file.infolist()
        # As they are written: what is compressed, or claimed twice, could be far larger than the file.
        if any(one.compress_type != zipfile.ZIP_STORED for one in members):
            raise ValueError(f"{path} is compressed")
        if sum(max(one.file_size, one.compress_size) for one in members) > path.stat().st_size:
            raise ValueError(f"{path} is shorter than what it claims to hold")
        # Each member has a CRC-32, which is compared when all of it is read, before anything is made of it.
        arrays = {one.filename: _array(file.read(one)) for one in members}
    facts = json.loads(arrays.pop(f"{FACTS}.npy").tobytes().decode("utf-8"))
    if facts.pop("format") != FORMAT or facts["version"] != __version__:
        raise ValueError(f"{path} is of another version")
    names = {name: name.removeprefix("state/").removesuffix(".npy") for name in arrays}
    found = Checkpoint(**facts, arrays={own: arrays[name] for name, own in names.items()})
    kinds = {"frame": int, "step": int, "time": float, "backend": dict, "forced": bool, "numbers": dict}
    if any(type(getattr(found, name)) is not kind for name, kind in kinds.items()) or {*found.backend} != BACKEND:
        raise TypeError(f"{path} states facts of another kind")
    return found


def _array(data: bytes) -> np.ndarray:
    """Return the array of a member, which has the size that it states."""
    stream = io.BytesIO(data)
    try:
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError("another format")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    except Exception as error:
        # A damaged header is given to Python's parsers, which raise errors of many kinds.
        raise ValueError("an array has no header") from error
    if dtype.hasobject or fortran or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError("an array does not fill its member")
    return np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape).copy()

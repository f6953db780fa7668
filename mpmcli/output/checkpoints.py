"""Checkpoints: complete states of a running simulation, from which it can be resumed. The newest two are kept."""

import io
import json
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
from mpmcli.output.checksums import DAMAGE
from mpmcli.output.durable import numbered_files, require_free_space, sealed, sync_directory

CHECKPOINTS = "checkpoints"
CHECKPOINT_NAME = re.compile(r"step_\d{9,}\.npz")
FORMAT = 1
KEPT = 2
# Member with the facts, as JSON.
FACTS = "facts"
# Exceptions that a damaged archive raises.
ARCHIVE_DAMAGE = (*DAMAGE, EOFError, struct.error, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True)
class Checkpoint:
    """The state of a run: `frame` is the first not stored, `forced` as in the run, `arrays` are read one by one."""

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


def _add(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    """Write an array as `numpy.savez` does."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)


def _paths(directory: Path) -> list[Path]:
    return numbered_files(directory / CHECKPOINTS, CHECKPOINT_NAME)[::-1]


def _read(path: Path) -> Checkpoint:
    with zipfile.ZipFile(path) as file:
        # Each member has a CRC-32, which is compared when all of it has been read, before it is used.
        members = {name.removesuffix(".npy"): io.BytesIO(file.read(name)) for name in file.namelist()}
    arrays = {name: np.load(data, allow_pickle=False) for name, data in members.items()}
    facts = json.loads(arrays.pop(FACTS).tobytes().decode("utf-8"))
    if facts.pop("format") != FORMAT or facts["version"] != __version__:
        raise ValueError(f"{path} is of another version")
    return Checkpoint(**facts, arrays={name.removeprefix("state/"): array for name, array in arrays.items()})

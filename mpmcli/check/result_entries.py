"""Opens a result that may be damaged: the frames that can be read, and findings for the others."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.damage import DAMAGE, first_line
from mpmcli.output.hdf5_items import DamageError
from mpmcli.output.header import RunHeader
from mpmcli.output.result import Result, open_result
from mpmcli.output.run_record import read_record
from mpmcli.output.run_status import run_status
from mpmcli.output.segments import PACKED, SEGMENTS, sealed_segments
from mpmcli.output.series import SERIES, SERIES_HEADER

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
RUN_AGAIN = "Copy the file again from where it was made, or run the scene again."


@dataclass(frozen=True)
class Entry:
    """One frame of a result, not yet read.

    Attributes:
        number: number of the frame, from the name of its file if it has its own.
        said: number of the frame in its content.
        time: time listed in the file, s.
        row: row of the ledger.
        count: number of particles listed in the file.
        result: result that holds the frame, None where it is in memory.
        k: index of the frame in `result`.
    """

    number: int
    said: int
    time: float
    row: LedgerRow
    count: int
    result: Result | None
    k: int

    def read(self) -> tuple[Frame, np.ndarray]:
        """Read the frame and its ids.

        Raises:
            InputError: it cannot be read.
        """
        try:
            frame, ids = self.result.numbered_frame(self.k)
        except DAMAGE as error:
            raise InputError(f"Frame {self.number} cannot be read ({first_line(error)}).") from error
        lengths = {name: len(array) for name, array in arrays_of(frame, ids).items()}
        shortest = min(lengths, key=lambda name: lengths[name])
        if lengths[shortest] < max(lengths.values()):
            raise InputError(
                f"Frame {self.number} is cut off: {shortest} has {lengths[shortest]} of {max(lengths.values())} rows."
            )
        return frame, ids


@dataclass(frozen=True)
class KeptEntry(Entry):
    """A frame in memory, all of which is known.

    Attributes:
        frame: the frame.
    """

    frame: Frame

    def read(self) -> tuple[Frame, np.ndarray]:
        return self.frame, np.arange(self.count, dtype=np.int32)


@dataclass(frozen=True)
class OpenedResult:
    """The readable part of a result.

    Attributes:
        path: file or directory read.
        kind: "packed", "segments", "series", "memory", or "none" if nothing can be read.
        header: header of the run.
        record: content of run.json, or None.
        entries: frames in the order of the files.
    """

    path: Path
    kind: str
    header: RunHeader
    record: dict[str, Any] | None
    entries: list[Entry]

    @property
    def status(self) -> str:
        """How the run stands, see `run_status`."""
        directory = self.path if self.path.is_dir() else self.path.parent
        return run_status(directory, self.record)


def arrays_of(frame: Frame, ids: np.ndarray) -> dict[str, np.ndarray]:
    """Return all arrays of a frame by name."""
    standard = {name: getattr(frame, name) for name in ("position", "velocity", "body", "material")}
    return {"id": ids, **standard, **frame.fields}


def kept_entries(header: RunHeader, frames: Sequence[Frame], ledger: Sequence[LedgerRow]) -> OpenedResult:
    """Return the frames of a run in memory that has finished, with the rows of its ledger."""
    entries = [
        KeptEntry(frame.index, frame.index, frame.time, row, len(frame.position), None, k, frame)
        for k, (frame, row) in enumerate(zip(frames, ledger, strict=True))
    ]
    return OpenedResult(Path(), "memory", header, {"status": "finished"}, entries)


def open_entries(path: Path, findings: FrameFindings) -> OpenedResult:
    """Open the readable part of a result.

    Raises:
        InputError: there is nothing at `path`, or nothing that this version of mpmcli wrote.
    """
    path = Path(path)
    if path.name == SEGMENTS and path.is_dir():
        path = path.parent
    if path.is_dir() and not (path / PACKED).exists() and sealed_segments(path):
        return _open_segments(path, findings)
    try:
        result = open_result(path)
    except DAMAGE as error:
        if not _is_damage(path, error):
            raise
        directory = path if path.is_dir() else path.parent
        findings.add("error", "unreadable", 0, f"No frame can be read: {first_line(error)}", RUN_AGAIN)
        return OpenedResult(path, "none", RunHeader.read({}), read_record(directory), [])
    listed = min(len(result.ledger), len(result.numbers), len(result.particle_counts))
    if listed < result.frame_count:
        what = f"The ledger has {listed} rows for {result.frame_count} frames"
        findings.add("error", "ledger-missing", listed, what, RUN_AGAIN)
    entries = [_entry(result, k, int(result.numbers[k])) for k in range(min(listed, result.frame_count))]
    return OpenedResult(result.path, result.kind, result.header, result.record, entries)


def _open_segments(directory: Path, findings: FrameFindings) -> OpenedResult:
    """Open each sealed segment separately, so that damage to one does not affect the others."""
    entries: list[Entry] = []
    for segment in sealed_segments(directory):
        number = int(segment.stem.split("_")[1])
        try:
            result = open_result(segment)
            entries += [_entry(result, k, number + k) for k in range(result.frame_count)]
        except DAMAGE as error:
            what = f"The segment of frame {number} cannot be read ({first_line(error)})"
            findings.add("error", "unreadable", number, what, RUN_AGAIN)
    header = entries[0].result.header if entries else RunHeader.read({})
    return OpenedResult(directory, "segments", header, read_record(directory), entries)


def _entry(result: Result, k: int, number: int) -> Entry:
    return Entry(
        number,
        int(result.numbers[k]),
        float(result.times[k]),
        result.ledger[k],
        int(result.particle_counts[k]),
        result,
        k,
    )


def _is_damage(path: Path, error: Exception) -> bool:
    """Return whether mpmcli wrote the file, so that it is damaged rather than of another kind."""
    directory = path if path.is_dir() else path.parent
    if not path.exists() or path.suffix == ".vtu":
        return False
    ours = read_record(directory) is not None
    if path.is_dir():
        packed = path / PACKED
        if not packed.exists() and not (path / SERIES).exists():
            return ours  # a run that wrote no frame
        path = packed if packed.exists() else path / SERIES
    if isinstance(error, DamageError):
        return True
    # open_result sets a cause if the file could not be read, and none if it is of another kind or version.
    if isinstance(error, InputError) and error.__cause__ is None:
        return False
    if ours or (path.parent / SERIES_HEADER).exists():
        return True
    with path.open("rb") as file:
        return file.read(8) == HDF5_SIGNATURE

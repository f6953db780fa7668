"""Opens a result that may be damaged, and checks that it holds each frame once, at its time, and how the run ended."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader
from mpmcli.output.reading import DamageError, first_line
from mpmcli.output.result import Result, open_result, result_place
from mpmcli.output.run_record import DIED, ELSEWHERE, read_record, run_status
from mpmcli.output.segments import PACKED, sealed_segments

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
RUN_AGAIN = "Copy the file again from where it was made, or run the scene again."
# Tolerance of times, relative to the duration of the run.
TIME_ERROR = 1e-9


@dataclass(frozen=True)
class Entry:
    """One frame of a result, not yet read: frame k of `result`, which is None where it is in memory."""

    # From the name of its file if it has its own, and by its content.
    number: int
    said: int
    # Time, s, row of the ledger and number of particles that the file lists.
    time: float
    row: LedgerRow
    count: int
    result: Result | None
    k: int

    @classmethod
    def of(cls, result: Result, k: int, number: int) -> "Entry":
        """Return frame k of a result."""
        time, count = float(result.times[k]), int(result.particle_counts[k])
        return cls(number, int(result.numbers[k]), time, result.ledger[k], count, result, k)

    def read(self) -> tuple[Frame, np.ndarray]:
        """Read the frame and its ids; raise InputError if it cannot be read."""
        try:
            frame, ids = self.result.numbered_frame(self.k)
        except InputError as error:
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
    """A frame in memory, all of which is known."""

    frame: Frame

    def read(self) -> tuple[Frame, np.ndarray]:
        return self.frame, np.arange(self.count, dtype=np.int32)


@dataclass(frozen=True)
class OpenedResult:
    """The readable part of a result, its frames in the order of the files."""

    path: Path
    # "packed", "segments", "memory", or "none" if nothing can be read.
    kind: str
    header: RunHeader
    # Content of run.json.
    record: dict[str, Any] | None
    entries: list[Entry]

    @property
    def status(self) -> str:
        """How the run stands, see `run_status`."""
        return run_status(_directory(self.path), self.record)

    @property
    def frames_expected(self) -> int | None:
        """Number of frames of the whole run, None if it is not known."""
        return (self.record or {}).get("frames_expected") or self.header.frames


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
    """Open what can be read of a result, and note the rest; InputError: nothing is there, or nothing of ours."""
    path = result_place(path)
    if path.is_dir() and not (path / PACKED).exists() and sealed_segments(path):
        return _open_segments(path, findings)
    try:
        result = open_result(path)
    except InputError as error:
        if not _is_damage(path, error):
            raise
        findings.add("error", "unreadable", 0, f"No frame can be read: {first_line(error)}", RUN_AGAIN)
        return OpenedResult(path, "none", RunHeader.read({}), read_record(_directory(path)), [])
    entries = [Entry.of(result, k, int(result.numbers[k])) for k in range(result.frame_count)]
    return OpenedResult(result.path, result.kind, result.header, result.record, entries)


def _open_segments(directory: Path, findings: FrameFindings) -> OpenedResult:
    """Open each sealed segment separately, so that damage to one does not affect the others."""
    entries: list[Entry] = []
    for segment in sealed_segments(directory):
        number = int(segment.stem.split("_")[1])
        try:
            result = open_result(segment)
            entries += [Entry.of(result, k, number + k) for k in range(result.frame_count)]
        except InputError as error:
            what = f"The segment of frame {number} cannot be read ({first_line(error)})"
            findings.add("error", "unreadable", number, what, RUN_AGAIN)
    header = entries[0].result.header if entries else RunHeader.read({})
    return OpenedResult(directory, "segments", header, read_record(directory), entries)


def _directory(path: Path) -> Path:
    return path if path.is_dir() else path.parent


def _is_damage(path: Path, error: Exception) -> bool:
    """Return whether mpmcli wrote the file, so that it is damaged rather than of another kind."""
    if not path.exists():
        return False
    ours = read_record(_directory(path)) is not None
    if path.is_dir():
        packed = path / PACKED
        if not packed.exists():
            return ours  # a run that wrote no frame
        path = packed
    if isinstance(error, DamageError):
        return True
    # open_result sets a cause if the file could not be read, and none if it is of another kind or version.
    if isinstance(error, InputError) and error.__cause__ is None:
        return False
    if ours:
        return True
    with path.open("rb") as file:
        return file.read(8) == HDF5_SIGNATURE


def check_order(opened: OpenedResult, findings: FrameFindings) -> None:
    """Check the numbers and times of the frames, and that a finished run has all of them."""
    entries, expected = opened.entries, opened.frames_expected
    _numbers(entries, findings)
    _times(entries, opened.header, findings)
    status = (opened.record or {}).get("status")
    numbers = {entry.number for entry in entries} | {entry.said for entry in entries}
    if expected is not None and entries and max(numbers) >= expected:
        what = f"There is a frame {max(numbers)}, where the scene has frames 0 to {expected - 1} only"
        findings.add("error", "extra-frames", expected, what, "Remove what was added to the result.")
    # Frames missing at the end of a run that did not finish are reported by its status.
    whole = expected if expected is not None and status in (None, "finished") else max(numbers, default=-1) + 1
    there = {entry.number for entry in entries} | findings.frames_of("unreadable")
    first, count = _missing(there, whole if expected is None else min(whole, expected))
    if count and entries:
        named = f"Frame {first} is" if count == 1 else f"Frame {first} and {count - 1} more of {whole} are"
        findings.add("error", "missing-frames", first, f"{named} missing", RUN_AGAIN, value=count)
    _status(opened, findings)


def _missing(there: set[int], whole: int) -> tuple[int, int]:
    # A damaged file may state any number, so that a loop over all of them could be endless.
    known = sorted(number for number in there if 0 <= number < whole)
    first = next((k for k, number in enumerate(known) if k != number), len(known))
    return first, whole - len(known)


def _numbers(entries: Sequence[Entry], findings: FrameFindings) -> None:
    seen: set[int] = set()
    highest = -1
    for entry in entries:
        if entry.said != entry.number:
            what = f"The file of frame {entry.number} holds frame {entry.said}"
            findings.add("error", "frame-number", entry.number, what, RUN_AGAIN, value=entry.said)
        elif entry.said in seen:
            what = f"Frame {entry.said} is there more than once"
            findings.add("error", "duplicated-frames", entry.said, what, "Remove the second one.", value=entry.said)
        elif entry.said < highest:
            what = f"Frame {entry.said} comes after frame {highest}"
            findings.add("error", "frame-order", entry.said, what, "Put the frames in order.", value=entry.said)
        seen.add(entry.said)
        highest = max(highest, entry.said)


def _times(entries: Sequence[Entry], header: RunHeader, findings: FrameFindings) -> None:
    before = None
    for entry in entries:
        allowed = TIME_ERROR * max(abs(entry.time), header.end or 0.0)
        if not abs(entry.time - entry.row.time) <= allowed:
            what = f"Frame {entry.number} is listed at {entry.time:.6g} s and its ledger row at {entry.row.time:.6g} s"
            findings.add("error", "frame-time", entry.number, what, RUN_AGAIN, value=entry.time, kind="ledger")
        elif before is not None and not entry.time > before:
            what = f"Frame {entry.number}, at {entry.time:.6g} s, is not later than the one before it"
            findings.add("error", "frame-time", entry.number, what, RUN_AGAIN, value=entry.time, kind="order")
        elif header.end is not None and header.frames is not None:
            planned = header.end * entry.number / (header.frames - 1)
            if not abs(entry.time - planned) <= allowed:
                what = f"Frame {entry.number} is at {entry.time:.6g} s, where the scene has it at {planned:.6g} s"
                findings.add("error", "frame-time", entry.number, what, RUN_AGAIN, value=entry.time, kind="scene")
        before = entry.time


def _status(opened: OpenedResult, findings: FrameFindings) -> None:
    count, expected = max((entry.number for entry in opened.entries), default=-1) + 1, opened.frames_expected
    far = f"{count} of {expected} frames" if expected is not None else f"{count} frames"
    record = opened.record
    if record is None:
        what = "No run.json lies beside the frames, so how the run ended is not known"
        findings.add("note", "no-record", None, what, "Keep run.json together with the frames.")
        return
    status = opened.status
    message = ((record.get("failure") or {}).get("message") or "").rstrip(".")
    said = f": {message}" if message else ""
    if status == "unstable":
        fix = "Change what the sentence names and run it again."
        findings.add("error", "unstable-run", count, f"After {far} {message or 'the run became unstable'}", fix)
    elif status == "failed":
        findings.add("error", "failed-run", count, f"The run failed after {far}{said}", "Run it again.")
    elif status == "interrupted":
        what = f"The run was interrupted after {far}"
        findings.add("warning", "interrupted-run", count, what, "mpmcli simulate --resume goes on with it.")
    elif status == "stopped":
        findings.add(
            "warning",
            "stopped-run",
            count,
            f"The run stopped after {far}{said}",
            "mpmcli simulate --resume goes on with it.",
        )
    elif status == DIED:
        what = f"The run died after {far}: its process has ended and left no word"
        findings.add("warning", "died-run", count, what, "mpmcli simulate --resume goes on with it.")
    elif status in ("running", ELSEWHERE):
        still = "and it goes on" if status == "running" else "and whether it goes on cannot be seen from here"
        what = f"The run has not ended; there are {far}, {still}"
        findings.add("warning", "running", count, what, "Wait for it, or run it again.")

"""Opens a result that may be damaged, and checks that it holds each frame at its time, and how the run ended."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.check.finding import FrameFindings, Severity
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader
from mpmcli.output.reading import DamageError, first_line
from mpmcli.output.result import Result, open_result, result_place
from mpmcli.output.run_record import DIED, ELSEWHERE, read_record, run_status
from mpmcli.output.segments import PACKED, sealed_segments

RUN_AGAIN = "Copy the file again from where it was made, or run the scene again."
GO_ON = "mpmcli simulate --resume goes on with it."
WAIT = "Wait for it, or run it again."
# Tolerance of times, relative to the duration of the run.
TIME_ERROR = 1e-9
# What is said of a run that did not finish, by its status.
GOES_ON = "The run has not ended; there are {far}, and "
ENDS: dict[str, tuple[Severity, str, str, str]] = {
    "unstable": ("error", "unstable-run", "After {far} {why}", "Change what the sentence names and run it again."),
    "failed": ("error", "failed-run", "The run failed after {far}{told}", "Run it again."),
    "interrupted": ("warning", "interrupted-run", "The run was interrupted after {far}", GO_ON),
    "stopped": ("warning", "stopped-run", "The run stopped after {far}{told}", GO_ON),
    DIED: ("warning", "died-run", "The run died after {far}: its process has ended and left no word", GO_ON),
    "running": ("warning", "running", GOES_ON + "it goes on", WAIT),
    ELSEWHERE: ("warning", "running", GOES_ON + "whether it goes on cannot be seen from here", WAIT),
}


@dataclass(frozen=True)
class Entry:
    """A frame that is not read yet: its number, time, s, row of the ledger and number of particles."""

    number: int
    time: float
    row: LedgerRow
    count: int
    # Reads the frame and its ids; InputError: it is damaged.
    read: Callable[[], tuple[Frame, np.ndarray]]


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

    @property
    def last(self) -> int:
        """Number of the last frame, -1 without any."""
        return max((entry.number for entry in self.entries), default=-1)

    @property
    def failure(self) -> dict[str, Any]:
        """What the record says of the failure of the run."""
        return (self.record or {}).get("failure") or {}


def kept_entries(header: RunHeader, frames: Sequence[Frame], ledger: Sequence[LedgerRow]) -> OpenedResult:
    """Return the frames of a run in memory that has finished, with the rows of its ledger."""

    def entry(frame: Frame, row: LedgerRow) -> Entry:
        n = len(frame.position)
        return Entry(frame.index, frame.time, row, n, lambda: (frame, np.arange(n, dtype=np.int32)))

    entries = list(map(entry, frames, ledger))
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
    return OpenedResult(result.path, result.kind, result.header, result.record, _entries(result))


def _entries(result: Result, number: int | None = None) -> list[Entry]:
    """Return the frames of a result, numbered from `number` on where the name of its file gives that."""
    numbers = result.numbers.tolist() if number is None else range(number, number + result.frame_count)
    columns = zip(numbers, result.times.tolist(), result.ledger, result.particle_counts.tolist(), strict=True)
    return [Entry(*facts, partial(result.numbered_frame, k)) for k, facts in enumerate(columns)]


def _open_segments(directory: Path, findings: FrameFindings) -> OpenedResult:
    """Open each sealed segment separately, so that damage to one does not affect the others."""
    header, entries = None, []
    for segment in sealed_segments(directory):
        number = int(segment.stem.split("_")[1])
        try:
            result = open_result(segment)
            entries += _entries(result, number)
            header = header or result.header
        except InputError as error:
            what = f"The segment of frame {number} cannot be read ({first_line(error)})"
            findings.add("error", "unreadable", number, what, RUN_AGAIN)
    return OpenedResult(directory, "segments", header or RunHeader.read({}), read_record(directory), entries)


def _directory(path: Path) -> Path:
    return path if path.is_dir() else path.parent


def _is_damage(path: Path, error: InputError) -> bool:
    """Return whether mpmcli wrote what cannot be read, so that it is damaged rather than of another kind."""
    ours = read_record(_directory(path)) is not None
    if path.is_dir() and not (path / PACKED).exists():
        return ours  # a run that wrote no frame
    # A cause is set if the file could not be read, and none if it is of another kind or version.
    return isinstance(error, DamageError) or (ours and error.__cause__ is not None)


def check_order(opened: OpenedResult, findings: FrameFindings) -> None:
    """Check the times of the frames, that a finished run has all of them, and how the run ended."""
    entries, expected, header = opened.entries, opened.frames_expected, opened.header
    for entry in entries if header.end is not None and header.frames is not None else ():
        planned = header.end * entry.number / (header.frames - 1)
        if not abs(entry.time - planned) <= TIME_ERROR * header.end:
            what = f"Frame {entry.number} is at {entry.time:.6g} s, where the scene has it at {planned:.6g} s"
            findings.add("error", "frame-time", entry.number, what, RUN_AGAIN, value=entry.time)
    # Frames missing at the end of a run that did not finish are reported by its status.
    over = (opened.record or {}).get("status") in (None, "finished")
    whole = expected if expected is not None and over else opened.last + 1
    there = {entry.number for entry in entries} | findings.frames_of("unreadable")
    missing = whole - sum(number < whole for number in there)
    if missing and entries:
        first = next(number for number in count() if number not in there)
        named = f"Frame {first} is" if missing == 1 else f"Frame {first} and {missing - 1} more of {whole} are"
        findings.add("error", "missing-frames", first, f"{named} missing", RUN_AGAIN, value=missing)
    if opened.record is None:
        what = "No run.json lies beside the frames, so how the run ended is not known"
        findings.add("note", "no-record", None, what, "Keep run.json together with the frames.")
    elif opened.status in ENDS:
        severity, rule, what, fix = ENDS[opened.status]
        message = (opened.failure.get("message") or "").rstrip(".")
        written = opened.last + 1
        far = f"{written} frames" if expected is None else f"{written} of {expected} frames"
        what = what.format(far=far, why=message or "the run became unstable", told=message and f": {message}")
        findings.add(severity, rule, written, what, fix)

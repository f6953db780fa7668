"""Opens a result that may be damaged, and checks the times of its frames and the end of its run."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from mpmcli.check.finding import FrameFindings, Severity
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.checksums import DamageError, first_line
from mpmcli.output.durable import number_of
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import PACKED, sealed_segments
from mpmcli.output.result import open_result, result_place
from mpmcli.output.run_record import DIED, ELSEWHERE, read_record, run_status

RUN_AGAIN = "Copy the file again from where it was made, or run the scene again."
GO_ON = "mpmcli simulate --resume goes on with it."
WAIT = "Wait for it, or run it again."
# Tolerance of times, relative to the duration of the run.
TIME_ERROR = 1e-9
# Messages on a run that did not finish, by its status.
GOES_ON = "The run has not ended; there are {far}, and "
ENDS: dict[str, tuple[Severity, str, str, str]] = {
    "unstable": ("error", "unstable-run", "After {far} {why}", "Change what the sentence names and run it again."),
    "failed": ("error", "failed-run", "The run failed after {far}{told}", "Run it again."),
    "interrupted": ("warning", "interrupted-run", "The run was interrupted after {far}", GO_ON),
    "stopped": ("warning", "stopped-run", "The run stopped after {far}{told}", GO_ON),
    DIED: ("warning", "died-run", "The run died after {far}: its process has ended without recording it", GO_ON),
    "running": ("warning", "running", GOES_ON + "it goes on", WAIT),
    ELSEWHERE: ("warning", "running", GOES_ON + "whether it continues cannot be determined", WAIT),
}


@dataclass(frozen=True)
class Entry:
    """A frame that is not read yet: its number, time, s, row of the ledger and number of particles."""

    number: int
    time: float
    row: LedgerRow
    count: int
    # Reads the frame; InputError: it is damaged. None if it is not kept.
    read: Callable[[], Frame] | None


@dataclass(frozen=True)
class OpenedResult:
    """The readable part of a result, its frames in the order of the files."""

    path: Path
    # "packed", "segments", "memory", or "none" if nothing can be read.
    kind: str
    header: RunHeader
    # Content of run.json, {} without one.
    record: dict[str, Any]
    entries: list[Entry]

    @property
    def status(self) -> str:
        """Status of the run, see `run_status`."""
        return run_status(_directory(self.path), self.record or None)

    @property
    def frames_expected(self) -> int | None:
        """Number of frames of the whole run, None if it is not known."""
        return self.record.get("frames_expected") or self.header.frames

    @property
    def last(self) -> int:
        """Number of the last frame, -1 without any."""
        return max((entry.number for entry in self.entries), default=-1)


def open_entries(path: Path, findings: FrameFindings) -> OpenedResult:
    """Open the readable part of a result, and report the rest; InputError: `path` is not a result of mpmcli.

    Each segment is opened separately, so that damage to one does not affect the others.
    """
    path = result_place(path)
    segments = sealed_segments(path) if path.is_dir() and not (path / PACKED).exists() else []
    kind, header, entries = "segments" if segments else "none", RunHeader.read({}), []
    for file in segments or [path]:
        first = number_of(file) if segments else 0
        try:
            result = open_result(file)
        except InputError as error:
            if not segments and not _is_damage(path, error):
                raise
            which = f"The segment of frame {first} cannot be read ({{}})" if segments else "No frame can be read: {}"
            findings.add("error", "unreadable", first, which.format(first_line(error)), RUN_AGAIN)
            continue
        header = header if entries else result.header
        numbers = range(first, first + result.frame_count) if segments else result.numbers.tolist()
        columns = zip(numbers, result.times.tolist(), result.ledger, result.particle_counts.tolist(), strict=True)
        entries += [Entry(*facts, partial(result.frame, k)) for k, facts in enumerate(columns)]
        path, kind = (path, kind) if segments else (result.path, result.kind)
    return OpenedResult(path, kind, header, read_record(_directory(path)) or {}, entries)


def _directory(path: Path) -> Path:
    return path if path.is_dir() else path.parent


def _is_damage(path: Path, error: InputError) -> bool:
    """Return whether an unreadable file was written by mpmcli, so that it is damaged rather than of another kind."""
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
    over = opened.record.get("status") in (None, "finished")
    whole = expected if expected is not None and over else opened.last + 1
    there = {entry.number for entry in entries} | findings.frames_of("unreadable")
    missing = whole - sum(number < whole for number in there)
    if missing and entries:
        first = next(number for number in count() if number not in there)
        named = f"Frame {first} is" if missing == 1 else f"Frame {first} and {missing - 1} more of {whole} are"
        findings.add("error", "missing-frames", first, f"{named} missing", RUN_AGAIN, value=missing)
    if not opened.record:
        what = "No run.json lies beside the frames, so how the run ended is not known"
        findings.add("note", "no-record", None, what, "Keep run.json together with the frames.")
    elif opened.status in ENDS:
        severity, rule, what, fix = ENDS[opened.status]
        message = ((opened.record.get("failure") or {}).get("message") or "").rstrip(".")
        written = opened.last + 1
        far = f"{written} frames" if expected is None else f"{written} of {expected} frames"
        what = what.format(far=far, why=message or "the run became unstable", told=message and f": {message}")
        findings.add(severity, rule, written, what, fix)

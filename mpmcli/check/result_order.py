"""Checks that a result holds each frame once, at its time, and how the run ended."""

from collections.abc import Sequence

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_entries import RUN_AGAIN, Entry, OpenedResult
from mpmcli.output.header import RunHeader
from mpmcli.output.run_status import DIED, ELSEWHERE

# Tolerance of times, relative to the duration of the run.
TIME_ERROR = 1e-9


def frames_expected(opened: OpenedResult, header: RunHeader) -> int | None:
    """Return the number of frames of the whole run, None if it is not known."""
    return (opened.record or {}).get("frames_expected") or header.frames


def check_order(opened: OpenedResult, header: RunHeader, findings: FrameFindings) -> None:
    """Check the numbers and times of the frames, and that a finished run has all of them."""
    entries = opened.entries
    _numbers(entries, findings)
    _times(entries, header, findings)
    expected = frames_expected(opened, header)
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
    _status(opened, expected, findings)


def _missing(there: set[int], whole: int) -> tuple[int, int]:
    """Return the first missing number below `whole`, and how many are missing."""
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
        elif before is not None and not entry.time > before.time:
            what = f"Frame {entry.number}, at {entry.time:.6g} s, is not later than the one before it"
            findings.add("error", "frame-time", entry.number, what, RUN_AGAIN, value=entry.time, kind="order")
        elif header.end is not None and header.frames is not None:
            planned = header.end * entry.number / (header.frames - 1)
            if not abs(entry.time - planned) <= allowed:
                what = f"Frame {entry.number} is at {entry.time:.6g} s, where the scene has it at {planned:.6g} s"
                findings.add("error", "frame-time", entry.number, what, RUN_AGAIN, value=entry.time, kind="scene")
        before = entry


def _status(opened: OpenedResult, expected: int | None, findings: FrameFindings) -> None:
    count = max((entry.number for entry in opened.entries), default=-1) + 1
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
        findings.add("warning", "interrupted-run", count, what, "Run it again to have all frames.")
    elif status == "stopped":
        findings.add("warning", "stopped-run", count, f"The run stopped after {far}{said}", "Run it again.")
    elif status == DIED:
        what = f"The run died after {far}: its process has ended and left no word"
        findings.add("warning", "died-run", count, what, "Run it again to have all frames.")
    elif status in ("running", ELSEWHERE):
        still = "and it goes on" if status == "running" else "and whether it goes on cannot be seen from here"
        what = f"The run has not ended; there are {far}, {still}"
        findings.add("warning", "running", count, what, "Wait for it, or run it again.")

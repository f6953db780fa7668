"""`mpmcli check RESULT`: whether a run stayed stable and its frames are complete."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mpmcli.check.finding import Finding, FrameFindings, Verdict, passes
from mpmcli.check.result_entries import RUN_AGAIN, OpenedResult, check_order, kept_entries, open_entries
from mpmcli.check.result_ledger import check_ledger
from mpmcli.check.result_state import CrowdCheck, MomentumCheck, StateCheck, StretchCheck
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader
from mpmcli.output.reading import first_line
from mpmcli.output.segments import PACKED
from mpmcli.plain_json import finite_json

# Labels of the figures in text.
TOLD = {
    "energy_growth": "energy growth / turned over",
    "energy_lost": "energy lost / turned over",
    "mass_change": "mass change",
    "momentum_drift": "momentum drift",
    "collider_impulse": "momentum that colliders took, kg m/s",
    "courant_max": "largest Courant number",
    "speed_max": "largest speed, m/s",
    "volume_ratio_min": "smallest J",
    "volume_ratio_max": "largest J",
    "volume_error": "lasting volume error",
    "contact_overlap": "deepest overlap of surfaces, cells",
    "contact_gap": "largest gap that acts, cells",
    "neighbour_distance": "farthest neighbours, cells",
    "densest_cell": "densest cell / meant",
    "empty_cells": "empty cells inside",
    "step_min": "smallest step, s",
    "step_max": "largest step, s",
}


@dataclass(frozen=True)
class ResultCheck:
    """Result of the check of a run; `path` and `kind` are those of `OpenedResult`, `status` is that of its record.

    `limit` is the bound on the step that was smallest at the first frame with an error or a warning, "" if not known.
    None are figures that are not available: those of TOLD, momentum_frames (compared), step_ratio (smallest over
    first), bytes (of particle data read).
    """

    first_bad_frame: int | None
    limit: str
    findings: tuple[Finding, ...]
    frames: int
    frames_expected: int | None
    particles: int
    figures: dict[str, float | None]
    kind: str
    status: str
    path: Path

    @property
    def verdict(self) -> Verdict:
        """ "unstable" with an error, "suspect" with a warning and no error, otherwise "stable"."""
        if not passes(self.findings):
            return "unstable"
        return "stable" if passes(self.findings, strict=True) else "suspect"

    def passes(self, strict: bool = False) -> bool:
        """Return whether there is no error; with `strict`, no warning either."""
        return passes(self.findings, strict=strict)

    def as_dict(self) -> dict:
        """Return the check as a dictionary for JSON."""
        findings = [finite_json(finding.as_dict()) for finding in self.findings]
        own = {**vars(self), "findings": findings, "figures": finite_json(self.figures), "path": str(self.path)}
        return {"ok": self.passes(), "verdict": self.verdict, **own}

    def text(self) -> str:
        """Return the check as text: the verdict, the figures, and a line for each finding."""
        bad = "" if self.first_bad_frame is None else f", first bad frame {self.first_bad_frame}"
        limit = f', nearest limit "{self.limit}"' if bad and self.limit else ""
        expected = "" if self.frames_expected is None else f" of {self.frames_expected}"
        told = {"frames": f"{self.frames}{expected}", "particles": str(self.particles), "status": self.status}
        known = {name: value for name, value in self.figures.items() if value is not None}
        told |= {words: f"{known[name]:.4g}" for name, words in TOLD.items() if name in known}
        width = max(map(len, told))
        lines = [f"{self.path}: {self.verdict}{bad}{limit}"]
        lines += [f"  {words:<{width}}  {value}" for words, value in told.items()]
        return "\n".join([*lines, *(finding.line for finding in self.findings)])


def check_result(path: Path) -> ResultCheck:
    """Check ledger and frames of a result, packed or segments, whose run may go on; InputError: none of ours."""
    findings = FrameFindings()
    opened = open_entries(path, findings)
    check = _check(opened, findings)
    if opened.kind == "segments" and (opened.path / PACKED).exists():
        # The run ended during the check, and has packed its frames.
        return check_result(opened.path)
    return check


def check_kept(header: RunHeader, frames: Sequence[Frame], ledger: Sequence[LedgerRow]) -> ResultCheck:
    """Check all frames of a finished run in memory, as `check_result` checks files, but not for changes since."""
    return _check(kept_entries(header, frames, ledger), FrameFindings())


def _check(opened: OpenedResult, findings: FrameFindings) -> ResultCheck:
    check_order(opened, findings)
    figures = check_ledger(opened.entries, opened.header, findings)
    if opened.entries:
        figures |= _check_frames(opened, findings)
    found = findings.found()
    first_bad = min((f.frame for f in found if f.severity != "note" and f.frame is not None), default=None)
    return ResultCheck(
        path=opened.path,
        kind=opened.kind,
        status=opened.status,
        findings=found,
        first_bad_frame=first_bad,
        limit="" if first_bad is None else _limit_at(opened, first_bad),
        frames=len(opened.entries) - len(findings.frames_of("unreadable") & {e.number for e in opened.entries}),
        frames_expected=opened.frames_expected,
        particles=opened.entries[0].count if opened.entries else 0,
        figures=figures,
    )


def _check_frames(opened: OpenedResult, findings: FrameFindings) -> dict[str, float | None]:
    """Read each frame once, and check its values."""
    header = opened.header
    state, stretch, momentum = (kind(header, findings) for kind in (StateCheck, StretchCheck, MomentumCheck))
    crowd = CrowdCheck(header, findings, opened.last)
    size = 0
    for entry in opened.entries:
        try:
            frame = entry.read()
        except InputError as error:
            what = f"Frame {entry.number} cannot be read ({first_line(error)})"
            findings.add("error", "unreadable", entry.number, what, RUN_AGAIN)
            momentum.lost()
            continue
        arrays = (frame.position, frame.velocity, frame.body, frame.material, *frame.fields.values())
        size += sum(array.nbytes for array in arrays)
        # Values that are not finite have one finding, and must not cause others.
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            if not state.check(frame):
                momentum.lost()
                continue
            momentum.check(frame, entry.row)
            crowd.check(frame)
            if not header.comes_and_goes:
                stretch.check(frame)
    return {**stretch.figures, **crowd.figures, **momentum.figures, "bytes": size}


def _limit_at(opened: OpenedResult, number: int) -> str:
    """Return the bound that was smallest at a frame: from the ledger, or from the diagnosis of an unstable run."""
    failure = opened.record.get("failure") or {}
    if number > opened.last and failure.get("limit"):
        return str(failure["limit"])
    rows = [entry.row for entry in opened.entries if entry.number <= max(number, 1)]
    return next((row.limit for row in reversed(rows) if row.limit), "")

"""`mpmcli check RESULT`: whether a run stayed stable and its frames are complete."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mpmcli.check.finding import Finding, FrameFindings, Verdict, passes
from mpmcli.check.result_entries import RUN_AGAIN, OpenedResult, arrays_of, check_order, kept_entries, open_entries
from mpmcli.check.result_ledger import AgreementCheck, check_ledger
from mpmcli.check.result_motion import MomentumCheck, MotionCheck, screen
from mpmcli.check.result_state import CrowdCheck, StateCheck, StretchCheck
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader
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
    "deformation_max": "largest deformation in a step",
    "displacement_ratio": "displacement / reach",
    "speed_max": "largest speed, m/s",
    "volume_ratio_min": "smallest J",
    "volume_ratio_max": "largest J",
    "volume_error": "lasting volume error",
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
    None are figures that are not available: those of TOLD, momentum_frames (compared), ledger_difference (largest
    relative one of ledger and frames), step_ratio (smallest over first), bytes (of particle data read).
    """

    path: Path
    kind: str
    status: str
    findings: tuple[Finding, ...]
    first_bad_frame: int | None
    limit: str
    frames: int
    frames_expected: int | None
    particles: int
    figures: dict[str, float | None]

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
        return {
            "ok": self.passes(),
            "verdict": self.verdict,
            "first_bad_frame": self.first_bad_frame,
            "limit": self.limit,
            "findings": [finite_json(finding.as_dict()) for finding in self.findings],
            **{name: getattr(self, name) for name in ("frames", "frames_expected", "particles")},
            "figures": finite_json(self.figures),
            "kind": self.kind,
            "status": self.status,
            "path": str(self.path),
        }

    def text(self) -> str:
        """Return the check as text: the verdict, the figures, and a line for each finding."""
        bad = "" if self.first_bad_frame is None else f", first bad frame {self.first_bad_frame}"
        limit = f', nearest limit "{self.limit}"' if bad and self.limit else ""
        expected = "" if self.frames_expected is None else f" of {self.frames_expected}"
        told = {"frames": f"{self.frames}{expected}", "particles": str(self.particles), "status": self.status}
        for name, words in TOLD.items():
            value = self.figures.get(name)
            if value is not None:
                told[words] = f"{value:.4g}"
        width = max(len(words) for words in told)
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
    bad = [f.frame for f in found if f.severity != "note" and f.frame is not None]
    first_bad = min(bad, default=None)
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
    """Read each frame once; check its values, and compare it with the previous frame and the ledger."""
    header = opened.header
    # Only a file can have been changed since the run.
    stored = opened.kind != "memory"
    state, motion = StateCheck(header, findings, stored=stored), MotionCheck(header, findings)
    agreement, stretch = AgreementCheck(header, findings), StretchCheck(header, findings)
    momentum = MomentumCheck(header, findings, opened.entries[0].row)
    crowd = CrowdCheck(header, findings, len(opened.entries))
    size = 0
    before: tuple[int, int] | None = None
    screened = None if stored else screen(header, opened.entries)
    for k, entry in enumerate(opened.entries):
        number, row = entry.number, entry.row
        try:
            frame, ids = entry.read()
        except InputError as error:
            findings.add("error", "unreadable", number, str(error).rstrip("."), RUN_AGAIN)
            motion.forget()
            momentum.lost()
            before = None
            continue
        size += sum(array.nbytes for array in arrays_of(frame, ids).values())
        if screened is not None and screened.quiet[k]:
            motion.passed(number, frame, float(screened.ratio[k]))
            momentum.check(number, frame, row, (screened.lowest[k], screened.highest[k]))
            stretch.check(number, frame)
            crowd.check(k, number, frame)
            continue
        # Values that are not finite have one finding, and must not cause others.
        with np.errstate(invalid="ignore", over="ignore"):
            sound = state.check(number, frame, ids, entry.count)
            J = state.volume_ratio(frame)
            if J is not None:
                state.check_volume(number, frame, J)
            if not header.drops:
                motion.check(number, frame, row, sound)
            if sound is None:
                steps = frame.step - before[1] if before is not None and before[0] + 1 == number else None
                if stored:
                    agreement.check(number, frame, row, J, steps)
                momentum.check(number, frame, row)
                crowd.check(k, number, frame, J)
                if not header.comes_and_goes:
                    stretch.check(number, frame)
            else:
                momentum.lost()
        before = (number, frame.step)
    return {
        "displacement_ratio": motion.largest_ratio,
        "deformation_max": motion.deformation,
        "neighbour_distance": stretch.largest,
        "densest_cell": crowd.densest,
        "empty_cells": crowd.empty,
        "momentum_drift": momentum.drift,
        "momentum_frames": momentum.frames,
        "ledger_difference": agreement.largest if stored else None,
        "bytes": size,
    }


def _limit_at(opened: OpenedResult, number: int) -> str:
    """Return the bound that was smallest at a frame: from the ledger, or from the diagnosis of an unstable run."""
    last = max((entry.number for entry in opened.entries), default=-1)
    diagnosed = ((opened.record or {}).get("failure") or {}).get("limit")
    if number > last and diagnosed:
        return str(diagnosed)
    up_to = [entry.row.limit for entry in opened.entries if entry.number <= max(number, 1) and entry.row.limit]
    return up_to[-1] if up_to else ""

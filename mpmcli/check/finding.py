"""Findings of a check: each states what is wrong, the number that shows it, and what to change."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

from mpmcli.plain_text import counted

Severity = Literal["error", "warning", "note"]
# Of a run; a check of its files finds the first three, the others stopped it.
Verdict = Literal["stable", "suspect", "unstable", "escaped", "failed"]
# In decreasing order of severity.
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One finding of a check.

    Attributes:
        severity: "error": the run or result is wrong; "warning": it is probably wrong; "note": information only.
        rule: short name of the rule, such as "thin-body".
        what: one sentence that states the finding, with numbers and units.
        fix: one sentence that states what to change.
        value: number that triggers the finding, or None.
        body: name of the body concerned, "" if there is no single one.
        frame: index of the first frame concerned, None for a scene or if there is no particular frame.
    """

    severity: Severity
    rule: str
    what: str
    fix: str
    value: float | None = None
    body: str = ""
    frame: int | None = None

    @property
    def line(self) -> str:
        """The finding in one line: severity, what, and what to change."""
        return f"{self.severity}: {self.what} {self.fix}"

    def as_dict(self) -> dict:
        """Return the finding as a dictionary for JSON."""
        return dict(vars(self))


def gravest_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings, errors before warnings before notes, otherwise in their order."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


def passes(findings: Iterable[Finding], *, strict: bool = False) -> bool:
    """Return whether no finding is an error; with `strict` a warning counts as one."""
    refused = SEVERITIES[: 2 if strict else 1]
    return not any(finding.severity in refused for finding in findings)


@dataclass
class _Seen:
    severity: Severity
    rule: str
    frame: int | None
    what: str
    fix: str
    value: float | None
    body: str
    frames: set[int] = field(default_factory=set)


class FrameFindings:
    """Findings of a result by rule. A fault that persists over frames is one finding, at its first frame."""

    def __init__(self) -> None:
        self._seen: dict[tuple[str, str, str], _Seen] = {}

    def add(
        self,
        severity: Severity,
        rule: str,
        frame: int | None,
        what: str,
        fix: str,
        value: float | None = None,
        body: str = "",
        kind: str = "",
    ) -> None:
        """Add a fault.

        Args:
            what: a sentence without its period.
            kind: distinguishes faults of one rule that are reported separately, such as the name of an array.
        """
        key = (severity, rule, kind)
        if key not in self._seen:
            self._seen[key] = _Seen(severity, rule, frame, what, fix, value, body)
        if frame is not None:
            self._seen[key].frames.add(frame)

    def frames_of(self, rule: str) -> set[int]:
        """Return the numbers of the frames with findings of a rule."""
        return set().union(*(seen.frames for seen in self._seen.values() if seen.rule == rule))

    def found(self) -> tuple[Finding, ...]:
        """Return all findings by severity, and by frame within a severity."""
        ordered = sorted(self._seen.values(), key=lambda seen: -1 if seen.frame is None else seen.frame)
        return gravest_first(_finding(seen) for seen in ordered)


def _finding(seen: _Seen) -> Finding:
    more = len(seen.frames) - 1
    suffix = f"; the same is found in {counted(more, 'more frame')}" if more > 0 else ""
    return Finding(
        seen.severity, seen.rule, f"{seen.what}{suffix}.", seen.fix, value=seen.value, body=seen.body, frame=seen.frame
    )

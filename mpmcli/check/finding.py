"""One thing that a check found, with what triggers it and what to change."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

Severity = Literal["error", "warning", "note"]
# From the gravest down.
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One thing that a check found.

    Attributes:
        severity: "error": the run or result cannot be trusted; "warning": it probably cannot; "note": good to know.
        rule: short name of the rule, such as "thin-body".
        what: one sentence that says what was found, with its numbers and units.
        fix: one sentence that says what to change.
        value: the number that triggers it, None where there is none.
        body: name of the body concerned, "" where it is not a single one.
        frame: index of the first frame concerned, None for a scene, or where it is none in particular.
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
        """Return it as JSON can hold it."""
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
    """Findings by rule; a fault that goes on from frame to frame is one finding, not hundreds."""

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
        """Note a fault.

        Args:
            what: a sentence without its period.
            kind: tells faults of one rule apart that are to be told each for itself, such as the array's name.
        """
        key = (severity, rule, kind)
        if key not in self._seen:
            self._seen[key] = _Seen(severity, rule, frame, what, fix, value, body)
        if frame is not None:
            self._seen[key].frames.add(frame)

    def frames_of(self, rule: str) -> set[int]:
        """Return the frames that a rule has found fault with."""
        return set().union(*(seen.frames for seen in self._seen.values() if seen.rule == rule))

    def found(self) -> tuple[Finding, ...]:
        """Return all of it, the gravest first, and by frame among the equally grave."""
        ordered = sorted(self._seen.values(), key=lambda seen: -1 if seen.frame is None else seen.frame)
        return gravest_first(_finding(seen) for seen in ordered)


def _finding(seen: _Seen) -> Finding:
    more = len(seen.frames) - 1
    suffix = f"; so it is in {more} more frame{'s' if more > 1 else ''}" if more > 0 else ""
    return Finding(
        seen.severity, seen.rule, f"{seen.what}{suffix}.", seen.fix, value=seen.value, body=seen.body, frame=seen.frame
    )

"""Collects what is wrong with the frames of a result: once per rule, at the first frame that shows it."""

from dataclasses import dataclass, field

from mpmcli.check.finding import Finding, Severity, gravest_first


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

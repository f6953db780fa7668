"""One thing that a check found, with what triggers it and what to change."""

from collections.abc import Iterable
from dataclasses import dataclass
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

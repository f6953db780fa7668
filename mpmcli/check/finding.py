"""Findings of a check: each states a fault, the number that shows it, and the change that removes it."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from mpmcli.plain_text import counted
from mpmcli.scene.problem import quoted, several

Severity = Literal["error", "warning", "note"]
# Verdicts of a run; a check of its files finds the first three, the others stopped it.
Verdict = Literal["stable", "suspect", "unstable", "escaped", "failed"]
# Rules on what the transfers take.
LOSSES = ("dissipation", "impact-loss", "numerical-viscosity")
# Rules on a run that a shorter step may change.
OF_STEP = ("courant", "energy", "escaped", "ledger-not-finite", "not-finite", "overlap", "step-collapse", "volume")
# In decreasing order of severity.
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One finding of a check."""

    severity: Severity  # "error": the run or result is wrong; "warning": probably; "note": information only
    rule: str  # short name, such as "thin-body"
    what: str  # one sentence that states the finding, with numbers and units
    fix: str  # one sentence that states what to change
    value: float | None = None  # that triggers the finding
    body: str = ""  # name of the body concerned, "" if there is no single one
    frame: int | None = None  # index of the first one concerned, None for a scene or if there is none in particular

    @property
    def line(self) -> str:
        """The finding in one line: severity, fault and change."""
        return f"{self.severity}: {self.what} {self.fix}"


def gravest_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings, errors before warnings before notes, otherwise in their order."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


def merged(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings as a text has them: one that names all bodies for those that say the same of each.

    Those of a rule in LOSSES say the same with other numbers, too; the largest loss is reported.
    """
    alike: dict[tuple[str, ...], list[tuple[Finding, str]]] = {}
    for finding in findings:
        said = finding.line.replace(f'"{finding.body}"', "")
        kind = re.sub(r"\d[\d.e+-]*", "", said) if finding.rule in LOSSES else said
        alike.setdefault((finding.severity, finding.rule, kind), []).append((finding, said))
    result = []
    for group in alike.values():
        first = max((finding for finding, _ in group), key=lambda one: one.value or 0.0)
        others = [one.body for one, _ in group if one is not first and one.body]
        same = "The same" if len({said for _, said in group}) == 1 else "As much or less"
        fix = f"{first.fix} {same} for {several(quoted(others))}." if others else first.fix
        result.append(replace(first, fix=fix))
    return result


def passes(findings: Iterable[Finding], *, strict: bool = False) -> bool:
    """Return whether no finding is an error; with `strict` a warning counts as one."""
    refused = SEVERITIES[: 2 if strict else 1]
    return not any(finding.severity in refused for finding in findings)


class FrameFindings:
    """Findings of a result by rule. A fault that persists over frames is one finding, at its first frame."""

    def __init__(self) -> None:
        # By severity, rule and kind: the first finding, and the numbers of all frames that have it.
        self._seen: dict[tuple[str, str, str], tuple[Finding, set[int]]] = {}

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
        """Add a fault; `what` has no period, and `kind` separates faults of one rule, as by the name of an array."""
        first = Finding(severity, rule, what, fix, value, body, frame)
        _, frames = self._seen.setdefault((severity, rule, kind), (first, set()))
        if frame is not None:
            frames.add(frame)

    def frames_of(self, rule: str) -> set[int]:
        """Return the numbers of the frames with findings of a rule."""
        return set().union(*(frames for first, frames in self._seen.values() if first.rule == rule))

    def found(self) -> tuple[Finding, ...]:
        """Return all findings by severity, and by frame within a severity."""
        complete = []
        for first, frames in self._seen.values():
            more = len(frames) - 1
            suffix = f"; the same is found in {counted(more, 'more frame')}" if more > 0 else ""
            complete.append(replace(first, what=f"{first.what}{suffix}."))
        return gravest_first(sorted(complete, key=lambda finding: -1 if finding.frame is None else finding.frame))

"""The report of a validation: cases, verdicts and costs, as JSON and as a table."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from mpmcli.plain_text import text_table
from mpmcli.validation.case import Case, Level, Setting
from mpmcli.validation.comparison import Cheapest, Compared, Ratios, cheapest, compare_settings, points_of, series_of
from mpmcli.validation.runs import Results, Run, RunResult
from mpmcli.validation.verdict import Verdict, judge, observed_order, verdict_of_run


@dataclass(frozen=True)
class RunRow:
    """One run: its error, order relative to the next coarser run of the setting, and "pass" or "fail", or None."""

    run: Run
    result: RunResult
    error: float | None
    order: float | None
    verdict: str | None

    def as_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON."""
        return {
            "n": self.run.n,
            "setting": self.run.setting.label,
            "knobs": asdict(self.run.setting),
            "error": self.error,
            "order": self.order,
            "seconds": self.result.seconds,
            "particle_steps": self.result.particle_steps,
            "particle_steps_per_s": self.result.rate,
            "verdict": self.verdict,
            **{key: value for key, value in self.result.as_dict().items() if key != "seconds"},
        }


@dataclass(frozen=True)
class CaseReport:
    """One case in the report: its runs, verdict and cheapest setting."""

    case: Case
    results: Results

    @cached_property
    def verdict(self) -> Verdict:
        """The checks of the case."""
        return judge(self.case, self.results)

    @cached_property
    def cheapest(self) -> Cheapest | None:
        """The setting that reaches 1 % in the least time."""
        return cheapest(self.case, self.results)

    @cached_property
    def rows(self) -> tuple[RunRow, ...]:
        """Every run, setting by setting, from coarse to fine."""
        return tuple(row for runs in series_of(self.case, self.results).values() for row in self._rows(runs))

    def _rows(self, runs: list[tuple[Run, RunResult]]) -> Iterator[RunRow]:
        before: tuple[int, float] | None = None
        for run, result in runs:
            error = result.error(self.case.measures[0].name)
            order = observed_order(before, (run.n, error)) if before is not None and error is not None else None
            yield RunRow(run, result, error, order, verdict_of_run(self.verdict, run))
            before = before if error is None else (run.n, error)

    @property
    def finest(self) -> tuple[int, float] | None:
        """Resolution and error of the finest run of the default setting that finished."""
        points = points_of(self.case, series_of(self.case, self.results).get(Setting(), []))
        return (points[-1].n, points[-1].error) if points else None

    @property
    def order(self) -> float | None:
        """Observed order between the two finest runs of the default setting that have one, None where there is none."""
        counts = self.case.measures[0].has_order_at
        rows = [row for row in self.rows if row.run.setting == Setting() and counts(row.run.n)]
        orders = [row.order for row in rows if row.error is not None]
        return orders[-1] if orders else None

    def as_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON."""
        case, best = self.case, self.cheapest
        return {
            "case": case.name,
            "title": case.title,
            "group": case.group,
            "source": case.source,
            "note": case.note,
            "resolution": case.resolution,
            "measures": [
                {"name": m.name, "unit": m.unit, "text": m.text, "order": m.order, "expected_order": m.expected}
                for m in case.measures
            ],
            "verdict": self.verdict.word,
            "reasons": list(self.verdict.reasons),
            "finest_n": self.finest and self.finest[0],
            "error": self.finest and self.finest[1],
            "order": self.order,
            "expected_order": case.measures[0].expected,
            "cheapest_to_1_percent": best and {"setting": best.setting.label, **asdict(best.cost)},
            "checks": [{**asdict(check), "setting": check.setting.label} for check in self.verdict.checks],
            "runs": [row.as_dict() for row in self.rows],
        }


@dataclass(frozen=True)
class Report:
    """All cases of one run of the validation, with the environment as `describe_environment` has it."""

    level: Level
    environment: dict[str, Any]
    cases: tuple[Case, ...]
    results: Results

    @cached_property
    def case_reports(self) -> tuple[CaseReport, ...]:
        """One per case."""
        return tuple(
            CaseReport(case, {run: result for run, result in self.results.items() if run.case == case.name})
            for case in self.cases
        )

    @cached_property
    def compared(self) -> list[Compared]:
        """Every setting against the default one."""
        return compare_settings(self.cases, self.results)

    @property
    def passed(self) -> bool:
        """Whether every case came out as it should."""
        return all(entry.verdict.passed for entry in self.case_reports)

    def as_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON."""
        return {
            "level": self.level,
            "environment": self.environment,
            "passed": self.passed,
            "cases": [entry.as_dict() for entry in self.case_reports],
            "settings": [
                {
                    "setting": entry.setting.label,
                    "error_ratio": _ratios(entry.error),
                    "seconds_ratio": _ratios(entry.seconds),
                    "seconds_to_equal_error_ratio": _ratios(entry.to_equal),
                    "failed": entry.failed,
                    "runs": entry.runs,
                }
                for entry in self.compared
            ],
        }

    def table(self) -> str:
        """Return a text table with a line per case, followed by the failed checks."""
        rows = [summary_row(entry) for entry in self.case_reports]
        failed = [f"{e.case.name}: {reason}" for e in self.case_reports for reason in e.verdict.reasons]
        count = sum(entry.verdict.passed for entry in self.case_reports)
        closing = f"{count} of {len(rows)} cases pass. Errors and orders are those of the default setting."
        return "\n".join([text_table(SUMMARY, rows, left={0, 1, 5}), *(["", *failed] if failed else []), "", closing])


# Columns of the table of cases.
SUMMARY = ("case", "verdict", "error", "at n", "order (expected)", "cheapest to 1 %", "seconds", "particle-steps")


def summary_row(entry: CaseReport) -> tuple[str, ...]:
    """Return the row of a case in the table of cases."""
    measure, finest, best = entry.case.measures[0], entry.finest, entry.cheapest
    order = "" if entry.order is None else f"{entry.order:.2f}"
    if measure.expected is not None:
        order = f"{order or '-'} ({measure.expected:g})"
    most = "≤ " if best is not None and best.cost.at_most else ""
    return (
        entry.case.name,
        entry.verdict.word,
        "" if finest is None else f"{finest[1]:.2e}{measure.unit_suffix}",
        "" if finest is None else str(finest[0]),
        order,
        best.setting.label if best is not None else "" if measure.unit else "none",
        "" if best is None else f"{most}{seconds_text(best.cost.seconds)}",
        "" if best is None else f"{most}{best.cost.particle_steps:.2g}",
    )


def seconds_text(seconds: float) -> str:
    """Return seconds as text with two digits and at most three decimals."""
    return f"{seconds:.3f}" if seconds < 0.1 else f"{seconds:.2g}" if seconds < 100 else f"{seconds:.0f}"


def _ratios(ratios: Ratios | None) -> dict[str, Any] | None:
    if ratios is None:
        return None
    return {"mean": ratios.mean, "smallest": ratios.low, "largest": ratios.high, "cases": ratios.of_case}

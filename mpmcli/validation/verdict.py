"""Verdict on a case: bounds of errors, orders of convergence, and single against double precision."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from mpmcli.validation.case import Case, Measure
from mpmcli.validation.convergence import observed_order
from mpmcli.validation.matrix import Run, label_of
from mpmcli.validation.run_result import RunResult
from mpmcli.validation.setting import Setting

# Largest ratio of values in f32 to those in f64, where those are above rounding (`Measure.single`).
SINGLE_RATIO = 1.2

SINGLE = replace(Setting(), precision="f32")

Results = Mapping[Run, RunResult]


@dataclass(frozen=True)
class Check:
    """One criterion and its outcome.

    Attributes:
        subject: quantity, such as "period error".
        setting: setting of the runs.
        n: resolution; None if the check concerns several.
        figure: value found; None if there is none.
        bound: admissible values, as text.
        passed: whether the criterion holds.
        sentence: the outcome, in one sentence.
    """

    subject: str
    setting: Setting
    n: int | None
    figure: float | None
    bound: str
    passed: bool
    sentence: str


@dataclass(frozen=True)
class Verdict:
    """All checks of a case."""

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether all checks passed."""
        return all(check.passed for check in self.checks)

    @property
    def word(self) -> str:
        """Return "pass" or "fail"."""
        return "pass" if self.passed else "fail"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences of the failed checks."""
        return tuple(check.sentence for check in self.checks if not check.passed)


def judge(case: Case, results: Results) -> Verdict:
    """Check the default setting against the bounds of the case, and f32 against f64.

    Other settings have no bounds.
    """
    default = default_results(case, results)
    checks = [check for n, result in default.items() for check in _bound_checks(case, n, result)]
    checks += [check for measure in case.measures if (check := _order_check(measure, default)) is not None]
    for run, result in results.items():
        if run.case == case.name and run.setting == SINGLE:
            checks += _single_checks(case, run, default.get(run.n), result)
    return Verdict(tuple(checks))


def default_results(case: Case, results: Results) -> dict[int, RunResult]:
    """Return the results of the default setting by resolution, from coarse to fine."""
    found = {run.n: result for run, result in results.items() if run.case == case.name and run.setting == Setting()}
    return dict(sorted(found.items()))


def verdict_of_run(verdict: Verdict, run: Run) -> str | None:
    """Return "pass" or "fail" for one run; None if no check concerns it."""
    mine = [check for check in verdict.checks if check.n == run.n and check.setting == run.setting]
    return None if not mine else "pass" if all(check.passed for check in mine) else "fail"


def _bound_checks(case: Case, n: int, result: RunResult) -> list[Check]:
    if not result.finished:
        sentence = f"At n = {n} the run with the default setting {_ending(result)}"
        return [Check("run", Setting(), n, None, "finishes", False, sentence)]
    checks = []
    for measure in case.measures:
        value, bound = result.values[measure.name], measure.bound(n)
        passed = abs(value) <= bound
        unit = f" {measure.unit}" if measure.unit else ""
        where = f"At n = {n} the {measure.name} is {value:.3g}{unit}"
        sentence = f"{where}, {'within' if passed else 'beyond'} its bound of {bound:.3g}{unit}."
        checks.append(Check(measure.name, Setting(), n, value, f"{bound:.3g}", passed, sentence))
    return checks


def _order_check(measure: Measure, default: dict[int, RunResult]) -> Check | None:
    finished = {n: result for n, result in default.items() if result.finished and measure.has_order_at(n)}
    finest = [(n, abs(result.values[measure.name])) for n, result in finished.items()][-2:]
    order = observed_order(*finest) if len(finest) == 2 else None
    if measure.order is None or order is None:
        return None
    passed = order >= measure.order
    between = f"Between n = {finest[0][0]} and {finest[1][0]} the {measure.name} falls at order {order:.2f}"
    sentence = f"{between}, {'as' if passed else 'but'} at least {measure.order:g} is asked for."
    return Check(f"order of {measure.name}", Setting(), None, order, f"at least {measure.order:g}", passed, sentence)


def _single_checks(case: Case, run: Run, double: RunResult | None, single: RunResult) -> list[Check]:
    if double is None or not double.finished:
        return []
    if not single.finished:
        sentence = f"At n = {run.n} the run in {label_of(run.setting)} {_ending(single)}"
        return [Check("run in f32", run.setting, run.n, None, "finishes", False, sentence)]
    checks = []
    for measure in case.measures:
        figure, usual = abs(single.values[measure.name]), abs(double.values[measure.name])
        bound = SINGLE_RATIO * max(usual, measure.single(run.n))
        passed = figure <= bound
        found = f"At n = {run.n} the {measure.name} is {figure:.3g} in f32 and {usual:.3g} in f64"
        sentence = f"{found}, {'within' if passed else 'beyond'} {bound:.3g}."
        checks.append(Check(f"f32, {measure.name}", run.setting, run.n, figure, f"{bound:.3g}", passed, sentence))
    return checks


def _ending(result: RunResult) -> str:
    word = "became unstable" if result.status == "unstable" else "failed"
    return f"{word}: {result.message}"

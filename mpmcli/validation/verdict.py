"""Verdict on a case: bounds of errors, orders of convergence, and single against double precision."""

import math
from dataclasses import dataclass, replace

from mpmcli.validation.case import Case, Measure, Setting
from mpmcli.validation.runs import Results, Run, RunResult

# Largest ratio of values in f32 to those in f64, where those are above rounding (`Measure.single`).
SINGLE_RATIO = 1.2

SINGLE = replace(Setting(), precision="f32")
# Errors below this are round-off of double precision, and have no order.
ROUND_OFF = 1e-10


def observed_order(coarse: tuple[float, float], fine: tuple[float, float]) -> float | None:
    """Return log(e1 / e2) / log(n2 / n1) of two pairs (n, error); None for equal n or round-off."""
    (n1, e1), (n2, e2) = coarse, fine
    if n1 == n2 or not min(e1, e2) > ROUND_OFF:
        return None
    return math.log(e1 / e2) / math.log(n2 / n1)


@dataclass(frozen=True)
class Check:
    """The figure of a quantity, the bound that it must keep, and a sentence with the outcome; n is None for several."""

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
    """Check the default setting against the bounds of the case, and f32 against f64. Other settings have no bounds."""
    mine = {run.n: result for run, result in results.items() if run.case == case.name and run.setting == Setting()}
    default = dict(sorted(mine.items()))
    checks = [check for n, result in default.items() for check in _bound_checks(case, n, result)]
    checks += [check for measure in case.measures if (check := _order_check(measure, default)) is not None]
    for run, result in results.items():
        if run.case == case.name and run.setting == SINGLE:
            checks += _single_checks(case, run, default.get(run.n), result)
    return Verdict(tuple(checks))


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
        unit = measure.unit_suffix
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
        sentence = f"At n = {run.n} the run in {run.setting.label} {_ending(single)}"
        return [Check("run in f32", run.setting, run.n, None, "finishes", False, sentence)]
    checks = []
    for measure in case.measures:
        figure, usual = abs(single.values[measure.name]), abs(double.values[measure.name])
        bound = SINGLE_RATIO * max(usual, measure.rounding_at(run.n))
        passed = figure <= bound
        both = f"At n = {run.n} the {measure.name} is {figure:.3g} in f32 and {usual:.3g} in f64"
        sentence = f"{both}, {'within' if passed else 'beyond'} {bound:.3g}."
        checks.append(Check(f"f32, {measure.name}", run.setting, run.n, figure, f"{bound:.3g}", passed, sentence))
    return checks


def _ending(result: RunResult) -> str:
    word = "became unstable" if result.status == "unstable" else "failed"
    return f"{word}: {result.message}"

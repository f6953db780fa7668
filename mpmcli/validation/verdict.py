"""Verdict on a case: bounds of errors, orders of convergence, and single against double precision."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from mpmcli.validation.case import Case, Measure, Setting
from mpmcli.validation.runs import CaseRun, Results

SINGLE = replace(Setting(), precision="f32")
# Largest admissible ratio of errors in f32 to those in f64, if above rounding (`Measure.rounding`).
SINGLE_RATIO = 1.2
# Errors below this are round-off in double precision and have no order.
ROUND_OFF = 1e-10


def observed_order(points: list[tuple[int, float]]) -> float | None:
    """Return log(e1 / e2) / log(n2 / n1) of the last two pairs (n, error); None for fewer pairs or round-off."""
    if len(points) < 2 or not min(error for _, error in points[-2:]) > ROUND_OFF:
        return None
    (n1, e1), (n2, e2) = points[-2:]
    return math.log(e1 / e2) / math.log(n2 / n1)


def order_of(measure: Measure, results: Results) -> float | None:
    """Return the order of a measure with the default setting, from the two finest resolutions up to `order_to`."""
    usual = [(run.n, result) for run, result in results.items() if run.setting == Setting() and result.finished]
    return observed_order([(n, result.error(measure.name)) for n, result in usual if n <= measure.order_to])


@dataclass(frozen=True)
class Check:
    """A checked value and its bound: an upper bound, or a lower bound of an order.

    n is None for an order; figure and bound are None for a run that did not finish.
    """

    subject: str
    setting: Setting
    n: int | None
    figure: float | None
    bound: float | None
    passed: bool
    sentence: str


@dataclass(frozen=True)
class Verdict:
    """All checks of a case."""

    checks: tuple[Check, ...]

    @property
    def word(self) -> str:
        """Return "pass" or "fail"."""
        return "fail" if self.reasons else "pass"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences of the failed checks."""
        return tuple(check.sentence for check in self.checks if not check.passed)

    def of_run(self, run: CaseRun) -> str:
        """Return "pass" or "fail" for one run; "" if no check concerns it."""
        mine = tuple(check for check in self.checks if (check.n, check.setting) == (run.n, run.setting))
        return Verdict(mine).word if mine else ""


def judge(case: Case, results: Results) -> Verdict:
    """Check the default setting against the bounds of the case, and f32 against f64. Other settings have no bounds.

    `results` are those of the case, from coarse to fine in each setting.
    """
    checks = [check for run in results for check in _checks_of(case, run, results)]
    for measure in case.measures:
        order = order_of(measure, results)
        if measure.order is not None and order is not None:
            passed, subject = order >= measure.order, f"order of {measure.name}"
            sentence = (
                f"The {subject} is {order:.2f}, {'as' if passed else 'but'} at least {measure.order:g} is required."
            )
            checks.append(Check(subject, Setting(), None, order, measure.order, passed, sentence))
    return Verdict(tuple(checks))


def _checks_of(case: Case, run: CaseRun, results: Results) -> Iterator[Check]:
    """Yield the checks of one run."""
    result, double = results[run], results.get(replace(run, setting=Setting()))
    single = run.setting == SINGLE
    if run.setting not in (Setting(), SINGLE) or double is None or (single and not double.finished):
        return
    where = f"At n = {run.n}{' in f32' if single else ''} the"
    if not result.finished:
        ending = "became unstable" if result.status == "unstable" else "failed"
        yield Check("run", run.setting, run.n, None, None, False, f"{where} run {ending}: {result.message}")
        return
    for measure in case.measures:
        name, figure, bound = measure.name, result.values[measure.name], measure.bound(run.n)
        if single:
            bound = SINGLE_RATIO * max(double.error(name), measure.rounding_at(run.n))
        passed = abs(figure) <= bound
        said = f"{figure:.3g}{measure.unit_suffix}, {'within' if passed else 'beyond'} its bound of {bound:.3g}"
        sentence = f"{where} {name} is {said}{measure.unit_suffix}."
        yield Check(name, run.setting, run.n, figure, bound, passed, sentence)

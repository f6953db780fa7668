"""What follows from results: verdicts and orders, of invented ones."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from invented_case import CASE, SINGLE, result, results, second_order

from mpmcli.validation.case import Setting
from mpmcli.validation.runs import CaseRun, matrix, runs_of, variants
from mpmcli.validation.verdict import judge, observed_order


def test_coarse_is_the_default_setting_and_single_precision_at_the_finest() -> None:
    runs = runs_of(CASE, "coarse")
    assert runs == [
        CaseRun("invented", 8, Setting()),
        CaseRun("invented", 16, Setting()),
        CaseRun("invented", 16, SINGLE),
    ]
    assert len(matrix([CASE, CASE], "coarse")) == 6


@pytest.mark.parametrize("level", ["default", "fine"])
def test_further_levels_try_every_knob_one_at_a_time(level: str) -> None:
    runs = runs_of(CASE, level)
    assert len(set(runs)) == len(runs)
    at = {}
    for run in runs:
        at.setdefault(run.setting.label, []).append(run.n)
    everywhere = list(CASE.levels[level])
    swept = {label: [16] for label in at if label.startswith("Courant")}
    assert len(swept) == 4 and [setting.safety for setting in variants("safety")] == [0.1, 0.2, 0.4, 0.95]
    names = ["default", "f32", "cubic kernel", "AFLIP"]
    names += ["1 particle per axis", "3 particles per axis"]
    assert at == dict.fromkeys(names, everywhere) | swept


def test_a_knob_that_means_nothing_to_a_case_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(CASE), "varies", ("transfer",))
    assert {run.setting.label for run in runs_of(CASE, "default")} == {"default", "AFLIP"}
    assert {run.setting for run in runs_of(CASE, "coarse")} == {Setting()}


def test_a_case_within_its_bounds_passes() -> None:
    verdict = judge(CASE, results())
    assert verdict.word == "pass" and verdict.reasons == ()
    order = next(check for check in verdict.checks if check.subject == "order of error")
    assert order.figure == pytest.approx(2.0)
    assert [check.n for check in verdict.checks if (check.subject, check.setting) == ("error", SINGLE)] == [8, 16, 32]


@given(n=st.sampled_from([8, 16, 32]), factor=st.floats(0.01, 100.0))
def test_a_bound_holds_or_fails_at_each_resolution(n: int, factor: float) -> None:
    """Errors are 5/6 of the bounds; one of them is multiplied."""
    found = results(lambda run: second_order(run) * (factor if run == CaseRun("invented", n, Setting()) else 1))
    checks = {
        check.n: check.passed
        for check in judge(CASE, found).checks
        if check.subject == "error" and check.setting == Setting()
    }
    assert checks == {8: True, 16: True, 32: True} | {n: factor * 5 / 6 <= 1 + 1e-12}


def test_a_negative_value_is_judged_by_its_size() -> None:
    found = results(lambda run: -second_order(run) * (2 if run.n == 16 else 1))
    (reason,) = [text for text in judge(CASE, found).reasons if "n = 16" in text and "bound" in text]
    assert reason == "At n = 16 the error is -0.25, beyond its bound of 0.15."


@given(order=st.floats(0.5, 4.0))
def test_the_order_is_that_of_the_two_finest(order: float) -> None:
    """The coarsest error is not of the law, and does not count."""
    found = results(lambda run: 1e-6 if run.n == 8 else 1e-3 * (16 / run.n) ** order)
    check = next(check for check in judge(CASE, found).checks if check.subject == "order of error")
    assert check.figure == pytest.approx(order) and check.passed == (check.figure >= 1.9)


def test_round_off_has_no_order() -> None:
    found = results(lambda run: 1e-13)
    verdict = judge(CASE, found)
    assert verdict.word == "pass" and not any(check.subject.startswith("order") for check in verdict.checks)
    assert observed_order([(8, 1e-3), (16, 0.0)]) is None and observed_order([(8, 1.0)]) is None


@given(ratio=st.floats(0.1, 10.0), error=st.floats(1e-6, 1e-1))
def test_single_precision_may_add_rounding_or_a_fifth(ratio: float, error: float) -> None:
    found = {CaseRun("invented", 8, Setting()): result(error), CaseRun("invented", 8, SINGLE): result(error * ratio)}
    checks = {check.subject: check for check in judge(CASE, found).checks if check.setting == SINGLE}
    assert set(checks) == {measure.name for measure in CASE.measures}
    check = checks["error"]
    assert check.figure == error * ratio
    assert check.passed == (error * ratio <= 1.2 * max(error, 1e-4))
    verdict = judge(CASE, found).of_run(CaseRun("invented", 8, SINGLE))
    assert verdict == ("pass" if all(check.passed for check in checks.values()) else "fail")


@pytest.mark.parametrize(
    ("setting", "passes"), [(Setting(), False), (SINGLE, False), (Setting(transfer="aflip"), True)]
)
def test_a_run_that_fails_counts_where_something_is_asked_of_it(setting: Setting, passes: bool) -> None:
    lost = CaseRun("invented", 16, setting)
    verdict = judge(CASE, results(lambda run: None if run == lost else second_order(run)))
    assert verdict.word == ("pass" if passes else "fail")
    assert all("became unstable: It was <lost>." in reason for reason in verdict.reasons)
    assert verdict.of_run(lost) == ("" if passes else "fail")

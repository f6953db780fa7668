"""The measured dam breaks, and the comparison with them."""

import numpy as np
import pytest

from mpmcli.validation.cases.dam_break import SHIFTS, best_shift, mean_error, measured


def test_the_data_are_three_fronts_and_a_height() -> None:
    fronts = measured("front")
    assert [series.name for series in fronts] == ["i", "ii", "iii"]
    assert [len(series.T) for series in fronts] == [15, 10, 15]
    (height,) = measured("height")
    assert len(height.T) == 17
    for series in (*fronts, height):
        assert len(series.T) == len(series.value)
        assert (np.diff(series.T) > 0).all()
        assert (np.sign(np.diff(series.value)) == (1 if series.quantity == "front" else -1)).all()


def test_the_series_of_the_larger_column_agree() -> None:
    """(i), from figure 3, and (iii), from table 2, are of one column: 2.5 %, T = 0.8 to 3.3 (docs/theory.md, 10)."""
    i, _, iii = measured("front")
    here = (i.T > 0.8) & (i.T < 3.3)
    assert np.interp(i.T[here], iii.T, iii.value) == pytest.approx(i.value[here], rel=0.025)


def test_no_front_is_faster_than_ritter() -> None:
    """Z <= 1 + 2 T: a dry dam break runs at 2 sqrt(g n^2 a) at most (Ritter 1892)."""
    for series in measured("front"):
        assert (series.value <= 1 + 2 * series.T).all()


@pytest.mark.parametrize("late", [0.0, 0.15, 0.3])
def test_a_late_gate_is_found(late: float) -> None:
    """Curves that run through the points of a series, `late` ahead of them."""
    for series in measured("front"):
        T, value = np.concatenate([[0.0], series.T - late, [9.5]]), np.concatenate([[1.0], series.value, [15.0]])
        shift, error = best_shift([series], T, value)
        assert shift == pytest.approx(late, abs=SHIFTS[1])
        assert error < 5e-3
        assert mean_error(series, T, value) == pytest.approx(0.0, abs=1e-12) or late > 0


def test_the_error_is_the_mean_over_the_points_compared() -> None:
    for series in measured("front"):
        assert mean_error(series, series.T, 1.1 * series.value) == pytest.approx(0.1, rel=1e-12)

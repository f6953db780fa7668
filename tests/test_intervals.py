"""Interval arithmetic on expressions against samples of them, and integrals over pulses against closed forms."""

import ast
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mpmcli.scene.colliders import between_keys, has_jump
from mpmcli.scene.expression import bounds_of, derivative, evaluate
from mpmcli.scene.expression_reader import parse
from mpmcli.scene.quadrature import Mean, integral_of, largest_of, telling_times

EXPRESSIONS = (
    *("t * x - x / (1.5 + t)", "t % 0.7 - x % 0.3", "x ** 3 + t ** 2 - x ** -1", "abs(t) ** x", "-t + pow(x, 0.5)"),
    *("sin(9 * t) + cos(7 * x)", "tan(t * x)", "asin(t / 4) + acos(x / 4)", "atan(t) * atan2(t, x)", "atan2(x, t)"),
    *("sinh(t) - cosh(x) + tanh(t)", "exp(-((t - x) / 0.1) ** 2)", "log(t) + log10(x)", "sqrt(t) - floor(3 * x)"),
    *("ceil(t) * sign(x)", "step(t - x)", "min(t, x, 0.2) + max(t, 0.1)", "clamp(t, -0.5, x)", "hypot(t, x)"),
    *("1 if t < x and not x > 0.5 else -t", "2 if t <= x or t >= 1 else x", "3 if t == x else 0", "1 if t != x else 2"),
)
END = st.floats(-3, 3).map(lambda end: end + 0.0)  # no -0.0, which numpy takes for less than 0.0


@given(text=st.sampled_from(EXPRESSIONS), ends=st.tuples(END, END, END, END), seed=st.integers(0, 2**31))
def test_bounds_hold_every_value(text: str, ends: tuple[float, ...], seed: int) -> None:
    """Of a hundred places at random between the ends; what is not a number counts as unknown."""
    tree = parse(text, ["t", "x"]).tree
    (t0, t1), (x0, x1) = sorted(ends[:2]), sorted(ends[2:])
    low, high = bounds_of(tree, {"t": (np.float64(t0), np.float64(t1)), "x": (np.float64(x0), np.float64(x1))})
    random = np.random.default_rng(seed)
    values = evaluate(tree, {"t": random.uniform(t0, t1, 100), "x": random.uniform(x0, x1, 100)})
    values = np.asarray(values)[np.isfinite(values)]
    slack = 1e-12 * (1 + np.abs(values))
    assert ((values >= low - slack) & (values <= high + slack)).all()


def test_bounds_are_the_range_where_a_name_occurs_once() -> None:
    """The exact range of functions of one t on [0.3, 2]."""
    for text, low, high in (
        ("sin(t)", math.sin(0.3), 1.0),
        ("(t - 1) ** 2", 0.0, 1.0),
        ("abs(t - 1)", 0.0, 1.0),
        ("5 if t > 3 else 1", 1.0, 1.0),
        ("exp(-t)", math.exp(-2), math.exp(-0.3)),
    ):
        found = bounds_of(parse(text, ["t"]).tree, {"t": (np.float64(0.3), np.float64(2.0))})
        assert found == pytest.approx((low, high), abs=1e-12), text


@pytest.mark.parametrize(("text", "integral", "peak"), [
    ("5000 if t > 0.1003 and t < 0.10032 else 0", 0.1, 5000.0),
    ("1e4 * exp(-((t - 0.25) / 1e-5) ** 2)", 0.1 * math.sqrt(math.pi), 1e4),
    ("abs(t - 0.3)", 0.29, 0.7),
    ("3 if t % 0.1 < 1e-4 else 0", 3e-3, 3.0),
    ("step(sin(50 * t))", 8 * math.pi / 50, 1.0),
    ("2 * cos(5 * t)", 0.4 * math.sin(5), 2.0),
    ("t * t", 1 / 3, 1.0),
])  # fmt: skip
@pytest.mark.parametrize("pause", [1.0, 0.3, 0.01])
def test_a_pulse_between_samples_is_found(text: str, integral: float, peak: float, pause: float) -> None:
    """Over [0, 1] s, however short it is; with its peak, and the time of it."""
    tree = parse(text, ["t"]).tree
    mean = Mean(tree, pause, 1.0)
    assert mean(0.0, 1.0) == pytest.approx(integral, rel=1e-8)
    edges = np.linspace(0.0, 1.0, 300) ** 1.5
    parts = [mean(a, b) * (b - a) for a, b in pairwise(edges.tolist())]
    assert sum(parts) == pytest.approx(integral, rel=1e-8)
    assert largest_of(tree, 0.0, 1.0) >= peak * (1 - 1e-12)
    found = max(abs(float(evaluate(tree, {"t": time}))) for time in telling_times(tree, 0.0, 1.0))
    assert found == pytest.approx(peak, rel=0.1)


@given(
    st.floats(1e-9, 1e4), st.integers(1, 400), st.integers(1, 400), st.lists(st.floats(0, 1), min_size=2, max_size=9)
)
def test_means_do_not_depend_on_when_a_run_ends(pause: float, few: int, more: int, places: list[float]) -> None:
    """Runs of few and of more frames as far apart, whose time between frames differs by roundings."""
    tree = parse("sin(7 * t) + 3 * t", ["t"]).tree
    end, later = few * pause, (few + more) * pause
    short, long = Mean(tree, end / few, end), Mean(tree, later / (few + more), later)
    for start, stop in pairwise(sorted(place * min(end, 50.0) for place in places)):
        assert short(start, stop) == long(start, stop)


@pytest.mark.parametrize(("end", "frames"), [(0.7, 1), (0.7, 50), (1.0, 3)])
def test_a_root_of_the_time_that_is_left_has_a_mean(end: float, frames: int) -> None:
    tree = parse("sqrt(tmax - t)", ["t"], {"tmax": ast.parse(repr(end), mode="eval").body}).tree
    mean = Mean(tree, end / frames, end)
    assert mean(0.0, end) == pytest.approx(2 / 3 * math.sqrt(end), rel=1e-7)


def test_a_slope_with_many_jumps_has_its_integral() -> None:
    """Of a largest line of 64, the tangents of t^2, and of a path of 400 keys: the difference of the values."""
    places = np.linspace(0.0, 1.0, 64).round(4)
    hull = parse(f"max({', '.join(f'{2 * a:.4f}*t - {a * a:.8f}' for a in places)})", ["t"]).tree
    gone = evaluate(hull, {"t": 0.51}) - evaluate(hull, {"t": 0.0})
    assert integral_of(derivative(hull, "t"), 0.0, 0.51) == pytest.approx(gone, rel=1e-6)
    times, values = np.arange(401) / 400, np.random.default_rng(0).random(401)
    path = between_keys(times.tolist(), values.tolist())
    assert integral_of(path, 0.0, 1.0) == pytest.approx(values[-1] - values[0], rel=1e-12)


def test_kinks_are_no_jumps_however_many_there_are() -> None:
    """The largest of 63 sines bends at most; every function that jumps is found where it does."""
    sines = ", ".join(f"sin({k}*t)" for k in range(1, 64))
    bent = (f"max({sines})", "abs(sin(9*t)) + clamp(t, 0.2, 0.3)", "2*t", "abs(t) if t < 0.5 else t", "t % 3")
    torn = ("floor(7*t)", "ceil(3*t)", "sign(t - 0.3)", "step(t - 0.3)", "t % 0.3", "1 if t < 0.7 else t")
    torn += ("1/(t - 0.3)", "(t - 0.3)**-1", "pow(t - 0.3, -1)", "tan(3*t)", "atan2(t - 0.3, -1)")
    for text in bent + torn:
        tree = parse(text, ["t"]).tree
        assert has_jump(tree, derivative(tree, "t"), 1.0) == (text in torn), text

"""`--frame`, `--size` and the like: what they mean, and the sentences for what means nothing."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mpmcli.errors import InputError
from mpmcli.render.frame_choice import choose_frames, evenly_spaced
from mpmcli.render.settings import parse_grid, parse_limits, parse_size

bounds = st.one_of(st.none(), st.integers(-30, 30))


def result(count: int, status: str = "finished") -> SimpleNamespace:
    return SimpleNamespace(path="results/run", frame_count=count, numbers=np.arange(count), status=status)


def test_names_and_numbers() -> None:
    five = result(5)
    assert choose_frames("first", five) == [0]
    assert choose_frames("last", five) == choose_frames("-1", five) == [4]
    assert choose_frames("all", five) == [0, 1, 2, 3, 4]
    assert choose_frames(" 3 ", five) == [3]


@given(st.integers(1, 20), bounds, bounds, bounds)
def test_ranges_are_those_of_python(count: int, start: int | None, stop: int | None, step: int | None) -> None:
    assume(step != 0)
    text = ":".join("" if part is None else str(part) for part in (start, stop, step))
    expected = list(range(count))[start:stop:step]
    if expected:
        assert choose_frames(text, result(count)) == expected
    else:
        with pytest.raises(InputError, match="selects no frame"):
            choose_frames(text, result(count))


@pytest.mark.parametrize("text", ["", "x", "1.5", "1:2:0", "::", "1:2:3:4", "-", "--1", "1:-"])
def test_what_means_nothing_is_refused(text: str) -> None:
    if text == "::":
        assert choose_frames(text, result(5)) == [0, 1, 2, 3, 4]
        return
    with pytest.raises(InputError, match="as in Python"):
        choose_frames(text, result(5))


def test_frames_that_are_not_there() -> None:
    with pytest.raises(InputError, match=r"--frame 5: results/run holds frames 0 to 4\."):
        choose_frames("5", result(5))
    with pytest.raises(InputError, match="holds frame 0 only so far, as its run goes on"):
        choose_frames("1", result(1, "running"))


@given(st.integers(1, 60), st.integers(1, 60))
def test_spaced_frames_begin_and_end_with_the_run(frames: int, count: int) -> None:
    chosen = evenly_spaced(list(range(frames)), count)
    assert len(chosen) == min(frames, count) and chosen[-1] == frames - 1
    assert chosen == sorted(set(chosen))
    if count > 1 and frames > 1:
        assert chosen[0] == 0
        assert np.ptp(np.diff(chosen)) <= 1


def test_sizes() -> None:
    assert parse_size("1280x720") == (1280, 720) and parse_size("800xauto") == (800, None)
    for text in ("", "1280", "1280x", "ax7", "-5x5", "1e3x5"):
        with pytest.raises(InputError, match="such as 1280x720"):
            parse_size(text)
    for text in ("8x8", "100000x100000", "16384x16384", "99999xauto"):
        with pytest.raises(InputError, match="64 to 16384 pixels, and a picture at most 64 million"):
            parse_size(text)


def test_grids_and_limits() -> None:
    assert parse_grid("3x2") == (3, 2)
    assert parse_limits("0,2.5") == (0.0, 2.5) and parse_limits("-1e3, 4") == (-1000.0, 4.0)
    for text in ("0x3", "3", "21x1", "axb"):
        with pytest.raises(InputError, match="columns and rows"):
            parse_grid(text)
    for text in ("", "1", "2,1", "1,1", "0,nan", "0,inf", "a,b", "1,2,3"):
        with pytest.raises(InputError, match="lower and the upper limit"):
            parse_limits(text)
    # Differences that overflow, vanish or round to nothing.
    for text in ("-1.7e308,1.7e308", "1,1.0000000000000002"):
        with pytest.raises(InputError, match="too wide or too narrow"):
            parse_limits(text)
    assert parse_limits("-1e-30,1e30") == (-1e-30, 1e30)

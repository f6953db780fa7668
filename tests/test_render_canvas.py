"""What stands around a picture: lengths and times that are right, texts that fit, colours that agree."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_results import JELLY, WATER, frame, header, write
from hypothesis import given
from hypothesis import strategies as st

from mpmcli.output import Result
from mpmcli.render.coloring import Categories, Coloring, color_by
from mpmcli.render.picture_layout import PictureLayout, cut, length_text, round_length, ticks_of, time_text
from mpmcli.render.pictures import picture_digest, set_up
from mpmcli.render.render_scene import render_scene_of
from mpmcli.render.settings import THEMES, Settings, rgb_bytes
from mpmcli.render.view import view_of

LIGHT = THEMES["light"]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    facts = header((2.0, 1.0), 0.1, [WATER, JELLY])
    return write(tmp_path_factory.mktemp("layout") / "run", facts, [frame(k, np.ones((4, 2))) for k in range(5)])


def canvas_of(result: Result, size: tuple[int, int] = (800, 500), by: str = "speed", **options) -> PictureLayout:
    scene = render_scene_of(result)
    colors = color_by(by, result, scene, LIGHT, limits=(0.0, 8.0) if by == "speed" else None)
    return PictureLayout(size, scene, LIGHT, tuple(result.times.tolist()), colors, **options)


def composed(layout: PictureLayout, count: int = 1, missing: int = 0) -> np.ndarray:
    view = view_of(layout.scene, "iso", layout.viewport_size)
    width, height = layout.viewport_size
    blank = np.full((height, width, 3), 255, np.uint8)
    return layout.compose([blank] * count, view, [0.01 * k for k in range(count)], missing)


def count_of(picture: np.ndarray, color: str) -> int:
    return int((picture == rgb_bytes(color)).all(axis=2).sum())


def test_the_scale_bar_is_as_long_as_it_says(result: Result) -> None:
    layout = canvas_of(result)
    picture = composed(layout)
    view = view_of(layout.scene, "iso", layout.viewport_size)
    text = (picture == rgb_bytes(LIGHT.text)).all(axis=2)
    # The longest run of pixels in the lower margin is the bar.
    row = max(text[-40:], key=lambda row: row[: len(row) // 2].sum())
    ends = np.flatnonzero(row)
    run = ends[: np.argmax(np.diff(ends, append=ends[-1] + 2) > 1) + 1]
    metres = len(run) / view.pixels_per_metre
    assert metres == pytest.approx(round_length(metres * 1.01), rel=0.02)


def test_walls_are_drawn_around_the_domain_and_nowhere_within(result: Result) -> None:
    layout = canvas_of(result)
    picture = composed(layout)
    view = view_of(layout.scene, "iso", layout.viewport_size)
    (x0, y1, _), (x1, y0, _) = view.pixels(np.array([layout.scene.lower, layout.scene.upper]))
    top = (500 - layout.viewport_size[1]) // 2
    rows, columns = np.nonzero((picture == rgb_bytes(LIGHT.wall)).all(axis=2))
    assert columns.min() >= x0 - 3 and columns.max() <= x1 + 3
    assert rows.min() - top >= y0 - 3 and rows.max() - top <= y1 + 3
    within = (columns > x0) & (columns < x1 - 1) & (rows - top > y0) & (rows - top < y1 - 1)
    assert not within.any()


def test_the_bar_shows_the_colours_of_its_values(result: Result) -> None:
    layout = canvas_of(result)
    assert isinstance(layout.colors, Coloring)
    picture = composed(layout)
    bottom, top = (tuple(color) for color in layout.colors.rgb(np.array([0.0, 8.0])).tolist())
    places = [np.flatnonzero((picture == color).all(axis=2).any(axis=1)) for color in (top, bottom)]
    assert places[0].mean() < places[1].mean()
    assert count_of(picture, LIGHT.missing) == 0
    assert count_of(composed(layout, missing=3), LIGHT.missing) > 50


def test_the_legend_has_each_material(result: Result) -> None:
    layout = canvas_of(result, by="material")
    picture = composed(layout)
    assert all(count_of(picture, appearance.ink) > 60 for appearance in layout.scene.appearances)


def test_a_legend_says_how_many_kinds_it_has_no_room_for(result: Result) -> None:
    layout = canvas_of(result, by="body")
    inks = tuple(f"#{k:02x}2030" for k in range(1, 41))
    many = Categories("body", tuple(f"body {k}" for k in range(40)), inks, tuple(range(40)))
    picture = composed(replace(layout, colors=many))
    shown = [count_of(picture, ink) > 60 for ink in inks]
    told = sum(shown)
    assert 5 < told < 40 and all(shown[:told])
    # "and 25 more" stands below the last of them, in a fainter colour.
    rows = np.nonzero((picture == rgb_bytes(LIGHT.faint)).all(axis=2))[0]
    assert rows.max() > np.nonzero((picture == rgb_bytes(inks[told - 1])).all(axis=2))[0].max() + 5


def test_titles_and_names_may_hold_what_no_font_has(tmp_path: Path) -> None:
    facts = header((1.0, 1.0), 0.1, [WATER, JELLY])
    facts |= {"title": "two\nlines,\ta tab\r\x01 and \u6c34", "bodies": ["left\nhand", " \t "]}
    result = write(tmp_path / "run", facts, [frame(0, np.ones((4, 2)))])
    scene = render_scene_of(result)
    assert scene.title == "two lines, a tab and \u6c34" and scene.bodies == ("left hand", "")
    assert composed(canvas_of(result, by="body")).shape == (500, 800, 3)


def test_a_size_that_follows_from_the_scene_leaves_no_empty_space(tmp_path: Path) -> None:
    for k, extent in enumerate(((2.0, 1.0), (1.0, 1.0), (1.0, 1.6), (0.2, 3.0), (6.0, 1.0))):
        run = write(tmp_path / str(k), header(extent, 0.1, [WATER]), [frame(0, np.ones((1, 2)))])
        setup = set_up(run, Settings("dots", "speed", None))
        width, height = setup.layout.size
        assert 640 <= width <= 1280 and height <= 720 and (width == 1280 or width == 640 or height > 700)
        assert width % 2 == height % 2 == 0
        if width > 640:
            empty = setup.layout.viewport_size - np.array(extent) * setup.view.pixels_per_metre
            assert empty.max() < 0.1 * max(setup.layout.viewport_size)


def test_lengths_stand_beside_the_edges_of_a_box_in_perspective(tmp_path: Path) -> None:
    run = write(tmp_path / "run", header((1.0, 2.0, 0.5), 0.1, [WATER]), [frame(0, np.ones((1, 3)))])
    setup = set_up(run, Settings("dots", "body", (960, 540)))
    width, height = setup.layout.viewport_size
    blank = np.full((height, width, 3), rgb_bytes(LIGHT.ground), np.uint8)
    texts: list[tuple[float, float, str]] = []
    layout = setup.layout
    object.__setattr__(layout, "_write", lambda draw, x, y, text, *_: texts.append((x, y, text)))
    layout.compose([blank], setup.view, [0.0])
    edges = {"1 m": (0.5, 0, 0), "2 m": (1.0, 1.0, 0), "50 cm": (0, 0, 0.25)}
    for x, y, text in texts[:3]:
        column, row, _ = setup.view.pixels(np.array([edges[text]], float))[0]
        assert abs(x - column) < 60 and abs(y - layout._place(0)[1] - row) < 40


def test_walls_of_a_slice_are_where_its_domain_ends(tmp_path: Path) -> None:
    run = write(tmp_path / "run", header((1.0, 2.0, 0.5), 0.1, [WATER]), [frame(0, np.ones((1, 3)))])
    setup = set_up(run, Settings("density", None, (640, 360), camera="side"))
    width, height = setup.layout.viewport_size
    blank = np.full((height, width, 3), 255, np.uint8)
    picture = setup.layout.compose([blank], setup.view, [0.0])[:, :width]
    rows, columns = np.nonzero((picture == rgb_bytes(LIGHT.wall)).all(axis=2))
    scale = setup.view.pixels_per_metre
    # 2 m by 0.5 m, and a line on each side.
    assert np.ptp(columns) == pytest.approx(2.0 * scale, abs=5) and np.ptp(rows) == pytest.approx(0.5 * scale, abs=5)
    assert not set_up(run, Settings("dots", "speed", (640, 360), camera="side")).layout.walls


@pytest.mark.parametrize("planned", [True, False])
def test_a_film_writes_all_times_alike_also_while_its_run_goes_on(tmp_path: Path, planned: bool) -> None:
    """Those of the first frames could be milliseconds, and those of the last seconds."""
    facts, settings = header((1.0, 1.0), 0.1, [WATER]), Settings("dots", "speed", (64, 64), limits=(0.0, 1.0))
    pause = 0.1 if planned else 0.01
    digests, labels = [], []
    for count in (2, 11):
        frames = [replace(frame(k, np.ones((1, 2))), time=pause * k) for k in range(count)]
        run = write(tmp_path / str(count), facts, frames)
        digests.append(picture_digest(run, settings, [1]))
        labels.append(time_text(pause, set_up(run, settings).layout.times))
    if planned:
        assert digests[0] == digests[1] and labels == ["t = 0.1 s"] * 2
    else:
        # Not the times of its scene: those that are there, and a picture is drawn again when they say it otherwise.
        assert digests[0] != digests[1] and labels == ["t = 10 ms", "t = 0.01 s"]


@pytest.mark.parametrize("size", [(64, 64), (90, 400), (400, 90), (320, 180), (2000, 1500)])
@pytest.mark.parametrize("by", ["speed", "material"])
def test_every_size_is_possible(result: Result, size: tuple[int, int], by: str) -> None:
    assert composed(canvas_of(result, size, by)).shape == (size[1], size[0], 3)
    assert composed(canvas_of(result, size, by, grid=(3, 2)), 5).shape == (size[1], size[0], 3)


def test_a_montage_places_its_pictures_in_rows(result: Result) -> None:
    layout = canvas_of(result, grid=(3, 2))
    width, height = layout.viewport_size
    inks = ["#102030", "#203040", "#304050", "#405060", "#506070"]
    pictures = [np.full((height, width, 3), rgb_bytes(ink), np.uint8) for ink in inks]
    view = view_of(layout.scene, "iso", layout.viewport_size)
    whole = layout.compose(pictures, view, [0.0] * 5)
    middles = []
    for ink in inks:
        rows, columns = np.nonzero((whole == rgb_bytes(ink)).all(axis=2))
        middles.append((rows.mean(), columns.mean()))
    rows, columns = np.array(middles).T
    np.testing.assert_allclose(rows[:3], rows[0], atol=3)
    assert rows[3] > rows[0] + 0.9 * height and (np.diff(columns[:3]) > 0.9 * width).all()
    assert columns[3] == pytest.approx(columns[0], abs=3)


def test_a_height_that_follows_from_the_scene_leaves_no_empty_band(result: Result) -> None:
    layout = canvas_of(result, (900, 900), grid=(2, 2))
    for _ in range(4):
        layout = replace(layout, size=(900, layout.height_for(0.5)))
    width, height = layout.viewport_size
    assert height / width == pytest.approx(0.5, abs=2 / width)


@pytest.mark.parametrize(("size", "least"), [((800, 500), 5), ((300, 150), 2), ((300, 120), 0), ((200, 90), 0)])
def test_numbers_beside_the_bar_have_room(result: Result, size: tuple[int, int], least: int) -> None:
    """Numbers are 8 pixels high in small pictures: ticks have to be further apart, however low the picture."""
    picture = composed(canvas_of(result, size))
    rows = np.flatnonzero((picture == rgb_bytes(LIGHT.faint)).all(axis=2).any(axis=1))
    assert len(rows) >= least
    assert len(rows) == 0 or np.diff(rows, append=10**6).min() >= 10


def test_pressures_beyond_reason_have_few_digits(result: Result) -> None:
    colors = replace(canvas_of(result).colors, unit="Pa")
    for high, unit in ((7.3, "Pa"), (2e5, "kPa"), (3e9, "GPa"), (3e12, "GPa"), (1e30, "10³⁰ Pa")):
        _, texts, told = ticks_of(replace(colors, limits=(0.0, high)), 6)
        assert told == unit and max(map(len, texts)) <= 5


def test_times_of_a_montage_do_not_run_into_each_other(result: Result) -> None:
    layout = canvas_of(result, (160, 120), grid=(6, 1), by="material")
    picture = composed(layout, 5)
    above = picture[24:36, : 5 * layout.viewport_size[0]]
    assert (above == rgb_bytes(LIGHT.ground)).all()
    assert not (composed(canvas_of(result, (900, 300), grid=(6, 1)), 5)[30:60, :600] == 255).all()


@given(st.floats(1e-12, 1e12))
def test_round_lengths_are_round_and_no_longer(longest: float) -> None:
    length = round_length(longest)
    assert length <= longest * (1 + 1e-9) < 2.5 * length * (1 + 1e-6)
    digits = f"{length:.6e}".partition("e")[0]
    assert float(digits) in (1.0, 2.0, 5.0)


def test_lengths_and_times_have_the_unit_that_suits_them() -> None:
    assert [length_text(x) for x in (5.0, 0.2, 2e-3, 5e-5, 2e3)] == ["5 m", "20 cm", "2 mm", "50 µm", "2 km"]
    assert time_text(0.25, [0.01 * k for k in range(101)]) == "t = 0.25 s"
    assert time_text(0.5, [0.25 * k for k in range(11)]) == "t = 0.50 s"
    assert time_text(3e-6, [1e-6 * k for k in range(101)]) == "t = 3 µs"
    assert time_text(0.012, [2e-3 * k for k in range(10)]) == "t = 12 ms"
    assert time_text(0.0, [0.0]) == "t = 0.0 s"
    # Digits that no step needs are left out, those of an eighth are not.
    assert time_text(1.0, [k / 30 for k in range(31)]) == "t = 1.000 s"
    assert time_text(1e4, [1e4 * k / 3 for k in range(4)]) == "t = 10000.0 s"
    assert time_text(0.125, [0.125 * k for k in range(9)]) == "t = 0.125 s"


@given(st.text(max_size=40), st.integers(0, 40))
def test_texts_are_cut_to_fit(text: str, room: int) -> None:
    shorter = cut(text, lambda candidate: len(candidate) <= room)
    assert len(shorter) <= max(room, 0) or shorter == ""
    assert shorter == text if len(text) <= room else shorter == "" or shorter.endswith("…")

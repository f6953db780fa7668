"""Tests of `mpmcli plot`: what is drawn are the numbers of the ledger, and the file is a picture of its own."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from command import run_here
from made_result import GRAVITY, LIMITS, MASS, PAUSE, STEP, made_header, made_row, write_made
from PIL import Image

from mpmcli.output import open_result
from mpmcli.plot import ledger_figure
from mpmcli.plot.ledger_figure import draw_ledger, ledger_picture, read_history
from mpmcli.plot.style import THEMES, drawing
from mpmcli.render.picture_file import settings_digest, write_picture

TIMES = PAUSE * np.arange(6)
SIZE = ("--size", "400x300")


@contextmanager
def drawn(directory: Path) -> Iterator[dict]:
    """Give the axes of the figure of a result, by their titles."""
    with drawing((400, 300), THEMES["light"]) as figure:
        titles = draw_ledger(figure, read_history(open_result(directory)), "light")
        yield dict(zip(titles, figure.axes, strict=True))


def line(axes, name: str) -> np.ndarray:
    """Return the (x, y) of a line, (n, 2)."""
    (found,) = [entry for entry in axes.lines if entry.get_label() == name]
    return found.get_xydata()


def series(axes) -> list[np.ndarray]:
    """Return the (x, y) of all lines over time, in the order of drawing; those at a level have two points."""
    return [entry.get_xydata() for entry in axes.lines if entry.get_linestyle() == "-"]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_made(tmp_path_factory.mktemp("made") / "result")


def test_the_panels_show_the_numbers_of_the_ledger(result):
    rows = [made_row(k, 2) for k in range(6)]
    with drawn(result) as panels:
        assert list(panels) == [
            "Energy",
            "Change of total energy",
            "Impulse of the walls",
            "Angular momentum",
            "Time step, by limit",
            "Courant number",
            "Volume ratio J",
            "Largest speed",
            "Reach along x",
            "Reach along y",
        ]
        energy = panels["Energy"]
        assert energy.get_ylabel().replace("\n", " ") == "J/m, potential above its lowest"
        assert np.allclose(line(energy, "kinetic"), [(row.time, row.kinetic) for row in rows])
        lowest = min(row.potential for row in rows)
        assert np.allclose(line(energy, "potential")[:, 1], [row.potential - lowest for row in rows])
        total = np.array([row.energy - lowest for row in rows])
        assert np.allclose(line(energy, "total")[:, 1], total)
        (change,) = series(panels["Change of total energy"])
        assert np.allclose(change[:, 1], (total - total[0]) / total.max())
        (speed,) = series(panels["Largest speed"])
        assert np.allclose(speed[:, 1], [row.speed_max for row in rows])
        low, high = series(panels["Volume ratio J"])
        assert np.allclose(low[:, 1], 1 - 0.01 * np.arange(6)) and np.allclose(high[:, 1], 1 + 0.02 * np.arange(6))
        (courant,) = series(panels["Courant number"])
        assert np.allclose(courant, [(k * PAUSE, 0.01 * k) for k in range(1, 6)])
        assert np.allclose(line(panels["Courant number"], "limit 1")[:, 1], 1.0)
        assert np.allclose(line(panels["Angular momentum"], "z")[:, 1], 0.3 * np.arange(6))


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_walls_gave_what_gravity_does_not_explain(tmp_path, dimension):
    """Half of the mass lies on the floor, which has given it M g t / 2 by the middle of the last step."""
    with drawn(write_made(tmp_path / "result", dimension=dimension)) as panels:
        axes = panels["Impulse of the walls"]
        assert axes.get_ylabel() == f"P - P₀ - M g t, {'N s/m' if dimension == 2 else 'N s'}"
        found = [line(axes, name)[:, 1] for name in "xyz"[:dimension]]
    middle = np.maximum(TIMES - STEP / 2, 0.0)
    assert np.allclose(found[-1], MASS * GRAVITY * middle / 2, atol=1e-12)
    assert np.abs(found[:-1]).max() == 0


def test_each_time_between_frames_has_the_colour_of_what_bounds_its_steps(result):
    with drawn(result) as panels:
        axes = panels["Time step, by limit"]
        boxes = {entry.get_label(): entry for entry in axes.collections}
        assert set(boxes) == set(LIMITS) and axes.get_yscale() == "log"
        assert len({tuple(entry.get_facecolor()[0]) for entry in boxes.values()}) == len(LIMITS)
        seen = {name: [path.get_extents().extents for path in entry.get_paths()] for name, entry in boxes.items()}
    for k in range(1, 6):
        low, high = (0.9, 1.1) if k == 2 else (1.0, 1.0)
        box = [TIMES[k - 1], low * STEP, TIMES[k], high * STEP]
        assert any(np.allclose(found, box) for found in seen[LIMITS[k % 3]]), k
    assert sum(map(len, seen.values())) == 5


def test_the_reach_is_that_of_each_body_between_the_walls(result):
    with drawn(result) as panels:
        for axis, name in enumerate("xy"):
            axes = panels[f"Reach along {name}"]
            assert np.allclose(line(axes, "walls")[:, 1], 0.0)
            # Two lines of each body, the lowest and the highest.
            left_low, left_high, right_low, right_high = (found[:, 1] for found in series(axes))
            if axis == 0:
                expected = (0.1, 0.2, 0.7, 0.9)
            else:
                fallen = 0.8 - GRAVITY * TIMES**2 / 2
                expected = (fallen, fallen, 0.05, 0.05)
            for found, value in zip((left_low, left_high, right_low, right_high), expected, strict=True):
                # Positions are stored in single precision.
                assert np.allclose(found, value, atol=1e-6)


def test_many_frames_are_read_evenly_and_that_is_said(result, monkeypatch):
    monkeypatch.setattr(ledger_figure, "FRAMES_MAX", 3)
    seen = read_history(open_result(result))
    assert np.allclose(seen.reach_times, TIMES[[0, 2, 5]]) or np.allclose(seen.reach_times, TIMES[[0, 3, 5]])
    assert seen.notes == ("The reach of the particles is read from 3 of 6 frames.",)


def test_where_forces_act_the_panels_say_so(tmp_path):
    with drawn(write_made(tmp_path / "result", driven=True)) as panels:
        assert "Impulse of the walls and forces" in panels
        label = panels["Change of total energy"].get_ylabel().replace("\n", " ")
        assert label == "(E - E₀) / largest E, while forces do work"


def test_numbers_that_are_not_finite_are_gaps_and_told(tmp_path):
    changes = {2: {"kinetic": np.nan, "step_max": np.inf}, 4: {"linear_momentum": (0.0, np.nan)}}
    directory = write_made(tmp_path / "result", changes=changes)
    with drawn(directory) as panels:
        kinetic = line(panels["Energy"], "kinetic")[:, 1]
        assert np.flatnonzero(np.isnan(kinetic)).tolist() == [2]
        assert len(panels["Time step, by limit"].collections) == 3
        # The momentum that is given by the walls is known again after the gap.
        assert np.flatnonzero(np.isnan(line(panels["Impulse of the walls"], "y")[:, 1])).tolist() == [2, 4]
    outcome = run_here("plot", directory, *SIZE)
    assert outcome.status == 0
    assert outcome.stderr.splitlines()[0] == (
        "The ledger holds numbers that are not finite in frames 2, 4; they are gaps in the figure."
    )


def test_a_first_frame_that_is_not_finite_is_not_what_changes_are_counted_from(tmp_path):
    nothing = {"kinetic": np.nan, "linear_momentum": (np.nan, np.nan)}
    with drawn(write_made(tmp_path / "result", changes={0: nothing})) as panels:
        (change,) = series(panels["Change of total energy"])
        impulse = line(panels["Impulse of the walls"], "y")
    assert np.isnan(change[0, 1]) and change[1, 1] == 0
    assert np.isnan(impulse[0, 1])
    # Half of the mass rests: the floor gives it M g / 2 in a second.
    assert np.allclose(impulse[1:, 1], MASS * GRAVITY * (TIMES[1:] - TIMES[1]) / 2, atol=1e-12)


@pytest.mark.parametrize(("form", "frames", "dimension"), [("packed", 6, 3), ("segments", 3, 2), ("segments", 1, 3)])
def test_every_form_of_result_becomes_a_picture_of_the_size_asked_for(tmp_path, form, frames, dimension):
    directory = write_made(tmp_path / "result", form, frames=frames, dimension=dimension)
    outcome = run_here("plot", directory, "--size", "451x301", "--json")
    assert outcome.status == 0, outcome.stderr
    said = json.loads(outcome.stdout)
    assert Path(said["path"]) == directory / "ledger.png" and said["frames"] == frames and said["size"] == [451, 301]
    assert said["panels"][-1] == f"Reach along {'xyz'[dimension - 1]}"
    with Image.open(directory / "ledger.png") as picture:
        assert picture.size == (451, 301)


def test_the_same_result_gives_the_same_bytes_and_another_theme_others(result, tmp_path):
    path = tmp_path / "new" / "picture.png"
    contents = []
    # Its own picture it replaces unasked.
    for theme in ("dark", "light", "light"):
        outcome = run_here("plot", result, "-o", path, *SIZE, "--theme", theme, "--quiet")
        assert (outcome.status, outcome.stdout, outcome.stderr) == (0, "", "")
        contents.append(path.read_bytes())
    assert contents[0] != contents[1] == contents[2]
    with Image.open(BytesIO(contents[0])) as dark, Image.open(path) as light:
        light, dark = np.asarray(light), np.asarray(dark)
    assert light[0, 0].tolist() == [255, 255, 255] and dark[0, 0].max() < 40
    # Something in colour is drawn in each third of the picture.
    for part in np.array_split(light, 3):
        assert (np.ptp(part, axis=2) > 60).sum() > 20


def test_a_file_that_it_did_not_make_is_replaced_only_when_asked_to(result, tmp_path):
    path = tmp_path / "picture.png"
    # A picture of another command is not its own either.
    write_picture(path, np.zeros((5, 5, 3), np.uint8), settings_digest({}))
    before = path.read_bytes()
    outcome = run_here("plot", result, "-o", path, *SIZE)
    assert outcome.status == 2 and path.read_bytes() == before
    assert outcome.stderr == (
        f"error: {path} is there and was not made by mpmcli plot: give another name, or --overwrite.\n"
    )
    outcome = run_here("plot", result, "-o", path, *SIZE, "--overwrite")
    assert outcome.stdout == f"{path}\n" and path.read_bytes() != before


@pytest.mark.parametrize(("arguments", "sentence"), [
    (["nothing"], "error: nothing does not exist"),
    (["result", "-o", "picture.jpg"], "error: picture.jpg cannot be a picture of this command: give a name that "),
    (["result", "--size", "12"], 'error: --size "12" is not a size: give width and height, such as'),
    (["result", "--size", "100x100"],
     "error: --size 100x100 is not possible: each side of this picture has 300 to 8000 pixels."),
    (["result", "--size", "300x900"], "error: --size 300x900 leaves no room for the panels: give a width of one"),
    (["result", "-o", "file/picture.png"], "error: file/picture.png cannot be written (file is no directory): "),
    (["result", "--theme", "pink"], "error: invalid value for '--theme'"),
    ([], "error: missing argument 'RESULT'. See mpmcli plot --help."),
])  # fmt: skip
def test_bad_input_is_refused_with_one_sentence(result, tmp_path, monkeypatch, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("x", encoding="utf-8")
    Path("result").symlink_to(result)
    outcome = run_here("plot", *arguments)
    assert (outcome.status, outcome.stdout) == (2, "") and outcome.stderr.startswith(sentence), outcome.stderr
    assert len(outcome.stderr.splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "result"]


def test_titles_may_hold_what_matplotlib_or_its_font_stumbles_over(tmp_path, recwarn):
    """A $ begins a formula elsewhere, a line break moves everything down, and the font has no Chinese."""
    title = "costs $5, or $x^{\n\tand 水 " + "a" * 100
    header = made_header(2) | {"title": title, "bodies": ["$left^{", "ri\nght"]}
    with mock.patch("made_result.made_header", return_value=header):
        write_made(tmp_path / "result", frames=3)
    history = read_history(open_result(tmp_path / "result"))
    assert history.title.startswith("costs $5, or $x^{ and 水 aaa") and history.names == ("$left^{", "ri ght")
    picture, _ = ledger_picture(history, (400, 300), "light")
    # The first row of panels is not pushed down, nor the title beyond the edge.
    assert (picture[:, -3:] == 255).all()
    assert not recwarn.list

"""Dots, looked at as pixels: where they are, how large, in which colour, and what is in front."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from drawn_results import WATER, frame, header, lattice, write

from mpmcli.frames.frame import Frame
from mpmcli.output import Result
from mpmcli.render.coloring import color_by
from mpmcli.render.dots import OVERLAP, DotsPainter, hidden, samples_of
from mpmcli.render.render_scene import RenderScene, render_scene_of
from mpmcli.render.settings import THEMES, rgb_bytes
from mpmcli.render.view import View, view_of

pytestmark = pytest.mark.usefixtures("drawing")

LIGHT = THEMES["light"]
SIZE = (320, 240)
H = 0.05


def painted(
    directory: Path, frames: list[Frame], size: tuple[float, ...], by: str = "speed", camera: str = "iso", **options
) -> tuple[list[np.ndarray], View, Result, RenderScene]:
    """Draw frames of a domain that begins at the origin."""
    result = write(directory / "run", header(size, H, [WATER]), frames)
    scene = render_scene_of(result)
    view = view_of(scene, camera, SIZE)
    colors = color_by(by, result, scene, LIGHT, **options)
    painter = DotsPainter(scene, view, LIGHT, colors, int(result.particle_counts.max()))
    return [painter.draw(result.frame(k, painter.fields)) for k in range(len(frames))], view, result, scene


def ink(picture: np.ndarray) -> np.ndarray:
    """Where something was drawn."""
    return (picture != rgb_bytes(LIGHT.ground)).any(axis=2)


def at(picture: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """The colours at places (n, 2 or more), from the left and from the top."""
    column, row = np.floor(pixels[:, :2]).astype(int).T
    return picture[row, column]


def deep(points: np.ndarray) -> np.ndarray:
    """Points of a plane as VTK has them."""
    return np.concatenate([points, np.zeros((len(points), 3 - points.shape[1]))], axis=1)


def test_dots_cover_their_particles_and_nothing_else(tmp_path: Path) -> None:
    block = lattice((0.2, 0.1), (0.7, 0.4), H / 2)
    (picture,), view, _, scene = painted(tmp_path, [frame(0, block)], (1.0, 0.75))
    drawn = ink(picture)
    assert at(drawn, view.pixels(deep(block))).all()
    # The area of a block, and half a dot around it, nothing else.
    scale, reach = view.pixels_per_metre, 0.5 * OVERLAP * scene.distances[0]
    (x0, y1, _), (x1, y0, _) = view.pixels(np.array([[0.2, 0.1, 0.0], [0.7, 0.4, 0.0]]))
    rows, columns = np.nonzero(drawn)
    assert columns.min() + 1 >= x0 - reach * scale - 1 and columns.max() <= x1 + reach * scale + 1
    assert rows.min() + 1 >= y0 - reach * scale - 1 and rows.max() <= y1 + reach * scale + 1
    assert drawn.sum() >= 0.95 * (x1 - x0) * (y1 - y0)


def test_a_dot_is_round_and_as_large_as_it_should_be(tmp_path: Path) -> None:
    place = np.array([[0.5, 0.375]])
    (picture,), view, _, scene = painted(tmp_path, [frame(0, place)], (1.0, 0.75))
    radius = 0.5 * OVERLAP * scene.distances[0] * view.pixels_per_metre
    rows, columns = np.nonzero(ink(picture))
    x, y, _ = view.pixels(deep(place))[0]
    distance = np.hypot(columns + 0.5 - x, rows + 0.5 - y)
    assert distance.max() <= radius + 1.0
    assert len(rows) == pytest.approx(np.pi * radius**2, abs=2 * np.pi * radius)
    assert np.ptp(rows) == pytest.approx(np.ptp(columns), abs=1)


@pytest.mark.parametrize("size", [(1.0, 0.75), (1.0, 0.75, 0.5)])
def test_far_from_the_origin_dots_are_where_they_are(tmp_path: Path, size: tuple[float, ...]) -> None:
    """Single precision has steps of 6 cm at 1000 km, so places have to be those from the domain's corner."""
    block = lattice((0.2,) * len(size), (0.45,) * len(size), H / 2)
    pictures = []
    for origin in (0.0, 1e6):
        facts = header(size, H, [WATER]) | {"origin": [origin] * len(size)}
        places = replace(frame(0, block), position=block + origin, velocity=np.zeros_like(block))
        result = write(tmp_path / f"{origin:g}", facts, [places])
        scene = render_scene_of(result)
        view = view_of(scene, "iso", SIZE)
        painter = DotsPainter(scene, view, LIGHT, color_by("speed", result, scene, LIGHT), len(block))
        pictures.append(painter.draw(result.frame(0)))
    differing = (np.abs(pictures[0].astype(int) - pictures[1]).max(axis=2) > 30).mean()
    # The camera's own place is rounded, which moves edges by a little of a pixel.
    assert ink(pictures[0]).mean() > 0.03 and differing < 0.003


def test_colours_follow_a_known_gradient(tmp_path: Path) -> None:
    block = lattice((0.1, 0.1), (0.9, 0.6), H / 2)
    gradient = frame(0, block, pressure=1000.0 * block[:, 0])
    options = {"by": "pressure", "limits": (0.0, 1000.0), "cmap": "gray"}
    (picture,), view, _, _ = painted(tmp_path, [gradient], (1.0, 0.75), **options)
    seen = at(picture, view.pixels(deep(block))).astype(float)
    # Exactly the colour of the value, as 256 steps of grey have it; matplotlib cuts both the step and its grey off.
    np.testing.assert_allclose(seen, np.repeat(255.0 * block[:, :1], 3, axis=1), atol=2.0)


def test_nan_is_drawn_in_its_colour_and_lost_particles_are_left_out(tmp_path: Path) -> None:
    places = np.array([[0.3, 0.3], [0.7, 0.3], [np.nan, 0.5]])
    values = np.array([np.nan, 5.0, 5.0])
    options = {"by": "pressure", "limits": (0.0, 10.0)}
    (picture,), view, _, _ = painted(tmp_path, [frame(0, places, pressure=values)], (1.0, 0.75), **options)
    left, right = at(picture, view.pixels(deep(places[:2])))
    assert tuple(left) == rgb_bytes(LIGHT.missing) and tuple(right) != rgb_bytes(LIGHT.missing)
    rows, columns = np.nonzero(ink(picture))
    near = view.pixels(deep(places[:2]))[:, :2]
    assert all(np.hypot(near[:, 0] - c, near[:, 1] - r).min() < 20 for r, c in zip(rows, columns, strict=True))


def test_empty_frames_single_particles_and_full_ones_alternate(tmp_path: Path) -> None:
    block = lattice((0.2, 0.1), (0.7, 0.4), H / 2)
    frames = [frame(0, block), frame(1, np.empty((0, 2))), frame(2, block[:1]), frame(3, block)]
    pictures, view, _, _ = painted(tmp_path, frames, (1.0, 0.75))
    assert not ink(pictures[1]).any()
    assert ink(pictures[2]).any() and ink(pictures[2]).sum() < 100
    assert at(ink(pictures[2]), view.pixels(deep(block[:1]))).all()
    np.testing.assert_array_equal(pictures[0], pictures[3])


def test_the_nearer_ball_hides_the_farther_one(tmp_path: Path) -> None:
    places = np.array([[0.5, 0.3, 0.4], [0.5, 0.7, 0.4], [0.9, 0.5, 0.4]])
    still = frame(0, places, pressure=np.array([0.0, 1.0, 1.0]))
    # The front camera looks along y.
    options = {"by": "pressure", "camera": "front", "limits": (0.0, 1.0), "cmap": "gray"}
    (picture,), view, _, _ = painted(tmp_path, [still], (1.0, 1.0, 0.75), **options)
    hidden, seen = at(picture, view.pixels(places[[0, 2]]))
    assert hidden.max() < 60 and seen.min() > 120


def test_perspective_makes_near_balls_larger(tmp_path: Path) -> None:
    places = np.array([[0.5, 0.02, 0.5], [0.5, 0.98, 0.5]])
    result = write(tmp_path / "run", header((1.0, 1.0, 1.0), 0.2, [WATER]), [frame(0, places)])
    scene = replace(render_scene_of(result), lower=(0.0, 0.0, 0.0))
    view = view_of(scene, "0.2,-2,0.5,0.5,0.5,0.5", (600, 400))
    painter = DotsPainter(scene, view, LIGHT, color_by("speed", result, scene, LIGHT), 2)
    drawn = painter.draw(result.frame(0)) < 120
    diameters = []
    for place in places:
        x, y, depth = view.pixels(place[None])[0]
        column = drawn[:, int(x)].any(axis=1)
        around = column[max(0, int(y) - 40) : int(y) + 40]
        diameters.append(around.sum())
        expected = OVERLAP * scene.distances[0] * view.pixels_per_metre * view.distance / depth
        # Layers of distance leave 2 % here, pixels one.
        assert diameters[-1] == pytest.approx(expected, rel=0.08, abs=2.0)
    assert diameters[0] > 1.3 * diameters[1]


def test_what_lies_behind_its_surroundings_is_darker(tmp_path: Path) -> None:
    # Two layers of the same colour, the upper one with a hole through which the lower one is seen.
    lower = lattice((0.1, 0.1, 0.0), (0.9, 0.9, H / 2), H / 2)
    upper = lower + np.array([0.0, 0.0, 0.2])
    hole = np.hypot(upper[:, 0] - 0.5, upper[:, 1] - 0.5) < 0.08
    # In the middle of the balls: lit alike, whatever their place.
    (picture,), view, _, _ = painted(
        tmp_path, [frame(0, np.concatenate([lower, upper[~hole]]))], (1.0, 1.0, 1.0), camera="top"
    )
    brightness = picture.astype(float).mean(axis=2)
    inside = at(brightness, view.pixels(lower[hole]))
    open_places = upper[np.hypot(upper[:, 0] - 0.5, upper[:, 1] - 0.25) < 0.08]
    outside = at(brightness, view.pixels(open_places))
    assert inside.mean() < 0.85 * outside.mean()


@pytest.mark.parametrize("camera", ["top", "iso"])
def test_dots_that_are_left_out_change_no_pixel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, camera: str) -> None:
    block = np.random.default_rng(1).random((40_000, 3)) * (0.8, 0.8, 0.5) + 0.1
    fields = {"pressure": np.random.default_rng(2).random(len(block))}
    options = {"by": "pressure", "camera": camera, "limits": (0.0, 1.0)}
    (fewer,), *_ = painted(tmp_path / "1", [frame(0, block, **fields)], (1.0, 1.0, 0.75), **options)
    left_out = []

    def none(pixels: np.ndarray, *arguments: object, **options: object) -> np.ndarray:
        left_out.append(hidden(pixels, *arguments, **options).mean())
        return np.zeros(len(pixels), dtype=bool)

    monkeypatch.setattr("mpmcli.render.dots.hidden", none)
    (all_of_them,), *_ = painted(tmp_path / "2", [frame(0, block, **fields)], (1.0, 1.0, 0.75), **options)
    assert left_out[0] > 0.05
    np.testing.assert_array_equal(fewer, all_of_them)


@pytest.mark.parametrize("camera", ["0.5,0.5,0.25,0.5,0.5,0.1", "0.5,0.5,0.25,0.5,0.5,0.2499"])
def test_a_camera_among_the_dots_takes_no_longer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, camera: str) -> None:
    """The nearest dots are larger than the picture: squares and rims of that size took minutes, and gigabytes."""
    reaches = []
    monkeypatch.setattr("mpmcli.render.dots.hidden", lambda *arguments, **options: reaches.append(arguments[3]))
    block = lattice((0.2, 0.2, 0.1), (0.8, 0.8, 0.4), H / 2)
    near = np.array([[0.5, 0.5, 0.249]])
    (picture,), *_ = painted(tmp_path, [frame(0, np.concatenate([block, near]))], (1.0, 1.0, 0.75), camera=camera)
    assert ink(picture).mean() > 0.5 and not reaches


def test_pictures_and_dots_are_no_larger_than_what_can_be_drawn(tmp_path: Path) -> None:
    """A window of more than 16384 pixels is black, and a dot of more than 255 is one of 255."""
    assert samples_of((1280, 720), 1000, 5.0) == 2
    # Wide, large, many dots, large ones.
    large = [((15_000, 100), 1000, 5.0), ((7000, 7000), 1000, 5.0), ((1280, 720), 10**6, 5.0), ((900, 900), 9, 200.0)]
    assert [samples_of(*each) for each in large] == [1] * 4
    result = write(tmp_path / "run", header((1.0, 0.5), 0.4, [WATER]), [frame(0, np.array([[0.5, 0.25]]))])
    scene = render_scene_of(result)
    view = view_of(scene, "iso", (900, 500))
    painter = DotsPainter(scene, view, LIGHT, color_by("speed", result, scene, LIGHT), 1)
    across = ink(painter.draw(result.frame(0))).any(axis=0).sum()
    expected = OVERLAP * scene.distances[0] * view.pixels_per_metre
    assert 150 < expected < 255 and across == pytest.approx(expected, abs=3)


def test_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path) -> None:
    block = lattice((0.2, 0.2, 0.1), (0.8, 0.8, 0.4), H / 2)
    _, _, result, scene = painted(tmp_path, [frame(0, block)], (1.0, 1.0, 0.75))
    view = view_of(scene, "iso", SIZE)
    painter = DotsPainter(scene, view, LIGHT, color_by("speed", result, scene, LIGHT), len(block))
    still = result.frame(0)
    used = []
    for _ in range(3):
        for _ in range(25):
            painter.draw(still)
        used.append(psutil.Process().memory_info().rss)
    # A picture and its depth alone are 4 MB with the samples of each pixel: 25 of them would be 100.
    assert used[2] - used[0] < 10e6


def test_the_same_frame_gives_the_same_pixels(tmp_path: Path) -> None:
    block = lattice((0.2, 0.2, 0.1), (0.8, 0.8, 0.4), H / 2)
    (first,), _, result, scene = painted(tmp_path, [frame(0, block)], (1.0, 1.0, 0.75))
    view = view_of(scene, "iso", SIZE)
    again = DotsPainter(scene, view, LIGHT, color_by("speed", result, scene, LIGHT), len(block))
    np.testing.assert_array_equal(first, again.draw(result.frame(0)))

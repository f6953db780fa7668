"""Pictures with colliders: where they are, what they hide, and what a container lets be seen."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_results import JELLY, WATER, frame, header, lattice, write
from scenes import ball, box

from mpmcli.output import Result
from mpmcli.render.colliders import FILLED
from mpmcli.render.pictures import set_up
from mpmcli.render.render_scene import render_scene_of
from mpmcli.render.settings import THEMES, Settings, rgb_bytes
from mpmcli.render.view import View

pytestmark = pytest.mark.usefixtures("drawing")

H = 0.05
LIGHT = THEMES["light"]
FILL = np.array(rgb_bytes(LIGHT.ground)) * (1 - FILLED) + FILLED * np.array(rgb_bytes(LIGHT.solid))
TANK = {"name": "tank", "side": "inside", "shape": ball([0.5, 0.5], 0.45)}
ROD = {"name": "rod", "shape": box([0.3, 0.55], [0.7, 0.65]), "angular_velocity": float(50 * np.pi)}


def drawn(result: Result, mode: str, k: int = 0, camera: str = "front", **more: Any) -> tuple[np.ndarray, View]:
    """The picture of frame k in a mode, and its view."""
    color = "material" if mode == "dots" else None
    setup = set_up(result, Settings(mode=mode, color=color, size=(400, 400), camera=camera, **more))
    painter = setup.painter()
    return painter.draw(result.frame(k, painter.fields)).astype(int), setup.view


def at(picture: np.ndarray, view: View, *point: float) -> np.ndarray:
    """The colour at a point of the scene."""
    column, row, _ = view.pixels(np.array([[*point, *[0.0] * (3 - len(point))]]))[0]
    return picture[int(row), int(column)]


def near(color: np.ndarray, other: np.ndarray) -> bool:
    """Whether two colours are the same to rounding."""
    return bool(np.abs(color - other).max() <= 2)


def green(picture: np.ndarray, view: View, x: float) -> float:
    """How green, as jelly is, the picture is about a place in the middle of its height."""
    column, row, _ = np.rint(view.pixels(np.array([[x, 0.5, 0.5]]))[0]).astype(int)
    window = picture[row - 8 : row + 9, column - 8 : column + 9].reshape(-1, 3).mean(axis=0)
    return float(window[1] - max(window[0], window[2]))


@pytest.mark.parametrize("mode", ["dots", "surface", "fluid", "density"])
def test_flat_colliders_fill_their_forms_and_turn(tmp_path: Path, mode: str) -> None:
    """After a quarter of a turn, in frame 1, the rod stands upright."""
    facts = header((1.0, 1.0), H, [WATER], [TANK, ROD])
    water = lattice((0.4, 0.2), (0.6, 0.4), H / 2)
    result = write(tmp_path / "run", facts, [frame(0, water), frame(1, water)])
    for k, (on, off) in enumerate([((0.35, 0.6), (0.5, 0.75)), ((0.5, 0.75), (0.35, 0.6))]):
        picture, view = drawn(result, mode, k)
        assert near(at(picture, view, *on), FILL)
        assert near(at(picture, view, *off), np.array(rgb_bytes(LIGHT.ground)))
        assert near(at(picture, view, 0.04, 0.04), FILL)
        assert not near(at(picture, view, 0.5, 0.3), FILL)
        other = np.abs(picture - FILL).max(axis=2) > 2
        scale, round_ = view.pixels_per_metre, 2 * np.pi * 0.45
        beside = other.size - scale**2
        # Rims are up to two pixels wide, and the walls may divide one.
        assert -10 < other.sum() - beside - (np.pi * 0.45**2 - 0.04) * scale**2 < 2 * (round_ + 1.2) * scale + 4 * scale
    bare, view = drawn(result, mode, 0, colliders="none")
    assert near(at(bare, view, 0.35, 0.6), np.array(rgb_bytes(LIGHT.ground)))


def test_particles_in_a_flat_collider_are_seen_as_dots(tmp_path: Path) -> None:
    facts = header((1.0, 1.0), H, [WATER], [ROD])
    result = write(tmp_path / "run", facts, [frame(0, np.array([[0.5, 0.6]]))])
    picture, view = drawn(result, "dots")
    assert not near(at(picture, view, 0.5, 0.6), FILL)
    assert near(at(picture, view, 0.55, 0.6), FILL)


@pytest.mark.parametrize("mode", ["dots", "surface", "fluid"])
def test_things_hide_what_is_behind_them_and_containers_hide_nothing(tmp_path: Path, mode: str) -> None:
    """Looked at along y: a slab at y < 0.3 stands before the one body, and moves to stand before the other."""
    slab = {"name": "slab", "shape": box([0.05, 0.1, 0.05], [0.45, 0.2, 0.95]), "velocity": [50.0, 0.0, 0.0]}
    room = {"name": "room", "side": "inside", "shape": box([0.02] * 3, [0.98] * 3)}
    facts = header((1.0, 1.0, 1.0), H, [JELLY, JELLY], [slab, room])
    block = lattice((0.15, 0.5, 0.4), (0.35, 0.7, 0.6), H / 2)
    both = np.concatenate([block, block + np.array([0.5, 0.0, 0.0])])
    body = np.repeat([0, 1], len(block))
    result = write(tmp_path / "run", facts, [frame(0, both, body), frame(1, both, body)])
    for k in range(2):
        picture, view = drawn(result, mode, k)
        without, _ = drawn(result, mode, k, colliders="none")
        hidden, seen = ((0.25, 0.75), (0.75, 0.25))[k]
        assert green(picture, view, hidden) < 5 < 20 < green(without, view, hidden)
        assert green(picture, view, seen) > 0.6 * green(without, view, seen)
    # Only its far side is left, which is before the body, too, and hidden by nothing.
    clear, view = drawn(result, mode, 0, colliders="clear")
    assert green(clear, view, 0.25) < 5


@pytest.mark.parametrize(("camera", "axes"), [("front", (0, 2)), ("side", (1, 2)), ("top", (0, 1))])
def test_a_slice_shows_the_section_of_a_collider(tmp_path: Path, camera: str, axes: tuple[int, int]) -> None:
    """Not in the middle, so that no picture is its own mirror image."""
    place = [0.5, 0.5, 0.5]
    place[axes[0]], place[axes[1]] = 0.3, 0.65
    ball = {"name": "ball", "shape": {"ball": {"center": place, "radius": 0.2}}}
    facts = header((1.0, 1.0, 1.0), H, [WATER], [ball])
    result = write(tmp_path / "run", facts, [frame(0, lattice((0.0,) * 3, (0.2,) * 3, H / 2))])
    picture, view = drawn(result, "density", camera=camera)
    rows, columns = np.nonzero(np.abs(picture - FILL).max(axis=2) <= 2)
    x, y, _ = view.pixels(np.array([place]))[0]
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx((x, y), abs=0.5)
    assert len(rows) == pytest.approx(np.pi * (0.2 * view.pixels_per_metre - 2) ** 2, rel=0.05)


def test_the_scene_of_a_picture_leaves_out_a_collider_that_cannot_be_read(tmp_path: Path) -> None:
    facts = header((1.0, 1.0), H, [WATER], [{**ROD, "shape": {"unheard_of": {}}}, TANK])
    result = write(tmp_path / "run", facts, [frame(0, np.array([[0.5, 0.5]]))])
    assert [collider.name for collider in render_scene_of(result).colliders] == ["tank"]
    assert result.header.collider_names == ("rod", "tank")


def test_a_body_on_a_collider_has_no_edge_there_and_is_not_seen_behind_a_thin_one(tmp_path: Path) -> None:
    """Its particles end a distance from the slab, as solvers keep them, and the picture shows no gap."""
    slab = {"name": "slab", "shape": box([0.0, 0.2], [1.0, 0.3])}
    shelf = {"name": "shelf", "shape": box([0.0, 0.7], [1.0, 0.71])}
    d = H / 2
    block = lattice((0.3, 0.3 + d / 2), (0.7, 0.5), d)
    facts = header((1.0, 1.0), H, [WATER], [slab, shelf])
    result = write(tmp_path / "run", facts, [frame(0, np.concatenate([block, block + np.array([0.0, 0.4])]))])
    picture, view = drawn(result, "surface")
    for y, top in ((0.3, 0.2), (0.71, 0.7)):
        # Two pixels above the rim, and below the collider.
        for x in (0.4, 0.5, 0.6):
            above = at(picture, view, x, y + 3 / view.pixels_per_metre)
            assert above[2] > above[0] + 60, "no gap, but water"
            below = at(picture, view, x, top - 3 / view.pixels_per_metre)
            assert near(below, np.array(rgb_bytes(LIGHT.ground)))


@pytest.mark.parametrize("mode", ["dots", "surface", "fluid"])
def test_a_hollow_collider_is_cut_open(tmp_path: Path, mode: str) -> None:
    """The jelly in a tube is seen from the front by default."""
    outer, inner = ({"min": [a, a, -0.1], "max": [1 - a, 1 - a, 1.1]} for a in (0.2, 0.3))
    tube = {"name": "tube", "shape": {"box": outer, "subtract": [{"box": inner}]}}
    inside = lattice((0.35, 0.35, 0.3), (0.65, 0.65, 0.7), H / 2)
    result = write(tmp_path / "run", header((1.0, 1.0, 1.0), H, [JELLY], [tube]), [frame(0, inside)])
    (open_, view), (shut, _) = (drawn(result, mode, colliders=word) for word in ("auto", "solid"))
    assert green(open_, view, 0.5) > 20 > 0 > green(shut, view, 0.5)
    above, _ = drawn(result, mode, camera="top")
    assert above.std() > 1
    # What holds little is no vessel, and stays whole.
    outside = np.concatenate([lattice((0.0, 0.0, 0.0), (0.15, 1.0, 0.5), H / 2), inside[:5]])
    other = write(tmp_path / "other", header((1.0, 1.0, 1.0), H, [JELLY], [tube]), [frame(0, outside)])
    assert set_up(other, Settings(mode=mode, color=None, size=(64, 64))).settings.colliders == "solid"
    empty = write(tmp_path / "none", header((1.0, 1.0, 1.0), H, [JELLY], [tube]), [frame(0, inside[:0])])
    assert set_up(empty, Settings(mode=mode, color="material", size=(64, 64))).settings.colliders == "solid"


def test_no_edge_of_the_domain_crosses_what_is_inside(tmp_path: Path) -> None:
    """A cube of jelly that fills it, seen from over a corner, has the colour of jelly in the middle of its outline."""
    full = lattice((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), H)
    result = write(tmp_path / "run", header((1.0, 1.0, 1.0), 2 * H, [JELLY]), [frame(0, full)])
    picture, view = drawn(result, "dots", camera="iso")
    corner = max(np.ndindex(2, 2, 2), key=lambda pick: float(np.array(pick) @ view.axes[2]))
    column, row, _ = np.rint(view.pixels(np.array([corner], float))[0]).astype(int)
    window = picture[row + 4 : row + 60, column - 1 : column + 2].reshape(-1, 3)
    assert (window[:, 1] - np.maximum(window[:, 0], window[:, 2]) > 5).all()

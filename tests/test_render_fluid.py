"""Pixels of screen-space liquids: where they are, what they hide, and what they let through."""

import resource
from dataclasses import replace

import numpy as np
import pytest

from mpmcli.frames.frame import Frame
from mpmcli.render.fluid import FluidPainter
from mpmcli.render.liquid_surface import Liquid, surface_of, window_of
from mpmcli.render.render_scene import APPEARANCES, RenderScene
from mpmcli.render.settings import THEMES
from mpmcli.render.view import View, view_of

pytestmark = pytest.mark.usefixtures("drawing")

SIZE = (320, 180)
SPACING = 0.04
DISTANCE = SPACING / 2
SUBJECT = RenderScene(
    title="water and jelly",
    dimension=3,
    lower=(0.0, 0.0, 0.0),
    upper=(1.6, 0.8, 0.9),
    up=(0.0, 0.0, 1.0),
    bodies=("water", "jelly"),
    appearances=(APPEARANCES["water"], APPEARANCES["jelly"]),
    material_of=(0, 1),
    distances=(DISTANCE, DISTANCE),
    densities=(1000.0, 1000.0),
)
WATER, JELLY = 0, 1
FRONT = view_of(SUBJECT, "front", SIZE)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
    """Return a lattice of particles in a box, (n, 3)."""
    axes = [np.arange(a + DISTANCE / 2, b, DISTANCE) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def frame_of(*bodies: tuple[np.ndarray, int]) -> Frame:
    """Return a frame of particles and the bodies that they are of."""
    position = np.concatenate([points for points, _ in bodies]) if bodies else np.empty((0, 3))
    body = np.concatenate([np.full(len(points), k) for points, k in bodies]) if bodies else np.empty(0)
    body = body.astype(np.int32)
    return Frame(0, 0.0, 0, position.astype(np.float32), np.zeros_like(position), body, body)


def covered(points: np.ndarray, view: View, radius: float) -> np.ndarray:
    """Return the pixels (h, w) whose middle is within a radius, m, of a particle as the view shows it."""
    column, row = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    result = np.zeros(column.shape, bool)
    for x, y, depth in view.pixels(points.astype(np.float64)):
        scale = view.pixels_per_metre * (1.0 if view.parallel else view.distance / depth)
        result |= (column - x) ** 2 + (row - y) ** 2 < (radius * scale) ** 2
    return result


def changed(image: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the pixels (h, w) that differ visibly."""
    return np.abs(image.astype(int) - other).max(axis=2) > 3


@pytest.fixture(scope="module")
def painter() -> FluidPainter:
    """Return a painter of the scene from the front, where the floor is seen edge-on and takes no shadows."""
    return FluidPainter(SUBJECT, FRONT, THEMES["light"])


@pytest.fixture(scope="module")
def empty(painter: FluidPainter) -> np.ndarray:
    """Return the picture of nothing."""
    return painter.draw(frame_of())


@pytest.mark.parametrize("camera", ["front", "iso"])
def test_liquid_covers_what_its_particles_cover(camera: str):
    view = view_of(SUBJECT, camera, SIZE)
    painter = FluidPainter(SUBJECT, view, THEMES["dark"])
    # Hung in the air, so that what is near it is not its shadow; some drops fly apart from the rest.
    points = np.concatenate([box((0.5, 0.3, 0.4), (0.9, 0.5, 0.7)), [[0.3, 0.4, 0.8], [1.2, 0.2, 0.5]]])
    different = changed(painter.draw(frame_of((points, WATER))), painter.draw(frame_of()))
    must = covered(points, view, 0.4 * DISTANCE)
    assert must.sum() > 1000
    assert different[must].mean() > 0.99
    assert different[covered(points[-2:], view, 0.4 * DISTANCE)].mean() > 0.9
    # A particle's sphere, an outline that is smoothed over as much again, and a pixel.
    may = covered(points, view, 1.8 * DISTANCE + 1.5 / view.pixels_per_metre)
    if camera == "front":
        assert not (different & ~may).any()


def test_nothing_and_one_particle_are_drawn(painter: FluidPainter, empty: np.ndarray):
    assert empty.shape == (180, 320, 3)
    assert empty.dtype == np.uint8
    one = np.array([[0.8, 0.4, 0.5]])
    different = changed(painter.draw(frame_of((one, WATER))), empty)
    column, row = np.floor(FRONT.pixels(one)[0, :2]).astype(int)
    assert different[row, column]
    size = DISTANCE * FRONT.pixels_per_metre
    assert 1 <= different.sum() <= np.pi * (1.5 * size + 2) ** 2
    assert changed(painter.draw(frame_of((one, JELLY))), empty)[row, column]


def test_drop_that_is_alone_has_its_size():
    view = view_of(SUBJECT, "0.8,-0.5,0.5,0.8,0.4,0.5", SIZE)
    painter = FluidPainter(SUBJECT, view, THEMES["dark"])
    drop = np.array([[0.8, 0.4, 0.5]])
    different = changed(painter.draw(frame_of((drop, WATER))), painter.draw(frame_of()))
    size = DISTANCE * view.pixels_per_metre
    # As much as a ball of the volume of a particle, whose radius is 0.62 distances, or somewhat less; not a dot.
    assert np.pi * (0.4 * size) ** 2 < different.sum() < np.pi * (0.62 * size + 1) ** 2


def test_places_that_are_not_numbers_are_left_out(painter: FluidPainter):
    water = box((0.5, 0.3, 0.2), (0.7, 0.5, 0.4))
    lost = np.full((5, 3), np.nan)
    lost[3] = (0.1, np.inf, 0.2)
    both = painter.draw(frame_of((water, WATER), (lost, WATER), (lost, JELLY)))
    np.testing.assert_array_equal(both, painter.draw(frame_of((water, WATER))))


def test_solid_hides_liquid_behind_it_and_is_tinted_by_liquid_before_it(painter: FluidPainter):
    jelly = box((0.6, 0.3, 0.2), (0.9, 0.5, 0.5))
    # The front looks along y.
    before, behind = box((0.5, 0.05, 0.1), (1.0, 0.25, 0.6)), box((0.5, 0.55, 0.1), (1.0, 0.75, 0.6))
    alone = painter.draw(frame_of((jelly, JELLY)))
    shown = covered(jelly, FRONT, 0.3 * DISTANCE)
    hidden = painter.draw(frame_of((jelly, JELLY), (behind, WATER)))
    # Shading by depth and what is seen between the dots may change a pixel here and there.
    assert changed(alone, hidden)[shown].mean() < 0.1
    tinted = painter.draw(frame_of((jelly, JELLY), (before, WATER)))
    assert changed(alone, tinted)[shown].mean() > 0.9
    # Bluer, but still green.
    shift = tinted[shown].mean(axis=0) - alone[shown].mean(axis=0)
    assert shift[2] > 15
    green = tinted[shown].astype(int)
    water = painter.draw(frame_of((before, WATER)))[shown].astype(int)
    assert (green[:, 1] - green[:, 0]).mean() != pytest.approx((water[:, 1] - water[:, 0]).mean(), abs=5)


def test_deeper_water_is_bluer(painter: FluidPainter):
    middle = 90 + int((0.45 - 0.35) * FRONT.pixels_per_metre), 160
    reds = []
    for depth in (0.1, 0.3, 0.7):
        picture = painter.draw(frame_of((box((0.5, 0.0, 0.1), (1.1, depth, 0.6)), WATER)))
        reds.append(int(picture[middle][0]))
    # Beer and Lambert: what is left of the red falls with the thickness.
    assert reds[0] > reds[1] + 10 > reds[2] + 20


def test_walls_hold_the_liquid(painter: FluidPainter, empty: np.ndarray):
    picture = painter.draw(frame_of((box((0.0, 0.0, 0.0), (1.6, 0.8, 0.3)), WATER)))
    bottom = int(np.ceil(FRONT.pixels(np.array([[0.0, 0.0, 0.0]]))[0, 1]))
    assert not changed(picture, empty)[bottom + 2 :].any()
    assert changed(picture, empty)[bottom - 4, 40:-40].all()


@pytest.mark.parametrize("camera", ["front", "iso"])
def test_liquid_is_flat_where_it_lies_at_a_wall(camera: str):
    """A pool ends in the faces of the domain, up to the edge between its surface and the wall."""
    view = view_of(SUBJECT, camera, (640, 360))
    position = box((0.0, 0.0, 0.0), (1.6, 0.8, 0.3))
    pixels = view.pixels(position)
    scale, volume = view.scale_at(pixels[:, 2]), np.full(len(position), DISTANCE**3)
    liquids = [Liquid(APPEARANCES["water"], DISTANCE, position, pixels, scale, volume)]
    window = window_of(liquids, view)
    surface = surface_of(liquids, window, view, SUBJECT)
    # Places on the front face, y = 0, from a particle's distance below the surface down.
    for x, z in ((0.2, 0.02), (0.8, 0.15), (1.4, 0.27)):
        column, row, depth = view.pixels(np.array([[x, 0.0, z]]))[0]
        here = int(row) - window.top, int(column) - window.left
        np.testing.assert_allclose(surface.normal[here] @ view.axes, [0, -1, 0], atol=0.05)
        assert surface.depth[here] == pytest.approx(depth, abs=0.3 * DISTANCE)


def test_liquid_that_has_left_the_domain_is_drawn(painter: FluidPainter, empty: np.ndarray):
    away = box((0.7, 0.3, 0.85), (0.9, 0.5, 0.93))
    must = covered(away, FRONT, 0.4 * DISTANCE)
    # But for the edge of the domain, which is before it.
    line = int(FRONT.pixels(np.array([[0.8, 0.0, 0.9]]))[0, 1])
    must[line - 1 : line + 2] = False
    assert must[: line - 1].any()
    assert changed(painter.draw(frame_of((away, WATER))), empty)[must].mean() > 0.99


def test_liquid_that_is_not_in_the_picture_changes_nothing(empty: np.ndarray, painter: FluidPainter):
    far = np.array([[50.0, 0.4, 0.4], [50.1, 0.4, 0.4]])
    np.testing.assert_array_equal(painter.draw(frame_of((far, WATER))), empty)


def test_shadow_falls_on_the_floor():
    painter = FluidPainter(SUBJECT, view_of(SUBJECT, "iso", SIZE), THEMES["light"])
    hung = box((0.6, 0.3, 0.5), (1.0, 0.6, 0.8))
    view = view_of(SUBJECT, "iso", SIZE)
    beside = ~covered(hung, view, 4 * DISTANCE)
    for body in (WATER, JELLY):
        lighter = painter.draw(frame_of()).astype(int) - painter.draw(frame_of((hung, body)))
        assert (lighter[beside] >= -1).all()
        assert (lighter[beside].max(axis=1) > 8).sum() > 100


@pytest.mark.parametrize("name", ["honey", "lava", "mud"])
def test_materials_look_like_what_they_are(name: str):
    scene = replace(SUBJECT, appearances=(APPEARANCES[name], APPEARANCES["jelly"]))
    for theme in ("light", "dark"):
        painter = FluidPainter(scene, FRONT, THEMES[theme])
        lump = box((0.5, 0.2, 0.2), (1.1, 0.6, 0.6))
        red, green, blue = painter.draw(frame_of((lump, WATER)))[covered(lump, FRONT, 0.3 * DISTANCE)].mean(axis=0)
        # All three are warm; lava is red, honey is yellow between red and green, mud is hardly coloured.
        assert red > green > blue
        share = (red - green) / (red - blue)
        assert {"honey": 0.25 < share < 0.7, "lava": share > 0.55, "mud": red - blue < 90}[name]


def test_same_frame_gives_the_same_bytes(painter: FluidPainter):
    frame = frame_of((box((0.2, 0.1, 0.0), (0.8, 0.5, 0.5)), WATER), (box((0.9, 0.2, 0.0), (1.2, 0.5, 0.3)), JELLY))
    first = painter.draw(frame)
    painter.draw(frame_of((box((0.2, 0.1, 0.0), (1.5, 0.5, 0.2)), WATER)))
    np.testing.assert_array_equal(painter.draw(frame), first)
    np.testing.assert_array_equal(FluidPainter(SUBJECT, FRONT, THEMES["light"]).draw(frame), first)


@pytest.mark.slow
def test_memory_does_not_grow_with_frames(painter: FluidPainter):
    def draw(k: int) -> None:
        shift = 0.005 * (k % 50)
        water = box((0.2 + shift, 0.1, 0.0), (0.6, 0.5, 0.3))
        painter.draw(frame_of((water, WATER), (box((0.9, 0.2, 0.0), (1.2 - shift, 0.5, 0.3)), JELLY)))

    for k in range(20):
        draw(k)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for k in range(50):
        draw(k)
    # kB. One window's picture and depth are 2 MB: a leak of one of them a frame would be 100 MB.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000

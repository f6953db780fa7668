"""Pictures of surfaces: they cover what their particles cover, and mean what their colours say."""

from functools import cache

import numpy as np
import pytest

from mpmcli.frames.frame import Frame
from mpmcli.render.coloring import Coloring
from mpmcli.render.lighting import lights_of
from mpmcli.render.pictures import Painter, surface_painter
from mpmcli.render.render_scene import APPEARANCES, RenderScene
from mpmcli.render.settings import THEMES
from mpmcli.render.view import View, view_of

pytestmark = pytest.mark.usefixtures("drawing")

SIZE = (320, 180)
DISTANCE = 0.025
LIGHT = THEMES["light"]


def by_column(unknown: tuple[int, ...] = ()) -> Coloring:
    """Colours by x, from 0 to 1; particles in `unknown` have no number."""

    def value(frame: Frame) -> np.ndarray:
        values = frame.position[:, 0].astype(np.float64)
        values[list(unknown)] = np.nan
        return values

    return Coloring("x", "m", (), value, "viridis", (0.0, 1.0), "#ff00c8")


def subject_with(dimension: int, *names: str) -> RenderScene:
    upper = (1.0, 1.0, 1.0) if dimension == 3 else (1.0, 1.0, 0.0)
    up = (0.0, 0.0, 1.0) if dimension == 3 else (0.0, 1.0, 0.0)
    appearances = tuple(APPEARANCES[name] for name in names)
    count = len(names)
    return RenderScene(
        title="",
        dimension=dimension,
        lower=(0.0, 0.0, 0.0),
        upper=upper,
        up=up,
        bodies=names,
        appearances=appearances,
        material_of=tuple(range(count)),
        distances=(DISTANCE,) * count,
        densities=(1e3,) * count,
    )


def frame_of(position: np.ndarray, body: np.ndarray | int = 0) -> Frame:
    bodies = np.broadcast_to(np.asarray(body, dtype=np.int32), len(position))
    return Frame(3, 0.5, 9, position, np.zeros_like(position), bodies, np.zeros_like(bodies))


def ball(dimension: int, radius: float, middle: float = 0.5) -> np.ndarray:
    axis = DISTANCE * (np.arange(round(1 / DISTANCE)) + 0.5)
    points = np.stack(np.meshgrid(*(axis,) * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
    return points[np.linalg.norm(points - middle, axis=1) < radius]


@cache
def painter(dimension: int, names: tuple[str, ...], camera: str = "front", theme: str = "light") -> Painter:
    scene = subject_with(dimension, *names)
    return surface_painter(scene, view_of(scene, camera, SIZE), THEMES[theme])


def mask_of(tool: Painter, frame: Frame) -> np.ndarray:
    """Return the pixels (h, w) that differ from those of the empty scene; from the front no shadow is seen."""
    empty = tool.draw(frame_of(frame.position[:0])).astype(int)
    return np.abs(tool.draw(frame).astype(int) - empty).max(axis=2) > 4


def on(view: View, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    points = np.zeros((len(position), 3))
    points[:, : position.shape[1]] = position
    columns, rows, _ = view.pixels(points).T
    return rows.astype(int), columns.astype(int)


@pytest.mark.parametrize(
    ("dimension", "name"),
    [(d, name) for d in (2, 3) for name in ("water", "jelly", "honey", "rubber", "sand", "metal", "clay")],
)
def test_a_ball_covers_its_particles_and_no_more(dimension: int, name: str) -> None:
    """Seen from the front, in parallel, its outline is a disk, to within half a particle all around."""
    tool = painter(dimension, (name,))
    position = ball(dimension, 0.3)
    mask = mask_of(tool, frame_of(position))
    # The thin rim of clear water may look as its surroundings do.
    assert mask[on(tool.view, position)].mean() > 0.99
    scale = tool.view.pixels_per_metre
    radius = np.sqrt(mask.sum() / np.pi) / scale
    assert radius == pytest.approx(0.3, abs=0.5 * DISTANCE)
    columns, rows = (np.flatnonzero(mask.any(axis=k)) for k in (0, 1))
    assert np.ptp(columns) / scale == pytest.approx(0.6, abs=1.5 * DISTANCE)
    assert np.ptp(rows) / scale == pytest.approx(0.6, abs=1.5 * DISTANCE)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_snow_covers_its_particles(dimension: int, theme: str) -> None:
    tool = painter(dimension, ("snow",), theme=theme)
    position = ball(dimension, 0.3)
    empty = tool.draw(frame_of(position[:0])).astype(int)
    mask = np.abs(tool.draw(frame_of(position)).astype(int) - empty).max(axis=2) > 3
    assert mask[on(tool.view, position)].mean() > 0.97


def test_the_area_of_a_block_in_the_plane_is_its_own() -> None:
    tool = painter(2, ("mud",))
    axis = DISTANCE * (np.arange(24) + 0.5)
    position = 0.2 + np.stack(np.meshgrid(axis, axis[:16], indexing="ij"), axis=-1).reshape(-1, 2)
    ground = tool.draw(frame_of(position[:0])).astype(float)
    # Share of each pixel that is not ground, by the colour of the brightest channel's fall.
    picture = tool.draw(frame_of(position)).astype(float)
    inside = picture[on(tool.view, np.array([[0.5, 0.4]]))][0]
    share = np.clip((ground - picture)[..., 2] / (ground[0, 0, 2] - inside[2]), 0.0, 1.0)
    true = len(position) * (DISTANCE * tool.view.pixels_per_metre) ** 2
    assert share.sum() == pytest.approx(true, rel=0.03)
    assert (share > 0.5).sum() == pytest.approx(true, rel=0.02)


@pytest.mark.parametrize("dimension", [2, 3])
def test_walls_cut_off_what_leans_on_them(dimension: int) -> None:
    tool = painter(dimension, ("clay",))
    position = ball(dimension, 0.35, middle=0.1)
    mask = mask_of(tool, frame_of(position))
    corner = np.zeros((1, dimension))
    row, column = (int(v[0]) for v in on(tool.view, corner))
    # Level with the particles at the wall, from its very first pixel on.
    level = row - int(0.1 * tool.view.pixels_per_metre)
    assert mask[level, column + 2 : column + 10].all()
    assert not mask[level, : column - 2].any()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("name", ["water", "sand", "snow"])
def test_one_particle_shows_and_none_does_not_fail(dimension: int, name: str) -> None:
    tool = painter(dimension, (name,), theme="dark")
    empty = tool.draw(frame_of(np.empty((0, dimension))))
    assert empty.shape == (SIZE[1], SIZE[0], 3)
    assert empty.dtype == np.uint8
    one = tool.draw(frame_of(np.full((1, dimension), 0.5)))
    row, column = (int(v[0]) for v in on(tool.view, np.full((1, dimension), 0.5)))
    near = np.abs(one.astype(int) - empty)[row - 4 : row + 4, column - 4 : column + 4]
    assert near.max() > 25
    lost = tool.draw(frame_of(np.array([[np.nan] * dimension, [np.inf] * dimension, [40.0] * dimension])))
    assert (lost == empty).all()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("name", ["water", "sand"])
def test_colours_follow_a_field(dimension: int, name: str) -> None:
    from matplotlib import colormaps

    scene = subject_with(dimension, name)
    view = view_of(scene, "front", SIZE)
    position = ball(dimension, 0.4)
    picture = surface_painter(scene, view, LIGHT, by_column()).draw(frame_of(position)).astype(float)
    x = np.linspace(0.2, 0.8, 25)
    places = np.full((len(x), dimension), 0.5)
    places[:, 0] = x
    seen = picture[on(view, places)]
    wanted = 255.0 * colormaps["viridis"](x)[:, :3]
    # Light makes colours brighter or darker; hues are compared: directions of the colours.
    cosines = (seen * wanted).sum(axis=1) / np.linalg.norm(seen, axis=1) / np.linalg.norm(wanted, axis=1)
    assert cosines.min() > 0.985
    assert cosines.mean() > 0.995


@pytest.mark.parametrize("dimension", [2, 3])
def test_values_that_are_no_numbers_have_their_own_colour(dimension: int) -> None:
    scene = subject_with(dimension, "jelly")
    view = view_of(scene, "front", SIZE)
    position = ball(dimension, 0.4)
    colors = by_column(unknown=tuple(np.flatnonzero(position[:, 0] > 0.5).tolist()))
    picture = surface_painter(scene, view, LIGHT, colors).draw(frame_of(position)).astype(int)
    right, left = (picture[on(view, 0.5 + shift * np.eye(dimension)[:1])][0] for shift in (0.2, -0.2))
    assert right[0] > 2 * right[1]
    assert right[2] > 2 * right[1]
    assert left[1] > left[0]


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_same_frame_has_the_same_bytes(dimension: int) -> None:
    names = ("water", "jelly", "snow", "sand")
    parts = [ball(dimension, 0.18, middle) for middle in (0.2, 0.4, 0.6, 0.8)]
    body = np.repeat(np.arange(4), [len(part) for part in parts])
    frame = frame_of(np.concatenate(parts), body)
    first = painter(dimension, names, "iso")
    picture = first.draw(frame)
    first.draw(frame_of(parts[0]))
    assert (first.draw(frame) == picture).all()
    scene = subject_with(dimension, *names)
    again = surface_painter(scene, view_of(scene, "iso", SIZE), LIGHT)
    assert (again.draw(frame) == picture).all()


@pytest.mark.parametrize("name", ["water", "jelly", "honey"])
def test_what_is_clear_shows_what_is_behind(name: str) -> None:
    """A dark block behind a clear one darkens it; behind an opaque one it changes nothing."""
    far, near = ([0.5, 0.8, 0.5], [0.5, 0.3, 0.5])
    axis = DISTANCE * (np.arange(8) - 3.5)
    block = np.stack(np.meshgrid(axis, axis[:4], axis, indexing="ij"), axis=-1).reshape(-1, 3)
    both = frame_of(np.concatenate([block + near, block + far]), np.repeat([0, 1], len(block)))
    alone = frame_of(block + near)
    changes = []
    for first in (name, "clay"):
        tool = painter(3, (first, "mud"))
        row, column = (int(v[0]) for v in on(tool.view, np.array([near])))
        window = np.s_[row - 3 : row + 3, column - 3 : column + 3]
        changes.append(tool.draw(alone)[window].mean() - tool.draw(both)[window].mean())
    assert changes[0] > 4
    assert abs(changes[1]) < 2


def test_a_floating_body_casts_a_shadow_below_it() -> None:
    tool = painter(3, ("clay",), "iso")
    frame = frame_of(ball(3, 0.2, 0.5))
    change = tool.draw(frame).astype(int) - tool.draw(frame_of(frame.position[:0]))
    lamp = lights_of(subject_with(3, "clay"), tool.view, LIGHT)["lampTo"]
    below = np.array([0.5, 0.5, 0.5]) - 0.5 / lamp[2] * lamp
    away = np.array([0.5, 0.5, 0.5]) + 0.5 / lamp[2] * lamp * (1, 1, -1)
    shadow, other = (change[on(tool.view, place[None])].max() for place in (below, away))
    assert shadow < -15
    # There too the ball hides a part of the sky.
    assert shadow < 2 * other


@pytest.mark.slow
def test_memory_does_not_grow_with_frames() -> None:
    from resource import RUSAGE_SELF, getrusage

    tool = painter(3, ("water", "sand"), "iso")
    parts = [ball(3, 0.2, middle) for middle in (0.3, 0.7)]
    body = np.repeat([0, 1], [len(part) for part in parts])
    peaks = []
    for k in range(200):
        tool.draw(frame_of(np.concatenate(parts) + 0.0002 * k, body))
        peaks.append(getrusage(RUSAGE_SELF).ru_maxrss)
    # A picture's window and meshes are over 1 MB: 100 frames of a leak would be 100 MB.
    assert (peaks[-1] - peaks[99]) / 1024 < 20

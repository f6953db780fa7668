"""The density of the grid: it holds the mass, is that of a block, and is drawn where it is."""

from pathlib import Path

import numpy as np
import pytest
from drawn_results import WATER, frame, header, lattice, write

from mpmcli.output import Result
from mpmcli.render.density import DensityPainter, density_colors, grid_density
from mpmcli.render.render_scene import render_scene_of
from mpmcli.render.settings import THEMES, rgb_bytes
from mpmcli.render.view import Slice, slice_of, view_of

LIGHT = THEMES["light"]
H = 0.05


def filled(directory: Path, size: tuple[float, ...]) -> Result:
    """A domain full of water, of which the left half is given."""
    half = lattice((0.0,) * len(size), (0.5 * size[0], *size[1:]), H / 2)
    facts = header(size, H, [WATER])
    # The header says that a body fills the domain: its mass is shared by the particles of one half.
    return write(directory / "run", facts, [frame(0, half), frame(1, half[:0])])


def weights(density: np.ndarray) -> np.ndarray:
    """Volume of each node in cells: half on a wall, a quarter in a corner."""
    sides = [np.where((np.arange(n) == 0) | (np.arange(n) == n - 1), 0.5, 1.0) for n in density.shape]
    return sides[0][:, None] * sides[1]


def test_all_mass_is_on_the_grid(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    places = rng.random((500, 2)) * (1.0, 0.5)
    result = write(tmp_path / "run", header((1.0, 0.5), H, [WATER]), [frame(0, places)])
    density = grid_density(result.frame(0), result.header, Slice((0, 1)))
    assert density.shape == (21, 11)
    # 1000 kg/m^3 over the whole domain; single precision of masses and places.
    assert (density * weights(density)).sum() * H**2 == pytest.approx(1000.0 * 1.0 * 0.5, rel=1e-6)


def test_a_block_has_its_density_up_to_the_walls(tmp_path: Path) -> None:
    result = filled(tmp_path, (1.0, 0.5))
    density = grid_density(result.frame(0), result.header, Slice((0, 1)))
    # All mass in half of the room; quadratic B-splines sum to one on a lattice of two particles per cell.
    np.testing.assert_allclose(density[:8], 2000.0, rtol=1e-5)
    np.testing.assert_allclose(density[13:], 0.0)
    np.testing.assert_allclose(density[10], 1000.0, rtol=1e-5)


@pytest.mark.parametrize(("camera", "across"), [("iso", (0, 2)), ("front", (0, 2)), ("side", (1, 2)), ("top", (0, 1))])
def test_a_slice_has_the_density_of_its_place(tmp_path: Path, camera: str, across: tuple[int, int]) -> None:
    result = filled(tmp_path, (0.6, 0.4, 0.5))
    plane = slice_of(render_scene_of(result), camera)
    assert plane.across == across
    density = grid_density(result.frame(0), result.header, plane)
    # The slice from the side lies on the edge of the block, where half of the kernel is.
    expected = 1000.0 if camera == "side" else 2000.0
    np.testing.assert_allclose(density[:4], expected, rtol=1e-5)


def test_the_image_shows_the_block_where_it_is(tmp_path: Path) -> None:
    result = filled(tmp_path, (1.0, 0.5))
    scene = render_scene_of(result)
    view = view_of(scene, "iso", (320, 200))
    plane = slice_of(scene, "iso")
    colors = density_colors(result, plane, LIGHT)
    assert colors.limits == (0.0, pytest.approx(2000.0, rel=1e-4))
    painter = DensityPainter(result.header, scene, view, LIGHT, plane, colors)
    picture = painter.draw(result.frame(0))
    left, right, outside = view.pixels(np.array([[0.2, 0.25, 0.0], [0.8, 0.25, 0.0], [1.02, 0.25, 0.0]]))[:, :2].astype(
        int
    )
    assert tuple(picture[left[1], left[0]]) == tuple(colors.rgb(np.array([2000.0]))[0])
    assert tuple(picture[right[1], right[0]]) == rgb_bytes(LIGHT.ground)
    assert tuple(picture[outside[1], outside[0]]) == rgb_bytes(LIGHT.ground)
    # An empty frame is an empty picture.
    assert (painter.draw(result.frame(1)) == rgb_bytes(LIGHT.ground)).all()

"""Depth, smoothing, thickness and normals of a liquid, against closed forms."""

import numpy as np
import pytest

from mpmcli.render.dots import hidden
from mpmcli.render.liquid_surface import NOTHING, blurred, normals, smoothed, sphere_depths, thickness
from mpmcli.render.particle_grid import deposited

SHAPE = (60, 80)
# Pixels to the metre.
SCALE = 100.0


def pixels_of(points: np.ndarray) -> np.ndarray:
    """Look along z at points (n, 3), m: pixels from the left and from the top, and the distance, m."""
    return np.stack([SCALE * points[:, 0], SCALE * points[:, 1], 5.0 - points[:, 2]], axis=1)


def camera_points(depth: np.ndarray) -> np.ndarray:
    """Return the points that pixels show, in camera axes, m."""
    rows, columns = depth.shape
    across, down = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    return np.stack([across / SCALE, -down / SCALE, -depth], axis=-1).astype(np.float32)


def block(spacing: float, counts: tuple[int, int, int], corner: tuple[float, float, float]) -> np.ndarray:
    """Return particles on a jittered lattice."""
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    jitter = np.random.default_rng(7).uniform(-0.2, 0.2, cells.shape)
    return (cells + 0.5 + jitter) * spacing + np.array(corner)


def test_sphere_has_its_area_and_its_bulge():
    pixels = np.array([[40.2, 30.6, 5.0]])
    depth = sphere_depths(pixels, np.array([SCALE]), 0.2, SHAPE)
    row, column = np.nonzero(depth < NOTHING)
    # A disc of 20 pixels' radius: its pixels are its area but for half of those on its edge, at the very most.
    assert len(row) == pytest.approx(np.pi * 20**2, abs=np.pi * 20)
    square = ((column + 0.5 - 40.2) ** 2 + (row + 0.5 - 30.6) ** 2) / SCALE**2
    expected = 5.0 - np.sqrt(np.maximum(0.2**2 - square, 0))
    # float32 next to the edge, where the root has an infinite slope: sqrt of 2^-23, times the radius.
    np.testing.assert_allclose(depth[row, column], expected, atol=0.2 * 4e-4)


def test_sphere_smaller_than_a_pixel_shows():
    depth = sphere_depths(np.array([[10.9, 7.1, 2.0]]), np.array([SCALE]), 1e-5, SHAPE)
    assert depth[7, 10] == pytest.approx(2.0, abs=2e-5)
    assert (depth < NOTHING).sum() <= 4


def test_spheres_over_the_edge_are_cut():
    pixels = np.array([[0.0, 0.0, 5.0], [-500.0, 30.0, 5.0], [40.0, 900.0, 5.0]])
    depth = sphere_depths(pixels, np.full(3, SCALE), 0.1, SHAPE)
    assert (depth < NOTHING).sum() == pytest.approx(np.pi * 10**2 / 4, abs=10)
    corners = np.array([[-10.0, -10.0, 5.0], [89.5, 69.5, 5.0], [-9.5, 69.5, 5.0], [89.5, -9.5, 5.0]])
    assert (sphere_depths(corners, np.full(4, SCALE), 0.1, SHAPE) == NOTHING).all()
    assert (sphere_depths(np.empty((0, 3)), np.empty(0), 0.1, SHAPE) == NOTHING).all()


def test_what_is_called_hidden_is_not_seen():
    spacing = 0.05
    points = block(spacing, (12, 9, 10), (0.1, 0.08, 0.0))
    pixels, radius = pixels_of(points), 0.9 * spacing
    behind = hidden(pixels, spacing * SCALE, 2 * radius)
    # Most of ten layers is behind the first three.
    assert behind.mean() > 0.4
    scale = np.full(len(points), SCALE)
    whole = sphere_depths(pixels, scale, radius, SHAPE)
    np.testing.assert_array_equal(sphere_depths(pixels[~behind], scale[~behind], radius, SHAPE), whole)


def test_only_what_is_covered_all_around_is_hidden():
    screen = np.array([(5.0 + 10 * i, 5.0 + 10 * j, 1.0) for i in range(3) for j in range(3)])

    def middle(others: np.ndarray, depth: float) -> bool:
        return bool(hidden(np.append(others, [[15.0, 15.0, depth]], axis=0), 10.0, 0.2)[-1])

    assert middle(screen, 1.21)
    assert not middle(screen, 1.19)
    # A hole in any corner of the screen may show it.
    for k in (0, 2, 3, 8):
        assert not middle(np.delete(screen, k, axis=0), 1.21)
    assert not hidden(screen, 10.0, 0.2).any()
    assert len(hidden(np.empty((0, 3)), 10.0, 0.2)) == 0


def test_smoothing_keeps_a_slope():
    _across, down = np.meshgrid(np.arange(80), np.arange(60))
    slope = (5.0 + 0.001 * down + 0.002 * _across).astype(np.float32)
    result = smoothed(slope, np.full(SHAPE, 4.0), 0.1)
    # Away from the edges the weights are even about each pixel, so that a linear function is kept.
    np.testing.assert_allclose(result[20:-20, 20:-20], slope[20:-20, 20:-20], atol=1e-5)


def test_smoothing_takes_the_bumps_and_keeps_the_steps():
    spacing, shape = 0.05, (120, 240)
    near = block(spacing, (24, 24, 2), (0.0, 0.0, 0.0))
    far = block(spacing, (48, 24, 2), (0.0, 0.0, -3.0))
    pixels = pixels_of(np.concatenate([near, far]))
    rough = sphere_depths(pixels, np.full(len(pixels), SCALE), 0.9 * spacing, shape)
    smooth = smoothed(rough, np.full(shape, 2.2 * spacing * SCALE), 0.9 * spacing)
    # The slopes of the bumps, of the order of one, are gone.
    slopes = [np.abs(np.diff(depth[50:70, 50:70], axis=1)).mean() * SCALE for depth in (rough, smooth)]
    assert slopes[0] > 0.2
    assert slopes[1] < 0.1 * slopes[0]
    # No pixel floats between the two layers, which are 3 m apart: at the rims it is 2 radii back, one for each round.
    assert np.abs(smooth - rough)[rough < NOTHING].max() < 3 * 0.9 * spacing
    np.testing.assert_array_equal(smooth < NOTHING, rough < NOTHING)


def test_wide_smoothing_takes_wide_steps():
    rough = np.full((200, 200), np.float32(5.0))
    rough[::2] += np.float32(0.01)
    smooth = smoothed(rough, np.full(rough.shape, 20.0), 0.1)
    # Far from the edges, which are rounded over the reach of the filter, 40 pixels, in every round.
    np.testing.assert_allclose(smooth[90:110, 90:110], 5.005, atol=1e-3)


def test_nothing_stays_nothing():
    nothing = np.full(SHAPE, NOTHING)
    np.testing.assert_array_equal(smoothed(nothing, np.full(SHAPE, 4.0), 0.1), nothing)


def test_thickness_integrates_to_the_volume():
    spacing = 0.03
    points = block(spacing, (13, 9, 7), (0.2, 0.15, 0.0))
    volumes = np.random.default_rng(3).uniform(0.5, 1.5, len(points)) * spacing**3
    layer = thickness(pixels_of(points), volumes, np.full(len(points), SCALE), 3.0, SHAPE)
    # Only rounding: float32 sums of some 2,000 pixels.
    assert layer.sum() / SCALE**2 == pytest.approx(volumes.sum(), rel=1e-4)
    # In the middle it is the depth of the block, 7 layers; jitter of 0.2 is averaged over 30 particles.
    even = thickness(pixels_of(points), np.full(len(points), spacing**3), np.full(len(points), SCALE), 3.0, SHAPE)
    assert even[28, 39] == pytest.approx(7 * spacing, rel=0.05)


def test_thickness_in_perspective_is_volume_over_area():
    # The same particle at twice the distance is seen with a quarter of the pixels: its thickness times their number
    # is its volume over the area of one pixel there.
    for scale in (SCALE, SCALE / 2):
        layer = thickness(np.array([[40.0, 30.0, 5.0]]), np.array([1e-3]), np.array([scale]), 2.0, SHAPE)
        assert layer.sum() / scale**2 == pytest.approx(1e-3, rel=1e-5)


def test_deposit_keeps_the_middle():
    pixels = np.array([[20.3, 11.8], [50.5, 40.5]])
    amounts = np.array([2.0, 3.0])
    image = deposited(pixels - 0.5, amounts, SHAPE)
    row, column = np.mgrid[:60, :80] + 0.5
    # Linear weights reproduce linear functions.
    assert (image * column).sum() == pytest.approx((amounts * pixels[:, 0]).sum(), rel=1e-6)
    assert (image * row).sum() == pytest.approx((amounts * pixels[:, 1]).sum(), rel=1e-6)
    assert image[40, 50] == pytest.approx(3.0)


@pytest.mark.parametrize("deviation", [0.5, 3.0, 9.0, 14.3, 40.0])
def test_blur_has_its_width(deviation: float):
    reach = int(4 * deviation)
    image = np.zeros((2 * reach + 1, 2 * reach + 3), np.float32)
    image[reach, reach + 1] = 1.0
    result = blurred(image, deviation)
    assert result.sum() == pytest.approx(1.0, rel=1e-5)
    offset = np.arange(2 * reach + 3) - reach - 1
    # Cut off at three standard deviations a Gaussian loses 2.7 % of its variance.
    # At half a pixel the samples are too few for the integral: their sum is 2 exp(-2) / (1 + 2 exp(-2)) = 0.213.
    expected = 0.213 if deviation == 0.5 else deviation**2
    assert (offset**2 * result.sum(axis=0)).sum() == pytest.approx(expected, rel=0.04)
    assert (offset * result.sum(axis=0)).sum() == pytest.approx(0.0, abs=1e-3)
    # Its height in the middle, of a Gaussian in two dimensions.
    if deviation > 1:
        assert result.max() == pytest.approx(1 / (2 * np.pi * deviation**2), rel=0.05)


def test_normals_of_a_plane_and_of_a_sphere():
    down = (np.arange(60) + 0.5)[:, None] / SCALE
    plane = np.broadcast_to(5.0 + 0.5 * down, SHAPE)
    everywhere = np.ones(SHAPE, bool)
    # Farther downwards: the height falls as the viewer's axis does, so it faces up by 0.5 to 1, the wrong way round.
    expected = np.array([0.0, -0.5, 1.0]) / np.hypot(0.5, 1.0)
    np.testing.assert_allclose(normals(camera_points(plane), everywhere)[5:-5, 5:-5] - expected, 0.0, atol=2e-4)
    depth = sphere_depths(np.array([[40.0, 30.0, 5.0]]), np.array([SCALE]), 0.25, SHAPE)
    covered = depth < NOTHING
    points = camera_points(depth)
    exact = (points - np.array([0.4, -0.3, -5.0])) / 0.25
    inner = covered & (exact[..., 2] > 0.5)
    found = normals(points, covered)[inner]
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-5)
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", found, exact[inner]), -1, 1))
    # Central differences over 1 / 25 of the radius: second order, h^2 / 6 times the third derivative, 9 / z^5 times.
    assert np.degrees(angle.max()) < 1.5


def test_normals_do_not_bridge_a_step():
    depth = np.full(SHAPE, np.float32(5.0))
    depth[:, 40:] = 9.0
    np.testing.assert_allclose(normals(camera_points(depth), np.ones(SHAPE, bool))[..., 2], 1.0, atol=1e-6)

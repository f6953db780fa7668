"""The camera: where a point falls on the picture, as VTK has it, and that the whole domain is in it."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_results import JELLY, WATER
from hypothesis import given
from hypothesis import strategies as st

from mpmcli.errors import InputError
from mpmcli.render.offscreen import OffscreenRenderer
from mpmcli.render.render_scene import RenderScene, appearance_of
from mpmcli.render.settings import THEMES
from mpmcli.render.view import CAMERAS, MARGIN, aspect_of, view_of

SUBJECT = RenderScene(
    title="",
    dimension=3,
    lower=(-1.0, 0.5, 2.0),
    upper=(2.0, 1.5, 3.2),
    up=(0.0, 0.0, 1.0),
    bodies=("body",),
    appearances=(appearance_of("fluid", WATER),),
    material_of=(0,),
    distances=(0.05,),
    densities=(1000.0,),
)
FLAT = replace(SUBJECT, dimension=2, lower=(-1.0, 0.5, 0.0), upper=(2.0, 1.5, 0.0), up=(0.0, 1.0, 0.0))


def corners(scene: RenderScene) -> np.ndarray:
    low, high = np.array(scene.lower), np.array(scene.upper)
    return np.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])


@pytest.mark.parametrize("camera", [*CAMERAS, "4,-3,5,0.5,1,2.5", "0.5,1,9,0.5,1,2.5"])
def test_points_fall_where_vtk_puts_them(drawing: str, camera: str) -> None:
    from vtkmodules.vtkRenderingCore import vtkCoordinate

    view = view_of(SUBJECT, camera, (320, 200))
    stage = OffscreenRenderer(view, THEMES["light"])
    stage.render()
    points = np.concatenate([corners(SUBJECT), [[0.3, 0.9, 2.2]]])
    for point, (x, y, _) in zip(points, view.pixels(points), strict=True):
        coordinate = vtkCoordinate()
        coordinate.SetCoordinateSystemToWorld()
        coordinate.SetValue(*point)
        vtk_x, vtk_y = coordinate.GetComputedDoubleDisplayValue(stage.plotter.renderer)
        # VTK counts to the middle of pixels, from the bottom.
        assert abs(x - vtk_x - 0.5) < 0.51 and abs(200 - y - vtk_y - 0.5) < 0.51
    stage.plotter.close()


@pytest.mark.parametrize("scene", [SUBJECT, FLAT], ids=["3d", "2d"])
@pytest.mark.parametrize("size", [(320, 200), (90, 400)])
@pytest.mark.parametrize("camera", CAMERAS)
def test_the_camera_frames_the_domain(scene: RenderScene, camera: str, size: tuple[int, int]) -> None:
    camera = camera if scene.dimension == 3 else "iso"
    seen = view_of(scene, camera, size).pixels(corners(scene))[:, :2]
    free = np.stack([seen.min(axis=0), np.array(size) - seen.max(axis=0)]) / size
    # In the middle, nothing outside, and no smaller than it must be.
    assert free.min() >= MARGIN - 1e-6
    assert free.min() <= MARGIN + 0.01
    np.testing.assert_allclose(free[0], free[1], atol=0.01)


def test_a_flat_scene_is_drawn_at_true_aspect() -> None:
    view = view_of(FLAT, "iso", (640, 480))
    (x0, y0, _), (x1, y1, _) = view.pixels(np.array([FLAT.lower, FLAT.upper]))
    assert (x1 - x0) / 3.0 == pytest.approx((y0 - y1) / 1.0, rel=1e-12) == pytest.approx(view.pixels_per_metre)
    assert aspect_of(FLAT, "iso") == pytest.approx((1 / 3 * 920 + 80) / 1000, rel=1e-6)


def test_up_is_up_whatever_axis_gravity_has() -> None:
    for axis in range(3):
        for sign in (1.0, -1.0):
            up = np.zeros(3)
            up[axis] = sign
            view = view_of(replace(SUBJECT, up=tuple(up)), "iso", (300, 300))
            middle = 0.5 * (np.array(SUBJECT.lower) + SUBJECT.upper)
            low, high = view.pixels(np.stack([middle, middle + 0.1 * up]))
            assert high[1] < low[1] and abs(high[0] - low[0]) < 0.1


@given(st.text(max_size=20))
def test_any_other_camera_is_refused_in_a_sentence(text: str) -> None:
    if text in CAMERAS:
        return
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) == 6:
        return
    with pytest.raises(InputError, match="or six numbers"):
        view_of(SUBJECT, text, (320, 200))


def test_a_flat_scene_has_no_other_side() -> None:
    for camera in ("side", "top", "1,2,3,4,5,6"):
        with pytest.raises(InputError, match="drawn in its plane"):
            view_of(FLAT, camera, (320, 200))


def test_a_camera_is_not_beyond_what_numbers_reach() -> None:
    for camera in ("1e300,0,0,0,0,0", "0,0,0,0,1e12,0"):
        with pytest.raises(InputError, match="too far from the domain"):
            view_of(SUBJECT, camera, (320, 200))
    assert np.isfinite(view_of(SUBJECT, "1e4,0,0,0,0,0", (320, 200)).far)


def test_a_camera_needs_something_to_look_at() -> None:
    with pytest.raises(InputError, match="position and its target are equal"):
        view_of(SUBJECT, "1,2,3,1,2,3", (320, 200))
    with pytest.raises(InputError, match="six numbers"):
        view_of(SUBJECT, "1,2,3,nan,2,3", (320, 200))


def test_materials_look_like_the_presets_they_are_nearest_to() -> None:
    fluid = {"law": "fluid", "density": 1000.0}
    assert appearance_of("fluid", fluid).name == "water"
    assert appearance_of("fluid", {**fluid, "viscosity": 1e-3}).name == "water"
    assert appearance_of("fluid", {**fluid, "density": 1400.0, "viscosity": 8.0}).name == "honey"
    assert appearance_of("neo_hookean", JELLY).name == "jelly"
    assert appearance_of("fixed_corotated", {**JELLY, "density": 950.0, "youngs_modulus": 2e6}).name == "rubber"
    assert appearance_of("von_mises", {"density": 2700.0, "yield_stress": 3e7}).name == "metal"
    first, second = appearance_of("my_law", {}), appearance_of("my_other_law", {}, others=1)
    assert first.name == "my_law" and first.ink != second.ink

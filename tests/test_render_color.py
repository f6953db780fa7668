"""What colours mean: values, limits, maps, and the sentences for what is not stored."""

from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from drawn_results import JELLY, WATER, frame, header, write

from mpmcli.errors import InputError
from mpmcli.output import Result
from mpmcli.render.coloring import Categories, Coloring, color_by, color_map
from mpmcli.render.render_scene import RenderScene, render_scene_of
from mpmcli.render.settings import THEMES, rgb_bytes

LIGHT = THEMES["light"]
N = 400
RNG = np.random.default_rng(7)
PLACES = RNG.random((N, 2))
STRESS = RNG.standard_normal((N, 2, 2))


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    facts = header((1.0, 1.0), 0.05, [WATER, JELLY])
    body = (np.arange(N) >= N // 2).astype(np.int32)
    frames = [
        frame(
            k,
            PLACES,
            body,
            velocity=np.stack([np.full(N, 0.3 * k), 0.4 * k * np.linspace(0, 1, N)], axis=1),
            density=np.linspace(900.0, 1100.0, N),
            stress=STRESS,
            pressure=np.full(N, 2.0e4),
        )
        for k in range(3)
    ]
    return write(tmp_path_factory.mktemp("color") / "run", facts, frames)


@pytest.fixture(scope="module")
def scene(result: Result) -> RenderScene:
    return render_scene_of(result)


def values(name: str, result: Result, scene: RenderScene, k: int = 2) -> np.ndarray:
    colors = color_by(name, result, scene, LIGHT)
    assert isinstance(colors, Coloring)
    return colors.values(result.frame(k, colors.fields))


def test_values_are_what_their_names_say(result: Result, scene: RenderScene) -> None:
    f = result.frame(2)
    np.testing.assert_allclose(values("speed", result, scene), np.hypot(*f.velocity.T), rtol=1e-6)
    np.testing.assert_allclose(values("velocity", result, scene), np.hypot(*f.velocity.T), rtol=1e-6)
    np.testing.assert_array_equal(values("velocity.y", result, scene), f.velocity[:, 1])
    np.testing.assert_array_equal(values("id", result, scene), np.arange(N))
    np.testing.assert_array_equal(values("density", result, scene), f.fields["density"])
    # J of each body is its own density at rest over its density.
    rest = np.where(f.body == 0, 1000.0, 1020.0)
    np.testing.assert_allclose(values("J", result, scene), rest / f.fields["density"], rtol=1e-6)
    stress = f.fields["stress"].astype(np.float64)
    np.testing.assert_array_equal(values("stress.xy", result, scene), stress[:, 0, 1])
    # In the plane the deviator has the eigenvalues +-s, s half the difference of the stress's own.
    low, high = np.linalg.eigvalsh(0.5 * (stress + stress.transpose(0, 2, 1))).T
    skew = 0.5 * (stress[:, 0, 1] - stress[:, 1, 0])
    expected = np.sqrt(1.5 * (2 * (0.5 * (high - low)) ** 2 + 2 * skew**2))
    np.testing.assert_allclose(values("stress", result, scene), expected, rtol=1e-6)


def test_limits_hold_nearly_all_particles_of_all_frames(result: Result, scene: RenderScene) -> None:
    speed = color_by("speed", result, scene, LIGHT)
    assert speed.limits[0] == 0.0
    everything = np.concatenate([np.hypot(*f.velocity.T) for f in result.frames()])
    assert 0.0 < (everything > speed.limits[1]).mean() < 0.01
    J = color_by("J", result, scene, LIGHT)
    assert J.cmap == "coolwarm" and sum(J.limits) == pytest.approx(2.0)
    shear = color_by("stress.xy", result, scene, LIGHT)
    assert shear.cmap == "coolwarm" and sum(shear.limits) == pytest.approx(0.0)
    # What never changes its sign has no neutral value, and neither have limits on one side of it.
    assert color_by("velocity.y", result, scene, LIGHT).cmap == "viridis"
    assert color_by("stress.xy", result, scene, LIGHT, limits=(0.0, 1.0)).cmap == "viridis"
    even = color_by("pressure", result, scene, LIGHT)
    assert even.limits[0] < 2.0e4 < even.limits[1]
    assert color_by("speed", result, scene, LIGHT, limits=(1.0, 3.0)).limits == (1.0, 3.0)


def test_colours_are_those_of_the_map_and_nan_has_its_own(result: Result, scene: RenderScene) -> None:
    colors = color_by("density", result, scene, LIGHT, limits=(0.0, 10.0), cmap="magma")
    given = np.array([-5.0, 0.0, 2.5, 5.0, 10.0, 99.0, np.nan, np.inf])
    expected = mpl.colormaps["magma"](np.array([0.0, 0.0, 0.25, 0.5, 1.0, 1.0]), bytes=True)[:, :3].astype(int)
    got = colors.rgb(given)
    assert np.abs(got[:6].astype(int) - expected).max() <= 3
    assert (got[6:] == rgb_bytes(LIGHT.missing)).all()


def test_materials_and_bodies_have_colours_of_their_own(result: Result, scene: RenderScene) -> None:
    f = result.frame(0, ())
    for name, kinds in (("material", ("water", "body 1")), ("body", ("body 0", "body 1"))):
        colors = color_by(name, result, scene, LIGHT)
        assert isinstance(colors, Categories) and colors.names == kinds
        rgb = colors.particle_rgb(f)
        assert (rgb[: N // 2] == rgb_bytes(colors.inks[0])).all() and (rgb[N // 2 :] == rgb_bytes(colors.inks[1])).all()


@pytest.mark.parametrize(("name", "sentence"), [
    ("volume_ratio", 'stores no "volume_ratio", but velocity, .*add "volume_ratio" to output.fields of the scene'),
    ("presure", 'did you mean "pressure"'),
    ("foo", "speed, material, body, id, density, pressure, J and stress have names of their own"),
    ("velocity.z", 'no component "z"; its components are x and y'),
    ("density.x", "it is one number"),
])  # fmt: skip
def test_what_is_not_stored_is_named(result: Result, scene: RenderScene, name: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        color_by(name, result, scene, LIGHT)


def test_j_needs_a_field_that_tells_it(tmp_path: Path) -> None:
    bare = write(tmp_path / "bare", header((1.0, 1.0), 0.1, [WATER]), [frame(0, PLACES)])
    with pytest.raises(InputError, match='add "volume_ratio" to output'):
        color_by("J", bare, render_scene_of(bare), LIGHT)
    with pytest.raises(InputError, match='add "pressure" to output'):
        color_by("pressure", bare, render_scene_of(bare), LIGHT)


def test_unknown_maps_are_refused() -> None:
    with pytest.raises(InputError, match='did you mean "viridis"'):
        color_map("virridis")


def test_only_nan_still_has_limits(tmp_path: Path) -> None:
    facts = header((1.0, 1.0), 0.1, [WATER])
    nothing = write(tmp_path / "nan", facts, [frame(0, PLACES, pressure=np.full(N, np.nan))])
    colors = color_by("pressure", nothing, render_scene_of(nothing), LIGHT)
    assert colors.limits[0] < colors.limits[1]
    empty = write(
        tmp_path / "empty", facts, [frame(0, np.empty((0, 2)), stress=np.empty((0, 2, 2)), volume_ratio=np.empty(0))]
    )
    for name in ("speed", "stress", "stress.xy", "volume_ratio", "id"):
        assert color_by(name, empty, render_scene_of(empty), LIGHT).particle_rgb(empty.frame(0)).shape == (0, 3)


def test_stress_has_all_three_axes_in_2d_too(tmp_path: Path) -> None:
    """Runs in the plane strain out of it: the solver stores nine numbers."""
    stress = np.random.default_rng(5).standard_normal((4, 3, 3))
    facts = header((1.0, 1.0), 0.05, [WATER])
    run = write(tmp_path / "run", facts, [frame(0, np.zeros((4, 2)), stress=stress.reshape(4, 9), way=stress[:, 0])])
    scene = render_scene_of(run)
    for name, expected in (("xy", stress[:, 0, 1]), ("yx", stress[:, 1, 0]), ("zz", stress[:, 2, 2])):
        np.testing.assert_allclose(values(f"stress.{name}", run, scene, 0), expected, rtol=1e-6)
    np.testing.assert_allclose(values("way.z", run, scene, 0), stress[:, 0, 2], rtol=1e-6)
    deviator = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    np.testing.assert_allclose(
        values("stress", run, scene, 0), np.sqrt(1.5 * (deviator**2).sum(axis=(1, 2))), rtol=1e-6
    )


def test_extremes_are_coloured_without_a_complaint(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    places = np.zeros((4, 2))
    big = np.array([-1.7e308, 0.0, 1.0, 1.7e308])
    ratio = np.array([0.0, 0.5, 1.0, 2.0])
    wide = replace(frame(0, places, volume_ratio=ratio), fields={"volume_ratio": ratio, "wide": big, "tiny": big * 0})
    run = write(tmp_path / "run", header((1.0, 1.0), 0.05, [WATER]), [wide])
    pictured = {}
    for name in ("density", "wide", "tiny"):
        colors = color_by(name, run, render_scene_of(run), LIGHT)
        assert isinstance(colors, Coloring) and np.isfinite(np.ptp(colors.limits))
        pictured[name] = colors.particle_rgb(run.frame(0, colors.fields))
    # No volume: its density is no number.
    assert tuple(pictured["density"][0]) == rgb_bytes(LIGHT.missing)
    assert tuple(pictured["wide"][0]) != tuple(pictured["wide"][3])
    narrow = color_by("wide", run, render_scene_of(run), LIGHT, limits=(0.0, 1e-300))
    assert isinstance(narrow, Coloring)
    assert len(np.unique(narrow.particle_rgb(run.frame(0, narrow.fields)), axis=0)) == 2
    assert not recwarn.list

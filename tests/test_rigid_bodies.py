"""Colliders with a density: they fall, spin, share momentum with the material, float, slide and stand."""

import math
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import run_here
from solver_state import scene_of

from mpmcli.check.result_check import check_result
from mpmcli.check.scene_check import check_scene
from mpmcli.errors import InputError
from mpmcli.output import open_result
from mpmcli.scene import LoadedScene, Scene, scene_to_toml
from mpmcli.scene.rigid import turned_by
from mpmcli.solver.engine.build import build_run
from mpmcli.solver.machine.backend import Backend
from mpmcli.solver.machine.plan import make_plan

JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
G, H = 9.81, 0.05


def box(low: list[float], high: list[float]) -> dict:
    """Return a shape."""
    return {"box": {"min": low, "max": high}}


def scene(dimension: int, gravity: float, *rigid: dict, jelly: dict | None = None, end: float = 0.1, **tables) -> Scene:
    """Return a scene with a block of jelly, in 2D from 0.3 to 0.5 and from 0.4 to 0.65, and rigid bodies."""
    tail = [0.4] * (dimension - 1)
    shape = box([0.3, *tail], [0.5, *(0.65 for _ in tail)])
    domain = {"size": [1.2] * dimension, "spacing": H, "gravity": [0.0] * (dimension - 1) + [gravity]}
    return scene_of(
        domain=domain | tables.pop("domain", {}),
        time=tables.pop("time", {"end": end, "frames": 2}),
        bodies=[{"name": "jelly", "material": JELLY, "shape": shape, **(jelly or {})}],
        colliders=[{"name": f"bar {k}", "density": 400.0, **one} for k, one in enumerate(rigid)],
        solver={"precision": "f64"} | tables.pop("solver", {}),
        **tables,
    )


# What a scene may say.


def test_moments_are_those_of_the_form() -> None:
    """Of a box m (a^2 + b^2) / 12, of a ball 2/5 m r^2, of a disc 1/2 m r^2, about their centres."""
    a, b, c = 0.4, 0.2, 0.3
    found = scene(3, 0.0, {"shape": box([0.1, 0.7, 0.7], [0.1 + a, 0.7 + b, 0.7 + c])}).colliders[0].moments
    assert found.mass == pytest.approx(400 * a * b * c, rel=1e-9)
    assert np.diag(found.inertia) == pytest.approx(found.mass / 12 * np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2]))
    ball = {"ball": {"center": [0.8, 0.8, 0.8], "radius": 0.2}}
    ball = scene(3, 0.0, {"shape": ball}).colliders[0].moments
    assert ball.mass == pytest.approx(400 * 4 / 3 * math.pi * 0.2**3, rel=1e-3)
    assert ball.inertia == pytest.approx(0.4 * ball.mass * 0.2**2 * np.eye(3), rel=2e-3, abs=1e-5)
    disc = scene(2, 0.0, {"shape": {"ball": {"center": [0.8, 0.8], "radius": 0.2}}}).colliders[0].moments
    assert disc.inertia[0, 0] == pytest.approx(0.5 * disc.mass * 0.2**2, rel=1e-3)
    assert disc.center == pytest.approx((0.8, 0.8), abs=1e-9)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"density": 0.0}, "colliders[0].density: must be greater than 0"),
        ({"offset": ["0.1*t", "0"]}, "colliders[0].offset: is for a collider that moves as the scene says"),
        ({"velocity": ["t", 0.0]}, "colliders[0].velocity: must be a number, that at the start"),
        ({"side": "inside"}, "colliders[0].density: is for a shape with the material outside of it"),
        ({"shape": {"plane": {"point": [0.0, 0.1], "normal": [0.0, 1.0]}}}, "colliders[0].density: is for a shape"),
    ],
)
def test_what_cannot_move_freely_is_one_sentence(given: dict, said: str) -> None:
    with pytest.raises(InputError) as raised:
        scene(2, 0.0, {"shape": box([0.6, 0.4], [0.8, 0.6])} | given)
    assert str(raised.value).count("\n") == 0 and said in str(raised.value)


@pytest.mark.parametrize(
    ("tables", "arch", "reason"),
    [
        ({}, "vulkan", "with --arch vulkan"),
        ({"domain": {"walls": {"x_min": "periodic", "x_max": "periodic"}}}, "cpu", "in a domain with periodic walls"),
        ({"domain": {"walls": "stick", "wall_velocity": {"y_min": [1.0, 0.0]}}}, "cpu", "beside walls that move"),
        ({"contact": {"default": "separate"}}, "cpu", "beside bodies that separate"),
    ],
)
def test_what_they_are_not_available_with_is_refused(tables: dict, arch: str, reason: str) -> None:
    asked = scene(2, 0.0, {"shape": box([0.6, 0.4], [0.8, 0.6])}, **tables)
    with pytest.raises(InputError, match=f"colliders with a density are not available {reason}; "):
        make_plan(asked, Backend(arch, 1, "f32", False))


def test_check_sees_what_is_thin_or_begins_inside() -> None:
    """Of a wall, of another one; what touches is no finding."""
    thin = {"shape": box([0.6, 0.4], [0.7, 0.6])}
    sunk = {"shape": box([0.9, -0.02], [1.1, 0.2])}
    on_it = {"shape": box([0.9, 0.2], [1.1, 0.4])}
    crossed = {"shape": box([0.75, 0.35], [0.95, 0.55])}
    found = check_scene(LoadedScene(scene(2, -G, thin, sunk, on_it, crossed), (), "scene.toml")).findings
    said = [(one.rule, one.what.split('"')[1], round(one.value, 2)) for one in found if one.severity == "warning"]
    expected = [("thin", "bar 0", 2.0), ("overlap", "bar 1", 0.4), ("overlap", "bar 2", 1.0), ("overlap", "bar 3", 1.0)]
    assert [one for one in said if one[1].startswith("bar")] == expected
    # Nothing is beyond an open face.
    asked = scene(2, -G, sunk, domain={"walls": {"y_min": "open"}})
    assert not any(one.rule == "overlap" for one in check_scene(LoadedScene(asked, (), "scene.toml")).findings)


# Motion.


def test_a_disc_falls_with_g(backend_of: Callable) -> None:
    disc = {"shape": {"ball": {"center": [0.9, 0.7], "radius": 0.1}}, "velocity": [0.1, 0.0], "angular_velocity": 3.0}
    row = [row for _, row in build_run(scene(2, -G, disc), backend_of("f64", 1)).frames()][-1]
    assert np.allclose(row.rigid_pose[0], [0.91, 0.7 - G * 0.1**2 / 2, 0.3], rtol=0, atol=1e-12)


def test_a_free_top_keeps_energy_and_angular_momentum(backend_of: Callable) -> None:
    """Turned about its middle axis, where every error grows: it tumbles."""
    shape = box([0.6, 0.6, 0.6], [0.9, 0.7, 0.8])
    top = {"shape": shape, "angular_velocity": 40.0, "axis": [0.02, 0.05, 1.0]}
    away = {"shape": box([0.1] * 3, [0.25] * 3)}
    asked = scene(3, 0.0, top, jelly=away, time={"end": 1.0, "frames": 10, "step": 5e-4})
    rows = [row for _, row in build_run(asked, backend_of("f64", 1)).frames()]
    body = asked.colliders[0].moments
    pose, motion = (np.array([getattr(row, name)[0] for row in rows]) for name in ("rigid_pose", "rigid_motion"))
    energy, turned = body.kinetic(pose, motion), turned_by(pose[:, 3:])
    spin = np.einsum("nab,bc,ndc,nd->na", turned, body.inertia, turned, motion[:, 3:])
    assert np.abs(energy / energy[0] - 1).max() < 1e-6
    assert np.abs(spin - spin[0]).max() < 1e-12 * np.abs(spin[0]).max()
    # It does tumble.
    assert turned[:, 2, 2].min() < 0.9


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("surface", [{"wall": "stick"}, {"wall": "separate"}, {"friction": 0.3}])
def test_what_the_material_loses_a_rigid_body_gains(backend_of: Callable, dimension: int, surface: dict) -> None:
    """Momentum and angular momentum of both together, to rounding, whatever the rounds found; energy does not grow."""
    tail = [0.5] * (dimension - 1)
    shape = box([0.52, *tail], [0.7, *(0.8 for _ in tail)])
    moving = {"velocity": [2.0] + [0.0] * (dimension - 1)}
    asked = scene(dimension, 0.0, {"shape": shape, "angular_velocity": 1.0, **surface}, jelly=moving)
    body = asked.colliders[0].moments
    rows = [row for _, row in build_run(asked, backend_of("f64", 1)).frames()]
    d = dimension
    pose, motion = (np.array([getattr(row, name)[0] for row in rows]) for name in ("rigid_pose", "rigid_motion"))
    momentum = body.mass * motion[:, :d]
    inertia = np.array([body.inertia] * len(rows))
    if d == 3:
        turned = turned_by(pose[:, d:])
        inertia = turned @ body.inertia @ turned.transpose(0, 2, 1)
    turning = np.cross(np.pad(pose[:, :d], ((0, 0), (0, 3 - d))), np.pad(momentum, ((0, 0), (0, 3 - d))))
    turning = turning[:, 3 - len(rows[0].angular_momentum) :] + np.einsum("nab,nb->na", inertia, motion[:, d:])
    total = np.array([row.linear_momentum for row in rows]) + momentum
    turns = np.array([row.angular_momentum for row in rows]) + turning
    assert abs(motion[-1, 0]) > 0.1
    assert np.abs(total - total[0]).max() < 1e-12 * np.abs(total[0]).max()
    assert np.abs(turns - turns[0]).max() < 1e-11 * np.abs(total[0]).max()
    assert rows[-1].energy <= rows[0].energy


def test_a_sparse_grid_does_the_same(backend_of: Callable) -> None:
    """Its blocks come in another order than rows."""
    rigid = {"shape": box([0.52, 0.5], [0.7, 0.8]), "angular_velocity": 1.0, "friction": 0.3}
    found = []
    for grid in ("dense", "sparse"):
        asked = scene(2, 0.0, rigid, jelly={"velocity": [2.0, 0.0]}, solver={"grid": grid})
        found.append(list(build_run(asked, backend_of("f64", 1)).frames())[-1][1].rigid_motion[0])
    assert abs(found[0][0]) > 0.1
    assert found[1] == pytest.approx(found[0], rel=1e-11)


@pytest.mark.parametrize("tilt", [0.0, pytest.param(10.0, marks=pytest.mark.slow)])
def test_a_box_floats_as_deep_as_it_is_heavy(backend_of: Callable, tilt: float) -> None:
    """Of half the density of water half of it is in the water: to 0.35 cells; what carries it is its weight.

    Let go from a tilt of 10 degrees it comes back to within 3.
    """
    n, h = 8, 0.05
    turned = turned_by(np.array([[math.radians(tilt)]]))[0]
    corners = np.array([[-8, -4], [8, -4], [8, 4], [-8, 4]]) * h @ turned.T + [24 * h, 16 * h]
    shape = {"polygon": {"vertices": corners.tolist()}}
    water = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5}
    pool = {"name": "water", "material": water, "initial_pressure": "hydrostatic"}
    pool["shape"] = {"box": {"min": [0.0, 0.0], "max": [48 * h, 16 * h]}, "subtract": [shape]}
    asked = scene_of(
        domain={"size": [48 * h, 32 * h], "spacing": h, "gravity": [0.0, -G]},
        time={"end": 4.0, "frames": 80},
        bodies=[pool],
        colliders=[{"name": "box", "shape": shape, "density": 500.0}],
    )
    rows = [row for _, row in build_run(asked, backend_of("f32")).frames()][60:]
    filled = rows[0].mass / 1000.0
    pose = np.array([row.rigid_pose[0] for row in rows])
    body = asked.colliders[0].moments
    # Water in the tank, and half of the box below its surface.
    level = (filled + body.mass / 1000.0) / (48 * h)
    draught = level - (pose[:, 1] - n / 2 * h)
    assert np.mean(draught) == pytest.approx(n / 2 * h, abs=0.35 * h)
    force = np.mean([row.collider_force[0][1] for row in rows])
    assert force == pytest.approx(body.mass * G, rel=0.02)
    assert abs(np.degrees(pose[:, 2] - 0.0).mean() + tilt) < 3.0


def test_a_bystander_leaves_the_material_alone(backend_of: Callable) -> None:
    """A rigid body that meets nothing: the same bytes as without it, and the same steps."""
    found = []
    for rigid in ((), ({"shape": box([0.8, 0.8], [1.0, 1.0])},)):
        asked = scene(2, -G, *rigid, end=0.2)
        found.append(list(build_run(asked, backend_of("f64", 1)).frames())[-1][0])
    assert found[0].step == found[1].step
    assert found[0].position.tobytes() == found[1].position.tobytes()


# Walls, colliders and each other.


@pytest.mark.parametrize("floor", ["wall", "collider", "sticks"])
def test_a_slider_stops_where_friction_stops_it(backend_of: Callable, floor: str) -> None:
    """After v^2 / (2 mu g); where it sticks at once."""
    low = 0.1 if floor == "collider" else 0.0
    slider = {"shape": box([0.6, low], [0.8, low + 0.1]), "velocity": [1.0, 0.0], "friction": 0.5}
    ground = {"shape": box([-0.1, -0.1], [1.3, low]), "friction": 0.2, "density": None}
    walls = {"walls": {"default": "separate", "y_min": "stick" if floor == "sticks" else "separate"}}
    asked = scene(2, -G, slider, *([ground] if floor == "collider" else []), end=0.3, domain=walls)
    row = [row for _, row in build_run(asked, backend_of("f64", 1)).frames()][-1]
    way = row.rigid_pose[0][0] - 0.7
    assert abs(way) < 5e-3 if floor == "sticks" else way == pytest.approx(1 / (2 * 0.5 * G), rel=2e-3)
    assert np.abs(row.rigid_motion[0]).max() < 1e-6


@pytest.mark.parametrize(("count", "end"), [(3, 1.0), pytest.param(10, 10.0, marks=pytest.mark.slow)])
def test_boxes_stand_on_each_other(backend_of: Callable, count: int, end: float) -> None:
    """They settle by a hundredth of their size in the first half, and by less than a thousandth in the second."""
    size = 0.2 if count == 3 else 0.1
    boxes = [{"shape": box([0.6, size * k], [0.6 + size, size * (k + 1)]), "friction": 0.5} for k in range(count)]
    rows = [row for _, row in build_run(scene(2, -G, *boxes, end=end), backend_of("f64", 1)).frames()]
    start, middle, last = (np.array(row.rigid_pose)[:, :2] for row in rows)
    assert np.abs(middle - start).max() < 1e-2 * size
    assert np.abs(last - middle).max() < 1e-3 * size


def test_jelly_stays_above_a_light_plate(backend_of: Callable) -> None:
    """A tenth as heavy as the jelly on it: the floor below it is known where both are solved for."""
    plate = {"shape": box([0.2, 0.0], [0.6, 0.15]), "density": 80.0}
    jelly = {"shape": box([0.3, 0.2], [0.5, 0.45])}
    frames = list(build_run(scene(2, -G, plate, jelly=jelly, end=1.0), backend_of("f64", 1)).frames())
    assert frames[-1][0].position[:, 1].min() > 0.15
    assert np.abs(frames[-1][1].rigid_pose[0][1] - 0.075) < 1e-3


def test_a_result_has_the_body_where_it_was(tmp_path: Path) -> None:
    """In its ledger, its colliders, the file that ParaView moves, and exports."""
    disc = {"shape": {"ball": {"center": [0.9, 0.7], "radius": 0.1}}, "velocity": [0.1, 0.0], "angular_velocity": 3.0}
    asked = scene(2, -G, disc)
    (tmp_path / "scene.toml").write_text(scene_to_toml(asked), encoding="utf-8")
    done = run_here("simulate", tmp_path / "scene.toml", "-o", tmp_path / "run", "--quiet")
    assert (done.status, done.stderr) == (0, "")
    result = open_result(tmp_path / "run")
    places = np.array([row.rigid_pose[0] for row in result.ledger])
    assert places[-1] == pytest.approx([0.91, 0.7 - G * 0.1**2 / 2, 0.3], abs=1e-6)
    (collider,) = result.colliders
    for time, pose in zip(result.times, places, strict=True):
        place, turned = collider.motion.pose(time)
        assert place == pytest.approx(pose[:2]) and turned[1, 0] == pytest.approx(math.sin(pose[2]))
    with h5py.File(tmp_path / "run" / "colliders_moving.vtkhdf") as file:
        shown = file["VTKHDF/Points"][()].reshape(3, -1, 3)[..., :2]
    assert shown.mean(axis=1) == pytest.approx(places[:, :2], abs=2e-3)
    done = run_here("export", tmp_path / "run", "--to", "npz", "-o", tmp_path / "out", "--walls", "colliders")
    assert done.status == 0
    with np.load(tmp_path / "out" / "000000.npz") as file:
        assert file["wall_position"].mean(axis=1) == pytest.approx(places[:, :2], abs=2e-3)
    assert check_result(tmp_path / "run").verdict == "stable"

"""Colliders with a density: they fall, spin, share momentum with the material, float, slide and stand."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyvista
import state_run
from command import run_here
from rounding import farthest
from scenes import ball, block, body, box, collider, plane, polygon, scene_of
from scipy.integrate import solve_ivp
from scipy.special import ellipk
from solver_state import with_colliders

from mpmcli.check.result_check import check_result
from mpmcli.check.scene_check import check_scene
from mpmcli.errors import InputError
from mpmcli.output import open_result
from mpmcli.scene import LoadedScene, Scene, scene_to_toml
from mpmcli.scene.primitives import unit
from mpmcli.scene.rigid import turned_by
from mpmcli.solver.engine.plan import make_plan
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import Backend

JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
G, H = 9.81, 0.05


def scene(dimension: int, gravity: float, *rigid: dict, jelly: dict | None = None, end: float = 0.1, **tables) -> Scene:
    """Return a scene with a block of jelly, in 2D from 0.3 to 0.5 and from 0.4 to 0.65, and rigid bodies.

    A box and a ball far away, and a step shorter than the body's own, let nearly all scenes share a kernel.
    """
    tail = [0.4] * (dimension - 1)
    shape = box([0.3, *tail], [0.5, *(0.65 for _ in tail)])
    domain = {"size": [1.2] * dimension, "spacing": H, "gravity": [0.0] * (dimension - 1) + [gravity]}
    asked = scene_of(
        body("jelly", JELLY, shape, **jelly or {}),
        domain=domain | tables.pop("domain", {}),
        time=tables.pop("time", {"end": end, "frames": 2, "step": 5e-4}),
        colliders=[{"name": f"bar {k}", "density": 400.0, **one} for k, one in enumerate(rigid)],
        solver={"precision": "f64"} | tables.pop("solver", {}),
        **tables,
    )
    corner = [-3.0] * dimension
    far = [box(corner, [-2.9] * dimension), ball(corner, 0.1)]
    more = with_colliders(asked, [{"name": f"far {k}", "shape": shape} for k, shape in enumerate(far) if rigid])
    return asked.model_copy(update={"colliders": asked.colliders + more.colliders})


def moved(asked: Scene, backend: Backend) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses and the rates, (frames, bodies, k), of the rigid bodies of a scene."""
    rows = [row for _, row in build_run(asked, backend).frames()]
    return np.array([row.rigid_pose for row in rows]), np.array([row.rigid_motion for row in rows])


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


@pytest.mark.parametrize(("given", "said"), [
    ({"density": 0.0}, "colliders[0].density: must be greater than 0"),
    ({"offset": ["0.1*t", "0"]}, "colliders[0].offset: is for a collider that moves as the scene says"),
    ({"velocity": ["t", 0.0]}, "colliders[0].velocity: must be a number, that at the start"),
    ({"side": "inside"}, "colliders[0].density: is for a shape with the material outside of it"),
    ({"shape": plane([0.0, 0.1], [0.0, 1.0])}, "colliders[0].density: is for a shape"),
    ({"mass": 3.0}, 'colliders[0].mass: "density" is given as well'),
    ({"density": None, "mass": 0.0}, "colliders[0].mass: must be greater than 0"),
    ({"density": None, "fixed": ["x"]}, "colliders[0].fixed: is for one that moves freely; give its density or mass"),
    ({"fixed": ["x", "y", "rotation"]}, "colliders[0].fixed: holds all of it; leave its density out"),
    ({"fixed": ["z"]}, 'colliders[0].fixed: must be some of "x", "y" and "rotation" in 2D'),
    ({"fixed": ["x"], "joint": {"type": "hinge"}}, 'colliders[0].fixed: "joint" is given as well'),
    ({"fixed": ["x"], "velocity": [1.0, 2.0]}, "colliders[0].velocity: must be 0 along what joint or fixed holds"),
    ({"joint": {"type": "slider", "axis": [1, 1]}, "angular_velocity": 2.0},
     "colliders[0].angular_velocity: must be 0 along"),
    ({"joint": {"type": "hinge"}, "velocity": [1.0, 0.0]}, "colliders[0].velocity: follows from angular_velocity"),
    ({"joint": {"type": "hinge", "axis": [0, 0, 1]}}, "axis: is for 3D scenes and this one is 2D"),
    ({"joint": {"type": "hinge", "strength": 2.0}}, 'strength: is that of a motor; give "motor" as well'),
    ({"joint": {"type": "slider"}}, "axis: missing"),
    ({"joint": {"type": "weld"}}, 'colliders[0].joint.type: must be "hinge" or "slider"; found "weld"'),
    ({"joint": {"point": [0.7, 0.5]}}, 'colliders[0].joint: missing key: type, "hinge" or "slider"'),
    ({"restitution": 1.5}, "colliders[0].restitution: must be"),
])  # fmt: skip
def test_what_cannot_move_freely_is_one_sentence(given: dict, said: str) -> None:
    with pytest.raises(InputError) as raised:
        scene(2, 0.0, {"shape": box([0.6, 0.4], [0.8, 0.6])} | given)
    assert str(raised.value).count("\n") == 0 and said in str(raised.value)


@pytest.mark.parametrize(
    ("tables", "reason"),
    [
        ({"domain": {"walls": {"x_min": "periodic", "x_max": "periodic"}}}, "in a domain with periodic walls"),
        ({"domain": {"walls": "stick", "wall_velocity": {"y_min": [1.0, 0.0]}}}, "with moving walls"),
    ],
)
def test_what_they_are_not_available_with_is_refused(tables: dict, reason: str) -> None:
    asked = scene(2, 0.0, {"shape": box([0.6, 0.4], [0.8, 0.6])}, **tables)
    with pytest.raises(InputError, match=f"colliders with a density are not available {reason}; "):
        make_plan(asked, Backend("cpu", 1, "f32", False))


def test_all_that_a_scene_cannot_combine_is_said_at_once() -> None:
    moved = {"walls": "stick", "wall_velocity": {"y_min": [1.0, 0.0]}}
    body = {"shape": box([0.6, 0.4], [0.8, 0.6])}
    asked = scene(2, 0.0, body, domain=moved, contact={"default": "separate"}, solver={"grid": "sparse"})
    with pytest.raises(InputError) as raised:
        make_plan(asked, Backend("vulkan", 1, "f32", False))
    assert [line.split(" are not available ")[0] for line in str(raised.value).splitlines()] == [
        "separating bodies",
        "colliders with a density",
        "sparse grids",
    ]


def test_check_sees_what_is_thin_or_begins_inside() -> None:
    """Of a wall, of another one; what touches is no finding. One elastic body has no material on the other side."""
    water = {"material": {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e6}}
    thin = {"shape": box([0.6, 0.4], [0.7, 0.6])}
    sunk = {"shape": box([0.9, -0.02], [1.1, 0.2])}
    on_it = {"shape": box([0.9, 0.2], [1.1, 0.4])}
    crossed = {"shape": box([0.75, 0.35], [0.95, 0.55])}
    expected = [("overlap", "bar 1", 0.4), ("overlap", "bar 2", 1.0), ("overlap", "bar 3", 1.0)]
    for jelly, thinness in (({}, []), (water, [("thin-body", "bar 0", 2.0)])):
        asked = scene(2, -G, thin, sunk, on_it, crossed, jelly=jelly)
        found = check_scene(LoadedScene(asked, (), "scene.toml")).findings
        found = [one for one in found if one.severity == "warning" and '"bar' in one.what]
        said = [(one.rule, one.what.split('"')[1], round(one.value, 2)) for one in found]
        assert said == thinness + expected
    huge = check_scene(LoadedScene(scene(2, -G, {"shape": box([-0.3, 0.7], [1.5, 0.9])}), (), "scene.toml")).findings
    (what,) = (one.what for one in huge if one.rule == "too-large" and one.severity == "error")
    assert "1.5 times as long as the domain" in what
    # Nothing is beyond an open face.
    asked = scene(2, -G, sunk, domain={"walls": {"y_min": "open"}})
    assert not any(one.rule == "overlap" for one in check_scene(LoadedScene(asked, (), "scene.toml")).findings)


def test_check_says_what_a_stiff_body_costs() -> None:
    """A bar a hundred times as stiff as the jelly, and three times as dense: steps sqrt(100 / 3) times as short."""
    bar = {"name": "bar", "material": JELLY | {"density": 3000.0, "youngs_modulus": 1e7}}
    bar["shape"] = box([0.7, 0.4], [0.9, 0.6])
    jelly = block("jelly", JELLY, [0.3, 0.4], [0.5, 0.65])
    for others, times in (([bar], math.sqrt(100 / 3)), ([], None), ([bar | {"material": JELLY}], None)):
        domain, time = {"size": [1.2, 1.2], "spacing": H, "gravity": [0.0, -G]}, {"end": 0.1, "frames": 2}
        other = scene_of(jelly, *others, domain=domain, time=time)
        found = [one for one in check_scene(LoadedScene(other, (), "scene.toml")).findings if one.rule == "stiff"]
        assert [one.value for one in found] == ([] if times is None else [pytest.approx(times, rel=0.2)])


# Motion.


def test_a_disc_falls_with_g(backend_of: Callable) -> None:
    disc = {"shape": ball([0.9, 0.7], 0.1), "velocity": [0.1, 0.0], "angular_velocity": 3.0}
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


@pytest.mark.slow
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
def test_a_box_floats_as_deep_as_it_is_heavy(backend_of: Callable, tilt: float, record_property: Callable) -> None:
    """Of half the density of water half of it is in the water: to 0.25 cells; what carries it is its weight.

    Let go from a tilt of 10 degrees it comes back to within 3.
    """
    n, h = 8, 0.05
    turned = turned_by(np.array([[math.radians(tilt)]]))[0]
    corners = np.array([[-8, -4], [8, -4], [8, 4], [-8, 4]]) * h @ turned.T + [24 * h, 16 * h]
    shape = polygon(corners.tolist())
    water = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5}
    pool = {"name": "water", "material": water, "initial_pressure": "hydrostatic"}
    pool["shape"] = {"box": {"min": [0.0, 0.0], "max": [48 * h, 16 * h]}, "subtract": [shape]}
    asked = scene_of(
        pool,
        domain={"size": [48 * h, 32 * h], "spacing": h, "gravity": [0.0, -G]},
        time={"end": 4.0, "frames": 80},
        colliders=[{"name": "box", "shape": shape, "density": 500.0}],
    )
    rows = [row for _, row in build_run(asked, backend_of("f32")).frames()][60:]
    # Compressed from the start by its weight.
    filled = asked.bodies[0].shape.form.volume
    pose = np.array([row.rigid_pose[0] for row in rows])
    body = asked.colliders[0].moments
    # Water in the tank, and half of the box below its surface.
    level = (filled + body.mass / 1000.0) / (48 * h)
    draught = level - (pose[:, 1] - n / 2 * h)
    record_property("too deep, its deviation, cells", (float(np.mean(draught) / h - n / 2), float(np.std(draught) / h)))
    assert np.mean(draught) == pytest.approx(n / 2 * h, abs=0.25 * h)
    assert np.std(draught) < 0.07 * h
    force = np.mean([row.collider_force[0][1] for row in rows])
    assert force == pytest.approx(body.mass * G, rel=0.02)
    assert abs(np.degrees(pose[:, 2] - 0.0).mean() + tilt) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("density", "cells", "coefficient", "least"),
    # 0.61, 0.89, 0.83 and 0.965, of 0.8, 0.92, 0.9 and 0.95 asked: small ones lock in the stiff liquid.
    [(500.0, 8, 1.017, 0.58), (500.0, 16, 1.07, 0.87), (3000.0, 8, 1.017, 0.8), (3000.0, 16, 1.07, 0.95)],
)
def test_a_disc_let_go_in_mid_water(
    backend_of: Callable, density: float, cells: int, coefficient: float, least: float, record_property: Callable
) -> None:
    """It accelerates with (rho_w - rho) g / (rho + C rho_w), C that of the tank, along 0.12 of its diameter."""
    h, diameter = 0.02, 0.02 * cells
    ball = {"ball": {"center": [40 * h, 22.3 * h], "radius": diameter / 2}}
    water = {"law": "fluid", "density": 1000.0, "bulk_modulus": "auto"}
    pool = {"name": "water", "material": water, "initial_pressure": "hydrostatic"}
    pool["shape"] = box([0.0, 0.0], [80 * h, 45 * h]) | {"subtract": [ball]}
    ideal = (1000.0 - density) * G / (density + coefficient * 1000.0)
    end = math.sqrt(2 * 0.12 * diameter / abs(ideal))
    asked = scene_of(
        pool,
        domain={"size": [80 * h, 50 * h], "spacing": h, "gravity": [0.0, -G], "walls": "separate"},
        time={"end": end, "frames": 4},
        colliders=[{"name": "disc", "shape": ball, "density": density}],
    )
    poses, _ = moved(asked, backend_of("f32", 1))
    share = (poses[-1, 0, 1] - poses[0, 0, 1]) / (ideal * end**2 / 2)
    record_property("acceleration over the ideal", float(share))
    assert least < share < 1.05


@pytest.mark.slow
def test_a_plate_with_round_ends_glides(backend_of: Callable, record_property: Callable) -> None:
    """A frictionless plate of 8 x 40 cells glides along itself for 0.2 s and keeps 0.89 of its speed (ideal 0.95)."""
    h, speed = 0.0125, 0.5
    plate = {"capsule": {"start": [40 * h, 56.3 * h], "end": [72 * h, 56.3 * h], "radius": 4 * h}}
    water = {"law": "fluid", "density": 1000.0, "bulk_modulus": 2.5e4}
    tank = body("water", water, box([0.0, 0.0], [112 * h] * 2) | {"subtract": [plate]})
    asked = scene_of(
        tank,
        domain={"size": [112 * h] * 2, "spacing": h, "walls": "slip"},
        time={"end": 0.2, "frames": 4},
        colliders=[{"name": "plate", "shape": plate, "density": 3000.0, "wall": "slip", "velocity": [speed, 0.0]}],
    )
    _, rates = moved(asked, backend_of("f32", 1))
    record_property("share of its speed", (rates[:, 0, 0] / speed).tolist())
    assert 0.89 < rates[-1, 0, 0] / speed < 0.96


def test_a_bystander_leaves_the_material_alone(backend_of: Callable) -> None:
    """A rigid body that meets nothing: the same bytes as without it, and the same steps."""
    found = []
    for rigid in ((), ({"shape": box([0.8, 0.8], [1.0, 1.0])},)):
        asked = scene(2, -G, *rigid, end=0.2)
        found.append(list(build_run(asked, backend_of("f64", 1)).frames())[-1][0])
    assert found[0].step == found[1].step
    assert found[0].position.tobytes() == found[1].position.tobytes()


def test_what_must_not_matter(backend_of: Callable) -> None:
    """A bar that jelly hits off its centre: mirrored, to rounding; with a bystander, in each byte.

    With half the step to the first order in it. Shifted on the grid to the first order in the spacing, as the surface
    that nodes meet is; the jelly is four cells wide.
    """

    def hit(shift: float = 0.0, mirrored: bool = False, step: float = 4e-4, more: tuple[dict, ...] = ()) -> np.ndarray:
        """Return the velocity and the spin of the bar after the blow; of the mirror image those of the original."""
        sign = -1.0 if mirrored else 1.0

        def placed(low: list[float], high: list[float]) -> dict:
            (left, y), (right, top) = np.array([low, high]) + shift * H
            return box([1.2 - right, y], [1.2 - left, top]) if mirrored else box([left, y], [right, top])

        jelly = {"shape": placed([0.3, 0.4], [0.5, 0.65]), "velocity": [2.0 * sign, 0.0]}
        bar = {"shape": placed([0.55, 0.5], [0.7, 0.8]), "friction": 0.3}
        times = {"end": 0.15, "frames": 1, "step": step}
        _, rates = moved(scene(2, 0.0, bar, *more, jelly=jelly, time=times), backend_of("f64", 1))
        return rates[-1, 0] * [sign, 1.0, sign]

    found = hit()
    assert hit(mirrored=True) == pytest.approx(found, rel=1e-11)
    bystander = {"shape": box([0.9, 0.9], [1.1, 1.1]), "density": 5000.0}
    assert hit(more=(bystander,)).tobytes() == found.tobytes()
    assert hit(step=2e-4) == pytest.approx(found, rel=0.02)
    assert hit(shift=0.3) == pytest.approx(found, rel=0.07)


# Joints, motors and forces.


CORNER = {"shape": box([0.05, 0.0], [0.2, 0.2])}


@pytest.mark.parametrize(("dimension", "release"), [(2, 1.5), (3, 1.0)])
def test_a_pendulum_keeps_its_period(backend_of: Callable, dimension: int, release: float) -> None:
    """4 K(sin(a / 2)) sqrt(I / (m g L)), released at an angle a, to the square of the step; the centre on its circle.

    In 3D about an axis that is tilted by 30 degrees, along which gravity has no part.
    """
    d, length, point = dimension, 0.3, np.array([0.6, 0.8] + [0.6] * (dimension - 2))
    axis = unit([0.0, 0.0, 1.0]) if d == 2 else np.array([0.5, 0.0, math.sqrt(0.75)])
    side = np.array([axis[2], 0.0, -axis[0]])[:d]
    center = point + length * (math.sin(release) * side - math.cos(release) * np.eye(d)[1])
    bob = ball(center.tolist(), 0.1)
    hinge = {"type": "hinge", "point": point.tolist()} | ({"axis": axis.tolist()} if d == 3 else {})
    corner = {"shape": box([0.05] + [0.0] * (d - 1), [0.2] * d)}
    time, gravity = {"end": 2.5, "frames": 500, "step": 1e-3}, {"gravity": [0.0, -G] + [0.0] * (d - 2)}
    asked = scene(d, 0.0, {"shape": bob, "joint": hinge}, jelly=corner, time=time, domain=gravity)
    poses, _ = moved(asked, backend_of("f64", 1))
    body, arm = asked.colliders[0].moments, poses[:, 0, :d] - point
    inertia = (axis @ body.inertia @ axis if d == 3 else body.inertia[0, 0]) + body.mass * length**2
    period = 4 * ellipk(math.sin(release / 2) ** 2) * math.sqrt(inertia / (body.mass * G * length))
    assert np.linalg.norm(arm, axis=1) == pytest.approx(length, rel=1e-9)
    swing = arm @ side
    times = np.linspace(0.0, 2.5, 501)
    (k,) = np.nonzero((swing[:-1] > 0) & (swing[1:] <= 0))
    passed = times[k] + (times[k + 1] - times[k]) * swing[k] / (swing[k] - swing[k + 1])
    assert passed[-1] - passed[0] == pytest.approx((len(passed) - 1) * period, rel=1e-4)
    assert swing.max() == pytest.approx(length * math.sin(release), rel=1e-4)


def test_forces_and_sliders(backend_of: Callable) -> None:
    """On a slope of 45 degrees half of gravity is left; a force in x alone of 2 t gives t^3 / 3."""
    block = {"shape": box([0.5, 0.7], [0.7, 0.9]), "joint": {"type": "slider", "axis": [1, -1]}}
    pushed = {"shape": box([0.9, 0.7], [1.1, 0.9]), "fixed": ["y", "rotation"]}
    forces = [{"body": "bar 1", "acceleration": ["2 * t", 0.0]}, {"acceleration": [0.0, 1.0]}]
    asked = scene(2, -G, block, pushed, jelly=CORNER, end=0.2, forces=forces)
    poses, _ = moved(asked, backend_of("f64", 1))
    way = 0.25 * (G - 1) * 0.2**2
    assert poses[-1, 0] - poses[0, 0] == pytest.approx([way, -way, 0.0], rel=1e-6)
    assert poses[-1, 1] - poses[0, 1] == pytest.approx([0.2**3 / 3, 0.0, 0.0], rel=1e-3)


def test_a_motor_gives_its_strength_until_it_has_its_rate(backend_of: Callable) -> None:
    """Angular velocity M t / I, up to that asked for, and down again; one without limit keeps its rate at once."""
    wheel = {"shape": ball([0.8, 0.7], 0.2)}
    wheel["joint"] = {"type": "hinge", "motor": "5 if t < 0.75 else 2", "strength": 20.0}
    ram = {"shape": box([0.4, 0.3], [0.6, 0.5]), "density": None, "mass": 4.0}
    ram["joint"] = {"type": "slider", "axis": [-1, 0], "motor": 0.5}
    times = {"end": 1.0, "frames": 10, "step": 1e-3}
    asked = scene(2, -G, wheel, ram, jelly=CORNER, time=times, domain={"walls": "separate"})
    # The first step knows how fast they will be; the corner of the bounding box counts.
    fastest = [collider.fastest(asked.domain, 0.0) for collider in asked.colliders[:2]]
    assert fastest == [pytest.approx(5.0 * 0.2 * math.sqrt(2)), pytest.approx(0.5)]
    poses, rates = moved(asked, backend_of("f64", 1))
    inertia, t = asked.colliders[0].moments.inertia[0, 0], np.linspace(0.0, 1.0, 11)
    assert rates[:8, 0, 2] == pytest.approx(np.minimum(5.0, 20.0 * t[:8] / inertia), rel=1e-9)
    # Within a step of the instant.
    assert rates[8:, 0, 2] == pytest.approx(np.maximum(2.0, 5.0 - 20.0 * (t[8:] - 0.75) / inertia), abs=0.02)
    # Before it meets the jelly.
    assert rates[1:4, 1, 0] == pytest.approx(-0.5, abs=1e-9)
    assert np.ptp(poses[:, 1, 1]) == 0


def test_a_hinge_takes_no_angular_momentum(backend_of: Callable) -> None:
    """Of a bar that jelly hits: about the hinge that of both together stays, to rounding."""
    bar = {"shape": box([0.52, 0.45], [0.62, 0.9]), "joint": {"type": "hinge", "point": [0.57, 0.85]}}
    asked = scene(2, 0.0, bar, jelly={"velocity": [2.0, 0.0]}, end=0.2)
    rows = [row for _, row in build_run(asked, backend_of("f64", 1)).frames()]
    body = asked.colliders[0].moments
    point, rate = np.array([0.57, 0.85]), np.array([row.rigid_motion[0][2] for row in rows])
    inertia = body.inertia[0, 0] + body.mass * float(np.sum((np.array(body.center) - point) ** 2))
    momentum = np.array([row.linear_momentum for row in rows])
    turning = np.array([row.angular_momentum[0] for row in rows])
    total = turning - point[0] * momentum[:, 1] + point[1] * momentum[:, 0] + inertia * rate
    assert abs(rate[-1]) > 1.0
    assert np.abs(total - total[0]).max() < 1e-11 * np.abs(turning).max()


# Walls, colliders and each other.


@pytest.mark.parametrize(("floor", "tilt"), [("stick", 3.0), ("stick", 10.0), ("slip", 3.0)])
def test_a_box_tips_over_its_edge(backend_of: Callable, floor: str, tilt: float) -> None:
    """As the pendulum above its edge, which rests or slides, does: 0.2 % at steps of 9 ms, which are the default."""
    width, height, tilt = 0.2, 0.4, math.radians(tilt)
    lean = tilt + math.atan2(width, height)
    turned = turned_by(np.array([[-lean]]))[0]
    corners = np.array([[-width, 0.0], [0.0, 0.0], [0.0, height], [-width, height]]) @ turned.T + [0.8, 0.0]
    long, inertia = math.hypot(width, height) / 2, (width**2 + height**2) / 12
    held = float(floor == "stick")

    def turn(_: float, y: np.ndarray) -> list[float]:
        s, c = math.sin(y[0]), math.cos(y[0])
        square = long**2 * (held + (1 - held) * s**2)
        return [y[1], (G * long * s - (1 - held) * long**2 * s * c * y[1] ** 2) / (inertia + square)]

    times = np.linspace(0.0, 0.3 if tilt > 0.1 or not held else 0.5, 7)
    exact = solve_ivp(turn, times[[0, -1]], [tilt, 0.0], t_eval=times, rtol=1e-10, atol=1e-12).y[0] - tilt
    asked = scene(
        2,
        -G,
        {"shape": polygon(corners.tolist())},
        jelly=CORNER,
        time={"end": float(times[-1]), "frames": 6},
        domain={"size": [1.6, 1.2], "walls": floor},
    )
    poses, _ = moved(asked, backend_of("f64", 1))
    assert -poses[:, 0, 2] == pytest.approx(exact, rel=2e-3, abs=1e-12)


@pytest.mark.parametrize(("strength", "holds"), [(1.25, True), (0.8, False)])
def test_a_gate_on_a_hinge_at_the_floor(backend_of: Callable, strength: float, holds: bool) -> None:
    """Water pushes with density g H^2 / 2 at H / 3; a brake of 1.25 times that torque holds it, one of 0.8 does not.

    The lower corner is cut, because a box would stand on it. A point of its surface is on the hinge.
    """
    depth = 0.4
    push = 1000.0 * G * depth**2 / 2
    joint = {"type": "hinge", "point": [0.4, 0.0], "motor": 0.0, "strength": strength * push * depth / 3}
    water = {"law": "fluid", "density": 1000.0, "bulk_modulus": 4e5}
    asked = scene_of(
        block("water", water, [0.0, 0.0], [0.4, depth], initial_pressure="hydrostatic"),
        domain={"size": [0.8, 0.6], "spacing": 0.02, "gravity": [0.0, -G], "walls": "separate"},
        time={"end": 0.3, "frames": 15},
        colliders=[
            collider("gate", polygon([[0.4, 0.0], [0.46, 0.06], [0.46, 0.52], [0.4, 0.52]]), density=500.0, joint=joint)
        ],
    )
    rows = [row for _, row in build_run(asked, backend_of("f64", 1)).frames()]
    angle = np.degrees([row.rigid_pose[0][2] for row in rows])
    if holds:
        assert np.abs(angle).max() < 1e-6
        assert np.mean([row.collider_force[0][0] for row in rows[5:]]) == pytest.approx(push, rel=0.01)
        assert np.mean([row.collider_torque[0][0] for row in rows[5:]]) == pytest.approx(-push * depth / 3, rel=0.02)
    else:
        assert angle[-1] < -1.0


def test_a_pose_that_is_not_finite_stops_the_run(backend_of: Callable) -> None:
    asked = scene(2, -G, {"shape": box([0.6, 0.7], [0.8, 0.9])}, jelly=CORNER)
    run = build_run(asked, backend_of("f64", 1))
    frames = run.frames()
    next(frames)
    pose = run.batch.device.features.rigid.pose
    values = pose.to_numpy()
    values[0, 1] = math.nan
    pose.from_numpy(values)
    with pytest.raises(UnstableRunError, match=r'rigid body "bar 0" .* a pose that is not finite'):
        list(frames)


@pytest.mark.parametrize("restitution", [1.0, 0.7])
@pytest.mark.parametrize(("step", "shift"), [(1.5e-3, 0.0), (1.5e-3, 0.013), (5e-4, 0.0), (2e-4, 0.0)])
def test_a_disc_hits_a_rod_off_its_centre(backend_of: Callable, restitution: float, step: float, shift: float) -> None:
    """Without friction: the impulse (1 + e) v / (1/m + 1/M + b^2/I) at one point, at any step and any time of it."""
    b, v = 0.21, 1.6
    disc = {"shape": ball([0.22 - shift, 0.72], 0.12), "velocity": [v, 0.0]}
    rod = {"shape": box([0.62, 0.51 - 0.35], [0.68, 0.51 + 0.35]), "density": 1400.0}
    asked = scene(
        2,
        0.0,
        disc | {"density": 1000.0, "restitution": restitution},
        rod | {"restitution": restitution},
        jelly=CORNER,
        time={"end": 0.4, "frames": 2, "step": step},
        domain={"walls": "separate"},
    )
    m, M = (asked.colliders[k].moments.mass for k in range(2))
    inertia = asked.colliders[1].moments.inertia[0, 0]
    impulse = (1 + restitution) * v / (1 / m + 1 / M + b**2 / inertia)
    _, rates = moved(asked, backend_of("f64", 1))
    expected = [[v - impulse / m, 0.0, 0.0], [impulse / M, 0.0, -impulse * b / inertia]]
    assert rates[-1, :2] == pytest.approx(np.array(expected), abs=1e-3)


@pytest.mark.parametrize("restitution", [0.0, 0.6, 1.0])
def test_a_ball_bounces(backend_of: Callable, restitution: float) -> None:
    """From a height H to e^2 H, e^4 H, ... of it, to the first order in the step."""
    ball = {"shape": {"ball": {"center": [0.7, 0.4], "radius": 0.1}}, "restitution": restitution}
    asked = scene(2, -G, ball, jelly=CORNER, time={"end": 1.5, "frames": 300, "step": 5e-4})
    poses, _ = moved(asked, backend_of("f64", 1))
    height = poses[:, 0, 1] - 0.1
    assert height.min() > -1e-3
    peaks = [b for a, b, c in zip(height, height[1:], height[2:], strict=False) if b >= a and b > c]
    if restitution == 0.0:
        assert np.abs(height[100:]).max() < 1e-6
    else:
        assert np.array(peaks[:2]) / 0.3 == pytest.approx(restitution ** np.array([2.0, 4.0]), abs=5e-3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_ball_rolls_as_a_ball(backend_of: Callable, dimension: int) -> None:
    """Down a slope at g sin(a) / (1 + k), k = 1/2 of a disc, 2/5 of a ball, however few points it has."""
    d, angle, radius = dimension, 0.3, 0.1
    ball = {"shape": {"ball": {"center": [0.3, radius] + [0.6] * (d - 2), "radius": radius}}, "friction": 0.5}
    corner = {"shape": box([1.0] + [0.0] * (d - 1), [1.15] * 1 + [0.15] * (d - 1))}
    gravity = {"gravity": [G * math.sin(angle), -G * math.cos(angle)] + [0.0] * (d - 2), "walls": "separate"}
    asked = scene(d, 0.0, ball, jelly=corner, end=0.5, domain=gravity)
    poses, _ = moved(asked, backend_of("f64", 1))
    assert poses[-1, 0, 0] - 0.3 == pytest.approx(0.125 * G * math.sin(angle) / (1.5 if d == 2 else 1.4), rel=2e-3)
    assert poses[-1, 0, 1] == pytest.approx(radius, abs=1e-4)


@pytest.mark.parametrize("floor", ["wall", "collider", pytest.param("sticks", marks=pytest.mark.slow)])
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


@pytest.mark.parametrize("grid", ["dense", pytest.param("sparse", marks=pytest.mark.slow)])
def test_bodies_that_are_alone_move_as_beside_material(backend_of: Callable, grid: str) -> None:
    """A ball that bounces and a box that tips, with a block in a corner and without any material."""
    ball = {"shape": {"ball": {"center": [0.9, 0.4], "radius": 0.1}}, "restitution": 0.6}
    tipping = {"shape": box([0.5, 0.0], [0.6, 0.3]), "velocity": [0.9, 0.0], "angular_velocity": -3.0, "friction": 0.5}
    asked = scene(2, -G, ball, tipping, jelly=CORNER, time={"end": 0.5, "frames": 20, "step": 5e-4})
    alone = asked.model_copy(update={"bodies": (), "solver": asked.solver.model_copy(update={"grid": grid})})
    (poses, rates), found = moved(asked, backend_of("f64", 1)), moved(alone, backend_of("f64", 1))
    assert np.abs(poses[-1] - poses[0]).max(axis=1).min() > 0.1
    assert found[0] == pytest.approx(poses, abs=1e-9) and found[1] == pytest.approx(rates, abs=1e-8)


@pytest.mark.parametrize("threads", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_ball_alone_falls_with_g(backend_of: Callable, threads: int) -> None:
    """Without particles no node is in use; the product of two negative extents crashed."""
    ball = {"name": "ball", "density": 500.0, "shape": {"ball": {"center": [0.5] * 3, "radius": 0.1}}}
    domain = {"size": [1.0] * 3, "spacing": 0.1, "gravity": [0.0, 0.0, -G]}
    asked = scene_of(domain=domain, time={"end": 0.2, "frames": 2}, colliders=[ball])
    run = build_run(asked, backend_of("f32", threads))
    rows = [row for _, row in run.frames()]
    assert rows[-1].rigid_pose[0][2] == pytest.approx(0.5 - G * 0.2**2 / 2, abs=1e-6)
    assert not run.batch.device.grid.box.to_numpy()[1].any()


def test_a_scene_of_rigid_bodies_alone_is_a_result(tmp_path: Path) -> None:
    """A ball that falls for 0.2 s: frames without particles, a stable run that goes on, and what VTK reads."""
    ball = '[[colliders]]\nname = "ball"\ndensity = 500.0\nshape = { ball = { center = [0.5, 0.7], radius = 0.1 } }\n'
    domain = "[domain]\nsize = [1.0, 1.0]\nspacing = 0.02\ngravity = [0.0, -9.81]\n[time]\nend = 0.2\nframes = 10\n"
    (tmp_path / "ball.toml").write_text(domain + ball, encoding="utf-8")
    (tmp_path / "wall.toml").write_text(domain + ball.replace("density = 500.0\n", ""), encoding="utf-8")
    run = ["simulate", tmp_path / "ball.toml", "-o", tmp_path / "run"]
    done = run_here(*run, "--json")
    assert done.status == 0 and json.loads(done.stdout)["check"]["verdict"] == "stable"
    done = run_here(*run, "--resume", "--set", "time.end=0.3", "--set", "time.frames=15", "-q")
    assert (done.status, done.stderr) == (0, "")
    result = open_result(tmp_path / "run")
    height = [row.rigid_pose[0][1] for row in result.ledger]
    assert height == pytest.approx(0.7 - G * result.times**2 / 2, abs=G * 0.01**2)
    assert [len(frame.position) for frame in result.frames()] == [0] * 16
    assert pyvista.read(tmp_path / "run" / "particles.vtkhdf").n_points == 0
    done = run_here("simulate", tmp_path / "wall.toml", "-o", tmp_path / "none")
    assert done.status == 2 and "rigid bodies (colliders with a density)" in done.stderr


def test_a_result_has_the_body_where_it_was(tmp_path: Path) -> None:
    """In its ledger, its colliders, the file that ParaView moves, and exports."""
    disc = {"shape": ball([0.9, 0.7], 0.1), "velocity": [0.1, 0.0], "angular_velocity": 3.0}
    asked = scene(2, -G, disc)
    asked = asked.model_copy(update={"colliders": asked.colliders[:1]})
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
        assert file["rigid_pose"][:, 0] == pytest.approx(places)
        assert file["rigid_motion"][-1, 0] == pytest.approx([0.1, -G * 0.1, 3.0], abs=G * 0.005)
    # The types of LagrangeBench and of "Learning to simulate" for rigid bodies.
    for form, number in (("lagrangebench", 3), ("gns", 0)):
        done = run_here("export", tmp_path / "run", "--to", form, "-o", tmp_path / form, "--walls", "colliders")
        assert done.status == 0
        types = json.loads((tmp_path / form / "metadata.json").read_text())["particle_types"]
        assert types["rigid_body"] == number
        assert number not in [types[name] for name in types if name != "rigid_body"]
    assert check_result(tmp_path / "run").verdict == "stable"


@pytest.mark.gpu
@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_rigid_bodies_on_a_gpu_follow_those_on_the_cpu(backend_of: Callable, dimension: int) -> None:
    """A raft that falls into water while it turns, and a wheel with a motor; in 3D jelly hits a box above a floor.

    Poses agree to single precision, rates and what the material loses to 1e-3, and a frame forgets what it has told.
    """
    if dimension == 2:
        # Later, rounding decides which drops the raft meets, also between f32 and f64 on the CPU.
        asked, steps, dt = state_run.scene_named("rigid"), 60, 2e-4
    else:
        turning = {"shape": box([0.52, 0.001, 0.4], [0.8, 0.2, 0.6]), "axis": [1, 2, 3], "angular_velocity": 4.0}
        shape = box([0.3, 0.05, 0.4], [0.5, 0.3, 0.65])
        jelly, steps, dt = {"velocity": [3.0, 0.0, 0.0], "shape": shape}, 30, 2e-4
        asked = scene(3, 0.0, turning, jelly=jelly, solver={"precision": "f32"})
    found = []
    for arch in ("vulkan", "cpu"):
        run = build_run(asked, backend_of("f32", 1, arch))
        for _ in range(steps):
            run.step(dt)
        frame, row = run.frame()
        again = run.frame()[1].collider_force
        assert np.abs(again).max() == 0.0
        found.append((frame, np.array(row.rigid_pose), np.array(row.rigid_motion), row.collider_force))
    (own, pose, motion, force), (other, expected_pose, expected_motion, expected_force) = found
    apart = farthest(other.position, other.velocity, steps, other.time)
    assert np.abs(own.position - other.position).max() < apart
    assert np.abs(pose - expected_pose).max() < 1e-6
    assert np.abs(motion - expected_motion).max() < 1e-3 * np.abs(expected_motion).max()
    scale = np.abs(expected_force).max()
    assert scale > 1.0
    assert np.abs(np.subtract(force, expected_force)).max() < 1e-3 * scale

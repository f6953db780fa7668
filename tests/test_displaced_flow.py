"""The speed and the pressure with which colliders push material, and the automatic moduli that follow."""

import math

import numpy as np
import pytest
from scenes import block, body, box, scene_of

from mpmcli.scene import Scene
from mpmcli.scene.bounds import scene_bounds
from mpmcli.scene.displaced_flow import AROUND, JET, displaced_flow

H, U = 0.01, 0.1
WATER = {"law": "fluid", "density": 1000.0, "viscosity": 0.0}


def syringe(
    d: int, *, material: object = WATER, gap: float = 0.0, wall: str = "separate", long: float = 0.15, **motion: object
) -> Scene:
    """Return a barrel of 20 cells from wall to wall, a piston, and a filled nozzle of 4 cells in an open domain."""
    width, middle = 24 * H, 12 * H

    def tube(start: float, stop: float, half: float) -> dict:
        return box([start, *[middle - half] * (d - 1)], [stop, *[middle + half] * (d - 1)])

    barrel = [tube(-0.2, 0.4, 0.1), tube(0.35, 0.4 + long, 0.02), tube(0.4 + long, 1.0, 0.3)]
    bore = {"add": [tube(0.4, 0.4 + long, 0.02)]}
    return scene_of(
        body("body", material, tube(0.2 + gap, 0.4, 0.1) | bore),
        domain={"size": [0.7, *[width] * (d - 1)], "spacing": H, "gravity": [0.0] * d},
        walls={"default": "separate", "x_max": "open"},
        end=0.5,
        colliders=[
            {"name": "barrel", "wall": wall, "shape": tube(-0.2, 0.9, 0.4) | {"subtract": barrel}},
            {"name": "piston", "shape": tube(-0.3, 0.2, 0.1), **(motion or {"velocity": [U] + [0.0] * (d - 1)})},
        ],
    )


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize(
    "motion",
    [
        {},
        {"gap": 0.02},
        {"velocity": ["0.1 * sin(8 * t)", 0.0, 0.0]},
        {"keyframes": [{"time": 0.0}, {"time": 0.5, "offset": [0.05, 0.0, 0.0]}]},
    ],
    ids=["piston", "air", "expression", "keyframes"],
)
def test_the_speed_in_a_nozzle_follows_from_continuity(d: int, motion: dict) -> None:
    """v = u A / a with (A / a) = 5^(d-1), and K = JET density (v^2 - u^2) / compressibility."""
    if "velocity" in motion:
        motion = {"velocity": motion["velocity"][:d]}
    if "keyframes" in motion:
        motion = {"keyframes": [one | {"offset": one.get("offset", [0.0] * 3)[:d]} for one in motion["keyframes"]]}
    scene = syringe(d, **motion)
    speed = U * 5 ** (d - 1)
    assert displaced_flow(scene).speed == pytest.approx(speed, rel=0.02)
    material = scene.bodies[0].material
    assert material.bulk_modulus == pytest.approx(JET * 1000.0 * (speed**2 - U**2) / material.compressibility, rel=0.04)


def test_the_pressure_of_a_viscous_liquid_is_that_of_poiseuille() -> None:
    """A longer nozzle adds 12 mu v / w^2 per length where the walls stick, and nothing where they slip."""
    mu, v, w = 50.0, 5 * U, 4 * H
    material = WATER | {"viscosity": mu}
    for wall, slope in (("stick", 12 * mu * v / w**2), ("separate", 0.0)):
        long, short = (scene_bounds(syringe(2, material=material, wall=wall, long=each)).load for each in (0.2, 0.1))
        assert (long - short) / 0.1 == pytest.approx(slope, rel=0.15, abs=0.1 * 12 * mu * v / w**2), wall
    scene = syringe(2, material=material, wall="stick")
    load, material = scene_bounds(scene).load, scene.bodies[0].material
    assert material.bulk_modulus == pytest.approx(load / material.compressibility)


@pytest.mark.parametrize("n", [0.5, 1.0])
def test_the_pressure_of_a_paste_is_above_that_of_slip_lines(n: float) -> None:
    """Through smooth walls that halve the width, 2.571 yield stresses (Hill 1950); and what flow adds."""
    tau, k = 5000.0, 100.0
    paste = {"law": "viscoplastic", "density": 2400.0, "yield_stress": tau, "consistency": k, "flow_index": n}
    scene = scene_of(
        block("concrete", paste, [0.1, 0.0], [0.6, 0.2]),
        domain={"size": [1.2, 0.2], "spacing": H, "gravity": [0.0, 0.0], "walls": "slip"},
        colliders=[
            {"name": "piston", "velocity": [U, 0.0], "shape": box([-0.4, -0.1], [0.1, 0.3])},
            {"name": "low", "shape": box([0.6, -0.1], [0.8, 0.05])},
            {"name": "high", "shape": box([0.6, 0.15], [0.8, 0.3])},
        ],
    )
    flow, load = displaced_flow(scene), scene_bounds(scene).load
    assert flow.speed == pytest.approx(2 * U, rel=0.01)
    assert 2.571 < flow.strain < 2 * 2.571
    jet = JET * 2400.0 * (flow.speed**2 - U**2)
    assert load == pytest.approx(flow.strain * (tau + k * flow.rate**n) + jet)
    material = scene.bodies[0].material
    assert material.bulk_modulus == pytest.approx(max(load, (2 + math.pi) * tau) / material.compressibility)


def test_a_plate_that_presses_a_layer_drives_it_sideways() -> None:
    """v = u L / (2 h) at its edges, with the height h left at the end."""
    scene = scene_of(
        block("body", WATER, [0.6, 0.0], [1.4, 0.4]),
        domain={"size": [2.0, 0.8], "spacing": 2 * H, "gravity": [0.0, 0.0]},
        colliders=[{"name": "plate", "velocity": [0.0, -0.2], "shape": box([0.6, 0.4], [1.4, 0.6])}],
    )
    assert displaced_flow(scene).speed == pytest.approx(0.2 * 0.8 / (2 * 0.2), rel=0.15)


@pytest.mark.parametrize("walls", ["separate", "periodic"])
def test_what_flows_around_a_collider_is_no_faster(walls: str) -> None:
    paddle, rod = box([0.3, 0.33], [0.7, 0.37]), box([0.1, 0.1], [0.14, 0.3])
    scene = scene_of(
        body("body", WATER, box([0.0, 0.0], [1.0, 0.7]) | {"subtract": [paddle, rod]}),
        domain={"size": [1.0, 1.0], "spacing": 2 * H, "gravity": [0.0, 0.0], "walls": walls},
        end=2.0,
        colliders=[
            {"name": "paddle", "angular_velocity": 3.0, "shape": paddle},
            {"name": "rod", "velocity": ["0.2 * cos(5 * t)", 0.0], "shape": rod},
        ],
    )
    flow = displaced_flow(scene)
    assert 0 < flow.speed <= max(one.fastest(scene.domain, 2.0) for one in scene.colliders)
    assert flow.strain <= AROUND


def test_material_that_nothing_lets_out_is_no_fault() -> None:
    scene = scene_of(
        block("body", WATER, [0.1, 0.0], [1.0, 0.2]),
        domain={"size": [1.0, 0.2], "spacing": 2 * H, "gravity": [0.0, 0.0]},
        colliders=[{"name": "piston", "velocity": [U, 0.0], "shape": box([-1.0, -0.1], [0.1, 0.3])}],
    )
    flow = displaced_flow(scene)
    assert np.isfinite([flow.speed, flow.strain, flow.rate]).all() and flow.speed <= 1.01 * U


def test_a_piston_makes_sand_stiffer() -> None:
    """Its pressure p grows by strain p sin(phi), and it leaves as a jet."""
    sand = {"law": "sand", "density": 1600.0, "friction_angle": 30.0}
    pushed = syringe(2, material=sand)
    bounds = scene_bounds(pushed)
    pressure = bounds.density * bounds.speed**2
    flow = displaced_flow(pushed)
    assert bounds.load == pytest.approx(flow.strain * pressure / 2 + JET * 1600.0 * (flow.speed**2 - U**2))
    material = pushed.bodies[0].material
    (said,) = material.model_copy(update={"youngs_modulus": "auto"}).resolve(bounds)[1]
    assert f"at {bounds.load:.4g} Pa, the pressure with which colliders push the material" in said
    bulk = material.lame_lambda + material.shear_modulus
    assert bounds.load > pressure and bulk == pytest.approx(bounds.load / material.compressibility)


def test_a_paste_is_stiff_against_a_punch() -> None:
    """K (1 - J) is (2 + pi) yield stresses at `compressibility` where neither weight nor speed ask for more."""
    paste = {"law": "viscoplastic", "density": 2000.0, "yield_stress": 1e4, "consistency": 1.0, "compressibility": 0.02}
    scene = scene_of(block("body", paste, [0.2, 0.0], [0.8, 0.5]), size=[1.0, 1.0], spacing=0.1, gravity=[0.0, -9.81])
    assert scene.bodies[0].material.bulk_modulus == pytest.approx((2 + math.pi) * 1e4 / 0.02)


@pytest.mark.parametrize("d", [2, 3])
def test_a_rigid_body_counts_with_its_weight(d: int) -> None:
    """K (1 - J) is density g H of a weight that lies on the liquid; one that a hinge holds does not count."""
    gravity = [0.0] * (d - 1) + [-9.81]
    weight = {"name": "weight", "density": 7800.0, "shape": box([0.1] * (d - 1) + [0.2], [0.9] * (d - 1) + [0.7])}
    hinge = {"joint": {"type": "hinge"}}
    for one, load in ((weight, 7800.0 * 9.81 * 0.5), (weight | hinge, 0.0)):
        scene = scene_of(
            block("body", WATER, [0.0] * d, [1.0] * (d - 1) + [0.2]),
            domain={"size": [1.0] * d, "spacing": 0.1, "gravity": gravity},
            colliders=[one],
        )
        material = scene.bodies[0].material
        assert scene_bounds(scene).load == pytest.approx(load)
        assert material.bulk_modulus == pytest.approx(max(load, 1000.0 * 2 * 9.81 * 0.2) / material.compressibility)

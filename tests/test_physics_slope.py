"""Layers on an inclined plane: which sand and which mud stay, and how fast the others flow (docs/theory.md, 10)."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import GRAVITY, block, row_means, scene, stresses, tilted

from mpmcli.scene import Scene, sample_bodies
from mpmcli.solver.engine.run import Run, build_run

H = 0.1
SAND, MUD = 1600.0, 1000.0
SLOPE = 30.0
YOUNG, NU = 2e6, 0.3
MU, LAMBDA = YOUNG / (2 * (1 + NU)), YOUNG * NU / ((1 + NU) * (1 - 2 * NU))
WALLS = {"default": "slip", "y_min": "stick"}


def layer(
    name: str,
    material: dict,
    cells: int,
    length: int,
    gap: int,
    degrees: float,
    end: float,
    frames: int,
    walls: object = WALLS,
    friction: object = 0.0,
) -> Scene:
    """Return a layer H deep and `length` H long, with a gap below its lower end, x down the slope.

    Its particles are in rows, over which means are taken.
    """
    return scene(
        [cells * (length + gap), cells + 4],
        H / cells,
        [block(name, material, [0, 0], [length * H, H], sampling="lattice")],
        end,
        frames=frames,
        gravity=tilted(degrees),
        walls=walls,
        friction=friction,
        fields=["velocity", "stress"],
    )


def middle_third(X: np.ndarray) -> np.ndarray:
    """Return which particles lie in the middle third of the layer at the start."""
    return np.abs(X - (X.min() + X.max()) / 2) < np.ptp(X) / 6


def hencky_stretch(tau: np.ndarray) -> np.ndarray:
    """Return the symmetric F, (n, 2, 2), with tau = 2 mu ln F + lambda tr(ln F) I."""
    trace = np.trace(tau, axis1=1, axis2=2) / (2 * MU + 2 * LAMBDA)
    strain, Q = np.linalg.eigh((tau - LAMBDA * trace[:, None, None] * np.eye(2)) / (2 * MU))
    return np.einsum("nij,nj,nkj->nik", Q, np.exp(strain), Q)


@pytest.mark.parametrize(
    ("phi", "stays"),
    [(float(np.degrees(np.arcsin(np.tan(np.radians(SLOPE + 2.1))))), True), (SLOPE + 2.1, True), (SLOPE - 2.1, False)],
    ids=["sin(phi) above", "phi above", "phi below"],
)
def test_sand_stays_on_a_gentle_slope_and_flows_on_a_steep_one(
    backend_of: Callable, phi: float, stays: bool, record_property: Callable
) -> None:
    """A layer between two end walls on a stick floor: binary, 2 degrees off the friction angle (docs/theory.md, 10).

    It starts from sigma_xx = sigma_yy = -rho g cos(theta) (H - y), sigma_xy = rho g sin(theta) (H - y). Where sand
    flows like this, in simple shear at constant volume, its stress is aligned with its rate, at 45 degrees to the
    plane: sigma_xy = p sin(phi), which is asked of the flowing layer to 2.5 %, from 1.2 sqrt(H/g) on. So a slope
    without ends gives way at tan(theta) = sin(phi) (Davis 1968), 28 degrees for phi = 32.1. From there to theta =
    phi the lower end holds a layer of this length, after a slip of some hundredths of H in which sigma_xx grows.
    Below, not even that happens.
    """
    unit = np.sqrt(H / GRAVITY)
    sand = {"law": "sand", "density": SAND, "youngs_modulus": YOUNG, "friction_angle": phi}
    asked = layer("sand", sand, 6, 16, 0, SLOPE, 6 * unit, 10)
    X, Y = sample_bodies(asked)[0].position.T
    weight = SAND * GRAVITY * (H - Y)
    pressure, shear = weight * np.cos(np.radians(SLOPE)), weight * np.sin(np.radians(SLOPE))
    run = build_run(asked, backend_of("f32"))
    run.groups[0].replace(
        deformation=hencky_stretch(np.stack([-pressure, shear, shear, -pressure], 1).reshape(-1, 2, 2))
    )
    middle = middle_third(X)
    low = middle & (H / 2 > Y)
    slips, speeds, ratios = [], [], []
    for frame, _ in run.frames():
        slips.append((frame.position[middle, 0] - X[middle]).mean() / H)
        speeds.append(frame.velocity[middle, 0].mean() / np.sqrt(GRAVITY * H))
        mean = stresses(frame.fields)[low].mean(0)
        ratios.append(-2 * mean[0, 1] / (mean[0, 0] + mean[1, 1]))
    strength = np.sin(np.radians(phi))
    record_property("slip / H", float(slips[-1]))
    record_property("speed / sqrt(g H)", float(speeds[-1]))
    record_property("shear stress / pressure", str(np.round(ratios, 4).tolist()))
    record_property("sin(phi)", float(strength))
    if stays:
        assert abs(slips[-1]) < (0.05 if strength < np.tan(np.radians(SLOPE)) else 2e-4)
        # What the ends hold swings on between them.
        assert np.abs(speeds[-4:]).max() < (1.5e-2 if strength < np.tan(np.radians(SLOPE)) else 1e-3)
    else:
        assert slips[-1] > 0.3
        assert np.array(ratios[2:]) == pytest.approx(strength, rel=0.025)


@pytest.mark.slow
@pytest.mark.parametrize("beyond", [4.0, -4.0], ids=["rough", "smooth"])
def test_sand_stays_on_a_rough_floor_and_slides_on_a_smooth_one(
    backend_of: Callable, beyond: float, record_property: Callable
) -> None:
    """A layer stronger than the floor stays with mu = tan(theta + 4 degrees), and slides with tan(theta - 4 degrees).

    It then goes down the slope as a whole, with a = g (sin(theta) - mu cos(theta)) in its middle third, to 0.4 % of g:
    elastic waves from its free end have crossed it by then.
    """
    end, frames = 2.0 * np.sqrt(H / GRAVITY), 10
    friction = float(np.tan(np.radians(SLOPE + beyond)))
    sand = {"law": "sand", "density": SAND, "youngs_modulus": YOUNG, "friction_angle": 42.0}
    asked = layer(
        "sand", sand, 6, 16, 8, SLOPE, end, frames, {"default": "slip", "y_min": "separate"}, {"y_min": friction}
    )
    X, Y = sample_bodies(asked)[0].position.T
    weight = SAND * GRAVITY * (H - Y)
    pressure = weight * np.cos(np.radians(SLOPE))
    shear = min(friction, np.tan(np.radians(SLOPE))) * pressure
    run = build_run(asked, backend_of("f32"))
    run.groups[0].replace(
        deformation=hencky_stretch(np.stack([-pressure, shear, shear, -pressure], 1).reshape(-1, 2, 2))
    )
    middle = middle_third(X)
    speeds = np.array([[frame.time, frame.velocity[middle, 0].mean()] for frame, _ in run.frames()]).T
    expected = GRAVITY * max(np.sin(np.radians(SLOPE)) - friction * np.cos(np.radians(SLOPE)), 0.0)
    found = float(np.polyfit(*speeds, 1)[0])
    record_property("acceleration / g", found / GRAVITY)
    record_property("expected", float(expected / GRAVITY))
    assert found == pytest.approx(expected, abs=4e-3 * GRAVITY)


DEGREES, REYNOLDS = 60.0, 0.5
WEIGHT = MUD * GRAVITY * H * np.sin(np.radians(DEGREES))
VISCOSITY = MUD * np.sqrt(GRAVITY * np.sin(np.radians(DEGREES)) * H**3 / (2 * REYNOLDS))
# The time in which momentum crosses the layer.
UNIT = H**2 * MUD / VISCOSITY


def mud_slope(backend_of: Callable, strength: float, times: float, frames: int) -> tuple[Run, np.ndarray]:
    """Return a layer of mud of yield stress strength rho g H sin(theta) in its stress at rest, and its X and Y.

    tau = K (J - 1) I + G dev(b): b has the shear of sigma_xy = rho g sin(theta) (H - y), cut off at the yield stress,
    and J the pressure.
    """
    modulus = MUD * 100 * GRAVITY * H
    mud = {
        "law": "viscoplastic",
        "density": MUD,
        "bulk_modulus": modulus,
        "yield_stress": float(strength * WEIGHT),
        "consistency": float(VISCOSITY),
        # The layer is part of an endless one: its ends must not hang on the walls.
        "tension_cutoff": True,
    }
    asked = layer("mud", mud, 8, 12, 3, DEGREES, times * UNIT, frames)
    start = sample_bodies(asked)[0].position
    depth = H - start[:, 1]
    J = 1 / (1 + MUD * GRAVITY * np.cos(np.radians(DEGREES)) * depth / modulus)
    shear = J * np.minimum(WEIGHT * depth / H, strength * WEIGHT) / asked.bodies[0].material.shear_modulus
    F = np.zeros((len(start), 2, 2))
    F[:, 0, 0] = (1 + shear**2) ** 0.25
    F[:, 1, 0] = shear / F[:, 0, 0]
    F[:, 1, 1] = 1 / F[:, 0, 0]
    run = build_run(asked, backend_of("f32"))
    run.groups[0].replace(deformation=F * np.sqrt(J)[:, None, None])
    return run, start


def test_mud_below_its_yield_stress_stays_for_ever(backend_of: Callable, record_property: Callable) -> None:
    """tau_y = 1.1 rho g H sin(theta): no creep in 12 H^2 / nu, in which mud without yield stress would go 6 H far.

    It trembles about its place, since nothing damps elastic waves below yield; but the means over the second, third
    and last quarter of the run are the same to 5e-4 H.
    """
    run, start = mud_slope(backend_of, 1.1, 12, 16)
    middle = middle_third(start[:, 0])
    frames = [frame for frame, _ in run.frames()]
    slips = np.array([(frame.position[middle, 0] - start[middle, 0]).mean() / H for frame in frames])
    speeds = [np.abs(frame.velocity[middle]).max() / np.sqrt(GRAVITY * H) for frame in frames]
    record_property("slip / H", str(np.round(slips, 5).tolist()))
    record_property("max|v| / sqrt(g H)", float(max(speeds)))
    quarters = slips[1:].reshape(4, 4).mean(1)
    assert np.abs(slips).max() < 2e-3
    assert np.abs(np.diff(quarters[1:])).max() < 5e-4
    assert max(speeds) < 0.03


def test_mud_above_its_yield_stress_flows_as_a_plug(backend_of: Callable, record_property: Callable) -> None:
    """tau_y = rho g H sin(theta) / 2: u = rho g sin(theta) / (2 eta) (2 H_y y - y^2) up to H_y = H/2, constant above.

    The stress falls below tau_y at y = H_y = H - tau_y / (rho g sin(theta)), and the plug above rides at
    rho g sin(theta) H_y^2 / (2 eta) (Bingham 1922). Judged from 1.5 to 3 H^2 / nu, since elastic waves are left: 3 %.
    """
    run, start = mud_slope(backend_of, 0.5, 3, 10)
    X, Y = start.T
    middle = middle_third(X)
    frames = [frame for frame, _ in run.frames()]
    u = np.mean([row_means(frame.velocity[:, 0], Y, middle) for frame in frames[5:]], axis=0)
    y = np.minimum(np.unique(np.round(Y, 9)), H / 2)
    exact = WEIGHT / H / (2 * VISCOSITY) * (H * y - y**2)
    record_property("L2 of u", float(np.linalg.norm(u - exact) / np.linalg.norm(exact)))
    record_property("plug velocity / exact", float(u[-1] / exact[-1]))
    assert np.linalg.norm(u - exact) / np.linalg.norm(exact) < 0.03
    assert u[-1] == pytest.approx(exact[-1], rel=0.03)
    # A plug: its upper third moves as one.
    assert np.ptp(u[-len(u) // 3 :]) < 0.005 * u[-1]


@pytest.mark.slow
def test_mud_flows_just_above_its_yield_stress(backend_of: Callable, record_property: Callable) -> None:
    """tau_y = 0.9 rho g H sin(theta): a plug of nine tenths, at a hundredth of the Newtonian velocity, goes on and on.

    20 % of u in the mean of the last half: the sheared layer is less than one cell deep.
    """
    run, start = mud_slope(backend_of, 0.9, 20, 16)
    middle = middle_third(start[:, 0])
    top = middle & (start[:, 1] > H / 2)
    frames = [frame for frame, _ in run.frames()]
    slips = [(frame.position[top, 0] - start[top, 0]).mean() / H for frame in frames]
    exact = WEIGHT / H / (2 * VISCOSITY) * (0.1 * H) ** 2
    u = (slips[-1] - slips[8]) * H / (frames[-1].time - frames[8].time)
    record_property("plug velocity / exact", float(u / exact))
    assert u == pytest.approx(exact, rel=0.2)

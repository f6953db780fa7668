"""Elastic bodies meet freely moving rigid bodies at their surfaces: impacts with known outcomes, and rest."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import ball, block, body, box, scene_of, slow
from test_deterministic import on_gpu_path
from test_gpu_path import after_steps, check_same

from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import Scene
from mpmcli.solver.engine.run import build_run

JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
G = 9.81


def rows_of(scene: Scene, backend: object) -> list[LedgerRow]:
    return [row for _, row in build_run(scene, backend).frames()]


def energies(rows: list[LedgerRow]) -> np.ndarray:
    """Return the energy at each frame, J, of material, rigid bodies and springs."""
    return np.array([row.energy for row in rows]) - np.cumsum([row.contact_work for row in rows])


def bar(cells: int, density: float, speed: float) -> Scene:
    """Return a bar of some cells, 0.5 m long, with one end on a wall, and a rigid mass that meets the other end."""
    h, long = 0.5 / cells, 0.5 / np.sqrt(JELLY["youngs_modulus"] / JELLY["density"])
    return scene_of(
        block("bar", JELLY | {"poissons_ratio": 0.0}, [0.0, 0.0], [0.5, 8 * h]),
        domain={"size": [1.0, 8 * h], "spacing": h, "walls": {"default": "slip", "x_min": "separate"}},
        time={"end": 0.5 * h / speed + 6 * long, "frames": 60},
        colliders=[
            {
                "name": "mass",
                "density": density,
                "fixed": ["y", "rotation"],
                "shape": box([0.5 + 0.5 * h, 0.0], [0.75, 8 * h]),
                "velocity": [-speed, 0.0],
            }
        ],
        contact={},
        precision="f64",
    )


@pytest.mark.parametrize(("cells", "share"), [(16, 0.005), (16, 0.025), slow(32, 0.025)])
def test_a_mass_leaves_a_bar_with_the_speed_of_st_venant(backend_of: Callable, cells: int, share: float) -> None:
    """Of equal mass: with 0.688 of its speed, to the first order in the cells; energy falls by waves that they lose.

    What moves is known half a step apart from what it stores, so that the work of half a step is not in the sum.
    """
    h, speed = 0.5 / cells, share * 10.0
    rows = rows_of(bar(cells, 1000.0 * 0.5 / (0.25 - 0.5 * h), speed), backend_of("f64", 1))
    assert rows[-1].rigid_motion[0][0] == pytest.approx(0.688 * speed, rel=0.8 / cells)
    energy = energies(rows) / rows[0].energy
    assert (energy - np.minimum.accumulate(energy)).max() < 8e-3
    assert 1 - 2 / cells < energy[-1] < 1


@pytest.mark.parametrize("density", [50.0, 2.0])
def test_a_light_body_leaves_no_faster_than_it_came(backend_of: Callable, density: float) -> None:
    """Springs as stiff as the bar would throw it back."""
    rows = rows_of(bar(16, density, 0.25), backend_of("f64", 1))
    speeds = np.array([row.rigid_motion[0][0] for row in rows])
    assert speeds[-1] > 0 and np.abs(speeds).max() <= 0.25
    energy = np.array([row.energy for row in rows])
    assert energy.max() <= energy[0] * (1 + 1e-12)


def discs(dimension: int, speed: float, density: float = 1000.0, **domain: object) -> Scene:
    """Return an elastic ball that hits a rigid one of the same size along 30 degrees, without friction."""
    d, radius, h = dimension, 0.1, 0.0125 if dimension == 2 else 0.02
    tail = [0.3] * (d - 2)
    return scene_of(
        body("ball", JELLY, ball([0.3, 0.3, *tail], radius), velocity=[speed, *[0.0] * (d - 1)]),
        domain={"size": [0.9, 0.8, 0.6][:d], "spacing": h} | domain,
        time={"end": 0.3 / speed, "frames": 20},
        colliders=[{"name": "other", "density": density, "shape": ball([0.48, 0.4, *tail], radius)}],
        contact={},
        fields=["velocity", "stress"],
        precision="f64",
    )


@pytest.mark.parametrize("dimension", [2, slow(3)])
def test_a_ball_that_hits_a_rigid_one_off_its_centre(backend_of: Callable, dimension: int) -> None:
    """The rigid one leaves along the normal, without spin; momentum is kept to rounding, and energy but for 7 %.

    While they touch the normal turns, by half the way that they slide over the distance of their centres.
    """
    d, scene = dimension, discs(dimension, 0.3)
    rows, body = rows_of(scene, backend_of("f64", 1)), scene.colliders[0].moments
    pose, motion = (np.array([getattr(row, name)[0] for row in rows]) for name in ("rigid_pose", "rigid_motion"))
    momentum = body.mass * motion[:, :d]
    total = momentum + [row.linear_momentum for row in rows]
    assert np.abs(total - total[0]).max() < 1e-12 * np.abs(total[0]).max()
    turning = np.cross(np.pad(pose[:, :d], ((0, 0), (0, 3 - d))), np.pad(momentum, ((0, 0), (0, 3 - d))))
    spin = motion[:, d:] @ np.atleast_2d(body.inertia)
    turns = turning[:, 3 - spin.shape[1] :] + spin + [np.atleast_1d(row.angular_momentum) for row in rows]
    assert np.abs(turns - turns[0]).max() < 1e-11 * np.abs(total[0]).max()
    touching = np.count_nonzero(np.diff(motion[:, 0])) * rows[1].time
    slid = np.degrees(0.5 * 0.3 * np.sin(np.pi / 6) * touching / 0.2)
    assert 29 < np.degrees(np.arctan2(motion[-1, 1], motion[-1, 0])) < 31 + slid
    assert np.abs(motion[-1, d:]).max() < 0.01 * 0.3 / 0.1
    assert 0.93 < rows[-1].energy / rows[0].energy < 1


def test_a_gpu_does_the_same(backend_of: Callable) -> None:
    """Its path in double precision on the CPU, while an elastic ball hits a rigid one."""
    scene = discs(2, 5.0, gravity=[0.0, -9.81])
    check_same(*(after_steps(scene, backend) for backend in (backend_of("f64"), on_gpu_path(backend_of("f64")))))


def test_a_box_lies_on_jelly(backend_of: Callable) -> None:
    """With its weight, and level, while it swings less and less."""
    shape = box([0.3, 0.2], [0.5, 0.3])
    jelly = block("jelly", JELLY, [0.2, 0.0], [0.6, 0.2])
    scene = scene_of(
        jelly,
        domain={"size": [0.9, 0.8], "spacing": 0.0125, "gravity": [0.0, -G]},
        time={"end": 3.0, "frames": 30},
        colliders=[{"name": "box", "density": 500.0, "shape": shape, "friction": 0.5}],
        contact={},
        precision="f64",
    )
    rows = rows_of(scene, backend_of("f64", 1))
    weight = scene.colliders[0].moments.mass * G
    assert np.mean([row.collider_force[0][1] for row in rows[-10:]]) == pytest.approx(weight, rel=0.01)
    assert abs(rows[-1].rigid_pose[0][2]) < 1e-3
    energy = energies(rows)
    assert (energy - np.minimum.accumulate(energy)).max() < 1e-3 * (energy[0] - energy.min())

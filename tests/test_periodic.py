"""Scenes that repeat: what leaves through a periodic face enters through the other, and nothing else happens there."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scenes import block, body, scene_of, slow
from solver_state import BodyState, bodies_of

from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.engine.run import build_run

H = 0.125
SOLID = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 2e4, "poissons_ratio": 0.3}
LIQUID = {"law": "fluid", "density": 800.0, "bulk_modulus": 2e4, "viscosity": 5.0, "tension_cutoff": False}
# By name: material of a ball and further tables. Nearly incompressible solids average volumes over cells.
BALLS = {
    "solid": (SOLID, {}),
    "liquid": (LIQUID, {}),
    "cubic": (SOLID, {"solver": {"kernel": "cubic"}}),
    "aflip": (SOLID, {"solver": {"transfer": "aflip"}}),
    "f_bar": (SOLID | {"poissons_ratio": 0.45}, {"solver": {"f_bar": True}}),
    # Of the period of the domain, or half of it: its slope, too, is that on the other side.
    "forced": (SOLID, {"forces": [{"acceleration": ["2 * sin(2 * pi * x)", "cos(2 * pi * y)"]}]}),
    "relaxing": ({"law": "fluid", "density": 800.0, "bulk_modulus": 2e4}, {}),
}


def ball(name: str, dimension: int = 2, walls: object = "periodic", **more: dict) -> Scene:
    """Return a ball that spins and flies in the middle of a box whose faces are all periodic."""
    material, tables = BALLS[name]
    d, spin = dimension, [[0.0, -3.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    motion = {"velocity": [0.9, 0.4, -0.3][:d], "velocity_gradient": [row[:d] for row in spin[:d]]}
    return scene_of(
        body("ball", material, {"ball": {"center": [8 * H] * d, "radius": 3.3 * H}}, **motion),
        domain={"size": [16 * H] * d, "spacing": H, "walls": walls} | more.get("domain", {}),
        frames=4,
        solver={"precision": "f64"} | tables.get("solver", {}) | more.get("solver", {}),
        forces=tables.get("forces", []),
    )


def moved_by(scene: Scene, cells: tuple[int, ...]) -> list[BodyParticles]:
    """Return the particles of a scene, moved by whole cells, and put back into the domain."""
    size = np.array(scene.domain.size)
    return [replace(b, position=(b.position + H * np.array(cells)) % size) for b in sample_bodies(scene)]


def run(backend: object, scene: Scene, particles: list[BodyParticles], steps: int, dt: float) -> BodyState:
    """Return the only body after some steps."""
    run = build_run(scene, backend, particles)
    for _ in range(steps):
        run.step(dt)
    return bodies_of(run)["ball"]


def apart(scene: Scene, first: BodyState, second: BodyState, cells: tuple[int, ...]) -> float:
    """Return the largest difference of two states, one of them moved: cells, m/s over 1, and that of F."""
    size = np.array(scene.domain.size)
    way = (second.x - first.x - H * np.array(cells) + size / 2) % size - size / 2
    return max(
        float(np.abs(way).max()) / H,
        float(np.abs(second.v - first.v).max()),
        float(np.abs(second.deformation - first.deformation).max()),
    )


@pytest.mark.parametrize("name", [name if k == 0 else slow(name) for k, name in enumerate(BALLS)])
def test_a_ball_across_the_faces_is_as_one_inside(backend_of: Callable, name: str, record_property: Callable) -> None:
    """A ball that begins in the corner, half of it at each of four faces, moves as one in the middle, to round-off.

    It crosses the faces again and again: 200 steps of a tenth of a cell each.
    """
    scene = ball(name)
    backend = backend_of("f64")
    inside = run(backend, scene, sample_bodies(scene), 200, 0.01)
    across = run(backend, scene, moved_by(scene, (8, 8)), 200, 0.01)
    largest = apart(scene, inside, across, (8, 8))
    record_property("largest difference", largest)
    assert np.abs(inside.x - sample_bodies(scene)[0].position).max() > 9 * H
    assert largest < 1e-11


@pytest.mark.slow
def test_in_three_dimensions_too(backend_of: Callable, record_property: Callable) -> None:
    """A ball in a corner, an eighth of it at each of eight, in boxes of which one pair of faces slips."""
    walls = {"default": "periodic", "z_min": "slip", "z_max": "slip"}
    scene, backend = ball("solid", 3, walls), backend_of("f64")
    inside = run(backend, scene, sample_bodies(scene), 20, 0.01)
    across = run(backend, scene, moved_by(scene, (8, 7, 0)), 20, 0.01)
    largest = apart(scene, inside, across, (8, 7, 0))
    record_property("largest difference", largest)
    assert largest < 1e-11


def dyadic(cells: tuple[int, ...]) -> tuple[Scene, list[BodyParticles]]:
    """Return a body whose positions, velocities and masses have few binary digits, moved by whole cells."""
    scene = ball("solid")
    random = np.random.default_rng(1)
    position = random.integers(0, 8 * 64, (200, 2)) / 64 * H + 4 * H
    velocity, affine = random.integers(-64, 64, (200, 2)) / 64, random.integers(-64, 64, (200, 2, 2)) / 64
    (body,) = sample_bodies(scene)
    body = replace(body, position=position, velocity=velocity, affine=affine, volume=H**2 / 4, mass=8.0)
    return scene, [replace(body, position=(position + H * np.array(cells)) % (16 * H))]


@pytest.mark.parametrize("cells", [(13, 9), *(slow(c) for c in ((1, 0), (8, 5)))])
def test_a_translated_scene_is_bitwise_the_translated_scene(backend_of: Callable, cells: tuple[int, int]) -> None:
    """Where sums and positions round nothing, as in the first step of such a body: no bit depends on the faces.

    Beyond it, the order of sums at a node is that of the tiles, and positions round by their distance from the corner.
    """
    backend, dt, found = backend_of("f64"), 2.0**-8, []
    for way in ((0, 0), cells):
        scene, particles = dyadic(way)
        found.append(run(backend, scene, particles, 1, dt))
    first, second = found
    for name in ("v", "C", "deformation"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
    assert apart(scene, first, second, cells) < 1e-14
    assert np.abs(first.v - particles[0].velocity).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_a_uniform_flow_stays_uniform(backend_of: Callable, precision: str, record_property: Callable) -> None:
    """A fluid that fills the domain flows for ten lengths of it: no force anywhere."""
    scene = scene_of(
        block("fluid", LIQUID, [0.0, 0.0], [1.0, 1.0], velocity=[1.0, -0.5]),
        domain={"size": [1.0, 1.0], "cells": [8, 8], "walls": "periodic"},
        time={"end": 10.0, "frames": 2},
        precision=precision,
    )
    rows = list(build_run(scene, backend_of(precision)).frames())
    (first, _), *_, (last, row) = rows
    moved = (last.position - first.position - [10.0, -5.0] + 0.5) % 1.0 - 0.5
    worst = max(float(np.abs(moved).max()), float(np.abs(last.velocity - [1.0, -0.5]).max()))
    record_property("largest difference", worst)
    assert worst < (1e-4 if precision == "f32" else 1e-11)
    assert row.mass == rows[0][1].mass and row.volume_error == pytest.approx(0.0, abs=1e-4)


@pytest.mark.slow
def test_momentum_is_conserved(backend_of: Callable, record_property: Callable) -> None:
    """Of a ball that crosses corners, with gravity M g t more: to round-off, as the frames of a batch say."""
    scene = ball("liquid", domain={"gravity": [0.5, -1.0]})
    rows = [row for _, row in build_run(scene, backend_of("f64"), moved_by(scene, (8, 8))).frames()]
    expected = [
        np.array(rows[0].linear_momentum) + r.mass * np.array([0.5, -1.0]) * (r.time - r.step_max / 2) for r in rows
    ]
    drift = max(
        float(np.abs(np.array(r.linear_momentum) - e).max()) for r, e in zip(rows[1:], expected[1:], strict=True)
    )
    record_property("drift", drift / rows[0].mass)
    assert drift < 1e-12 * rows[0].mass
    assert {row.mass for row in rows} == {rows[0].mass}


@pytest.mark.slow
@pytest.mark.gpu
@pytest.mark.parametrize("name", ["solid", "aflip"])
def test_a_gpu_follows_the_cpu(backend_of: Callable, name: str) -> None:
    """Every step puts particles back there; sums of another order leave round-off of single precision."""
    scene = ball(name, solver={"precision": "f32"})
    found = [run(backend_of("f32", 1, arch), scene, moved_by(scene, (8, 8)), 100, 0.01) for arch in ("vulkan", "cpu")]
    assert apart(scene, *found, (0, 0)) < 1e-3


def poiseuille(y: np.ndarray, time: float) -> np.ndarray:
    """Return the velocity of a viscous fluid, nu = 1, that a pull of 0.5 m/s^2 drives from rest between two walls."""
    k = np.pi * (2 * np.arange(50) + 1)
    return 0.25 * y * (1 - y) - np.sin(y[:, None] * k) @ (2 / k**3 * np.exp(-(k**2) * time))


@pytest.mark.slow
def test_poiseuille(backend_of: Callable, record_property: Callable) -> None:
    """Gravity along a periodic channel starts the flow of the series, to second order."""
    backend, errors = backend_of("f64"), []
    thick = LIQUID | {"density": 1000.0, "bulk_modulus": 1e5, "viscosity": 1000.0}
    for n in (8, 16):
        scene = scene_of(
            block("fluid", thick, [0.0, 0.0], [8 / n, 1.0]),
            domain={"size": [8 / n, 1.0], "cells": [8, n], "gravity": [0.5, 0.0]},
            walls={"default": "stick", "x_min": "periodic", "x_max": "periodic"},
            end=0.15,
            precision="f64",
        )
        *_, (frame, row) = build_run(scene, backend).frames()
        exact = poiseuille(frame.position[:, 1], row.time - row.step_max / 2)
        errors.append(float(np.sqrt(((frame.velocity[:, 0] - exact) ** 2).mean() / (exact**2).mean())))
        # Nothing distinguishes one place along the channel from another.
        assert np.abs(frame.velocity[:, 1]).max() < 1e-12
    record_property("errors", str(errors))
    assert errors[0] < 1.6 / 8**2 and errors[1] < errors[0] / 3.7

"""Bodies with velocity fields of their own meet on a GPU as they do on the CPU."""

from collections.abc import Callable

import numpy as np
import pytest
from rounding import farthest
from solver_state import scene_of
from test_batch import batch_of

from mpmcli.scene import Scene
from mpmcli.solver.engine.run import Run, build_run, frames_of_all

pytestmark = pytest.mark.gpu

JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5}


def box(low: list[float], high: list[float], dimension: int) -> dict:
    """Return a shape; in 3D it has the same depth everywhere."""
    return {"box": {"min": [*low, 0.3][:dimension], "max": [*high, 0.6][:dimension]}}


def scene(dimension: int, friction: float = 0.3, **tables) -> Scene:
    """Return two blocks of jelly that fly at each other above a floor, one of them beside water and against a ball."""
    d = dimension
    bodies = [
        ("left", JELLY, box([0.2, 0.02], [0.45, 0.3], d), 2.0),
        ("right", JELLY | {"youngs_modulus": 2e5}, box([0.48, 0.02], [0.7, 0.3], d), -2.0),
        *[("water", WATER, box([0.72, 0.02], [0.9, 0.2], d), -1.0)] * (d == 2),
    ]
    ball = {"ball": {"center": [0.1, 0.15, 0.45][:d], "radius": 0.08}}
    return scene_of(
        domain={
            "size": [1.0] * d,
            "cells": [20 if d == 2 else 14] * d,
            "gravity": [0.0, -9.81, 0.0][:d],
            "friction": 0.2,
        },
        time={"end": 0.02, "frames": 2},
        bodies=[
            {"name": name, "material": material, "shape": shape, "velocity": [speed, -2.0, 0.0][:d]}
            for name, material, shape, speed in bodies
        ],
        colliders=[{"name": "ball", "shape": ball, "velocity": [5.0, 0.0, 0.0][:d], "friction": 0.4}],
        contact={"default": "separate", "friction": friction},
        solver={"precision": "f32"},
        **tables,
    )


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_contact_on_a_gpu_follows_that_on_the_cpu(backend_of: Callable, dimension: int) -> None:
    """Positions to round-off, forces and overlaps to 1e-3, across a saved state; a frame forgets what it has told."""
    found, steps = [], 100 if dimension == 2 else 50
    for arch in ("vulkan", "cpu"):
        run = build_run(scene(dimension), backend_of("f32", 1, arch))
        for k in range(steps):
            run.step(2e-4)
            if k == steps // 2 and arch == "vulkan":
                run.load(run.save().copied())
        frame, row = run.frame()
        told = np.array([*row.contact_force, *row.collider_force])
        assert np.abs(run.frame()[1].contact_force).max() == 0.0
        found.append((frame, told, row.contact_overlap))
    (own, told, overlap), (other, expected_told, expected_overlap) = found
    apart = farthest(other.position, other.velocity, steps, other.time)
    assert np.abs(own.position - other.position).max() < apart
    assert (np.abs(expected_told[[-2, -1], 0]) > 5).all()
    assert np.abs(told - expected_told).max() < 1e-3 * np.abs(expected_told).max()
    assert overlap == pytest.approx(expected_overlap, rel=1e-3)


@pytest.mark.slow
def test_runs_of_a_batch_do_what_they_do_alone(backend_of: Callable) -> None:
    """Each with friction of its own."""
    scenes = [scene(2), scene(2, friction=0.0)]
    backend = backend_of("f32", 1, "vulkan")
    batch, last = batch_of(scenes, backend), {}
    for slot, event in frames_of_all({k: Run(batch, k, one) for k, one in enumerate(scenes)}):
        if isinstance(event, tuple):
            last[slot] = event[0].position
    *_, (alone, _) = build_run(scenes[1], backend).frames()
    assert np.abs(last[0] - last[1]).max() > 1e-4
    assert np.abs(last[1] - alone.position).max() < 1e-5

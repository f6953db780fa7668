"""A run on a GPU meets colliders as one on the CPU does."""

from collections.abc import Callable

import numpy as np
import pytest
import state_run
from rounding import farthest
from test_batch import scene_named
from test_rigid_bodies import box
from test_rigid_bodies import scene as scene_with

from mpmcli.solver.engine.run import build_run

pytestmark = pytest.mark.gpu


def test_a_run_on_a_gpu_follows_the_cpu(backend_of: Callable) -> None:
    """Equal steps between colliders at rest and moving: positions to round-off, forces after twenty to 1e-5.

    Later, rounding decides where grains go: after sixty steps one in ten may be elsewhere, by less than 1e-3 m.
    """
    scene = scene_named("colliders")
    found = []
    for arch in ("vulkan", "cpu"):
        run = build_run(scene, backend_of("f32", 1, arch))
        for _ in range(20):
            run.step(2e-4)
        _, row = run.frame()
        for _ in range(40):
            run.step(2e-4)
        found.append((run.frame()[0], np.array(row.collider_force), np.array(row.collider_torque)))
    (own, force, torque), (other, expected_force, expected_torque) = found
    apart = np.abs(own.position - other.position).max(axis=1)
    assert np.quantile(apart, 0.9) < farthest(other.position, other.velocity, 60, other.time)
    assert apart.max() < 1e-3
    scale = np.abs(expected_force).max()
    assert scale > 10
    assert np.abs(force - expected_force).max() < 1e-5 * scale
    assert np.abs(torque - expected_torque).max() < 1e-5 * np.abs(expected_torque).max()


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_rigid_bodies_on_a_gpu_follow_those_on_the_cpu(backend_of: Callable, dimension: int) -> None:
    """A raft that falls into water while it turns, and a wheel with a motor; in 3D jelly hits a box above a floor.

    Poses agree to single precision, rates and what the material loses to 1e-3, and a frame forgets what it has told.
    """
    if dimension == 2:
        # Later, rounding decides which drops the raft meets, also between f32 and f64 on the CPU.
        scene, steps, dt = state_run.scene_named("rigid"), 60, 2e-4
    else:
        turning = {"shape": box([0.52, 0.001, 0.4], [0.8, 0.2, 0.6]), "axis": [1, 2, 3], "angular_velocity": 4.0}
        shape = box([0.3, 0.05, 0.4], [0.5, 0.3, 0.65])
        jelly, steps, dt = {"velocity": [3.0, 0.0, 0.0], "shape": shape}, 30, 2e-4
        scene = scene_with(3, 0.0, turning, jelly=jelly, solver={"precision": "f32"})
    found = []
    for arch in ("vulkan", "cpu"):
        run = build_run(scene, backend_of("f32", 1, arch))
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

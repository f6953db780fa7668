"""A run on a GPU meets colliders as one on the CPU does."""

from collections.abc import Callable

import numpy as np
import pytest
from test_batch import scene_named

from mpmcli.solver.engine.build import build_run

pytestmark = pytest.mark.gpu


def test_a_run_on_a_gpu_follows_the_cpu(backend_of: Callable) -> None:
    """A hundred equal steps between colliders at rest and moving: positions to round-off, forces to 1e-3."""
    scene = scene_named("colliders")
    found = []
    for arch in ("vulkan", "cpu"):
        run = build_run(scene, backend_of("f32", 1, arch))
        for _ in range(100):
            run.step(2e-4)
        frame, row = run.frame()
        found.append((frame.position, np.array(row.collider_force), np.array(row.collider_torque)))
    (position, force, torque), (expected, expected_force, expected_torque) = found
    assert np.abs(position - expected).max() < 100 * np.finfo(np.float32).eps
    scale = np.abs(expected_force).max()
    assert scale > 10
    assert np.abs(force - expected_force).max() < 1e-3 * scale
    assert np.abs(torque - expected_torque).max() < 1e-3 * np.abs(expected_torque).max()

"""A device without double precision, as Metal's: the host counts the time and chooses the steps."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import single_precision_run
from rounding import farthest
from scenes import slow
from single_precision_run import in_single_precision
from test_batch import batch_of, outputs_of, scene_named

from mpmcli.errors import InputError
from mpmcli.solver.engine.run import build_run

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("name", ["gravity of time", *(slow(n) for n in ("sand", "forces on one body of two"))])
def test_runs_follow_those_with_double_precision(backend_of: Callable, name: str) -> None:
    """Two runs in which all numbers differ: as many steps, and what sums in another order changes by round-off."""
    scenes = [scene_named(name), scene_named(name, other=True)]
    backend = backend_of("f32", 1)
    found = outputs_of(batch_of(scenes, in_single_precision(backend)), scenes)
    for outcome, scene in zip(found, scenes, strict=True):
        expected = list(build_run(scene, backend).frames())
        assert [row.steps for _, row in outcome] == [row.steps for _, row in expected]
        steps = expected[-1][0].step
        assert steps > 15
        for (frame, row), (other, other_row) in zip(outcome, expected, strict=True):
            assert frame.time == other.time
            apart = farthest(other.position, other.velocity, steps, other.time)
            assert np.abs(frame.position - other.position).max() < apart
            assert row.energy == pytest.approx(other_row.energy, rel=1e-5)
            assert row.step_min == pytest.approx(other_row.step_min, rel=1e-4) and row.limit == other_row.limit


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["rough walls", slow("forces on one body of two")])
def test_no_kernel_counts_in_double_precision(name: str) -> None:
    """Not one number of 64 bits in the intermediate code of all kernels, which is not empty."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, single_precision_run.__file__, name],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path, "TI_PRINT_IR": "1"},
    )
    with process:
        kernels = doubles = 0
        for line in process.stdout:
            kernels += line.startswith("kernel {")
            doubles += "f64" in line
        said = process.stderr.read()
    if "needs a device" in said:
        pytest.skip("no software Vulkan")
    assert process.returncode == 0, said
    assert kernels > 20 and doubles == 0


def test_colliders_that_move_are_refused(backend_of: Callable) -> None:
    backend = in_single_precision(backend_of("f32", 1))
    with pytest.raises(InputError, match="moving colliders are not available"):
        build_run(scene_named("colliders"), backend)

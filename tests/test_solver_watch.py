"""What a solver must not overlook between two measurements of its state, on the CPU and on a GPU."""

import json
from collections.abc import Callable
from pathlib import Path

import fall_run
import path_run
import pytest

from mpmcli.stability.limits import COURANT

ARCHES = ["cpu", "vulkan"]


@pytest.fixture(scope="module", params=ARCHES)
def outcome(request: pytest.FixtureRequest, run_module: Callable) -> dict:
    """Return what `fall_run.py` found on a backend, in a process of its own."""
    run = run_module(Path(fall_run.__file__), request.param)
    if run.status == path_run.NO_DEVICE or (request.param != "cpu" and run.status < 0):
        pytest.skip(f"no {request.param} device here: {run.stdout.strip() or f'signal {-run.status}'}")
    assert run.status == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


def test_a_fall_from_rest_is_watched(outcome: dict) -> None:
    """v = g t, and no step moves a particle by more than half a cell, though nothing moves when the run begins.

    The wave bound of a soft body allows steps in which gravity alone adds half a cell of speed each: the
    bound on the speed must follow within a step. y = g t^2/2 to first order in the step: g t dt/2.
    """
    fall = outcome["fall"]
    assert "lost" not in fall, fall
    g, t = fall_run.GRAVITY, fall_run.SECONDS
    assert fall["speeds"] == pytest.approx([-g * t, -g * t], rel=1e-5)
    assert abs(fall["fallen"] - g * t**2 / 2) < g * t * fall["step_max"] / 2 * 1.01
    # One step's gravity more than the bound saw.
    assert fall["courant"] <= COURANT + g * fall["step_max"] ** 2 / fall_run.H


def test_a_lost_particle_ends_the_run_soon(outcome: dict) -> None:
    """Within 16 steps on a GPU, which is not read back more often, and with the particle's own id."""
    lost = outcome["lose"]
    assert lost, "the run went on"
    assert lost["particle"] == 10
    assert 20 < lost["step"] <= 37
    assert "particle 10" in lost["sentence"]

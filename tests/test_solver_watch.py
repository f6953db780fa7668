"""What a run must not overlook between two measurements of its state, on the CPU and on a GPU."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import fall_run
import numpy as np
import path_run
import pytest
from conftest import GPU
from scenes import block, restart, scene, slow

from mpmcli.scene import sample_bodies
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.frames.diagnosis import read_group
from mpmcli.stability.limits import COURANT

ARCHES = ["cpu", pytest.param(GPU, marks=pytest.mark.gpu)]


@pytest.fixture(scope="module", params=ARCHES)
def outcome(request: pytest.FixtureRequest, run_module: Callable) -> dict:
    """Return what `fall_run.py` found on a backend, in a process of its own."""
    run = run_module(Path(fall_run.__file__), request.param)
    if run.status == path_run.NO_DEVICE or (request.param != "cpu" and run.status < 0):
        pytest.skip(f"no {request.param} device here: {run.stdout.strip() or f'signal {-run.status}'}")
    assert run.status == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


def test_a_fall_from_rest_is_watched(outcome: dict) -> None:
    """y = g t^2/2, v = g (t - dt/2), and no step moves a particle by more than half a cell, though it begins at rest.

    The wave bound of a soft body allows steps in which gravity alone adds half a cell of speed each: the
    bound on the speed must follow within a step.
    """
    fall = outcome["fall"]
    assert "lost" not in fall, fall
    g, t = fall_run.GRAVITY, fall_run.SECONDS
    assert fall["speeds"] == pytest.approx([-g * (t - fall["last"] / 2)] * 2, rel=1e-5)
    assert fall["fallen"] == pytest.approx(g * t**2 / 2, rel=1e-4)
    # One step's gravity more than the bound saw.
    assert fall["courant"] <= COURANT + g * fall["step_max"] ** 2 / fall_run.H


def test_a_lost_particle_ends_the_run_soon(outcome: dict) -> None:
    """Within 16 steps on a GPU, which is not read back more often, and with the particle's own id."""
    lost = outcome["lose"]
    assert lost, "the run went on"
    assert lost["particle"] == 10
    assert 20 < lost["step"] <= 37
    assert "particle 10" in lost["sentence"]


@pytest.mark.parametrize("law", ["neo_hookean", "viscoplastic", *(slow(n) for n in ("fixed_corotated", "snow"))])
def test_no_step_exceeds_the_limit_of_its_moment(law: str, backend_of: Callable, record_property: Callable) -> None:
    """A block hits a wall at a fifth of its wave speed: no step is longer than the state then allows.

    Snow hardens by e^10 per strain, and is measured once in several steps all the same.
    """
    wave_speed, density = 20.0, 400.0
    stiffness = density * wave_speed**2
    material = {"law": law, "density": density, "poissons_ratio": 0.2, "youngs_modulus": 0.9 * stiffness}
    if law == "viscoplastic":
        material = {
            "law": law,
            "density": density,
            "yield_stress": 200.0,
            "consistency": 5.0,
            "bulk_modulus": stiffness,
        }
    body = block("block", material, [0.65, 0.05], [0.95, 0.25], velocity=[wave_speed / 5, 0.0])
    run = build_run(scene([32, 16], 1 / 32, [body], end=1.0), backend_of("f32", 1))
    largest, at_start = 0.0, min(run.limits_now()).value
    smallest = at_start
    while run.time < 0.06:
        dt, _ = run.stable_step()
        limit = min(run.limits_now()).value
        largest, smallest = max(largest, dt / limit), min(smallest, limit)
        run.step(dt)
    record_property("step over limit", largest)
    record_property("limit over first", smallest / at_start)
    assert largest <= 1.0
    assert smallest < 0.95 * at_start


@pytest.mark.parametrize("law", ["fluid", *(slow(n) for n in ("viscoplastic", "neo_hookean"))])
def test_the_step_does_not_drive_what_it_follows(law: str, backend_of: Callable) -> None:
    """A lone particle that takes tension oscillates for 1,000 steps of the solver's own choice, let go at three J.

    Its bound on the step goes up and down with J: a step that did the same would burst it within 400.
    """
    material = {
        "fluid": {"bulk_modulus": 4e5, "tension_cutoff": False},
        "viscoplastic": {"bulk_modulus": 4e5, "yield_stress": 1e3, "consistency": 1.0},
        "neo_hookean": {"youngs_modulus": 4e5, "poissons_ratio": 0.3},
    }[law]
    body = block("drop", {"law": law, "density": 1e3, **material}, [0.5, 0.5], [0.53, 0.53])
    asked = scene([16, 16], 1 / 16, [body], end=100.0, precision="f64")
    sample = sample_bodies(asked)[0]
    lone = replace(sample, position=np.full((1, 2), 0.513), velocity=np.zeros((1, 2)), affine=np.zeros((1, 2, 2)))
    run = build_run(asked, backend_of("f64", 1), [lone])
    group = run.groups[0]
    for J in (0.8, 1.1, 1.2):
        restart(run, [lone], 100.0)
        group.replace(deformation=np.full(1, J) if group.law.deformation == "J" else np.eye(2)[None] * J**0.5)
        run.state_was_replaced()
        for _ in range(1000):
            run.step(run.stable_step()[0])
        assert 0.2 < read_group(group).volume_ratio[0] < 3, J

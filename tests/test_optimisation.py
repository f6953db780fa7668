"""Tests compile with fewer of Taichi's optimisations than users do (conftest.py): both compute the same bytes."""

from collections.abc import Callable

import pytest
import state_run

from mpmcli.solver.engine.run import build_run

# Two bodies, and FLIP; forces are slow to compile.
USUAL = ("several bodies, FLIP",)
STEPS = 40


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in USUAL else pytest.mark.slow) for name in state_run.NAMES]
)
def test_the_bytes_do_not_depend_on_the_optimisation(backend_of: Callable, name: str) -> None:
    states = []
    for fully_optimised in (True, False):
        run = build_run(state_run.scene_named(name), backend_of("f32", 1, fully_optimised=fully_optimised))
        state_run.advance(run, STEPS)
        states.append(state_run.saved_of(run))
    assert state_run.differences(*states) == []

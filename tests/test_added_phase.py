"""A phase that is added to the step, as docs/architecture.md says: one function of a node, on every device and grid."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import block
from solver_state import scene_of

from mpmcli.quick_taichi import ti
from mpmcli.solver.engine import device, kernel_store
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.engine.step import Phase, step_phases

RATE, STEP, COUNT = 2.0, 1e-3, 100
JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e4, "poissons_ratio": 0.3}


@ti.func
def drag(at: ti.template(), node: ti.template(), kick: float):
    """Slow a node: v <- v / (1 + c dt)."""
    index = at.grid.linear_index(node)
    for a in ti.static(range(at.grid.dimension)):
        at.grid.nodes[index][a] = at.grid.nodes[index][a] / (1.0 + RATE * kick)


def with_drag(*given: object, **flags: object) -> tuple[Phase, ...]:
    """Return the phases of a step, drag behind the update of nodes."""
    phases = step_phases(*given, **flags)
    at = 1 + next(k for k, phase in enumerate(phases) if phase.name == "update")
    return (*phases[:at], Phase("drag", "nodes", body=drag), *phases[at:])


@pytest.mark.parametrize(
    ("arch", "threads", "more"),
    [
        ("cpu", 1, {}),
        ("cpu", 3, {}),
        ("cpu", 2, {"solver": {"grid": "sparse"}}),
        ("cpu", 2, {"contact": {"default": "separate"}}),
        pytest.param("vulkan", 1, {}, marks=pytest.mark.gpu),
    ],
    ids=["one thread", "three threads", "sparse", "layers", "gpu"],
)
def test_a_drag_on_nodes_slows_all_that_flies(
    backend_of: Callable, monkeypatch: pytest.MonkeyPatch, arch: str, threads: int, more: dict
) -> None:
    """Two bodies that fly apart: each step divides v by 1 + c kick, the first kick being half a step."""
    monkeypatch.setattr(device, "step_phases", with_drag)
    monkeypatch.setenv(kernel_store.SWITCH, "off")
    bodies = [
        block("left", JELLY, [0.3, 0.4], [0.5, 0.6]) | {"velocity": [-1.0, 0.5]},
        block("right", JELLY, [0.8, 0.4], [1.0, 0.6]) | {"velocity": [1.0, 0.0]},
    ]
    precision = "f64" if arch == "cpu" else "f32"
    asked = scene_of(
        domain={"size": [1.4, 1.0], "spacing": 0.05, "gravity": [0.0, 0.0]},
        time={"end": 1.0, "frames": 1},
        bodies=bodies,
        solver={"precision": precision} | more.get("solver", {}),
        **{name: table for name, table in more.items() if name != "solver"},
    )
    run = build_run(asked, backend_of(precision, threads, arch))
    for _ in range(COUNT):
        run.step(STEP)
    velocity, body = run.frame()[0].velocity, run.frame()[0].body
    left = 1 / ((1 + RATE * STEP / 2) * (1 + RATE * STEP) ** (COUNT - 1))
    for k, start in enumerate(([-1.0, 0.5], [1.0, 0.0])):
        np.testing.assert_allclose(velocity[body == k].mean(axis=0), np.multiply(left, start), rtol=1e-5, atol=1e-6)

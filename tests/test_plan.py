"""The memory that a scene is said to take is the memory that its fields take."""

from collections.abc import Callable

import pytest
from solver_state import scene_of

from mpmcli.errors import InputError
from mpmcli.solver.ordering import entry_count
from mpmcli.solver.plan import Plan, make_plan, require_room
from mpmcli.solver.solver import Solver

MATERIALS = {
    "fluid": {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5},
    "solid": {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5},
}


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("bodies", [1, 2])
def test_the_plan_counts_every_field(
    backend_of: Callable, dimension: int, material: str, bodies: int, precision: str
) -> None:
    """Bytes of state, labels and sort buffers, counted from the fields themselves; 160 at most for the 3D fluid."""
    d, h = dimension, 0.1
    scene = scene_of(
        domain={"size": [8 * h] * d, "spacing": h},
        time={"end": 1.0, "frames": 1},
        solver={"precision": precision},
        bodies=[
            {
                "name": f"body {k}",
                "material": MATERIALS[material],
                "shape": {"box": {"min": [4 * h * k] + [h] * (d - 1), "max": [4 * h * k + 2 * h] + [3 * h] * (d - 1)}},
            }
            for k in range(bodies)
        ],
    )
    backend = backend_of(precision)
    plan, solver = make_plan(scene, backend), Solver(scene, backend)
    (group,) = solver.groups
    real = {"f32": 4, "f64": 8}[precision]
    widest = max(entry_count(field) for field in group.state)
    state = real * sum(entry_count(field) for field in group.state)
    assert plan.particles == solver.particle_count
    assert plan.bytes_per_particle == state + 4 * len(group.labels) + widest * real + 4 + 4
    assert plan.nodes == solver.grid.node_count
    assert plan.bytes_per_node == real * solver.grid.nodes.n
    if (dimension, material, bodies, precision) == (3, "fluid", 1, "f32"):
        assert plan.bytes_per_particle <= 160


def test_more_than_an_index_reaches_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """3 x 4 numbers of 2^28 particles are 3 x 2^30 entries of one field."""
    monkeypatch.setattr("mpmcli.solver.plan.MEMORY_SHARE", 1e6)
    with pytest.raises(InputError, match="more than 32-bit indices can address"):
        require_room(Plan(2**28, 1000, 140, 16, 16000, 1))

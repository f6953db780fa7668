"""What acts in every step acts by its length: the same motion at steps of 1, 1/5 and 1/50 (docs/theory.md, 7.3)."""

from collections.abc import Callable

import pytest
from solver_state import bodies_of, scene_of

from mpmcli.scene import Scene
from mpmcli.solver.engine.build import build_run

GRAVITY, FRICTION, SPEED, END = 10.0, 0.3, 0.6, 0.1
SOLID = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
# What a step of 0.8 of the bound is divided by.
STEP, PARTS = 8e-4, [1, 5, pytest.param(50, marks=pytest.mark.slow)]


def sliding(floor: str) -> Scene:
    """Return a block that slides on a floor with friction, which is the wall, or a plate that lies on the wall."""
    walls = {"walls": {"default": "slip", "y_min": "separate"}}
    low, friction, colliders = 0.0, {"y_min": FRICTION}, []
    if floor == "collider":
        low, friction = 0.1, {}
        plate = {"box": {"min": [-0.5, -0.5], "max": [1.5, low]}}
        colliders = [{"name": "plate", "shape": plate, "wall": "separate", "friction": FRICTION}]
    block = {"box": {"min": [0.1, low], "max": [0.4, low + 0.15]}}
    return scene_of(
        domain={"size": [0.8, 0.4], "spacing": 0.025, "gravity": [0.0, -GRAVITY], "friction": friction} | walls,
        time={"end": 1.0, "frames": 1},
        solver={"precision": "f64"},
        bodies=[{"name": "block", "material": SOLID, "shape": block, "velocity": [SPEED, 0.0]}],
        colliders=colliders,
    )


@pytest.mark.parametrize("floor", ["wall", "collider"])
@pytest.mark.parametrize("parts", PARTS)
def test_friction_takes_as_much_in_a_second_at_any_step(backend_of: Callable, parts: int, floor: str) -> None:
    """Coulomb: what slides loses mu times the push, m (g t + v_y) with what it still bounces by."""
    run = build_run(sliding(floor), backend_of("f64", 1))
    while run.time < END:
        run.step(STEP / parts)
    block, t = bodies_of(run)["block"], run.state.velocity_time
    along, up = block.momentum() / block.mass.sum()
    lost = FRICTION * (GRAVITY * t + up)
    # A wall takes less from a column where less stops it (docs/theory.md, 3.4).
    assert SPEED - along == pytest.approx(lost, rel={"wall": 5e-3, "collider": 1e-9}[floor])
    assert lost > 0.4 * SPEED

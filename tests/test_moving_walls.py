"""Walls that move along themselves: what sticks to one, or rubs on it, moves as in the frame of the wall."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import block, scene_of, slow
from solver_state import bodies_of

from mpmcli.scene import Scene
from mpmcli.solver.engine.run import build_run
from mpmcli.stability.limits import COURANT

# DT is 0.70 to 0.85 of the bound by stiffness, and twice that by speed of a body that moves by a cell in it. In both
# frames it counts as a whole own step, and AFLIP keeps the same share (docs/theory.md, 2.3).
SOLID = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 4e4, "poissons_ratio": 0.3}
H, DT = 0.125, 0.01
# By name: walls, friction, and settings of the solver.
BLOCKS = {
    "stick": ("stick", 0.0, {}),
    "rough, aflip": ("separate", 0.3, {"transfer": "aflip"}),
    "rough, slip": ("slip", 0.3, {}),
    "stick, aflip": ("stick", 0.0, {"transfer": "aflip"}),
}


def pressed_block(name: str, speed: float) -> Scene:
    """Return a block that flies against a floor that moves at some speed, with a velocity of its own relative to it."""
    word, friction, settings = BLOCKS[name]
    velocity = {} if speed == 0 else {"wall_velocity": {"y_min": [speed, 0.0]}}
    return scene_of(
        block("block", SOLID, [4 * H, 0.0], [9 * H, 4 * H], velocity=[speed + 1.0, -0.8]),
        domain={
            "size": [16 * H] * 2,
            "spacing": H,
            "gravity": [0.0, -9.81],
            "walls": {"default": "periodic", "y_min": word, "y_max": "slip"},
        }
        | velocity
        | ({"friction": {"y_min": friction}} if friction else {}),
        frames=4,
        solver={"precision": "f64"} | settings,
    )


@pytest.mark.parametrize("name", [name if name == "rough, aflip" else slow(name) for name in BLOCKS])
def test_a_moving_wall_is_one_at_rest_in_its_own_frame(
    backend_of: Callable, name: str, record_property: Callable
) -> None:
    """A floor that moves by a cell per step does to a block what one at rest does, to round-off.

    The faces along x are periodic, and the block crosses them in every sixteenth step.
    """
    backend, speed, found = backend_of("f64"), H / DT, []
    for own in (0.0, speed):
        run = build_run(pressed_block(name, own), backend)
        for _ in range(100):
            run.step(DT)
        state = bodies_of(run)["block"]
        found.append((state.x - [own * 100 * DT, 0.0], state.v - [own, 0.0], state.deformation))
    (x, v, F), (other_x, other_v, other_F) = found
    size = 16 * H
    apart = (other_x - x + size / 2) % size - size / 2
    largest = max(float(np.abs(apart).max()) / H, float(np.abs(other_v - v).max()), float(np.abs(other_F - F).max()))
    record_property("largest difference", largest)
    assert np.ptp(v[:, 0]) > 0.01
    assert largest < 1e-10


@pytest.mark.parametrize("solids", ["updated", slow("total")])
def test_a_rough_wall_drags_a_block_along(backend_of: Callable, solids: str, record_property: Callable) -> None:
    """Its momentum grows by mu M g per second until it moves with the wall, to 1 %, and stays there.

    It bounces with a period T under its weight, which leaves mu g T / (2 pi) = 0.7 % of that speed.
    """
    speed, friction, g = 1.0, 0.3, 9.81
    # On its way it leaves through the face along x, unless there is a wall.
    left = 0.25 if solids == "total" else 1.0
    scene = scene_of(
        block("block", SOLID | {"youngs_modulus": 1e7, "poissons_ratio": 0.0}, [left, 0.0], [left + 0.75, 0.375]),
        domain={"size": [2.0, 1.0], "cells": [16, 8], "gravity": [0.0, -g]},
        walls={"default": "separate"} | ({} if solids == "total" else {"x_min": "periodic", "x_max": "periodic"}),
        friction={"y_min": friction},
        wall_velocity={"y_min": [speed, 0.0]},
        time={"end": 0.6, "frames": 12},
        solids=solids,
    )
    rows = [row for _, row in build_run(scene, backend_of("f32")).frames()]
    found = np.array([row.linear_momentum[0] / row.mass for row in rows])
    times = np.array([row.time - row.step_max / 2 for row in rows])
    expected = np.minimum(friction * g * times, speed)
    record_property("largest difference", float(np.abs(found - expected).max()))
    assert np.abs(found - expected).max() < 0.01 * speed
    # On the grid of its state at rest nothing damps its swing.
    assert abs(found[-1] - speed) < (0.01 if solids == "total" else 1e-3) * speed


@pytest.mark.slow
def test_a_wall_that_moves_bounds_the_first_step(backend_of: Callable) -> None:
    """Before anything else moves: half of a cell at the speed of the wall at most."""
    run = build_run(
        pressed_block("stick", 1e4).model_copy(update={"bodies": pressed_block("stick", 0.0).bodies}), backend_of("f64")
    )
    assert run.stable_step()[1].name == "speed"
    assert run.stable_step()[0] <= COURANT * H / 1e4

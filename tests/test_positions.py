"""Positions in single precision: a motion below the rounding of the coordinate is carried, not lost."""

from collections.abc import Callable

import numpy as np
import pytest
import taichi as ti
from solver_state import scene_of

from mpmcli.scene import Scene
from mpmcli.solver.engine import build_engine
from mpmcli.solver.solver import Solver

# A block at 8.6 m that moves by a fifth of the spacing of the numbers there in a step, and one beside it that is fast.
SPEED, STEP = 4e-4, 5e-4
BETWEEN = 2.0**-20


def two_blocks(dimension: int, end: float, solids: str = "updated") -> Scene:
    """Return the scene; axes but the first are short."""
    rest = dimension - 1

    def block(name: str, low: float, speed: float) -> dict:
        return {
            "name": name,
            "material": {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5},
            "shape": {"box": {"min": [low] + [0.4] * rest, "max": [low + 0.2] + [0.6] * rest}},
            "velocity": [speed] + [0.0] * rest,
        }

    return scene_of(
        domain={"size": [10.0] + [1.0] * rest, "spacing": 0.1},
        time={"end": end, "frames": 1, "step": STEP},
        bodies=[block("slow", 8.5, SPEED), block("fast", 1.0, 1.0)],
        solver={"solids": solids},
    )


@pytest.mark.parametrize(
    ("dimension", "solids", "arch", "end"),
    [
        (2, "updated", "cpu", 5.0),
        pytest.param(2, "total", "cpu", 1.0, marks=pytest.mark.slow),
        pytest.param(3, "updated", "cpu", 5.0, marks=pytest.mark.slow),
        pytest.param(2, "updated", "vulkan", 0.1, marks=pytest.mark.gpu),
    ],
)
def test_a_slow_block_beside_a_fast_one(
    backend_of: Callable, dimension: int, solids: str, arch: str, end: float
) -> None:
    """At 8.6 m it moves by v t, to half the spacing of the numbers there: 2.4e-4 of its 2 mm after 5 s."""
    scene = two_blocks(dimension, end, solids)
    engine = build_engine(scene, backend_of("f32", 1, arch), batched=True)
    first, last = (frame for frame, _ in engine.frames(lambda: False))
    slow = first.body == 0
    way = last.position[slow].astype(np.float64) - first.position[slow]
    assert SPEED * STEP < BETWEEN / 4 and engine.step_count == round(end / STEP)
    assert np.abs(way[:, 0] - SPEED * end).max() <= 0.51 * BETWEEN
    assert np.abs(way[:, 1:]).max() == 0.0


def test_remainders(backend_of: Callable) -> None:
    """A move and its remainder sum to the way, in double precision; a particle that the domain holds has none."""
    solver = Solver(two_blocks(2, 1.0), backend_of("f32", 1))
    particles, group = solver._kernels.particles, solver.groups[0]
    rng = np.random.default_rng(0)
    n = 200
    arrays = {
        "x": rng.uniform(0.0, [10.0, 1.0], (n, 2)),
        "r": rng.uniform(-0.5, 0.5, (n, 2)) * BETWEEN / 8,
        "v": rng.normal(0.0, 1.0, (n, 2)) * 10.0 ** rng.uniform(-6, 3, (n, 1)),
        "inside": np.zeros((n, 2)),
        "after": np.zeros((n, 2)),
    }
    fields = {name: ti.Vector.field(2, ti.f32, shape=n) for name in arrays}
    for name, values in arrays.items():
        fields[name].from_numpy(values.astype(np.float32))
    x, r, v, inside, after = fields.values()

    @ti.kernel
    def move(dt: float):
        for p in range(n):
            ended, left, _beyond = particles.moved(group, x[p], r[p], v[p], dt)
            inside[p], after[p] = ended, left

    move(STEP)
    x, r, v, inside, after = (field.to_numpy().astype(np.float64) for field in fields.values())
    way = np.float64(np.float32(STEP)) * v + r
    held = (x + way < 0.0) | (x + way > [10.0, 1.0])
    assert 0 < held.sum() < n / 2
    assert (after[held] == 0.0).all()
    # A sum of three has an error of its own: of the way, not of the position.
    error = np.abs(inside + after - (x + way))[~held]
    assert (error <= 2.0**-23 * np.abs(way)[~held] + 2.0**-47).all()

"""Positions in single precision: a motion below the rounding of the coordinate is carried, not lost."""

from collections.abc import Callable
from copy import copy

import numpy as np
import pytest
import taichi as ti
from made_result import made_frame, made_header
from scenes import block, liquid, scene_of, solid

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_state import StateCheck
from mpmcli.output.header import RunHeader
from mpmcli.scene import Scene
from mpmcli.solver.engine.run import build_run

# A block at 8.6 m that moves by a fifth of the spacing of the numbers there in a step, and one beside it that is fast.
SPEED, STEP = 4e-4, 5e-4
BETWEEN = 2.0**-20


def two_blocks(dimension: int, end: float, solids: str = "updated") -> Scene:
    """Return the scene; axes but the first are short."""
    rest = dimension - 1

    blocks = ("slow", 8.5, SPEED), ("fast", 1.0, 1.0)
    return scene_of(
        *(
            block(name, solid(1e5), [x, *[0.4] * rest], [x + 0.2, *[0.6] * rest], velocity=[speed, *[0.0] * rest])
            for name, x, speed in blocks
        ),
        domain={"size": [10.0] + [1.0] * rest, "spacing": 0.1},
        time={"end": end, "step": STEP},
        solids=solids,
    )


@pytest.mark.parametrize(
    ("dimension", "solids", "arch", "end"),
    [
        (2, "updated", "cpu", 5.0),
        pytest.param(2, "total", "cpu", 1.0, marks=pytest.mark.slow),
        pytest.param(3, "updated", "cpu", 5.0, marks=pytest.mark.slow),
        pytest.param(2, "updated", "vulkan", 0.1, marks=[pytest.mark.gpu, pytest.mark.slow]),
    ],
)
def test_a_slow_block_beside_a_fast_one(
    backend_of: Callable, dimension: int, solids: str, arch: str, end: float
) -> None:
    """At 8.6 m it moves by v t, to half the spacing of the numbers there: 2.4e-4 of its 2 mm after 5 s."""
    scene = two_blocks(dimension, end, solids)
    run = build_run(scene, backend_of("f32", 1, arch))
    first, last = (frame for frame, _ in run.frames())
    slow = first.body == 0
    way = last.position[slow].astype(np.float64) - first.position[slow]
    assert SPEED * STEP < BETWEEN / 4 and run.step_count == round(end / STEP)
    assert np.abs(way[:, 0] - SPEED * end).max() <= 0.51 * BETWEEN
    assert np.abs(way[:, 1:]).max() == 0.0


def test_remainders(backend_of: Callable) -> None:
    """A move and its remainder sum to the way, in double precision; a particle that the domain holds has none."""
    run = build_run(two_blocks(2, 1.0), backend_of("f32", 1))
    # As the view of a run has it.
    particles, group = copy(run.batch.device.particles), run.groups[0].arrays
    particles.extent = run.scene.domain.size
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


@pytest.mark.parametrize(("walls", "settings", "holds"), [
    ("slip", {}, False),
    pytest.param("separate", {}, False, marks=pytest.mark.slow),
    pytest.param("stick", {}, False, marks=pytest.mark.slow),
    pytest.param("slip", {"transfer": "aflip"}, False, marks=pytest.mark.slow),
    pytest.param("slip", {"kernel": "cubic"}, False, marks=pytest.mark.slow),
])  # fmt: skip
def test_folded_walls_hold_no_particle(backend_of: Callable, walls: str, settings: dict, holds: bool) -> None:
    """A block of liquid splashes in a corner, at the whole of the stable step: none is put on a wall of its domain."""
    scene = scene_of(
        block("liquid", liquid(1e5), [0.125, 0.125], [0.5, 0.5], velocity=[-3.0, -2.0]),
        domain={"size": [1.0, 1.0], "cells": [32, 32], "gravity": [0.0, -10.0], "walls": walls},
        time={"end": 0.5, "frames": 50, "safety": 1.0},
        solver=settings,
    )
    run = build_run(scene, backend_of("f32", 1))
    on_walls = [((f.position <= 0) | (f.position >= 1)).any(axis=1).sum() for f, _ in run.frames()]
    assert (max(on_walls) > 0) == holds


@pytest.mark.parametrize("held", [0, 1])
def test_check_counts_what_walls_hold(held: int) -> None:
    """Of four particles one on a wall, after the start: noted with its share; before, the scene put it there."""
    findings, frames = FrameFindings(), [made_frame(k, 2) for k in range(3)]
    check = StateCheck(RunHeader.read(made_header(2)), findings)
    for frame in frames:
        frame.position[:held, 0] = 0.0
        check.check(frame)
    told = [(f.rule, f.severity, f.frame, f.value) for f in findings.found() if f.rule == "held-positions"]
    assert told == ([("held-positions", "note", 1, 0.25)] if held else [])

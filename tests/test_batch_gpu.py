"""Runs of a batch on a GPU follow those on the CPU, which chooses the same steps; a sweep computes many at once."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import GPU
from rounding import farthest
from test_batch import batch_of, outputs_of, scene_named
from tiny_sweep import tiny_sweep

from mpmcli.dataset.compute import Task, compute
from mpmcli.solver.engine.run import Run, build_run, frames_of_all
from mpmcli.solver.frames.diagnosis import UnstableRunError

pytestmark = pytest.mark.gpu


# Two kinds of one law; sand, walls and friction are in the one that is left.
SLOW = (
    "rough walls",
    "colliders, 3D",
    "a force of the place",
    "neo_hookean",
    "rough walls, 3D, AFLIP",
    "rough walls, total",
    "periodic, a wall moves",
    "periodic, a wall moves, AFLIP",
    "periodic, 3D, f_bar",
    "two laws, two bodies of one",
    "3D, AFLIP",
    "forces on one body of two",
)


@pytest.mark.parametrize("name", ["colliders", *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW)])
def test_runs_follow_those_on_the_cpu(backend_of: Callable, name: str) -> None:
    """Two runs in which all numbers differ: as many steps, and what sums in another order changes by round-off."""
    scenes = [scene_named(name), scene_named(name, other=True)]
    backend = backend_of("f32", 1, "vulkan")
    found = outputs_of(batch_of(scenes, backend), scenes)
    cpu = backend_of("f32", 1)
    for outcome, scene in zip(found, scenes, strict=True):
        expected = list(build_run(scene, cpu).frames())
        assert [row.steps for _, row in outcome] == [row.steps for _, row in expected]
        steps = expected[-1][0].step
        assert steps > 15
        for (frame, row), (other, other_row) in zip(outcome, expected, strict=True):
            apart = farthest(other.position, other.velocity, steps, other.time)
            assert np.abs(frame.position - other.position).max() < apart
            assert row.energy == pytest.approx(other_row.energy, rel=1e-5)
            assert np.allclose(row.collider_force, other_row.collider_force, rtol=1e-3, atol=1e-3)
            assert row.step_max == pytest.approx(other_row.step_max, rel=1e-4) and row.limit == other_row.limit
            scale = np.abs(other.fields["stress"]).max()
            assert np.abs(frame.fields["stress"] - other.fields["stress"]).max() <= 1e-3 * scale
            assert np.array_equal(frame.body, other.body) and np.array_equal(frame.material, other.material)


@pytest.mark.slow
def test_an_unstable_run_stops_alone(backend_of: Callable) -> None:
    sound = scene_named("neo_hookean")
    time = sound.time.model_copy(update={"step": 0.004, "end": 0.4})
    wild = sound.model_copy(update={"time": time})
    batch = batch_of([sound, wild], backend_of("f32", 1, "vulkan"))
    events = list(frames_of_all({0: Run(batch, 0, sound), 1: Run(batch, 1, wild, force=True)}))
    (error,) = (event for _, event in events if isinstance(event, Exception))
    assert isinstance(error, UnstableRunError) and "the run became unstable at step" in str(error)
    assert [event[0].index for slot, event in events if slot == 0 and event] == [0, 1, 2, 3]
    # The place serves the next run.
    (again,) = outputs_of(batch, [sound])
    assert len(again) == 4


@pytest.mark.slow
def test_a_sweep_computes_many_at_once(tmp_path: Path) -> None:
    """All trajectories of a task, stored as on the CPU."""
    sweep = tiny_sweep(tmp_path, 6)
    found = {}
    for arch in (GPU, "cpu"):
        rows = compute(Task(tmp_path / arch, sweep, tuple(range(6)), arch))
        assert [row.verdict for row in rows] == ["stable"] * 6 and {row.arch for row in rows} == {arch}
        assert all((tmp_path / arch / row.file).exists() and row.seconds > 0 for row in rows)
        found[arch] = rows
    for row, other in zip(found[GPU], found["cpu"], strict=True):
        assert (row.steps, row.particles, row.frames) == (other.steps, other.particles, other.frames)

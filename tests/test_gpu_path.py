"""The path of a GPU on threads of the CPU: it computes what the CPU path does, in few launches."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from conftest import ROOT
from scenes import block, liquid, scene_of
from test_batch import batch_of, scene_named
from test_deterministic import on_gpu_path

from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.solver.engine import gpu_launch
from mpmcli.solver.engine.run import Run, build_run, frames_of_all
from mpmcli.solver.machine.backend import Backend, choose_backend, launcher, start, stop_backend
from mpmcli.solver.transfer import run_sums
from mpmcli.solver.transfer.run_sums import WARP, stored_at

KINDS = (
    "fluid", "two laws, two bodies of one", "3D, two laws", "3D, AFLIP", "rough walls", "periodic, a wall moves, AFLIP",
    "periodic, 3D, f_bar", "colliders", "contact", "rigid bodies",
)  # fmt: skip


STEPS, STEP = 30, 2.5e-4


def in_doubles(name: str) -> Scene:
    scene = scene_named(name)
    return scene.model_copy(update={"solver": scene.solver.model_copy(update={"precision": "f64"})})


def after_steps(scene: Scene, backend: Backend) -> dict[str, np.ndarray]:
    """Return what a frame after STEPS steps holds; later, rounding decides where grains of sand go."""
    run = build_run(scene, backend)
    for _ in range(STEPS):
        run.step(STEP)
    frame, row = run.frame()
    loads = {"force": row.collider_force, "torque": row.collider_torque, "energy": [row.energy]}
    fields = {"x": frame.position, "v": frame.velocity, "stress": frame.fields["stress"]}
    return {name: np.asarray(value) for name, value in (fields | loads).items()}


def check_same(expected: dict[str, np.ndarray], found: dict[str, np.ndarray]) -> None:
    """Compare arrays to 1e-12 of their largest value."""
    for name, value in expected.items():
        error = np.abs(found[name] - value).max(initial=0.0) / max(np.abs(value).max(initial=0.0), 1e-300)
        assert error <= 1e-12, name


@pytest.mark.parametrize("name", KINDS)
def test_steps_are_those_of_the_cpu(backend_of: Callable, name: str) -> None:
    """Positions, velocities, stresses, energies and loads on colliders after thirty steps."""
    scene = in_doubles(name)
    check_same(*(after_steps(scene, backend) for backend in (backend_of("f64"), on_gpu_path(backend_of("f64")))))


def test_particles_are_sorted_within_a_launch(backend_of: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """As large scenes are, but after a fiftieth of a cell: the same frames to rounding."""
    scene, backend = in_doubles("fluid"), on_gpu_path(backend_of("f64"))
    expected, sorts = after_steps(scene, backend), []
    sort = gpu_launch.GpuLaunch._sort
    monkeypatch.setattr(gpu_launch, "MANY", 0)
    monkeypatch.setattr(gpu_launch, "AGED", 0.02)
    monkeypatch.setattr(gpu_launch.GpuLaunch, "_sort", lambda self: (sorts.append(self), sort(self)))
    check_same(expected, after_steps(scene, backend))
    assert len(sorts) > 10


def atomics_of(run: Run, length: int) -> float:
    """Return the atomic additions of P2G per particle; a thread of `length` adds where the stencil changes."""
    (group,) = run.batch.device.groups
    x, d = group.x.to_numpy()[: run.particle_count], run.scene.dimension
    base, p = np.floor(x / run.spacing - 0.5).astype(int), np.arange(len(x))
    thread, place = p // (length * WARP) * WARP + p % WARP, p % (length * WARP) // WARP
    order = np.lexsort((place, thread))
    changes = (np.diff(base[order], axis=0) != 0).any(axis=1) | (np.diff(thread[order]) != 0)
    return (1 + np.count_nonzero(changes)) * 3**d * (d + 1) / len(x)


POOL = scene_of(
    block("pool", liquid(1e5), [0.1, 0.1], [0.8, 0.9], velocity=["-2 * Y", "X"]),
    domain={"size": [1.0, 1.0], "cells": [64, 64]},
    end=0.15,
)


@pytest.fixture
def profiled(monkeypatch: pytest.MonkeyPatch) -> Iterator[Backend]:
    """Give the path of a GPU while Taichi's profiler runs."""
    stop_backend()
    monkeypatch.setenv("TI_KERNEL_PROFILER", "1")
    yield on_gpu_path(start(choose_backend("cpu", 1, "f32", compile_cache=False)))
    stop_backend()


def launches_in(work: Callable[[], object]) -> int:
    """Return how many launches of steps are in some work."""
    ti.profiler.clear_kernel_profiler_info()
    work()
    records = ti.lang.impl.get_runtime().prog.get_kernel_profiler_records()
    return sum(record.name.startswith("step_") for record in records)


def test_a_step_of_a_liquid_is_five_launches(profiled: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clear, P2G, walls, nodes and G2P, besides those of the few steps that shift particles.

    With 16 particles a thread P2G adds 15 times a particle, for 27, after particles have moved by up to 0.4 cells.
    """
    monkeypatch.setattr(run_sums, "SHORTEST", 16)
    run = build_run(POOL, profiled)
    run.step(1e-4)
    assert atomics_of(run, 16) < 10
    moved = 0.0
    while moved < 0.4:
        run.step(2e-4)
        moved += run.courant
    assert atomics_of(run, 16) < 15
    assert launches_in(lambda: run.step(2e-4)) == 5


def test_launches_do_not_grow_with_the_runs(profiled: Backend) -> None:
    """Seven runs take as many as one."""
    launches = {}
    for count in (1, 7):
        batch = batch_of([POOL] * count, profiled)
        runs = {slot: Run(batch, slot, POOL) for slot in range(count)}
        launches[count] = launches_in(lambda runs=runs: list(frames_of_all(runs)))
        assert runs[count - 1].step_count > 100
    assert launches[1] < 8 * runs[0].step_count
    assert launches[7] == launches[1]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_code_of_cuda_is_that_of_five_launches() -> None:
    """P2G in 2D adds 27 numbers at two places of its code, one of which is in the loop, and notes a lost particle."""
    script = ROOT / "scripts" / "ptx"
    done = subprocess.run(
        [sys.executable, script, ROOT / "configs" / "dam_break_2d.toml"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in done.stdout.splitlines()[2:]]
    assert [row[1] for row in rows] == [f"step {k}" for k in range(5)]
    assert rows[1][4] == str(2 * 27 + 1)


def test_a_place_in_memory_is_that_of_one_particle(backend_of: Callable) -> None:
    """Places of 1,000 particles are a permutation; where 32 threads have 8 each, the k-th ones are contiguous."""
    backend_of("f32", 1)
    count, length = 1000, 8
    places = ti.field(int, shape=count)

    @ti.kernel
    def fill():
        for p in range(count):
            places[p] = stored_at(p, count, length)

    fill()
    found = places.to_numpy()
    assert sorted(found) == list(range(count))
    whole = count // (length * WARP) * length * WARP
    assert (found[whole:] == np.arange(whole, count)).all()
    thread, k = np.divmod(np.arange(length * WARP), length)
    assert (found[: length * WARP] == k * WARP + thread).all()


@ti.data_oriented
class Counter:
    """A number that a kernel increases."""

    def __init__(self) -> None:
        self.number = ti.field(int, shape=())

    @ti.kernel
    def increase(self, by: ti.template()):
        self.number[None] += by


def test_a_kernel_is_launched_without_the_call_of_taichi(backend_of: Callable) -> None:
    """By names of Taichi 1.7.4 that are not public; a new release may need others."""
    backend_of("f32", 1)
    counter = Counter()
    counter.increase(3)
    again = launcher(counter.increase, 3)
    again()
    again()
    assert counter.number[None] == 9

"""The path of a GPU on threads of the CPU: it computes what the CPU path does, in few launches."""

from collections.abc import Callable

import numpy as np
import pytest
from test_batch import scene_named
from test_deterministic import on_gpu_path

from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.solver.engine import gpu_launch
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.machine.backend import Backend, choose_backend, launcher, start, stop_backend
from mpmcli.solver.transfer.run_sums import WARP, stored_at

KINDS = (
    "fluid",
    "two laws, two bodies of one",
    "3D, two laws",
    "3D, AFLIP",
    "rough walls",
    "periodic, a wall moves, AFLIP",
    "periodic, 3D, f_bar",
    "colliders",
    "contact",
    "rigid bodies",
)


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


def test_a_step_of_a_liquid_is_five_launches(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture) -> None:
    """Clear, P2G, walls, nodes and G2P, besides those of the few steps that shift particles."""
    stop_backend()
    monkeypatch.setenv("TI_KERNEL_PROFILER", "1")
    try:
        backend = start(choose_backend("cpu", 1, "f32", compile_cache=False))
        run = build_run(scene_named("fluid"), on_gpu_path(backend))
        run.advance(2)
        ti.profiler.clear_kernel_profiler_info()
        run.advance(1)
        ti.profiler.print_kernel_profiler_info()
    finally:
        stop_backend()
    launches = [line.split()[-1] for line in capfd.readouterr().out.splitlines() if "_kernel_" in line]
    assert len([name for name in launches if name.startswith("step_")]) == 5


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

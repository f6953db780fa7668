"""Every path of a step against plain numpy and against each other: the coloured CPU scatter and the atomic one.

One scene with both laws, three densities, all kinds of wall and random states runs in a process per path. Each of its
first steps (the first right after a sort, the next ones after drift, and those in which a sort falls) is compared with
`mpm_reference` from the same state, nodes and particles both.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import path_run
import pytest
from conftest import GPU, PythonRun
from path_reference import TOLERANCE, Arrays, check_steps

from mpmcli.scene import sample_bodies

CPU_THREADS = (1, 3)
PATHS = [("cpu", threads) for threads in CPU_THREADS] + [(GPU, 1)]
# In 3D one path is enough: the threads share the work as in 2D, where the same atomics add, too.
SLOW = {(GPU, 1, 3), ("cpu", 1, 3)}


@pytest.fixture(scope="module")
def path_arrays(tmp_path_factory: pytest.TempPathFactory, run_module: Callable) -> Iterator[Callable[..., Arrays]]:
    """Return `arrays(arch, threads, dimension)`: what a process of its own stored.

    Those that are always asked for start at once, two at a time: most of their time is compilation on one core.
    """
    room = tmp_path_factory.mktemp("paths")

    def run(arch: str, threads: int, dimension: int) -> PythonRun:
        return run_module(Path(path_run.__file__), arch, threads, dimension, "f32", file_of(arch, threads, dimension))

    def file_of(arch: str, threads: int, dimension: int) -> Path:
        return room / f"{arch}_{threads}_{dimension}.npz"

    with ThreadPoolExecutor(2) as pool:
        always = [(*path, dimension) for dimension in (2, 3) for path in PATHS if (*path, dimension) not in SLOW]
        runs = {path: pool.submit(run, *path) for path in always}

        def arrays(arch: str, threads: int, dimension: int) -> Arrays:
            path = (arch, threads, dimension)
            if path not in runs:
                runs[path] = pool.submit(run, *path)
            done = runs[path].result()
            if done.status == path_run.NO_DEVICE or (arch != "cpu" and done.status < 0):
                pytest.skip(f"no {arch} device here: {done.stdout.strip() or f'signal {-done.status}'}")
            assert done.status == 0, done.stderr
            with np.load(file_of(*path)) as stored:
                return dict(stored)

        yield arrays
        pool.shutdown(cancel_futures=True)


def marked(*path: object) -> object:
    return pytest.param(*path, marks=[pytest.mark.slow] * (path in SLOW))


@pytest.mark.parametrize(
    ("arch", "threads", "dimension"), [marked(*path, dimension) for dimension in (2, 3) for path in PATHS]
)
def test_steps_match_plain_numpy(path_arrays: Callable, arch: str, threads: int, dimension: int) -> None:
    """Six steps, each from the device's own state, to f32 round-off."""
    arrays = path_arrays(arch, threads, dimension)
    check_steps(path_run.scene_of(dimension, "f32"), arrays, TOLERANCE["f32"])


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_steps_match_plain_numpy_in_double_precision(backend_of: Callable, dimension: int) -> None:
    """The same kernels in f64, to f64 round-off: what f32 shows is round-off, and nothing else."""
    arrays = path_run.record(backend_of("f64", 3), dimension)
    check_steps(path_run.scene_of(dimension, "f64"), arrays, TOLERANCE["f64"])


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_bitwise_equal_for_any_number_of_threads(path_arrays: Callable, dimension: int) -> None:
    """State, frames and step sizes after some 350 steps and many sorts: not one bit depends on the threads."""
    one, several = (path_arrays("cpu", threads, dimension) for threads in CPU_THREADS)
    assert one["sorts"] > 20
    assert one.keys() == several.keys()
    different = [name for name in one if not np.array_equal(one[name], several[name])]
    assert not different


@pytest.mark.gpu
@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_gpu_follows_the_cpu(path_arrays: Callable, dimension: int) -> None:
    """Atomics add in another order: round-off of 6e-8 per step and sum, which 60 steps may amplify tenfold."""
    gpu, cpu = path_arrays(GPU, 1, dimension), path_arrays("cpu", 1, dimension)
    for law in ("fluid", "neo_hookean"):
        for name, tolerance in (("x", 1e-5), ("v", 5e-5), ("C", 5e-5), ("deformation", 5e-5)):
            right = cpu[f"watched_{law}_{name}"]
            error = np.abs(gpu[f"watched_{law}_{name}"] - right).max() / np.abs(right).max()
            assert error < tolerance, f"{law} {name}: {error:.2e}"


def test_particles_stay_in_the_domain_and_keep_their_number(path_arrays: Callable) -> None:
    """Bodies are thrown at every kind of wall: 0 <= x <= size, with nothing lost and nothing not finite."""
    for dimension in (2, 3):
        size = np.array(path_run.CELLS[dimension]) * path_run.SPACING
        scene = path_run.scene_of(dimension, "f32")
        count = sum(sample.count for sample in sample_bodies(scene))
        for threads in CPU_THREADS:
            arrays = path_arrays("cpu", threads, dimension)
            x = np.concatenate([arrays["long_fluid_x"], arrays["long_neo_hookean_x"]])
            assert x.shape == (count, dimension)
            assert np.isfinite(x).all()
            assert x.min() >= 0
            assert (x <= size * (1 + 1e-6)).all()
            assert arrays["frame_position"].shape == (count, dimension)
        # The scene reaches the walls, or it would show nothing.
        assert x.min() < path_run.SPACING / 2

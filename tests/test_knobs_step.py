"""Every knob of [solver] against plain numpy: the same scene of two laws and all kinds of wall as test_solver_paths."""

from collections.abc import Callable

import numpy as np
import path_run
import pytest
from path_reference import TOLERANCE, check_steps
from scenes import slow

from mpmcli.errors import InputError
from mpmcli.scene import Scene
from mpmcli.scene.schema import SolverSettings
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.machine.backend import Backend

CUBIC = {"kernel": "cubic"}
AFLIP = {"transfer": "aflip", "flip": 0.9}


def name_of(choice: object) -> str:
    return "-".join(map(str, choice.values())) if isinstance(choice, dict) else f"{choice}D"


def scene_of(dimension: int, precision: str, knobs: dict) -> Scene:
    """Return the scene of `path_run` with other knobs; in 3D of its jelly alone, which compiles in half the time."""
    scene = path_run.scene_of(dimension, precision)
    bodies = scene.bodies if dimension == 2 else scene.bodies[:1]
    return scene.model_copy(update={"solver": SolverSettings(precision=precision, **knobs), "bodies": bodies})


def prepare(scene: Scene, backend: Backend) -> Run:
    """Return a run of the scene with the random state of `path_run`."""
    run = build_run(scene, backend, path_run.stirred(scene))
    path_run.deform(run)
    return run


@pytest.mark.parametrize(
    ("dimension", "knobs"),
    [(2, AFLIP), slow(2, CUBIC), slow(2, AFLIP | CUBIC), slow(3, CUBIC), slow(3, AFLIP | CUBIC)],
    ids=name_of,
)
def test_steps_match_plain_numpy(backend_of: Callable, dimension: int, knobs: dict) -> None:
    """Six steps in double precision, each from the device's own state, to round-off."""
    scene = scene_of(dimension, "f64", knobs)
    check_steps(scene, path_run.record_steps(prepare(scene, backend_of("f64"))), TOLERANCE["f64"])


@pytest.mark.gpu
@pytest.mark.parametrize(("dimension", "knobs"), [(2, AFLIP | CUBIC), slow(3, CUBIC)], ids=name_of)
def test_steps_of_a_gpu_match_plain_numpy(backend_of: Callable, dimension: int, knobs: dict) -> None:
    try:
        backend = backend_of("f32", 1, "vulkan")
    except InputError as error:
        pytest.skip(str(error))
    scene = scene_of(dimension, "f32", knobs)
    check_steps(scene, path_run.record_steps(prepare(scene, backend)), TOLERANCE["f32"])


@pytest.mark.parametrize(
    ("dimension", "knobs"), [slow(2, CUBIC), slow(2, AFLIP | CUBIC), slow(3, AFLIP | CUBIC)], ids=name_of
)
def test_bitwise_equal_for_any_number_of_threads(backend_of: Callable, dimension: int, knobs: dict) -> None:
    """State after 150 steps and many sorts: the tiles of a wider stencil are as disjoint when their colours run."""
    states = []
    for threads in (1, 2):
        run = prepare(scene_of(dimension, "f32", knobs), backend_of("f32", threads))
        orders = set()
        for _ in range(150):
            run.step(0.75 * path_run.STEP)
            orders.add(path_run.order_of(run))
        assert len(orders) > 5
        states.append(path_run.state(run))
    for name, value in states[0].items():
        assert np.array_equal(value, states[1][name]), name

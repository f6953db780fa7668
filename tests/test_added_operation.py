"""An operation on particles that is added to the solver, as docs/architecture.md says, wherever a scene runs."""

from collections.abc import Callable

import numpy as np
import pytest
from added_operation import Marker, fields_with_mark, raised
from scenes import block, scene_of
from test_batch import batch_of, outputs_of

from mpmcli.scene import Scene
from mpmcli.solver.engine import batch
from mpmcli.solver.engine.compiled_kind import CompiledKind
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.features import Features
from mpmcli.solver.particles import arrays
from mpmcli.solver.particles.loop import Operation, Pass

STEP, COUNT = 1e-3, 60
# Sorts follow each other by about ten steps.
FAST, FAR = 5.0, 144
JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e4, "poissons_ratio": 0.3}


class WithMarker(Features):
    """The features with a marker of each particle."""

    def __init__(self, kind: CompiledKind, backend: object, runs: int, *given: object) -> None:
        super().__init__(kind, backend, runs, *given)
        self.marker = Marker()


@pytest.fixture(autouse=True)
def added(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "Features", WithMarker)
    monkeypatch.setattr(arrays, "fields_of", fields_with_mark)


def thrown(speed: float = FAST, *, precision: str = "f64", **solver: object) -> Scene:
    """Return a block of FAR particles that hits a wall and a floor."""
    return scene_of(
        block("jelly", JELLY, [0.5, 0.12], [0.8, 0.42]) | {"velocity": [speed, -1.0]},
        domain={"size": [1.0, 1.0], "spacing": 0.05, "gravity": [0.0, -9.81]},
        time={"end": COUNT * STEP, "step": STEP},
        solver={"precision": precision} | solver,
    )


def marks(made: batch.Batch) -> np.ndarray:
    """Return the marks of the particles of each run, (runs, FAR), by id."""
    arrays = made.device.groups[0]
    ids, marked = (field.to_numpy().reshape(made.runs, -1)[:, :FAR] for field in (arrays.id, arrays.marked))
    return np.take_along_axis(marked, ids.argsort(axis=1), axis=1)


@pytest.mark.parametrize(
    ("arch", "threads", "solver"),
    [
        ("cpu", 1, {}),
        ("cpu", 2, {"grid": "sparse"}),
        pytest.param("vulkan", 1, {}, marks=pytest.mark.gpu),
        pytest.param("vulkan", 1, {"deterministic": True}, marks=pytest.mark.gpu),
    ],
    ids=["dense", "sparse", "gpu", "fixed point"],
)
def test_a_marker_follows_the_largest_rate(backend_of: Callable, arch: str, threads: int, solver: dict) -> None:
    """Each particle has the largest norm of its rate of strain after any step, also while sorts move it."""
    precision = "f64" if arch == "cpu" else "f32"
    run = build_run(thrown(precision=precision, **solver), backend_of(precision, threads, arch))
    largest = np.zeros(FAR)
    for _ in range(COUNT):
        run.step(STEP)
        found = run.groups[0].read()
        rate = np.linalg.norm(0.5 * (found["C"] + found["C"].transpose(0, 2, 1)), axis=(1, 2))
        largest[found["id"]] = np.maximum(largest[found["id"]], rate)
    assert run.particle_count == FAR and largest.min() < 1.0 and largest.max() > 50.0
    np.testing.assert_allclose(marks(run.batch)[0], largest, rtol=1e-12 if arch == "cpu" else 1e-5)
    saved = run.save().arrays
    np.testing.assert_array_equal(saved["neo_hookean.marked"], run.groups[0].arrays.marked.to_numpy())
    assert not np.array_equal(saved["neo_hookean.id"][:FAR], np.arange(FAR))


def test_runs_of_a_batch_have_markers_of_their_own(backend_of: Callable) -> None:
    """The bytes of each run alone."""
    scenes, backend = [thrown(), thrown(0.5 * FAST)], backend_of("f64", 1)
    alone = []
    for scene in scenes:
        made = batch_of([scene], backend)
        outputs_of(made, [scene])
        alone.append(marks(made)[0])
    together = batch_of(scenes, backend)
    outputs_of(together, scenes)
    np.testing.assert_array_equal(marks(together), alone)
    assert not np.array_equal(*alone)


def test_an_operation_writes_what_a_pass_gives() -> None:
    """A column whose name no pass gives would keep its values without a word."""
    keep = Pass(raised, {"marked": ()})
    with pytest.raises(ValueError, match="writes mark, which none of its passes gives"):
        Operation(reads=("C", "marked"), passes=(keep,), writes=("mark",))

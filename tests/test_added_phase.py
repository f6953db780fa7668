"""A feature that is added to the solver, as docs/architecture.md says: one file, and a line in a list of features."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from added_feature import Drag
from scenes import block, scene_of
from taichi.lang import kernel_impl

from mpmcli.scene import Scene
from mpmcli.solver.engine import batch
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.compiled_kind import CompiledKind
from mpmcli.solver.engine.plan import make_plan
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import Run, build_run, frames_of_all
from mpmcli.solver.features import Features

RATE, STEP, COUNT, STARTS = 20.0, 1e-3, 100, ([-1.0, 0.5], [1.0, 0.0])
JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e4, "poissons_ratio": 0.3}


class WithDrag(Features):
    """The features with the line that adds a drag; None stands for a kind of scenes without one."""

    has = True

    def __init__(self, kind: CompiledKind, backend: object, runs: int, *given: object) -> None:
        super().__init__(kind, backend, runs, *given)
        self.drag = Drag(runs) if self.has else None


@pytest.fixture(autouse=True)
def added(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "Features", WithDrag)


def flying(rate: float = RATE, *, precision: str = "f64", frames: int = 1, **more: dict) -> Scene:
    """Return two bodies that fly apart."""
    places = ("left", [0.3, 0.4], [0.5, 0.6]), ("right", [0.8, 0.4], [1.0, 0.6])
    return scene_of(
        *(block(name, JELLY, *box) | {"velocity": v} for (name, *box), v in zip(places, STARTS, strict=True)),
        title=f"drag {rate}",
        domain={"size": [1.4, 1.0], "spacing": 0.05, "gravity": [0.0, 0.0]},
        time={"end": 0.1, "frames": frames, "step": STEP},
        solver={"precision": precision} | more.get("solver", {}),
        **{name: table for name, table in more.items() if name != "solver"},
    )


def left(rate: float) -> float:
    """Return the share of the velocity after COUNT steps: of each 1 / (1 + c s kick), the first kick half a step."""
    kicks = np.array([STEP / 2] + [STEP] * (COUNT - 1))
    return float(np.prod(1 / (1 + rate * np.cumsum(kicks) * kicks)))


ARCHES = pytest.mark.parametrize(
    ("arch", "threads", "more"),
    [
        ("cpu", 1, {}),
        ("cpu", 3, {}),
        ("cpu", 2, {"solver": {"grid": "sparse"}}),
        ("cpu", 2, {"contact": {"default": "separate"}}),
        pytest.param("vulkan", 1, {}, marks=pytest.mark.gpu),
    ],
    ids=["one thread", "three threads", "sparse", "layers", "gpu"],
)


@ARCHES
def test_a_drag_slows_all_that_flies_and_goes_on_after_a_pause(
    backend_of: Callable, arch: str, threads: int, more: dict
) -> None:
    """By the formula; the ledger has the time that it has lasted; a run that was saved in between goes on alike."""
    precision = "f64" if arch == "cpu" else "f32"
    asked, backend = flying(precision=precision, **more), backend_of(precision, threads, arch)
    run = build_run(asked, backend)
    for k in range(COUNT):
        if k == COUNT // 2:
            saved = run.save().copied()
        run.step(STEP)
    frame, row = run.frame()
    for k, start in enumerate(STARTS):
        own = frame.velocity[frame.body == k].mean(axis=0)
        np.testing.assert_allclose(own, np.multiply(left(RATE), start), rtol=1e-5, atol=1e-6)
    assert row.contact_overlap == pytest.approx((COUNT - 0.5) * STEP, rel=1e-5)
    again = build_run(asked, backend)
    again.load(saved)
    for _ in range(COUNT // 2, COUNT):
        again.step(STEP)
    close = {} if arch == "cpu" else {"rtol": 1e-5, "atol": 1e-6}
    np.testing.assert_allclose(again.frame()[0].velocity, frame.velocity, **close or {"rtol": 0, "atol": 0})


def test_runs_of_a_batch_have_drags_of_their_own(backend_of: Callable) -> None:
    scenes = [flying(rate, frames=2) for rate in (RATE, 3 * RATE)]
    together = Batch(Resolved(scenes[0]).kind, backend_of("f64", 1), len(scenes))
    ends = {}
    for slot, event in frames_of_all({slot: Run(together, slot, scene) for slot, scene in enumerate(scenes)}):
        if event is not None:
            ends[slot] = event[0]
    for slot, rate in enumerate((RATE, 3 * RATE)):
        own = ends[slot].velocity[ends[slot].body == 1].mean(axis=0)
        np.testing.assert_allclose(own, np.multiply(left(rate), STARTS[1]), rtol=1e-5, atol=1e-6)


def test_it_is_planned_to_the_byte_and_absent_elsewhere(
    backend_of: Callable, monkeypatch: pytest.MonkeyPatch, own_kernels: None
) -> None:
    """Two numbers of a run and a pass of its step; without a drag nothing calls its function."""
    asked, backend, called, call = flying(), backend_of("f64", 1), set(), kernel_impl.Func.__call__

    def noted(self: kernel_impl.Func, *given: object, **named: object) -> object:
        called.add(self.func.__name__)
        return call(self, *given, **named)

    monkeypatch.setattr(kernel_impl.Func, "__call__", noted)
    plans = []
    for has in (False, True):
        monkeypatch.setattr(WithDrag, "has", has)
        plans.append(make_plan(asked, backend))
        build_run(asked, backend).step(STEP)
        assert ("update_massive" in called, "slow" in called) == (True, has)
    assert plans[1].device_bytes - plans[0].device_bytes == 2 * 8
    assert [b for a, b in pairwise(plans[1].passes) if a == "update grid"] == ["slow nodes"]
    assert tuple(name for name in plans[1].passes if name != "slow nodes") == plans[0].passes

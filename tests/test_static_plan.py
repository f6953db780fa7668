"""A scene without a feature has none of its fields, functions and kernels, in the plan and in what Taichi is given."""

import sys
from collections import Counter
from collections.abc import Callable

import pytest
from solver_state import scene_of
from taichi.lang import impl, kernel_impl

from mpmcli.scene import Scene
from mpmcli.solver.engine import build_engine
from mpmcli.solver.plan import make_plan

WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5}
# The modules whose fields, functions and kernels only a feature needs, and what it is called in the passes of the plan.
MODULES = {
    "colliders": {"boundaries.colliders", "boundaries.collider_motion", "boundaries.distances"},
    "friction": {"boundaries.wall_friction", "boundaries.rough_faces"},
    "emitters": {"solver.activity"},
    "forces": {"solver.expression_kernels", "solver.expression_functions", "solver.time_tables"},
    "moving walls": {"boundaries.moving_faces"},
    "periodic faces": {"solver.period"},
    # Not asked for by the scene with features either.
    "grids of distances": {"boundaries.grid_distance"},
    "means of volume": {"solver.volume_average"},
}


def scene(*, with_features: bool) -> Scene:
    """Return a pool, plain or with a collider, friction, an emitter, a force, a moving wall and periodic faces."""
    tables = {
        "domain": {"size": [1.0, 1.0], "spacing": 0.1, "gravity": [0.0, -9.81], "walls": "separate"},
        "time": {"end": 1.0, "frames": 1, "step": 1e-4},
        "bodies": [
            {"name": "pool", "material": WATER, "shape": {"box": {"min": [0.0, 0.0], "max": [1.0, 0.4]}}},
        ],
    }
    if with_features:
        tables["domain"] |= {
            "walls": {"default": "separate", "x_min": "periodic", "x_max": "periodic"},
            "friction": {"y_min": 0.3},
            "wall_velocity": {"y_min": [0.1, 0.0]},
        }
        ball = {"ball": {"center": [0.3, 0.6], "radius": 0.15}}
        tables["colliders"] = [{"name": "ball", "shape": ball, "velocity": ["t", 0.0]}]
        mouth = {"ball": {"center": [0.75, 0.75], "radius": 0.1}}
        tables["emitters"] = [{"name": "jet", "material": WATER, "shape": mouth, "velocity": [0.0, -1.0]}]
        tables["forces"] = [{"acceleration": ["x * sin(t)", 0.0]}]
    return scene_of(**tables)


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> Counter:
    """How many functions, kernels and fields Taichi was given, by word and module of mpmcli."""
    found = Counter()
    call, materialize, make = kernel_impl.Func.__call__, kernel_impl.Kernel.materialize, impl.create_field_member

    def name(module: str) -> str:
        return module.removeprefix("mpmcli.")

    def called(self: kernel_impl.Func, *arguments: object, **named: object) -> object:
        found["function", name(self.func.__module__)] += 1
        return call(self, *arguments, **named)

    def compiled(self: kernel_impl.Kernel, *arguments: object, **named: object) -> None:
        before = len(self.compiled_kernels)
        materialize(self, *arguments, **named)
        found["kernel", name(self.func.__module__)] += len(self.compiled_kernels) - before

    def made(*arguments: object, **named: object) -> object:
        frame = sys._getframe(1)
        while not frame.f_globals["__name__"].startswith("mpmcli."):
            frame = frame.f_back
        found["field", name(frame.f_globals["__name__"])] += 1
        return make(*arguments, **named)

    monkeypatch.setattr(kernel_impl.Func, "__call__", called)
    monkeypatch.setattr(kernel_impl.Kernel, "materialize", compiled)
    monkeypatch.setattr(impl, "create_field_member", made)
    return found


def step(asked: Scene, backend: object, *, batched: bool) -> object:
    """Take a step and read a frame, and return the engine."""
    engine = build_engine(asked, backend, batched=batched)
    engine.begin()
    engine.advance(1)
    engine.frame()
    return engine


def modules(found: Counter) -> set[str]:
    return {module for _, module in found}


@pytest.mark.parametrize("batched", [True, False], ids=["batch", "solver"])
def test_a_plain_scene_has_nothing_of_features(backend_of: Callable, given: Counter, batched: bool) -> None:
    """No field, function or kernel of theirs; and no more kernels than a step, a sort, a frame and a start need."""
    plain, backend = scene(with_features=False), backend_of("f32", 1)
    plan = make_plan(plain, backend)
    assert plan.passes == ("clear grid", "scatter fluid", "find contact", "update grid", "gather fluid")
    assert plan.laws[0].fields.keys() == {"position", "velocity", "velocity_gradient", "volume_ratio", "id"}
    engine = step(plain, backend, batched=batched)
    # What is counted is not blind to what there is.
    assert {("field", "solver.grid"), ("function", "boundaries.walls")} <= given.keys()
    assert modules(given).isdisjoint(set().union(*MODULES.values()))
    kernels = {module: count for (what, module), count in given.items() if what == "kernel" and "." in module}
    kernels.pop("taichi._kernels", None)
    if batched:
        assert kernels == {"solver.batch_kernel": 1, "solver.particle_exchange": 1}
        kind, device = engine.batch.kind, engine.batch.device
        assert (kind.rough, kind.moving, kind.colliders.count, kind.comings.any) == ((), (), 0, False)
        assert (device.colliders, device.motion, engine.batch.pushes) == (None, None, [None])
        assert (device.friction.faces, device.moving.faces, device.emission) == ((), (), None)
    else:
        assert sum(kernels.values()) == 11


@pytest.mark.slow
@pytest.mark.parametrize("batched", [True, False], ids=["batch", "solver"])
def test_a_scene_with_features_has_their_modules(backend_of: Callable, given: Counter, batched: bool) -> None:
    """So that the names above are those of what features need; grids and means stay out."""
    asked, backend = scene(with_features=True), backend_of("f32", 1)
    plan = make_plan(asked, backend)
    assert {"scatter fluid with forces", "find friction", "update grid with colliders"} <= set(plan.passes)
    assert "activity" in plan.laws[0].fields
    step(asked, backend, batched=batched)
    for feature, own in MODULES.items():
        found = modules(given) & own
        if feature in ("grids of distances", "means of volume"):
            assert not found
        else:
            assert found == own - (set() if batched else {"solver.time_tables"})

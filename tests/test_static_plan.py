"""A scene without a feature has none of its fields, functions and kernels, in the plan and in what Taichi is given."""

import sys
from collections import Counter
from collections.abc import Callable

import pytest
from scenes import block, body, scene_of
from taichi.lang import impl, kernel_impl

from mpmcli.scene import Scene
from mpmcli.solver.engine.plan import make_plan
from mpmcli.solver.engine.run import Run, build_run

WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5}
# The modules, classes or functions that only a feature needs, and what it is called in the passes of the plan.
MODULES = {
    "colliders": {"boundaries.colliders", "boundaries.colliders.ColliderMotion", "boundaries.distances"},
    "friction": {"boundaries.mirror_images.find_friction", "boundaries.walls.RoughFaces"},
    "emitters": {"solver.particles.inflow"},
    "forces": {"solver.drive.expressions.TimeTables", "solver.drive.forces.GroupForce"},
    "moving walls": {"boundaries.walls.MovingFaces"},
    "periodic faces": {"solver.grid.period.Period"},
    "shifts": {"solver.grid.fine_grid.FineGrid", "solver.transfer.redistribution.fill_fine"},
    "bodies that separate": {f"solver.contact.{name}" for name in ("body_contact", "shared_field", "surfaces")},
    # Not asked for by the scene with features either.
    "grids of distances": {"boundaries.distances.GridDistance"},
    "means of volume": {f"solver.transfer.volume.{name}" for name in ("cell_of", "add_volume", "average_for_frame")},
}


def scene(*, with_features: bool) -> Scene:
    """Return a pool, plain or with a collider, friction, an emitter, a force, a moving wall and periodic faces."""
    tables = {
        "domain": {"size": [1.0, 1.0], "spacing": 0.1, "gravity": [0.0, -9.81], "walls": "separate"},
        "time": {"end": 1.0, "frames": 1, "step": 1e-4},
        "bodies": [block("pool", WATER, [0.0, 0.0], [1.0, 0.4])],
    }
    if not with_features:
        tables["solver"] = {"redistribute": False}
    else:
        tables["domain"] |= {
            "walls": {"default": "separate", "x_min": "periodic", "x_max": "periodic"},
            "friction": {"y_min": 0.3},
            "wall_velocity": {"y_min": [0.1, 0.0]},
        }
        ball = {"ball": {"center": [0.3, 0.6], "radius": 0.15}}
        tables["colliders"] = [{"name": "ball", "shape": ball, "velocity": ["t", 0.0]}]
        mouth = {"ball": {"center": [0.75, 0.75], "radius": 0.1}}
        tables["emitters"] = [body("jet", WATER, mouth, velocity=[0.0, -1.0])]
        tables["forces"] = [{"acceleration": ["x * sin(t)", 0.0]}]
    return scene_of(**tables)


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> Counter:
    """How many functions, kernels and fields Taichi was given, by word and place in mpmcli, of kernels the module."""
    found = Counter()
    call, materialize, make = kernel_impl.Func.__call__, kernel_impl.Kernel.materialize, impl.create_field_member

    def name(module: str) -> str:
        return module.removeprefix("mpmcli.")

    def called(self: kernel_impl.Func, *arguments: object, **named: object) -> object:
        found["function", name(f"{self.func.__module__}.{self.func.__qualname__}")] += 1
        return call(self, *arguments, **named)

    def compiled(self: kernel_impl.Kernel, *arguments: object, **named: object) -> None:
        before = len(self.compiled_kernels)
        materialize(self, *arguments, **named)
        found["kernel", name(self.func.__module__)] += len(self.compiled_kernels) - before

    def made(*arguments: object, **named: object) -> object:
        frame = sys._getframe(1)
        while not frame.f_globals["__name__"].startswith("mpmcli."):
            frame = frame.f_back
        found["field", name(f"{frame.f_globals['__name__']}.{frame.f_code.co_qualname}")] += 1
        return make(*arguments, **named)

    monkeypatch.setattr(kernel_impl.Func, "__call__", called)
    monkeypatch.setattr(kernel_impl.Kernel, "materialize", compiled)
    monkeypatch.setattr(impl, "create_field_member", made)
    return found


def step(asked: Scene, backend: object) -> Run:
    """Take a step and read a frame, and return the run."""
    run = build_run(asked, backend)
    run.begin()
    run.advance(1)
    run.frame()
    return run


def among(found: Counter, places: set[str]) -> set[str]:
    """Return those places that something was found in."""
    return {place for place in places if any(f"{name}.".startswith(f"{place}.") for _, name in found)}


def test_a_plain_scene_has_nothing_of_features(backend_of: Callable, given: Counter, own_kernels: None) -> None:
    """No field, function or kernel of theirs; and no more kernels than one, and two that fill the device."""
    plain, backend = scene(with_features=False), backend_of("f32", 1)
    plan = make_plan(plain, backend)
    assert plan.passes == ("clear grid", "scatter fluid", "find contact", "update grid", "gather fluid")
    assert plan.laws[0].fields.keys() == {"position", "velocity", "velocity_gradient", "volume_ratio", "borne", "id"}
    run = step(plain, backend)
    # What is counted is not blind to what there is.
    for word, place in (("field", "solver.grid."), ("function", "boundaries.walls.")):
        assert any(what == word and name.startswith(place) for what, name in given)
    assert not among(given, set().union(*MODULES.values()))
    kernels = {module: count for (what, module), count in given.items() if what == "kernel" and "." in module}
    kernels.pop("taichi._kernels", None)
    assert kernels == {"solver.engine.cpu_launch": 1, "solver.particles.arrays": 1, "boundaries.rows": 1}
    kind, features = run.batch.kind, run.batch.device.features
    assert (kind.rough, kind.moving, kind.colliders.count, kind.inflow.any) == ((), (), 0, False)
    assert (features.colliders, features.motion, run.batch.pushes) == (None, None, [None])
    assert (features.friction.faces, features.moving.faces, features.emission) == ((), (), None)


@pytest.mark.slow
def test_a_scene_with_features_has_their_modules(backend_of: Callable, given: Counter, own_kernels: None) -> None:
    """So that the names above are those of what features need; grids and means stay out."""
    asked, backend = scene(with_features=True), backend_of("f32", 1)
    plan = make_plan(asked, backend)
    assert {"scatter fluid with forces", "find friction", "update grid with colliders"} <= set(plan.passes)
    assert "activity" in plan.laws[0].fields
    step(asked, backend)
    for feature, own in MODULES.items():
        found = among(given, own)
        if feature in ("bodies that separate", "grids of distances", "means of volume"):
            assert not found
        else:
            assert found == own

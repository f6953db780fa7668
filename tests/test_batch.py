"""Runs of a batch have the bytes that they have alone, in a batch of one: any law and wall, any number of threads."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import state_run
from conftest import GPU
from rounding import farthest
from scenes import ball, block, box, plane, polygon, scene_of, slow
from solver_state import with_colliders
from tiny_sweep import tiny_sweep

from mpmcli.dataset.compute import Task, compute
from mpmcli.errors import MpmcliError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import Scene
from mpmcli.solver.engine import run as engine_run
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.compiled_kind import CompiledKind
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import Run, build_run, frames_of_all
from mpmcli.solver.frames.diagnosis import UnstableRunError

# By name: materials, dimension, and further tables of the scene.
DRIVEN = ("gravity of time", "a force of the place", "forces on one body of two")
# What falls along x enters again at the other face.
REPEATING = {"walls": {"default": "separate", "x_min": "periodic", "x_max": "periodic"}, "gravity": [-100.0, -9.81]}
DOUBLY_REPEATING = {
    "walls": {"default": "periodic", "y_min": "separate", "y_max": "separate"},
    "gravity": [-100.0, -9.81, 50.0],
}
SCENES = (
    {name: ((name,), 2, {}) for name in state_run.MATERIALS}
    | {
        "two laws, two bodies of one": (("sand", "fluid", "sand"), 2, {}),
        "3D, two laws": (("snow", "fluid"), 3, {}),
        "3D, AFLIP": (("snow",), 3, {"solver": {"transfer": "aflip", "flip": 0.9}}),
        "cubic splines, f64": (("neo_hookean",), 2, {"solver": {"kernel": "cubic", "precision": "f64"}}),
        "rough walls": (("neo_hookean",), 2, {"domain": {"walls": {"default": "separate", "y_min": "slip"}}}),
        "rough walls, 3D, AFLIP": (("snow",), 3, {"solver": {"transfer": "aflip"}}),
        "rough walls, total": (("neo_hookean",), 2, {"solver": {"solids": "total"}}),
        "periodic, a wall moves": (("fluid",), 2, {"domain": REPEATING}),
        "periodic, a wall moves, AFLIP": (("sand",), 2, {"domain": REPEATING, "solver": {"transfer": "aflip"}}),
        "periodic, 3D, f_bar": (("neo_hookean",), 3, {"domain": DOUBLY_REPEATING, "solver": {"f_bar": True}}),
        "colliders": (("sand",), 2, {"colliders": True}),
        "colliders, 3D": (("neo_hookean",), 3, {"colliders": True}),
        "contact": (("neo_hookean", "fixed_corotated", "fluid", "snow"), 2, {"contact": 0.3, "colliders": True}),
        "rigid bodies": (("sand",), 2, {"rigid": True}),
        "rigid bodies, 3D": (("sand",), 3, {"rigid": True}),
        "slip and stick": (("sand",), 2, {"domain": {"walls": {"default": "slip", "y_min": "stick"}}}),
    }
    | dict.fromkeys(DRIVEN)
)


def driven(k: int) -> dict[str, tuple]:
    """Return materials, gravity and forces by name, with numbers that depend on k."""
    gravity = [f"{k} * sin(40 * t)", f"-9.81 * {k} - (3000 if t % 0.03 < {0.0005 * k} else 0)"]
    everywhere = [f"-{50 * k} * (x - 0.{3 + k})", f"{9 * k} * cos(30 * t) if x > {0.1 * k} else {k}"]
    swirl = [f"{20 * k} * (Y - 0.3)", f"-{20 * k} * (X - x) * (1 if t < {0.02 * k} else 0.5)**2"]
    return {
        "gravity of time": (("fluid",), gravity, []),
        "a force of the place": (("neo_hookean",), [0.0, -9.81], [(None, everywhere)]),
        "forces on one body of two": (("snow", "snow"), gravity, [("body 1", swirl), (None, everywhere)]),
    }


def colliders(dimension: int, k: int) -> list[dict]:
    """Return colliders at rest and moving, with numbers that depend on k, and one more in the first run."""
    pad = [0.5] * (dimension - 2)
    found = [
        {"shape": plane([0.0, 0.05, *pad], [0.1 * k, 1.0, *pad]), "friction": 0.2 * k},
        {"shape": box([0.4, 0.2, 0.4][:dimension], [0.5, 0.3, 0.6][:dimension])},
        {"shape": ball([0.2, 0.1, *pad], 0.04 * k), "wall": "stick"},
        {"shape": {"capsule": {"start": [0.6, 0.1, *pad], "end": [0.7, 0.2, *pad], "radius": 0.05}}, "wall": "slip"},
    ]
    found[1] |= {"angular_velocity": f"{9 * k} * cos(30 * t)", "velocity": [0.5 * k, *[0.0] * (dimension - 1)]}
    if dimension == 2:
        found.append({"shape": polygon([[0.1, 0.3], [0.2, 0.3], [0.12, 0.35]])})
    else:
        found[1] |= {"axis": [1.0, 2.0 * k, 0.5]}
        base = {"base": [0.3, 0.1, 0.5], "axis": [1.0, 0.0, 1.0], "radius": 0.06, "height": 0.1 * k}
        found.append({"shape": {"cylinder": base}})
    return [{"name": f"collider {n}", **table} for n, table in enumerate(found[: 5 - (k == 2)])]


def rigid(dimension: int, k: int) -> list[dict]:
    """Return rigid bodies that fall into the material and onto each other, beside a post, with numbers of k."""
    low, high = [0.3, 0.45, 0.4][:dimension], [0.5, 0.45 + 0.1 * k, 0.6][:dimension]
    speed = {"velocity": [0.0, -3.0 * k, 0.0][:dimension], "angular_velocity": 2.0 * k, "friction": 0.2 * k}
    found = [
        {"shape": box(low, high), "density": 300.0 * k, **speed},
        {"shape": ball([0.6, 0.5, 0.5][:dimension], 0.05), "wall": "slip"},
        {"shape": ball([0.42, 0.75, 0.5][:dimension], 0.08), "density": 900.0, **speed},
    ]
    # A flap on a hinge, whose motor has other numbers.
    flap = box([0.75, 0.3, 0.4][:dimension], [0.8, 0.6, 0.6][:dimension])
    joint = {"type": "hinge", "point": [0.77, 0.3, 0.5][:dimension], "motor": f"{5 * k} * t", "strength": 20.0 * k}
    found.append({"shape": flap, "density": 500.0, "joint": joint, "restitution": 0.2 * k})
    return [{"name": f"body {n}", **table} for n, table in enumerate(found)]


# In the default suite, with the runs that are repeated alone: the second is smaller than what the batch has room for.
# All others, and the first runs of these, carry the marker slow.
USUAL = {"two laws, two bodies of one": (1,), "rigid bodies": (1,)}
Output = list[tuple[Frame, LedgerRow]]


def scene_named(name: str, other: bool = False) -> Scene:
    """Return blocks that hit a floor; the `other` one has other cells, parameters, gravity, sizes and times."""
    if name in DRIVEN:
        materials, gravity, forces = driven(1 + other)[name]
        d, more = 2, {"domain": {"gravity": gravity, "origin": [-0.1 * other, -0.02]}}
    else:
        (materials, d, more), forces = SCENES[name], []
    width = 0.8 / len(materials)
    bodies = [
        block(
            f"body {k}",
            state_run.MATERIALS[law] | ({"density": 700.0 + 100 * k} if other else {}),
            [0.1 + width * k, 0.02, 0.3][:d],
            [0.1 + width * (k + (0.7 if other else 0.8)), 0.3 if other else 0.4, 0.6][:d],
            velocity=[1.0 - other, -2.0, 0.5][:d],
        )
        for k, law in enumerate(materials)
    ]
    cells = (17 if other else 20) if d == 2 else (11 if other else 12)
    rough = {"friction": {"y_min": 0.4 - 0.1 * other, "x_max": 0.3 + 0.1 * other}}
    rough = rough if "rough" in name or "contact" in more else {}
    if "a wall moves" in name:
        rough = {"friction": {"y_min": 0.4 - 0.1 * other}, "wall_velocity": {"y_min": [2.0 + other, 0.0]}}
    domain = {"size": [1.0] * d, "cells": [cells] * d, "gravity": [0.5 * other, -9.81, 0.0][:d]}
    contact = {"default": "separate", "friction": more["contact"] + 0.1 * other} if "contact" in more else None
    scene = scene_of(
        *bodies,
        domain=domain | more.get("domain", {}) | rough,
        time={"end": 0.05 if other else 0.06, "frames": 3, "safety": 0.7 if other else 0.8},
        fields=["velocity", "stress", "volume_ratio", "deformation_gradient"],
        forces=[{"acceleration": a} | ({"body": body} if body else {}) for body, a in forces],
        solver=more.get("solver", {}),
        contact=contact or {"default": "stick"},
    )
    # They stand in the material, where they meet it at once.
    made = colliders if more.get("colliders") else rigid if more.get("rigid") else lambda *_: []
    return with_colliders(scene, made(d, 1 + other))


def batch_of(scenes: Sequence[Scene], backend: object) -> Batch:
    """Return a batch with room for one run of each scene."""
    kinds = [Resolved(scene).kind for scene in scenes]
    kind = kinds[0]
    for more in kinds[1:]:
        kind = kind.joined(more)
    return Batch(kind, backend, len(scenes))


def outputs_of(batch: Batch, scenes: Sequence[Scene]) -> list[Output | MpmcliError]:
    """Run a scene in each place of a batch, all at once; a run that stops gives its error."""
    found: list = [[] for _ in scenes]
    for slot, event in frames_of_all({slot: Run(batch, slot, scene) for slot, scene in enumerate(scenes)}):
        if isinstance(event, Exception):
            found[slot] = event
        elif event is not None:
            found[slot].append(event)
    return found


def same(found: Output, expected: Output) -> Iterator[str]:
    """Yield what two outputs differ in."""
    if len(found) != len(expected):
        yield f"{len(found)} frames for {len(expected)}"
    for (frame, row), (other, other_row) in zip(found, expected, strict=False):
        if row != other_row or (frame.time, frame.step) != (other.time, other.step):
            yield f"row {frame.index}: {row} for {other_row}"
        arrays = {"position": (frame.position, other.position), "velocity": (frame.velocity, other.velocity)}
        arrays |= {"body": (frame.body, other.body), "material": (frame.material, other.material)}
        arrays |= {field: (frame.fields[field], other.fields[field]) for field in other.fields}
        yield from (
            f"{field} {frame.index}" for field, pair in arrays.items() if pair[0].tobytes() != pair[1].tobytes()
        )


@pytest.mark.parametrize(
    ("name", "compared"),
    [*USUAL.items(), *(slow(name, (0, 1)) for name in SCENES if USUAL.get(name) != (0, 1))],
    ids=lambda value: value if isinstance(value, str) else " and ".join(["first", "second"][k] for k in value),
)
def test_runs_have_the_bytes_that_they_have_alone(backend_of: Callable, name: str, compared: tuple[int, ...]) -> None:
    """Two runs in which all numbers differ."""
    scenes = [scene_named(name), scene_named(name, other=True)]
    backend = backend_of(scenes[0].solver.precision, 1)
    found = outputs_of(batch_of(scenes, backend), scenes)
    for k in compared:
        expected = list(build_run(scenes[k], backend).frames())
        assert expected[-1][1].steps >= 5
        assert list(same(found[k], expected)) == []


@pytest.mark.parametrize("name", ["sand", *(slow(n) for n in ("two laws, two bodies of one", "3D, AFLIP"))])
def test_threads_share_no_memory(backend_of: Callable, name: str) -> None:
    """Many runs at once on three threads, again and again, have the bytes that they have on one."""
    scenes = [scene_named(name, other=k % 2 == 1) for k in range(7)]
    truth = outputs_of(batch_of(scenes[:2], backend := backend_of("f32", 1)), scenes[:2])
    batch = batch_of(scenes, backend_of("f32", 3))
    assert batch.backend.threads == 3 != backend.threads
    for _ in range(5):
        for k, outcome in enumerate(outputs_of(batch, scenes)):
            assert list(same(outcome, truth[k % 2])) == []


@pytest.mark.parametrize("name", ["sand", *(slow(n) for n in SCENES if n != "sand" and n not in DRIVEN)])
def test_threads_that_share_a_run_change_no_byte(backend_of: Callable, name: str) -> None:
    """One run on more threads than there are cores, again and again: any thread may do any part, at any time."""
    # The kernels of the two runs serve other tests, too.
    scenes = [scene_named(name), scene := scene_named(name, other=True)]
    _, truth = outputs_of(batch_of(scenes, backend_of(scene.solver.precision, 1)), scenes)
    batch = batch_of([scene], backend_of(scene.solver.precision, 5))
    for _ in range(5):
        (found,) = outputs_of(batch, [scene])
        assert list(same(found, truth)) == []


def test_a_place_is_used_again(backend_of: Callable) -> None:
    """A run leaves nothing behind in its place, one that became unstable included."""
    backend = backend_of("f32", 1)
    first, second = scene_named("sand"), scene_named("sand", other=True)
    batch = batch_of([first, second], backend)
    fresh = outputs_of(batch, [first, second])
    again = outputs_of(batch, [second, first])
    assert list(same(again[0], fresh[1])) == list(same(again[1], fresh[0])) == []


@pytest.mark.parametrize("arch", ["cpu", pytest.param("vulkan", marks=[pytest.mark.gpu, pytest.mark.slow])])
def test_an_unstable_run_stops_alone(backend_of: Callable, arch: str) -> None:
    """It says what it says alone, and the others and the next in its place go on; on the CPU with the same bytes."""
    sound = scene_named("neo_hookean")
    time = sound.time.model_copy(update={"step": 0.004, "end": 0.4})
    wild = sound.model_copy(update={"time": time})
    batch = batch_of([sound, wild], backend_of("f32", 1, arch))
    runs = [Run(batch, 0, sound), Run(batch, 1, wild, force=True)]
    found, errors = [[], []], [None, None]
    for slot, event in frames_of_all(dict(enumerate(runs))):
        if isinstance(event, tuple):
            found[slot].append(event)
        elif event is not None:
            errors[slot] = event
    assert errors[0] is None and [frame.index for frame, _ in found[0]] == [0, 1, 2, 3]
    assert isinstance(errors[1], UnstableRunError) and "the run became unstable at step" in str(errors[1])
    again = outputs_of(batch, [wild.model_copy(update={"time": sound.time}), sound])
    assert [len(outcome) for outcome in again] == [4, 4]
    if arch != "cpu":
        return
    assert list(same(again[1], found[0])) == []
    # A fresh backend numbers its fields from 0, and finds the kernels that it has compiled before.
    alone = build_run(wild, backend_of("f32", 1), force=True)
    expected = []
    with pytest.raises(UnstableRunError) as caught:
        expected.extend(alone.frames())
    assert str(errors[1]) == str(caught.value)
    assert list(same(found[0], list(build_run(sound, backend_of("f32", 1)).frames()))) == []


def test_what_is_compiled_decides_on_the_kind() -> None:
    def kind_of(name: str, **changes: object) -> CompiledKind:
        scene = scene_named(name).model_copy(update=changes)
        return Resolved(scene).kind

    wide = kind_of("sand").joined(Resolved(scene_named("sand", other=True)).kind)
    assert wide.cells == (20, 20)
    assert wide.particles == kind_of("sand").particles
    assert kind_of("sand").joined(kind_of("fluid")) is None
    assert kind_of("sand").joined(kind_of("slip and stick")) is None
    assert kind_of("sand").joined(kind_of("two laws, two bodies of one")) is None


def test_kinds_are_equal_where_flags_are() -> None:
    """Numbers of a material are data; a term that a law leaves out is compiled."""
    fluid = scene_named("fluid")
    thin = fluid.bodies[0].material.model_copy(update={"viscosity": 0.1})
    dry = fluid.bodies[0].material.model_copy(update={"viscosity": 0.0})

    def kind_with(material: object) -> CompiledKind:
        scene = fluid.model_copy(update={"bodies": (fluid.bodies[0].model_copy(update={"material": material}),)})
        return Resolved(scene).kind

    assert kind_with(thin).joined(Resolved(fluid).kind) is not None
    assert kind_with(dry).joined(Resolved(fluid).kind) is None


def test_frames_stop_on_request(backend_of: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between two launches, after the frames that were recorded until then."""
    monkeypatch.setattr(engine_run, "FIRST", 1)
    monkeypatch.setattr(engine_run, "LAUNCH", 0.0)
    scene = scene_named("sand")
    run = Run(batch_of([scene, scene_named("sand", other=True)], backend_of("f32", 1)), 0, scene)
    frames = run.frames(stop=lambda: run.step_count > 0)
    next(frames)
    with pytest.raises(KeyboardInterrupt):
        list(frames)
    assert np.isfinite(run.frame(1)[0].position).all()


def test_no_frame_shows_a_particle_without_volume(backend_of: Callable) -> None:
    """The step that crushed it cannot tell, and the next one comes after the frame."""
    scene = scene_named("sand")
    backend = backend_of("f32", 1)
    run = build_run(scene, backend)
    assert run.frame()[1].volume_ratio_min > 0.9
    run.groups[0].arrays.displacement_gradient[5][0, 0] = -1.0
    with pytest.raises(UnstableRunError, match="was inverted"):
        run.frame()


# Two kinds of one law; sand, walls and friction are in the one that is left.
SLOW_ON_A_GPU = (
    "rough walls", "colliders, 3D", "a force of the place", "neo_hookean", "rough walls, 3D, AFLIP",
    "rough walls, total", "periodic, a wall moves", "periodic, a wall moves, AFLIP", "periodic, 3D, f_bar",
    "two laws, two bodies of one", "3D, AFLIP", "forces on one body of two",
)  # fmt: skip


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["colliders", *(slow(n) for n in SLOW_ON_A_GPU)])
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


@pytest.mark.gpu
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

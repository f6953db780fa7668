"""What a check says that a run will take, against what runs take."""

import gc
import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import taichi as ti
from check_scenes import FLUID, box, check, loaded
from command import SCENE, run_here

from mpmcli.check.facts import SceneFacts
from mpmcli.check.forecast import expected_steps, layout_of, packed_bytes, series_bytes, steps_at, wave_loss
from mpmcli.check.scene_check import check_scene
from mpmcli.output import SegmentStore
from mpmcli.output.layout import FrameLayout
from mpmcli.output.series import write_series
from mpmcli.scene import scene_to_toml
from mpmcli.scene.schema import SolverSettings
from mpmcli.solver.engine.plan import make_plan
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.frames.diagnosis import Diagnosis, UnstableRunError
from mpmcli.solver.particles.sort import entry_count

SAND = {"law": "sand", "density": 1600.0, "youngs_modulus": 1e7, "friction_angle": 30.0}
# The kernels of these scenes are those of test_hard_materials.py.
SMALL = {"cells": [16, 16], "walls": "separate"}
SPACE = {"size": [1.0, 1.0, 1.0], "cells": [16, 16, 16], "gravity": [0.0, 0.0, -10.0], "walls": "separate"}
EVERYTHING = [
    "velocity",
    "density",
    "pressure",
    "volume_ratio",
    "deformation_gradient",
    "affine",
    "stress",
    "mass",
    "plastic_volume_strain",
]


def two_bodies() -> list[dict]:
    """Return a block of sand and one of fluid."""
    shapes = (box([0.0, 0.0], [0.25, 0.25]), box([0.5, 0.0], [0.75, 0.5]))
    pairs = zip(("sand", "fluid"), (SAND, FLUID), shapes, strict=True)
    return [{"name": name, "material": material, "shape": shape} for name, material, shape in pairs]


CASES = {
    "fluid": lambda: loaded(domain=SMALL, shape=box([0.0, 0.0], [1.0, 1.0]), time={"end": 8e-3, "frames": 4}),
    "mixed": lambda: loaded(
        two_bodies(), time={"end": 1e-3, "frames": 3}, solver={"precision": "f64"}, output={"fields": EVERYTHING}
    ),
    "space": lambda: loaded(
        domain=SPACE,
        shape={"ball": {"center": [0.5, 0.5, 0.4], "radius": 0.3}},
        time={"end": 2e-3, "frames": 2},
        output={"fields": ["velocity", "stress"]},
    ),
}


def fields() -> list[ti.Field]:
    """Return every Taichi field that Python still holds, those of backends that have ended among them."""
    gc.collect()
    return [one for one in gc.get_objects() if isinstance(one, ti.Field)]


def bytes_of(field: ti.Field) -> int:
    """Return the bytes that the entries of a field take; Taichi packs them densely."""
    return {ti.f32: 4, ti.i32: 4, ti.f64: 8, ti.i64: 8}[field.dtype] * entry_count(field) * math.prod(field.shape)


@pytest.mark.parametrize(
    ("case", "threads"),
    [("fluid", 1), *(pytest.param(case, 2, marks=pytest.mark.slow) for case in ("fluid", "mixed", "space"))],
)
def test_a_run_takes_what_was_forecast(backend_of: Callable, tmp_path: Path, case: str, threads: int) -> None:
    """Memory of all fields, packed file and .vtu series within 5 % (the issue asks for 10), steps to within 2."""
    scene = CASES[case]()
    backend = backend_of(scene.scene.solver.precision, threads)
    checked = check_scene(scene, plan=make_plan(scene.scene, backend))
    forecast = checked.forecast
    before = fields()
    run = build_run(scene.scene, backend)
    frames = run.frames()
    first = next(frames)
    known = {id(field) for field in before}
    taken = sum(bytes_of(field) for field in fields() if id(field) not in known and field.snode.ptr is not None)
    assert forecast.device_bytes == pytest.approx(taken, rel=0.05)

    header = {"scene": scene_to_toml(scene.scene), "bodies": [], "materials": []}
    store = SegmentStore(tmp_path, header)
    written = [first, *frames]
    for frame, row in written:
        store.write(frame, row)
    assert layout_of(scene.scene) == FrameLayout.of(written[0][0])
    assert forecast.frames == len(written)
    assert forecast.steps == pytest.approx(run.step_count, abs=2)
    low, high = forecast.steps_range
    assert low <= run.step_count <= high
    assert forecast.file_bytes == pytest.approx(store.finish().stat().st_size, rel=0.05)
    write_series(tmp_path, [])
    series = sum(path.stat().st_size for path in tmp_path.glob("*.vtu"))
    assert forecast.vtk_bytes == pytest.approx(series, rel=0.05)


def test_the_layout_is_that_of_a_frame(backend_of: Callable) -> None:
    """Every output field there is, and positions far from zero, which are stored in double precision."""
    shape, domain = box([1e5, 0.0], [1e5 + 0.25, 0.25]), SMALL | {"origin": [1e5, 0.0]}
    scene = loaded(material=SAND, shape=shape, domain=domain, output={"fields": EVERYTHING}).scene
    frame, _ = build_run(scene, backend_of("f32", 1)).frame()
    assert layout_of(scene) == FrameLayout.of(frame)
    assert layout_of(scene).arrays["Points"].dtype == "float64"


def test_sizes_grow_with_frames_and_particles() -> None:
    """By the bytes of a frame; the list of point numbers, 8 bytes, is there once."""
    scene = loaded(time={"frames": 10}).scene
    more = loaded(time={"frames": 20}).scene
    each = layout_of(scene).bytes_per_particle
    # In the series each particle is a cell, too: number, offset and type, 8 bytes each, and all of it in base64.
    for size, per_particle in ((packed_bytes, each), (series_bytes, (each + 24) * 4 / 3)):
        grown = (size(more, 100_000) - size(scene, 100_000)) / 10
        assert grown == pytest.approx(100_000 * per_particle, rel=1e-3)
    assert packed_bytes(scene, 2000) - packed_bytes(scene, 1000) == 1000 * (11 * each + 8)


def test_steps_are_those_of_rest_until_something_is_hit() -> None:
    """A snowball in flight, thrown at a wall: the steps of rest up to there, and those of hard snow after it."""
    snow = {"law": "snow", "density": 400.0, "hardening_limit": 10.0}
    weightless = {"gravity": [0.0, 0.0]}

    def facts(x: float) -> SceneFacts:
        shape = box([x, 0.25], [x + 0.25, 0.5])
        scene = loaded(material=snow, domain=weightless, shape=shape, velocity=[10.0, 0.0], time={"end": 0.1})
        return SceneFacts(scene.scene)

    near, far = facts(0.74), facts(0.25)
    assert expected_steps(near) == steps_at(near, near.step)
    free = (0.5 - 1 / 64) / 10 / 0.1
    before, after = steps_at(far, far.step_at_start), steps_at(far, far.step)
    assert expected_steps(far) == pytest.approx(free * before + (1 - free) * after, rel=0.01)
    assert after > 2.5 * before
    gone = loaded(material=snow, domain=weightless, shape=box([0.25, 0.25], [0.5, 0.5]), velocity=[1e-3, 0.0])
    assert check_scene(gone).forecast.steps == check_scene(gone).forecast.steps_range[0]


def test_the_frames_and_the_asked_step_are_heeded() -> None:
    """Equal steps end on each frame, and none is larger than time.step."""
    checked = check(time={"end": 1.0, "frames": 7, "step": 1e-4})
    assert checked.forecast.steps == 7 * math.ceil(1 / 7 / 1e-4)
    assert check(time={"end": 1e-4, "frames": 10}).forecast.steps == 10


def test_the_loss_is_that_of_the_law() -> None:
    """0.024 (k h)^4 per step, and so more per second in smaller steps (docs/theory.md, 2.4)."""
    assert wave_loss(2.0, 0.1, 1e-3, SolverSettings()) == pytest.approx(0.024 * (math.pi * 0.05) ** 4 / 1e-3)
    assert wave_loss(2.0, 0.1, 1e-4, SolverSettings()) == pytest.approx(
        10 * wave_loss(2.0, 0.1, 1e-3, SolverSettings())
    )


def test_the_command_probes_and_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of a run is that of its steps, and more; where the probe breaks down there is none, and an error."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "drop.toml"
    path.write_text(SCENE)
    outcome = run_here("check", path, "--probe", "--threads", "1", "--json")
    forecast = json.loads(outcome.stdout)["forecast"]
    assert outcome.status == 0 and forecast["measured"]
    assert forecast["seconds"] > forecast["steps"] * forecast["step_seconds"] + forecast["compile_seconds"] > 0
    assert list(tmp_path.iterdir()) == [path]

    def broken(self: Run, count: int) -> tuple[int, float]:
        raise UnstableRunError(Diagnosis(1, 0.1, 7, "drop", (0.5, 0.5), "went to pieces", "wave", 0.1, "look at it"))

    monkeypatch.setattr(Run, "advance", broken)
    outcome = run_here("check", path, "--probe", "--threads", "1")
    assert outcome.status == 1
    assert "error: The run became unstable within 0 steps of the probe: the run became unstable" in outcome.stdout
    assert "not ok: 1 error" in outcome.stdout

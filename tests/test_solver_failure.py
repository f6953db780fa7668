"""A run whose state is lost stops at once, and says which particle, where and why."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import block, body, liquid, scene_of, solid

from mpmcli.scene import Scene, sample_bodies
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.engine.saved_state import SavedState
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import Backend

H = 0.1
STEP = 1e-3


def scene(dimension: int = 2, precision: str = "f32") -> Scene:
    """Return a scene of a block of jelly, a drop, and a second drop of another density, all moving slowly."""
    d = dimension

    def box(low: float) -> dict:
        return {"box": {"min": [low] + [0.5] * (d - 1), "max": [low + 0.3] + [0.8] * (d - 1)}}

    fluid = liquid(1e4)
    return scene_of(
        body("drop", fluid, box(-0.8), velocity=[0.1] * d),
        body("jelly", solid(1e4), box(0.0), velocity=[0.2] * d),
        body("second drop", {**fluid, "density": 700.0}, box(0.8)),
        domain={"size": [2.4] + [1.5] * (d - 1), "origin": [-1.0] + [0.0] * (d - 1), "spacing": H},
        time={"end": 0.2, "frames": 10},
        precision=precision,
    )


def by_id(run: Run, law: str) -> tuple[object, np.ndarray]:
    """Return the group of a law and where each of its particles, in the order of their ids, lies in memory."""
    group = run.groups[run.laws.index(law)]
    return group, np.argsort(group.read()["id"])


def first_id(run: Run, body: str) -> int:
    """Return the id of the first particle of a body: ids count through the bodies in the order of the scene."""
    counts = [sample.count for sample in sample_bodies(run.scene)]
    names = [b.name for b in run.scene.bodies]
    return sum(counts[: names.index(body)])


def poison(run: Run, law: str, row: int, field: str, value: object) -> None:
    group, place = by_id(run, law)
    values = group.read()[field]
    values[place[row]] = value
    group.replace(**{field: values})


def run_until_lost(run: Run, steps: int = 40) -> UnstableRunError:
    """Return the error that ends the run."""
    with pytest.raises(UnstableRunError) as stopped:
        for _ in range(steps):
            run.step(STEP)
    return stopped.value


@pytest.fixture(scope="module")
def backend(backend_of: Callable) -> Backend:
    return backend_of("f32")


@pytest.fixture(scope="module")
def started(backend: Backend) -> tuple[Run, SavedState, SavedState]:
    """Return a run on two threads, its state at the start, and that after some steps and sorts."""
    run = build_run(scene(), backend)
    start = run.save().copied()
    for _ in range(30):
        run.step(STEP)
    return run, start, run.save().copied()


@pytest.fixture
def fresh(started: tuple[Run, SavedState, SavedState]) -> Run:
    """Return the run as it was at the start."""
    run, start, _ = started
    run.load(start)
    return run


@pytest.fixture
def running(started: tuple[Run, SavedState, SavedState]) -> Run:
    """Return the run as it was after some steps and sorts."""
    run, _, later = started
    run.load(later)
    return run


@pytest.mark.parametrize(("law", "body", "value", "cause"), [
    ("fluid", "drop", np.nan, "not finite"),
    ("fluid", "second drop", -0.5, "was inverted"),
    ("fluid", "drop", 0.0, "was inverted"),
    ("neo_hookean", "jelly", np.nan, "not finite"),
    ("neo_hookean", "jelly", np.diag([-1.0, 1.0]), "was inverted"),
], ids=["J NaN", "J negative", "J zero", "F NaN", "F inverted"])  # fmt: skip
def test_a_lost_deformation_names_its_particle(running: Run, law: str, body: str, value: object, cause: str) -> None:
    """The very particle is named, before its stress spreads over its neighbours, one step later at most."""
    names = [b.name for b in running.scene.bodies if b.material.law == law]
    counts = {s.name: s.count for s in sample_bodies(running.scene)}
    row = sum(counts[n] for n in names[: names.index(body)]) + 5
    before = running.step_count
    poison(running, law, row, "deformation", value)
    error = run_until_lost(running)
    diagnosis = error.diagnosis
    assert diagnosis.particle == first_id(running, body) + 5
    assert diagnosis.body == body
    assert cause in diagnosis.cause
    assert before < diagnosis.step <= before + 2
    assert diagnosis.time == pytest.approx(diagnosis.step * STEP)
    assert diagnosis.step_size == pytest.approx(STEP)
    # A body is 0.3 m wide and has moved by less than a cell: the place, in the scene's coordinates, is in it.
    assert {"drop": -0.8, "jelly": 0.0, "second drop": 0.8}[body] - 0.01 < diagnosis.position[0]
    assert diagnosis.position[0] < {"drop": -0.5, "jelly": 0.3, "second drop": 1.1}[body] + 0.05
    assert 0.5 < diagnosis.position[1] < 0.85
    sentence = str(error)
    for part in (f"particle {diagnosis.particle}", f'"{body}"', f"step {diagnosis.step}", diagnosis.limit):
        assert part in sentence
    assert sentence.endswith(".")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30], ids=["NaN", "infinite", "1e30"])
def test_a_lost_velocity_names_its_body(running: Run, value: float) -> None:
    """What a velocity does reaches its neighbours in the same step: one of them is named, of the same body."""
    poison(running, "neo_hookean", 7, "v", value)
    before = running.step_count
    diagnosis = run_until_lost(running).diagnosis
    assert diagnosis.body == "jelly"
    assert diagnosis.step == before + 1
    assert any(part in diagnosis.cause for part in ("not finite", "left the domain", "was inverted"))
    assert all(np.isfinite(diagnosis.position))


def test_a_particle_that_leaves_is_named_with_its_speed(backend: Backend) -> None:
    """One lone particle, faster than the step allows, leaves: it is it, there, and that fast."""
    lone = scene_of(
        block("bullet", liquid(1e4), [1.0, 0.7], [1.1, 0.8], particles_per_cell=1, velocity=[900.0, 0.0]),
        domain={"size": [2.4, 1.5], "origin": [-1.0, 0.0], "spacing": H},
    )
    diagnosis = run_until_lost(build_run(lone, backend)).diagnosis
    assert (diagnosis.particle, diagnosis.body, diagnosis.step) == (0, "bullet", 1)
    assert diagnosis.cause == "left the domain at 900 m/s"
    assert diagnosis.position == pytest.approx((1.05, 0.75), abs=1e-5)
    assert diagnosis.limit == "speed"


def test_frames_before_the_end_stay(fresh: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that is lost between two frames has yielded the earlier ones, all of them finite and complete."""
    # One frame in a launch.
    monkeypatch.setattr("mpmcli.solver.frames.recorder.ROOM", 1)
    frames = fresh.frames()
    kept = [next(frames) for _ in range(4)]
    poison(fresh, "fluid", 3, "deformation", np.nan)
    with pytest.raises(UnstableRunError):
        next(frames)
    with pytest.raises(StopIteration):
        next(frames)
    assert [frame.time for frame, _ in kept] == pytest.approx([0.0, 0.02, 0.04, 0.06], abs=1e-15)
    for frame, row in kept:
        assert len(frame.position) == fresh.particle_count
        assert np.isfinite(frame.position).all()
        assert row.volume_ratio_min > 0
        assert np.isfinite(row.energy)


def test_no_frame_holds_a_crushed_particle(fresh: Run) -> None:
    """A particle that is pressed to nothing is seen before that state becomes a frame."""
    group, place = by_id(fresh, "fluid")
    C = group.read()["C"]
    # A fifth shorter along each axis in the first step, and so on until nothing is left.
    C[place[: sample_bodies(fresh.scene)[0].count]] = -2e5 * np.eye(2)
    group.replace(C=C)
    fresh.restart()
    limits = [limit for limit in fresh.limits() if limit.name == "deformation"]
    assert min(limits).value == pytest.approx(0.5 / 4e5)
    frames = fresh.frames()
    with pytest.raises(UnstableRunError, match="collapsed to zero volume"):
        for frame, row in frames:
            assert row.volume_ratio_min > 0, frame.index


def test_the_number_of_particles_never_changes(running: Run) -> None:
    """Every id from 0 to n - 1 is there once, after many sorts."""
    ids = np.concatenate([group.read()["id"] for group in running.groups])
    assert np.array_equal(np.sort(ids), np.arange(running.particle_count))

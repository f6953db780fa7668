"""Particles that come and go: a jet against its closed form, runs of a batch against those alone, what a file says."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command import run_here
from scenes import ball, block, body, box, scene_of
from state_run import MATERIALS
from test_batch import Output, batch_of, outputs_of, same
from test_deterministic import on_gpu_path

from mpmcli.check.result_check import check_result
from mpmcli.check.scene_check import check_scene
from mpmcli.dataset.dataset import open_dataset
from mpmcli.output import open_result
from mpmcli.scene import LoadedScene, Scene, sample_bodies, scene_to_toml
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.machine.backend import Backend

WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 2e4}
SPEED, SPACING = 2.0, 0.0125


def jet_scene(**more: object) -> Scene:
    """Return a jet through empty space, from x = 0.125 to an open face at 1.0, beside a pool at rest."""
    tables = {
        "domain": {"size": [1.0, 0.5], "spacing": 2 * SPACING, "walls": {"default": "separate", "x_max": "open"}},
        "time": {"end": 0.6, "frames": 6},
        "bodies": [block("pool", WATER, [0.3, 0.0], [0.4, 0.05])],
        "emitters": [block("jet", WATER, [0.1, 0.2], [0.15, 0.3], velocity=[SPEED, 0.0])],
        "output": {"fields": ["velocity", "density", "pressure", "volume_ratio", "mass"]},
    }
    return scene_of(**tables | more)


def mixed_scene(other: bool = False) -> Scene:
    """Return a jet of water, two laws, a mouth that is blocked at once, and two open faces; all numbers can differ."""
    speed = 2.0 + other
    return jet_scene(
        domain={
            "size": [1.0, 0.5],
            "spacing": 2 * SPACING,
            "gravity": [0.0, -9.81],
            "origin": [-0.1 * other, 0.0],
            "walls": {"default": "separate", "x_max": "open", "y_min": "open"},
        },
        time={"end": 0.4 + 0.1 * other, "frames": 4},
        bodies=[block("block", MATERIALS["snow"], [0.5, 0.1], [0.8, 0.2])],
        emitters=[
            block("jet", MATERIALS["fluid"], [0.1, 0.2], [0.15, 0.3], velocity=[speed, 0.5], end=0.3),
            body(
                "hail",
                MATERIALS["snow"],
                ball([0.6, 0.4], 0.06 - 0.02 * other),
                velocity=[0.0, -1.0],
                sampling="jittered",
                seed=3 + other,
                start=0.1,
                volume=0.015,
            ),
            # In the middle of the jet.
            body(
                "blocked",
                MATERIALS["fluid"],
                ball([0.2, 0.25], 0.05),
                velocity=[0.0, -1.0],
                sampling="lattice" if other else "turned",
                start=0.1,
            ),
        ],
        output={"fields": ["velocity", "volume_ratio", "stress"]},
    )


@pytest.fixture(scope="module")
def jets(backend_of: Callable[..., Backend]) -> dict[str, Output]:
    """Return those of the two samplings."""
    backend, found = backend_of("f32", 1), {}
    for sampling in ("turned", "lattice"):
        emitter = jet_scene().model_dump(exclude_none=True)["emitters"][0] | {"sampling": sampling}
        scene = jet_scene(emitters=[emitter])
        found[sampling] = outputs_of(batch_of([scene], backend), [scene])[0]
    return found


@pytest.fixture(scope="module")
def jet(jets: dict[str, Output]) -> Output:
    return jets["turned"]


def test_the_jet_flows_as_its_velocity_says(jet: Output) -> None:
    """8 particles each SPACING / SPEED, one by one: emitted mass to 1e-6, and every particle at x0 + v (t - due).

    To two thousandths of a cell: even in this sample density varies, and with it J.
    """
    waiting = sample_bodies(jet_scene())[1]
    first = len(jet[0][0].position) - len(waiting.position)
    for frame, row in jet:
        status = frame.fields["status"]
        assert status.dtype == np.int8 and status[:first].min() != 0
        # They pass the mouth as many periods after 0, and enter two cells before it.
        due = np.arange(len(waiting.position)) * (SPACING / SPEED / 8) - 4 * SPACING / SPEED
        entered = row.emitted + round(row.nozzle_mass * 8 / (1000.0 * 0.1 * SPACING))
        # What is due in a step enters in the next one, the nozzle's in the first.
        assert (
            frame.index == 0
            or 0 <= np.count_nonzero(due < frame.time - 1e-9) - entered <= 8 * SPEED * row.step_max / SPACING
        )
        assert row.emitted_mass == pytest.approx(1000.0 * 0.1 * SPACING * row.emitted / 8, rel=1e-6)
        assert abs(row.emitted - 8 * SPEED / SPACING * frame.time) <= 1 + 8 * SPEED * row.step_max / SPACING
        # Beyond the face a particle stays when it has gone two cells.
        mine = (status[first:] == 1) & (frame.position[first:, 0] < 1.0)
        x = waiting.position[mine, 0] + SPEED * (frame.time - due[mine])
        assert frame.position[first:][mine, 0] == pytest.approx(x, abs=5e-5)
        assert frame.position[first:][mine, 1] == pytest.approx(waiting.position[mine, 1], abs=5e-5)
        # Those that wait lie still where they will enter.
        waits = status[first:] == 0
        assert (frame.position[first:][waits] == waiting.position[waits].astype(np.float32)).all()
        assert not frame.velocity[status == 0].any()


def test_other_material_passes_a_nozzle(backend_of: Callable[..., Backend]) -> None:
    """A block of the same law flies across the nozzle before anything enters, and keeps its velocity."""
    block = body("pool", WATER, box([0.075, 0.025], [0.125, 0.1]), velocity=[0.0, 1.0])
    emitter = jet_scene().model_dump(exclude_none=True)["emitters"][0] | {"start": 0.5}
    scene = jet_scene(bodies=[block], emitters=[emitter], time={"end": 0.6, "frames": 6})
    for frame, _ in outputs_of(batch_of([scene], backend_of("f32", 1)), [scene])[0][:4]:
        assert np.abs(frame.velocity[frame.body == 0] - [0.0, 1.0]).max() < 1e-3


def test_a_jet_whose_rate_varies(backend_of: Callable[..., Backend]) -> None:
    """The mass is rho int q dt, to two sheets and a step, and the momentum rho int q^2 dt / area."""
    pulse = {"velocity": [1.0, 0.0], "rate": "0.2 * (0.6 + 0.4 * cos(9*t))"}
    emitter = block("jet", WATER, [0.1, 0.2], [0.15, 0.3], **pulse)
    scene = jet_scene(emitters=[emitter])
    rows = [row for _, row in outputs_of(batch_of([scene], backend_of("f32", 1)), [scene])[0]]
    for row in rows:
        t = np.linspace(0.0, row.time, 1001)
        q = 0.2 * (0.6 + 0.4 * np.cos(9 * t))
        late = 2 * 1000.0 * 0.1 * SPACING / 8 + 200.0 * row.step_max
        assert row.blocked == 0 and row.emitted_mass == pytest.approx(1000.0 * np.trapezoid(q, t), abs=late)
        if row.retired == 0:
            momentum = 1000.0 * np.trapezoid(q**2, t) / 0.1
            assert row.linear_momentum[0] == pytest.approx(momentum, rel=1e-3, abs=late * SPEED)
    assert rows[2].retired == 0 < rows[-1].retired


@pytest.mark.parametrize("safety", [0.9, 0.3])
def test_a_rope_hangs_on_its_nozzle(backend_of: Callable[..., Backend], safety: float) -> None:
    """It grows by v t, and by rho g L^2 / (2 E'), E' = E / (1 - nu^2), at any step."""
    modulus, density, speed, g = 3e4, 1000.0, 0.5, 9.81
    jelly = {"law": "neo_hookean", "density": density, "youngs_modulus": modulus, "poissons_ratio": 0.3}
    domain = {"size": [0.4, 0.8], "spacing": 0.02, "gravity": [0.0, -g]}
    emitter = block("rope", jelly, [0.16, 0.68], [0.24, 0.72], velocity=[0.0, -speed])
    asked = scene_of(domain=domain, time={"end": 0.5, "frames": 5, "safety": safety}, emitters=[emitter])
    frames = [frame.of_present for frame, _ in build_run(asked, backend_of("f64", 1)).frames()]
    first, frame = frames[1], frames[-1]
    grown = first.position[:, 1].min() - frame.position[:, 1].min() - speed * (frame.time - first.time)
    stretch = density * g * (1 - 0.3**2) / (2 * modulus) * speed**2 * (frame.time**2 - first.time**2)
    assert grown == pytest.approx(stretch, rel=0.15)


@pytest.mark.parametrize(
    ("sampling", "uneven", "mean", "drawn"), [("lattice", 2e-5, 2e-5, 2e-5), ("turned", 0.02, 5e-4, 4e-4)]
)
def test_the_jet_leaves_as_if_nothing_were_there(
    jets: dict[str, Output], sampling: str, uneven: float, mean: float, drawn: float
) -> None:
    """No pressure comes back from the open face: the velocity of a lattice stays what it was, to rounding, and J.

    J of others follows how evenly they lie, 1.4e-2 at most, 2e-4 in the mean, and its suction draws at them a little.
    """
    jet = jets[sampling]
    frame, row = jet[-1]
    assert row.retired > 100
    there = (frame.fields["status"] == 1) & (frame.body == 1)
    J = frame.fields["volume_ratio"][there]
    assert np.abs(J - 1).max() < uneven and abs(J.mean() - 1) < mean
    assert np.abs(frame.velocity[there] - [SPEED, 0.0]).max() < drawn
    gone = frame.fields["status"] == 2
    assert row.retired == gone.sum() and (frame.position[gone, 0] == 1.0).all()
    # At most two cells beyond, until the next sort.
    assert frame.position[there, 0].max() < 1.0 + 4 * SPACING
    came = row.emitted_mass + row.nozzle_mass - row.retired_mass
    assert row.mass == pytest.approx(jet[0][1].mass - jet[0][1].nozzle_mass + came, rel=1e-9)
    assert row.linear_momentum[0] == pytest.approx(SPEED * came, rel=1e-5)


@pytest.mark.slow
def test_a_jet_needs_no_body(backend_of: Callable[..., Backend], jet: Output) -> None:
    """Emitters alone are a scene, and the jet does not know of the pool that it never meets: the same, to the byte."""
    scene = jet_scene(bodies=[])
    alone = outputs_of(batch_of([scene], backend_of("f32", 1)), [scene])[0]
    pool = len(jet[0][0].position) - len(alone[0][0].position)
    for (frame, _), (mine, _) in zip(jet, alone, strict=True):
        assert np.array_equal(frame.position[pool:], mine.position)
        assert np.array_equal(frame.velocity[pool:], mine.velocity)
    check = check_scene(LoadedScene(scene, (), "jet.toml"))
    assert check.passes() and check.forecast.steps > 0


def test_runs_have_the_bytes_that_they_have_alone(backend_of: Callable[..., Backend]) -> None:
    """Of two laws and three emitters, one of them blocked, beside a run in which all numbers differ."""
    scenes = [mixed_scene(), mixed_scene(other=True)]
    backend = backend_of("f32", 1)
    found = outputs_of(batch_of(scenes, backend), scenes)
    kept = build_run(scenes[0], backend)
    start = kept.save().copied()
    assert list(same(found[0], list(kept.frames()))) == []
    last = found[0][-1][1]
    assert last.blocked >= 1 and last.emitted > 300 and last.retired > 100
    # Saved in the middle, loaded and continued.
    kept.load(start)
    for _ in range(60):
        kept.step(kept.stable_step()[0])
    saved = kept.save().copied()
    for _ in range(40):
        kept.step(kept.stable_step()[0])
    expected = kept.frame()
    kept.load(saved)
    for _ in range(40):
        kept.step(kept.stable_step()[0])
    again = kept.frame()
    assert expected[1].emitted > 0 and list(same([again], [expected])) == []


@pytest.mark.slow
def test_all_runs_of_a_batch_do(backend_of: Callable[..., Backend]) -> None:
    scenes = [mixed_scene(other=True), mixed_scene(), mixed_scene(other=True)]
    backend = backend_of("f32", 1)
    found = outputs_of(batch_of(scenes, backend), scenes)
    for output, scene in zip(found, scenes, strict=True):
        assert list(same(output, list(build_run(scene, backend).frames()))) == []
    shared = backend_of("f32", 3)
    (together,) = outputs_of(batch_of(scenes[1:2], shared), scenes[1:2])
    assert list(same(together, found[1])) == []


@pytest.mark.slow
def test_runs_of_a_batch_on_the_path_of_a_gpu_follow_those_on_the_cpu(backend_of: Callable[..., Backend]) -> None:
    """As many particles come in at every frame, and the jet is where it is on the CPU."""
    scenes = [mixed_scene(), mixed_scene(other=True)]
    found = outputs_of(batch_of(scenes, on_gpu_path(backend_of("f32"))), scenes)
    for output, scene in zip(found, scenes, strict=True):
        # The second run finds the stored kernel of the first one.
        expected = list(build_run(scene, backend_of("f32")).frames())
        for (frame, row), (other, other_row) in zip(output, expected, strict=True):
            assert (row.emitted, row.blocked) == (other_row.emitted, other_row.blocked)
            # When a sort retires what is beyond a face differs, in double precision too; it bounds steps until then.
            assert abs(row.steps - other_row.steps) <= 0.01 * other_row.steps
            inside = [
                (one.fields["status"] == 1) & (one.position[:, 0] <= 0.85) & (one.position[:, 1] >= 0.02)
                for one in (frame, other)
            ]
            both = inside[0] & inside[1]
            assert both.sum() > 0.99 * inside[1].sum()
            assert np.median(np.abs(frame.position - other.position)[both]) < 1e-5
        assert output[-1][1].blocked >= 1 and output[-1][1].emitted > 300


@pytest.mark.slow
@pytest.mark.gpu
def test_a_gpu_does_the_same(backend_of: Callable[..., Backend], jet: Output) -> None:
    """The same particles inside the domain, where they are on the CPU."""
    scene = jet_scene()
    backend = backend_of("f32", 1, "vulkan")
    for (frame, row), (other, other_row) in zip(build_run(scene, backend).frames(), jet, strict=True):
        assert (row.emitted, row.blocked) == (other_row.emitted, other_row.blocked)
        # When a sort retires what is beyond the face differs.
        inside, other_inside = ((one.fields["status"] == 1) & (one.position[:, 0] <= 1.0) for one in (frame, other))
        assert (inside == other_inside).all()
        assert np.abs(frame.position - other.position)[inside].max() < 2e-6
        assert np.abs(frame.velocity - other.velocity)[inside].max() < 2e-5
        there = (frame.fields["status"] == 1).sum() * row.emitted_mass / max(row.emitted, 1)
        assert row.emitted == 0 or row.mass == pytest.approx(there, rel=1e-5)


def test_a_result_says_who_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It passes its check; render, info and plot take it; learners' formats do not."""
    monkeypatch.chdir(tmp_path)
    scene = jet_scene(output={"fields": ["velocity", "density", "volume_ratio"]})
    Path("jet.toml").write_text(scene_to_toml(scene), encoding="utf-8")
    assert run_here("simulate", "jet.toml", "-o", "out").status == 0
    check = check_result(Path("out"))
    assert check.passes(strict=True), check.text()
    result = open_result(Path("out"))
    assert result.field_names[-1] == "status" and 764 <= result.ledger[-1].emitted <= 768
    frame = result.present_frame(3, ())
    assert len(frame.position) == np.count_nonzero(result.frame(3).fields["status"] == 1)
    refused = run_here("export", "out", "--to", "gns", "-o", "gns")
    assert refused.status == 2 and "has particles that come or go, and GNS cannot say which are there" in refused.stderr
    assert run_here("export", "out", "--to", "npz", "-o", "npz").status == 0


@pytest.mark.slow
def test_a_file_may_hold_only_those_that_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jet: Output
) -> None:
    """Its frames are those of the whole file without the others, and the ids say which."""
    monkeypatch.chdir(tmp_path)
    scene = jet_scene(
        output={"fields": ["velocity", "density", "pressure", "volume_ratio", "mass"], "drop_retired": True}
    )
    Path("jet.toml").write_text(scene_to_toml(scene), encoding="utf-8")
    assert run_here("simulate", "jet.toml", "-o", "out").status == 0
    assert check_result(Path("out")).passes(strict=True), check_result(Path("out")).text()
    result = open_result(Path("out"))
    for k, (whole, row) in enumerate(jet):
        frame, ids = result.frame(k), result.stored(k)["id"]
        there = np.flatnonzero(whole.fields["status"] == 1)
        assert ids.tolist() == there.tolist() and len(there) == result.particle_counts[k]
        assert frame.position.tobytes() == whole.position[there].tobytes()
        assert result.ledger[k].mass == row.mass
    (trajectory,) = open_dataset(Path("out"))
    for k, (whole, _) in enumerate(jet):
        there = whole.fields["status"] == 1
        found = trajectory.read("position", slice(k, k + 1))[0][there[: trajectory.particle_count]]
        assert found.tobytes() == whole.position[there].tobytes()
    drawn = run_here("render", "out", "--mode", "density", "-o", "picture.png")
    assert drawn.status == 2 and "density needs all of them" in drawn.stderr

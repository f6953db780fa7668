"""The benchmark: peers are the package's own examples, and all sides run in turn. No clock decides here."""

import json
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest
from command import run_here
from pydantic import Field

from mpmcli.bench import compare, ours, peers, profile, throughput
from mpmcli.bench.cases import CASES, DENSITY, EDGE, GRAVITY, SPEED, BenchCase
from mpmcli.bench.worker import Side, run_block
from mpmcli.check.scene_check import check_scene
from mpmcli.dataset.draw import draw
from mpmcli.errors import RunError
from mpmcli.materials.law import StateBound
from mpmcli.materials.registry import laws, parameter_models
from mpmcli.scene import estimate_particles, parse_scene
from mpmcli.scene.bounds import scene_bounds
from mpmcli.scene.material import Knob, MaterialParameters
from mpmcli.scene.quantity import Positive
from mpmcli.stability.limits import mode_limit

SMALL_2D = BenchCase(dimension=2, cells=32, particles=200, step=5e-4)
# At 16 cells the wall of mpm3d, 3 cells thick, would touch the block.
SMALL_3D = BenchCase(dimension=3, cells=32, particles=200, step=5e-4)
SMALL = pytest.mark.parametrize("case", [SMALL_2D, SMALL_3D], ids=lambda case: case.peer)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_cases_suit_the_examples(case: BenchCase) -> None:
    """The block is filled about as theirs; mpm3d passes the number of cells as a block size, a power of two."""
    assert 2 <= case.particles / (EDGE * case.cells) ** case.dimension <= 8
    assert case.cells & (case.cells - 1) == 0
    np.testing.assert_array_equal(case.positions(), case.positions())


@SMALL
def test_an_example_is_changed_in_its_settings_alone(case: BenchCase) -> None:
    """As many lines as in the example up to where it draws, and nothing else differs."""
    text = peers.example_path(case.peer).read_text(encoding="utf-8")
    source = peers.adapted_source(text, case, 3, "cpu", "f64")
    pairs = zip(text.splitlines(), source.splitlines(), strict=False)
    assert sum(old != new for old, new in pairs) == {"mpm3d": 3, "mpm88": 4}[case.peer]
    assert "ti.init(arch=ti.cpu, default_fp=ti.f64, cpu_max_num_threads=3, offline_cache=False)" in source
    assert "n_particles = 200" in source and "GUI" not in source
    with pytest.raises(RunError, match=r"the line `.*` 0 times instead of once"):
        peers.adapted_source(text.replace("n_particles = ", "particle_count = "), case, 3, "cpu", "f64")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow) for case in (SMALL_2D, SMALL_3D)], ids=lambda case: case.peer
)
def test_both_move_alike(case: BenchCase, run_python: Callable, tmp_path: Path) -> None:
    """The same physics: from the same block, before a wall is in reach, both give the same positions.

    Both take tau = E (J - 1) and x by dt v, so in f64 hardly more than round-off differs: J grows by
    det(I + dt C) here and by 1 + dt tr C there, (dt C)^2 apart where little deforms. And both fall: after n
    steps of the peer's symplectic Euler, which begins with a whole step of gravity where leapfrog begins with half
    a step, the mean is at y0 - V n dt - g dt^2 n (n + 1) / 2. Ours is told that a step has gone before.
    """
    steps = 20
    for module, make in (("ours", "block_of_ours(case, 2, precision='f64')"), ("peers", "Peer(case, 2, 'cpu', 'f64')")):
        run_python(f"""
import numpy as np
from mpmcli.bench.cases import BenchCase
from mpmcli.bench.{module} import *
case = {case!r}
side = {make}
if "{module}" == "ours":
    # Few particles: one thread.
    assert side.threads == 1
    side.run.begin()
    side.run.state.last_step = {case.step}
assert side.advance({steps}) == {steps}
side.sync()
assert side.particles == {case.particles} and side.is_sound()
np.save("{module}.npy", side.positions())
""")
    found, expected = np.load(tmp_path / "ours.npy"), np.load(tmp_path / "peers.npy")
    assert np.abs(found - expected).max() < 1e-12
    fallen = SPEED * steps * case.step + GRAVITY * case.step**2 * steps * (steps + 1) / 2
    assert expected[:, 1].mean() == pytest.approx(case.positions()[:, 1].mean() - fallen, abs=1e-12)


@SMALL
def test_the_mass_is_that_of_the_block(case: BenchCase) -> None:
    _, (particles,) = ours.falling_block(case)
    assert particles.count * particles.mass == pytest.approx(DENSITY * EDGE**case.dimension)


class Clock:
    """A simulation of 7 particles whose steps take `seconds` each, of a clock of its own, and phases half of it."""

    particles, threads = 7, 2

    def __init__(self, seconds: float = 0.01, fault: str = "") -> None:
        if fault:
            raise RunError(fault)
        self.now, self.seconds, self._told = 0.0, seconds, 0.0

    def advance(self, count: int) -> int:
        self.now += self.seconds * count
        return count

    def sync(self) -> None:
        pass

    def is_sound(self) -> bool:
        return self.seconds < 0.1

    def phases(self) -> dict[str, float]:
        spent, self._told = self.now - self._told, self.now
        return {"scatter": spent / 2, "clear": spent / 4}


def test_a_block_lasts_as_long_as_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("mpmcli.bench.worker.time.perf_counter", lambda: clock.now)
    steps, seconds, _ = run_block(clock, 1.0)
    assert seconds == pytest.approx(steps * 0.01)
    assert 1.0 <= seconds <= 1.02
    assert run_block(clock, 0.0)[0] == 1


class Local(Side):
    """A side in this process, with a clock of its own."""

    def __init__(self, name: str, make: Callable, *, by_processor: bool) -> None:
        self.name, self.blocks, self.worker, self._by_processor = name, [], make(), False
        self.particles, self.threads = self.worker.particles, self.worker.threads
        self.start_seconds, self.compile_seconds = 0.5, 1.5

    def ask(self, act: Callable, *arguments: object) -> object:
        if act is run_block:
            steps = round(arguments[0] / self.worker.seconds)
            self.worker.advance(steps)
            return steps, steps * self.worker.seconds, 0.0
        return act(self.worker, *arguments)

    def close(self) -> None:
        pass


class Sleeper(Clock):
    """Whose steps take their time."""

    def advance(self, count: int) -> int:
        time.sleep(count * self.seconds)
        return count


def test_a_side_is_a_process() -> None:
    with closing(Side("sleeper", Sleeper, by_processor=False)) as side:
        assert (side.particles, side.threads) == (7, 2)
        assert side.measure(0.01) >= 1 and side.cost > 0
        assert side.facts()["sound"]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (partial(Clock, fault="no memory"), "clock cannot be measured: no memory"),
        (partial(exec, "import os; os.write(2, b'last words'); os._exit(3)"), r"ended with 3\. last words"),
    ],
)
def test_a_side_that_cannot_start_is_a_sentence(make: Callable, words: str) -> None:
    with pytest.raises(RunError, match=words):
        Side("clock", make, by_processor=False)


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """All sides are clocks: a step of mpmcli takes 2 ms, of the peer 8, in C 1; all in this process."""
    case = BenchCase(2, 64, 7, 1e-3)
    for module in (compare, profile, throughput):
        monkeypatch.setattr(module, "Side", Local)
    monkeypatch.setattr(compare, "block_of_ours", lambda *_: Clock(0.002))
    monkeypatch.setattr(compare, "Peer", lambda *_: Clock(0.008))
    monkeypatch.setattr(throughput, "Peer", lambda *_: Clock(0.002))
    monkeypatch.setattr(profile, "ProfiledColumn", lambda *_: Clock(0.002))
    for module in (compare, profile):
        monkeypatch.setattr(module, "Yardstick", lambda *_: Clock(0.001))
        monkeypatch.setattr(module, "has_compiler", lambda: True)
    monkeypatch.setattr("mpmcli.bench.cases.CASES", (case,))
    monkeypatch.setattr("mpmcli.bench.ours.COLUMNS", (case,))


@pytest.mark.usefixtures("clocks")
def test_the_comparison() -> None:
    """Costs are per particle and step, ratios of blocks that are neighbours; a number of threads has a row."""
    done = run_here("bench", "--threads", "1,2", "--seconds", "0.8", "--blocks", "3", "--json")
    record = json.loads(done.stdout)
    assert len(record["cases"]) == 2
    for case in record["cases"]:
        assert case["ratio_blocks"] == pytest.approx([4] * 3)
        assert case["sides"]["mpmcli"]["ns_per_particle_step"] == pytest.approx(2e6 / 7)
    row = run_here("bench", "--seconds", "0.8").stdout.splitlines()[4].split()
    assert " ".join(row) == "2d-64 mpm88 7 2 / 2 0.00 0.00 4.0 (4.0 to 4.0) 0.01 2.00 0.5 1.5"


@pytest.mark.usefixtures("clocks")
def test_what_is_not_sound_or_not_the_same_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compare, "Peer", lambda *_: Clock(0.2))
    assert "Warning: at 2d-64 mpm88 lost a particle" in run_here("bench", "--seconds", "0.8").stdout
    monkeypatch.setattr(Clock, "particles", 8)
    done = run_here("bench", "--seconds", "0.8")
    assert done.status == 1 and "mpmcli runs 8 particles instead of 7" in done.stderr


@pytest.mark.usefixtures("clocks")
def test_the_profile() -> None:
    """Phases that have no column are of the grid, and what no phase takes is the rest."""
    record = json.loads(run_here("bench", "--profile", "--seconds", "0.8", "--json").stdout)
    assert [row["name"] for row in record["profile"]] == [*sorted(laws()), "fluid in C"]
    each = record["profile"][0]["ns_per_particle_step"]
    assert each["total"] == pytest.approx(2e6 / 7)
    assert (each["p2g"], each["grid"], each["rest"]) == pytest.approx((1e6 / 7, 0.5e6 / 7, 0.5e6 / 7))
    assert run_here("bench", "--profile", "--seconds", "0.8").stdout.count("\n2d-64") == len(laws()) + 1


@pytest.mark.slow
@pytest.mark.usefixtures("clocks")
def test_the_sweeps_are_stored_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rounds of a trajectory with three frames; the ratio is to what the generator would take here."""
    monkeypatch.setattr(throughput, "WARM_UP", 2)
    record = throughput.run_throughput(1, 1e-3, 2, lambda line: None, frames=3)
    (result,) = record["results"]
    assert (result["trajectories"], result["accepted"]) == (2, 2)
    # 8.4 s where mpm88 makes 6.5 million particle-steps/s; here 7 particles take a step in 2 ms.
    assert record["generator_s"] == pytest.approx(8.4 * 6.5e6 / 3500)
    rates = result["trajectories_per_hour_blocks"]
    assert result["ratio_blocks"] == pytest.approx([rate * record["generator_s"] / 3600 for rate in rates])
    assert f"{result['accepted']} of {result['trajectories']}" in throughput.throughput_table(record)


def test_the_scene_of_the_sweeps_is_that_of_the_generator(tmp_path: Path) -> None:
    """1,444 particles, 64 x 64 cells, 350 frames of 2.5 ms, and about 2,800 steps, whatever is drawn."""
    sweep = throughput.sand_sweep(tmp_path, 3)
    for number in range(sweep.count):
        loaded = draw(sweep, number).scene(parameter_models())
        scene = loaded.scene
        assert estimate_particles(scene) == 1444
        assert (scene.domain.cells, scene.time.frames) == ((64, 64), 350)
        assert scene.time.end == pytest.approx(0.875)
        assert check_scene(loaded).forecast.steps == pytest.approx(2800, rel=0.05)


@pytest.mark.parametrize("case", ours.COLUMNS, ids=lambda case: case.name)
@pytest.mark.parametrize("law", sorted(laws()))
def test_the_step_of_columns_is_far_from_the_limit_of_every_law_at_rest(law: str, case: BenchCase) -> None:
    """So that one step serves all, with room for what stiffens under load; and each has as many particles."""
    column = parse_scene(ours.column(law, case), laws=parameter_models(), source="bench").scene
    assert estimate_particles(column) == case.particles
    parameters, _ = column.bodies[0].material.resolve(scene_bounds(column))
    modes = laws()[law]((parameters,), case.dimension).modes(parameters, StateBound())
    limits = [
        mode_limit(column.domain.spacing, parameters.density, mode.stiffness, mode.viscosity)[0] for mode in modes
    ]
    assert 4 * case.step < min(limits) < 8 * case.step


def test_a_parameter_that_must_be_given_is_taken_from_its_knob() -> None:
    class Sticky(MaterialParameters):
        law: Literal["slime"] = "slime"
        stickiness: Annotated[Positive, Field(description="Pa."), Knob("stick", 1.0, 100.0, "0 is dry")]

    class Bare(MaterialParameters):
        law: Literal["slime"] = "slime"
        stickiness: Annotated[Positive, Field(description="Pa.")]

    assert ours.material_of(Sticky) == {"law": "slime", "density": 1000.0, "stickiness": pytest.approx(10.0)}
    with pytest.raises(RunError, match='the law "slime" needs stickiness'):
        ours.material_of(Bare)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--threads", "0"], "invalid value for '--threads': 0 is not a number of threads; give 2, or 1,2"),
        (["--threads", "1,x"], "invalid value for '--threads': 1,x is not a number of threads"),
        (["--dataset", "--profile"], "--dataset has one scene and one table"),
        (["--dataset", "--case", "2d-64"], "--dataset has one scene and one table"),
        (["--profile", "--threads", "1,2"], "--dataset and --profile take one number of threads: give --threads 1."),
        (["--profile", "--arch", "cuda"], "--dataset and --profile run on the CPU: leave out --arch cuda."),
        (["--profile", "--case", "3d-65"], 'there is no case "3d-65"; the cases are 2d-128, 3d-64.'),
    ],
)
def test_what_a_table_does_not_have_is_refused(arguments: list[str], sentence: str) -> None:
    outcome = run_here("bench", *arguments)
    assert outcome.status == 2
    assert outcome.stderr.lower().startswith(f"error: {sentence}".lower())
    assert outcome.stdout == ""

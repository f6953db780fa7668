"""The benchmark of sweeps: counts of what is computed, and ratios. No clock decides here."""

import json

import pytest
from command import run_here

from mpmcli.bench.cases import CASES, BenchCase
from mpmcli.bench.side import BenchOptions, Setting
from mpmcli.bench.throughput import (
    FRAMES,
    GENERATOR_PEER_RATE,
    run_throughput,
    sand_sweep,
    throughput_record,
    throughput_table,
)
from mpmcli.check.scene_check import check_scene
from mpmcli.dataset.draw import draw
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import estimate_particles

MACHINE = {"processor": "A processor", "taichi": "1.7.4"}


class FakePeer:
    """Answers like mpm88 that takes a millisecond per step."""

    def __init__(self, asked: list[str]) -> None:
        self.asked = asked

    def ask(self, command: str) -> dict:
        self.asked.append(command)
        return {"steps": 100, "seconds": 0.1}

    def __enter__(self) -> "FakePeer":
        return self

    def __exit__(self, *_: object) -> None:
        self.asked.append("end")


def record_of(*results: dict, rate: float = GENERATOR_PEER_RATE) -> dict:
    return throughput_record(results, (rate, 2 * rate, rate), 1444, FRAMES, 20.0) | {"machine": MACHINE}


ONE = {
    "workers": 1,
    "trajectories_per_hour": 3500.0,
    "trajectories_per_hour_blocks": [3000.0, 4000.0],
    "blocks_s": [20.0, 19.0],
    "trajectories": 40,
    "accepted": 40,
    "steps": 3500.0,
}
TWO = ONE | {"workers": 2, "trajectories_per_hour": 7000.0, "trajectories_per_hour_blocks": [6000.0, 8000.0]}
TWO |= {"trajectories": 80, "accepted": 79}


def test_the_scene_is_that_of_the_generator(tmp_path) -> None:
    """1,444 particles, 64 x 64 cells, 350 frames of 2.5 ms, and about 3,500 steps, whatever is drawn."""
    sweep = sand_sweep(tmp_path, 3)
    for number in range(sweep.count):
        loaded = draw(sweep, number).scene(parameter_models())
        scene = loaded.scene
        assert estimate_particles(scene) == 1444
        assert scene.domain.cells == (64, 64)
        assert scene.time.frames == 350
        assert scene.time.end == pytest.approx(0.875)
        assert check_scene(loaded).forecast.steps == pytest.approx(3500, rel=0.05)


def test_every_block_is_a_sweep_that_is_stored() -> None:
    """Two rounds of two trajectories per worker, with three frames; mpm88 steps before each round."""
    asked: list[str] = []

    def start(who: str, case: BenchCase, setting: Setting) -> FakePeer:
        assert (who, case, setting.threads) == ("peer", CASES[0], 2)
        return FakePeer(asked)

    lines: list[str] = []
    options = BenchOptions((1,), blocks=2, progress=lines.append, start=start)
    record = run_throughput(options, trajectories=2, frames=3)
    assert asked == ["first", "run 0.3", "run 2.0", "run 2.0", "end"]
    assert len(lines) == 3
    (result,) = record["results"]
    assert (result["workers"], result["trajectories"], result["accepted"]) == (1, 4, 4)
    assert (record["particles"], record["frames"]) == (1444, 3)
    assert result["steps"] == pytest.approx(30, abs=3)
    for rate, seconds in zip(result["trajectories_per_hour_blocks"], result["blocks_s"], strict=True):
        # The first of the two starts the worker.
        assert rate > 2 * 3600 / seconds
    assert record["peer_particle_steps_per_s"] == pytest.approx(CASES[0].particles * 1000)


def test_the_ratio_is_to_a_generator_on_each_core() -> None:
    """8.4 s where mpm88 makes 6.5 million particle-steps/s, and half of that where it makes twice as many."""
    record = record_of(ONE, TWO)
    assert record["generator_s"] == pytest.approx(8.4)
    one, two = json.loads(json.dumps(record))["results"]
    assert one["ratio"] == pytest.approx(3500 * 8.4 / 3600)
    assert two["ratio"] == pytest.approx(7000 * 8.4 / 3600 / 2)
    fast = record_of(ONE, rate=2 * GENERATOR_PEER_RATE)["results"][0]
    assert fast["ratio"] == pytest.approx(one["ratio"] / 2)
    assert one["trajectories_per_hour"] == 3500
    assert one["trajectories_per_hour_blocks"] == [3000, 4000]
    assert (two["ratio_min"], two["ratio_max"]) == pytest.approx((3000 * 8.4 / 3600, 4000 * 8.4 / 3600))


def test_the_table_tells_what_was_refused() -> None:
    lines = throughput_table(record_of(ONE, TWO)).splitlines()
    assert lines[1] == "A block of sand: 1,444 particles, 64 x 64 cells, 350 frames."
    assert " ".join(lines[5].split()) == "1 40 3,500 3,500 3,000-4,000 1.03 8.2 7.0-9.3"
    assert lines[-1] == "Beware: with 2 workers 1 of 80 trajectories were not accepted."


@pytest.mark.parametrize("option", [["--profile"], ["--quick"], ["--case", "2d-64"]])
def test_other_tables_are_refused(option: list[str]) -> None:
    outcome = run_here("bench", "--dataset", *option)
    assert outcome.status == 2
    assert "--dataset has one scene" in outcome.stderr

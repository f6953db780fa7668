"""The phases of a step: a law and the yardstick in their processes. No clock decides."""

import json

import pytest
from fake_contestant import figures_of

from mpmcli.bench import peers
from mpmcli.bench.cases import BenchCase
from mpmcli.bench.profile import IN_C, PHASES, block_of, profile_record, profile_table, run_profile
from mpmcli.bench.side import BenchOptions

TINY = BenchCase(dimension=2, cells=32, particles=2_304, step=1e-3)


def test_a_law_and_the_yardstick_are_profiled() -> None:
    options = BenchOptions((1,), 0.05, blocks=2, yardstick=peers.is_here())
    record = json.loads(json.dumps(run_profile([TINY], options, names=["fluid", "no_such_law"])))
    assert len(record["flaws"]) == 1
    assert "no_such_law at 2d-32 could not be measured" in record["flaws"][0]
    found = {entry["name"]: entry for entry in record["profile"]}
    assert set(found) == {"fluid", *([IN_C] if peers.is_here() else [])}
    for entry in found.values():
        each = entry["ns_per_particle_step"]
        assert each["p2g"] > 0
        assert each["g2p"] > 0
        assert each["grid"] > 0
        assert len(entry["ns_per_particle_step_blocks"]["total"]) == 2
    assert set(found["fluid"]["ns_per_particle_step"]) == {*PHASES, "rest", "total"}


def test_table() -> None:
    phases = {"sort": [1.0, 1.0], "p2g": [10.0, 12.0], "grid": [2.0, 2.0], "g2p": [20.0, 22.0]}
    one = figures_of("profile:fluid", TINY, (40e-9, 42e-9), phases=phases)
    record = profile_record([one], ["sand fell over."], BenchOptions())
    record["machine"] = {"processor": "A processor", "taichi": "1.7.4"}
    lines = profile_table(record).splitlines()
    assert lines[0] == "A processor, cpu, 1 thread, f32, taichi 1.7.4"
    assert lines[4].split() == ["2d-32", "fluid", "2,304", "1.0", "11.0", "2.0", "21.0", "6.0", "41.0"]
    assert lines[-1] == "Beware: sand fell over."


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_block_in_c_has_as_many_particles_in_a_cell(dimension: int) -> None:
    """A scene has 2^d by default, and the block is 0.4 wide."""
    block = block_of(BenchCase(dimension, 50, 1, 1e-3))
    assert block.particles == 2**dimension * 20**dimension

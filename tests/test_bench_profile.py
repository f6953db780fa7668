"""The phases of a step: what belongs to which, and a law and the yardstick in their processes. No clock decides."""

import json

import pytest

from mpmcli.bench import yardstick
from mpmcli.bench.cases import BenchCase
from mpmcli.bench.profile import IN_C, PHASES, ProfileReport, ProfileResult, block_of, run_profile

TINY = BenchCase(dimension=2, cells=32, particles=2_304, step=1e-3)


def test_each_task_belongs_to_a_phase() -> None:
    """Names as Taichi writes them. The first loop of p2g clears; the last one of each group in the update is G2P."""
    from mpmcli.solver.phase_times import phase_times

    names = {
        "p2g_c118_0_kernel_0_range_for": 1.0,
        "p2g_c118_0_kernel_1_range_for": 2.0,
        "p2g_c118_0_kernel_2_range_for": 4.0,
        "update_and_g2p_c122_0_kernel_0_serial": 8.0,
        "update_and_g2p_c122_0_kernel_1_range_for": 16.0,
        "update_and_g2p_c122_0_kernel_2_range_for": 32.0,
        "update_and_g2p_c122_0_kernel_3_range_for": 64.0,
        "relax_c120_0_kernel_1_range_for": 128.0,
        "count_stable_c100_0_kernel_0_range_for": 256.0,
        "move_c110_0_kernel_9_range_for": 512.0,
        "measure_c90_0_kernel_0_range_for": 1024.0,
    }
    one = phase_times([*names.items()], 1)
    assert one == {"p2g": 6, "grid": 1 + 8 + 16 + 32, "g2p": 64, "volumes": 128, "sort": 768, "measure": 1024}
    two = phase_times([*names.items()], 2)
    assert (two["grid"], two["g2p"]) == (1 + 8 + 16, 96)
    assert sum(one.values()) == sum(two.values()) == sum(names.values())


def test_a_law_and_the_yardstick_are_profiled() -> None:
    report = run_profile([TINY], 1, 0.05, names=["fluid", "no_such_law"], blocks=2, yardstick=yardstick.is_here())
    assert len(report.flaws) == 1
    assert "no_such_law at 2d-32 could not be measured" in report.flaws[0]
    found = {entry["name"]: entry for entry in json.loads(json.dumps(report.as_dict()))["profile"]}
    assert set(found) == {"fluid", *([IN_C] if yardstick.is_here() else [])}
    for entry in found.values():
        each = entry["ns_per_particle_step"]
        assert each["p2g"] > 0
        assert each["g2p"] > 0
        assert each["grid"] > 0
        assert len(entry["ns_per_particle_step_blocks"]["total"]) == 2
    assert set(found["fluid"]["ns_per_particle_step"]) == {*PHASES, "rest", "total"}


def test_table() -> None:
    phases = {"sort": (1.0, 1.0), "p2g": (10.0, 12.0), "grid": (2.0, 2.0), "g2p": (20.0, 22.0)}
    result = ProfileResult(TINY, "fluid", 2_304, phases, (40.0, 42.0))
    report = ProfileReport((result,), ("sand fell over.",), 1, 0.5, {"processor": "A processor", "taichi": "1.7.4"})
    lines = report.table().splitlines()
    assert lines[0] == "A processor, cpu, 1 thread, f32, taichi 1.7.4"
    assert lines[4].split() == ["2d-32", "fluid", "2,304", "1.0", "11.0", "2.0", "21.0", "6.0", "41.0"]
    assert lines[-1] == "Beware: sand fell over."


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_block_in_c_has_as_many_particles_in_a_cell(dimension: int) -> None:
    """A scene has 2^d by default, and the block is 0.4 wide."""
    block = block_of(BenchCase(dimension, 50, 1, 1e-3))
    assert block.particles == 2**dimension * 20**dimension

"""Speed against size: sizes, the budget of time and memory, the exponent, and the table. No clock decides."""

import json

import pytest
from fake_contestant import FakeWorker

from mpmcli.bench.cases import EDGE, BenchCase
from mpmcli.bench.compare import (
    COUNTS,
    PER_CELL,
    case_of,
    fitted_exponent,
    peer_case_of,
    run_scaling,
    scaling_table,
)
from mpmcli.bench.side import BenchOptions, Setting
from mpmcli.errors import RunError

# Time of a step per particle on one thread, s, and bytes of a process of each particle.
EACH = {"ours": 4e-8, "yardstick": 2e-8, "peer": 16e-8}
BYTES = 1000


def started(who: str, case: BenchCase, setting: Setting) -> FakeWorker:
    """Start a contestant whose steps take a time proportional to the number of particles."""
    memory = 200_000_000 + BYTES * case.particles
    each = EACH[who] * case.particles / setting.threads
    return FakeWorker(who, each, case.particles, case.step, peak_memory=memory)


def measured(threads: tuple[int, ...] = (1,), start=started, peers: bool = True, **others) -> dict:
    options = BenchOptions(threads, 0.5, blocks=2, yardstick=True, peers=peers, start=start)
    return run_scaling((3,), options, **others)


class TestSizes:
    @pytest.mark.parametrize("dimension", [2, 3])
    @pytest.mark.parametrize("particles", COUNTS)
    def test_cells_hold_as_many_particles_at_every_size(self, dimension: int, particles: int) -> None:
        """The number of cells is rounded, by half a cell of an edge at most."""
        case = case_of(dimension, particles)
        edge = EDGE * case.cells
        assert particles / edge**dimension == pytest.approx(PER_CELL, rel=1.05 * dimension * EDGE / 2 / edge)
        assert case.step * case.cells == pytest.approx(0.01)

    @pytest.mark.parametrize("particles", COUNTS)
    def test_peer_in_3d_has_a_power_of_two_and_as_many_in_a_cell(self, particles: int) -> None:
        case = peer_case_of(3, particles)
        assert case.cells & (case.cells - 1) == 0
        assert case.particles / (EDGE * case.cells) ** 3 == pytest.approx(PER_CELL, rel=1e-3)
        assert 8**-0.5 < case.particles / particles < 8**0.5 * 1.1
        assert peer_case_of(2, particles) == case_of(2, particles)


class TestRun:
    def test_exponents_and_ratios(self) -> None:
        record = measured(counts=(10_000, 100_000), threads=(1, 2))
        found = json.loads(json.dumps(record))
        assert not found["flaws"]
        assert [entry["exponent"] for entry in found["exponents"]] == pytest.approx([1.0] * 6)
        assert {(row["label"], row["threads"]): row["ns_per_particle_step"] for row in found["scaling"]} == {
            ("mpmcli", 1): pytest.approx(40),
            ("C", 1): pytest.approx(20),
            ("mpm3d", 1): pytest.approx(160),
            ("mpmcli", 2): pytest.approx(20),
            ("C", 2): pytest.approx(10),
            ("mpm3d", 2): pytest.approx(80),
        }
        rows = [" ".join(line.split()) for line in scaling_table(record).splitlines()]
        assert "3D, threads: 1" in rows
        assert "10,000 34 40.0 20.0 2.00" in rows
        assert "exponent 1.000 1.000 1.000" in rows

    def test_sizes_beyond_the_budget_are_left_out(self) -> None:
        """Each size takes 10 s by this clock: two end in 26 s, and the third might take 15 s more."""
        now = [0.0]

        def start(*arguments) -> FakeWorker:
            now[0] += 5.0
            return started(*arguments)

        record = measured(counts=COUNTS[:4], budget=26.0, clock=lambda: now[0], start=start, peers=False)
        assert sorted({row["particles"] for row in record["scaling"]}) == [10_000, 30_000]
        assert record["flaws"] == [
            "3d, 100,000 particles, 1 thread: left out, since the time would not suffice.",
            "3d, 300,000 particles, 1 thread: left out, since the time would not suffice.",
        ]

    def test_sizes_beyond_the_memory_are_left_out(self) -> None:
        """Two contestants hold 1,000 bytes of each particle: 1e6 particles take 2e9 bytes, of 2e9 free ones."""
        record = measured(counts=(100_000, 300_000, 1_000_000), free_memory=lambda: 2_000_000_000, peers=False)
        assert sorted({row["particles"] for row in record["scaling"]}) == [100_000, 300_000]
        assert record["flaws"] == ["3d, 1,000,000 particles, 1 thread: left out, since the memory would not suffice."]

    def test_one_that_fails_is_left_out_with_the_reason(self) -> None:
        def start(who: str, case: BenchCase, setting: Setting) -> FakeWorker:
            if who == "yardstick":
                raise RunError("gcc fell over.")
            return started(who, case, setting)

        record = measured(counts=(10_000,), start=start)
        assert [row["who"] for row in record["scaling"]] == ["ours", "peer"]
        assert record["flaws"] == ["yardstick, 3d, 10,000 particles: gcc fell over."]
        assert record["exponents"] == []


def test_exponent_of_a_known_law() -> None:
    """Time per particle as N^0.25: a step takes N^1.25."""
    assert fitted_exponent([(count, count**0.25) for count in COUNTS]) == pytest.approx(1.25)

"""The benchmark: peers are the package's own examples, and both sides run in turn. No clock decides here."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fake_contestant import FakeWorker, figures_of

from mpmcli.bench import contestant, ours, peers
from mpmcli.bench.cases import CASES, DENSITY, EDGE, GRAVITY, SPEED, BenchCase
from mpmcli.bench.compare import bench_record, bench_table, run_bench
from mpmcli.bench.report import describe_machine
from mpmcli.bench.side import BenchOptions, Setting, Side, start_worker
from mpmcli.errors import RunError

SMALL_2D = BenchCase(dimension=2, cells=32, particles=200, step=5e-4)
# At 16 cells the wall of mpm3d, 3 cells thick, would touch the block.
SMALL_3D = BenchCase(dimension=3, cells=32, particles=200, step=5e-4)


# Each example and a case that it can solve.
EXAMPLES = [("mpm88", SMALL_2D), ("mpm3d", SMALL_3D), *((name, SMALL_2D) for name in SMALL_2D.other_peers)]


def adapted(case: BenchCase, text: str | None = None, name: str | None = None) -> str:
    name = name or case.peer
    text = text or peers.example_path(name).read_text(encoding="utf-8")
    return peers.adapted_source(text, case, name, threads=3, precision="f64", arch="cpu")


class TestCases:
    def test_names_are_unique(self) -> None:
        assert len({case.name for case in CASES}) == len(CASES)

    @pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
    def test_block_is_filled_about_as_the_examples_fill_theirs(self, case: BenchCase) -> None:
        per_cell = case.particles / (EDGE * case.cells) ** case.dimension
        assert 2 <= per_cell <= 8

    @pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
    def test_grid_suits_mpm3d(self, case: BenchCase) -> None:
        # It passes the number of cells as a block size, which must be a power of two.
        assert case.cells & (case.cells - 1) == 0

    def test_positions_are_the_same_every_time(self) -> None:
        assert SMALL_3D.positions().shape == (200, 3)
        np.testing.assert_array_equal(SMALL_3D.positions(), SMALL_3D.positions())


class TestAdaptedSource:
    def test_all_examples_are_here(self) -> None:
        assert {name for name, _ in EXAMPLES} == set(peers.EXAMPLES)

    @pytest.mark.parametrize(("name", "case"), EXAMPLES)
    def test_settings_are_ours_and_nothing_is_drawn(self, name: str, case: BenchCase) -> None:
        source = adapted(case, name=name)
        compile(source, "adapted", "exec")
        assert "ti.init(arch=ti.cpu, default_fp=ti.f64, cpu_max_num_threads=3, offline_cache=False)" in source
        assert "n_particles = 200" in source or "n_particles, n_grid = 200, 32" in source
        assert "GUI" not in source
        assert "ti.gpu" not in source

    @pytest.mark.parametrize(("name", "case"), EXAMPLES)
    def test_everything_else_is_untouched(self, name: str, case: BenchCase) -> None:
        """As many lines as in the example up to where it draws, and only the settings differ."""
        original = peers.example_path(name).read_text(encoding="utf-8").splitlines()
        pairs = list(zip(original, adapted(case, name=name).splitlines(), strict=False))
        changed = [new for old, new in pairs if old != new]
        assert len(changed) == {"mpm3d": 3, "mpm88": 4, "mpm99": 5, "mpm128": 5}[name]

    def test_another_version_of_an_example_is_noticed(self) -> None:
        text = peers.example_path("mpm88").read_text(encoding="utf-8")
        with pytest.raises(RunError, match="`n_grid = 128` 0 times instead of once"):
            adapted(SMALL_2D, text.replace("n_grid = 128", "n_grid = 129"))


class TestOurs:
    @pytest.mark.parametrize("case", [SMALL_2D, SMALL_3D], ids=lambda case: case.name)
    def test_both_start_from_the_same_block(self, case: BenchCase) -> None:
        particles = ours.particles_of(case)
        np.testing.assert_array_equal(particles.position, case.positions())
        assert particles.count == case.particles
        assert particles.count * particles.mass == pytest.approx(DENSITY * EDGE**case.dimension)

    @pytest.mark.parametrize(
        "case", [SMALL_2D, pytest.param(SMALL_3D, marks=pytest.mark.slow)], ids=lambda case: case.peer
    )
    def test_both_move_alike(self, case: BenchCase, run_python: Callable, tmp_path: Path) -> None:
        """The same physics: from the same block, before a wall is in reach, both give the same positions.

        Both take tau = E (J - 1) and x by dt v, so in f64 hardly more than round-off differs: J grows by
        det(I + dt C) here and by 1 + dt tr C there, (dt C)^2 apart where little deforms. And both fall: after n
        steps of the peer's symplectic Euler, which begins with a whole step of gravity where leapfrog begins with half
        a step, the mean is at y0 - V n dt - g dt^2 n (n + 1) / 2. Ours is told that a step has gone before.
        """
        steps = 20
        for module, name in (("ours", "falling_block"), ("peers", "Peer")):
            run_python(f"""
import numpy as np
from mpmcli.bench.cases import BenchCase
from mpmcli.bench.{module} import {name}
side = {name}({case!r}, threads=2, precision="f64", arch="cpu")
if "{module}" == "ours":
    # Few particles: one thread.
    assert side.threads == 1
    side.run.begin()
    side.run.state.last_step = {case.step}
assert side.advance({steps}) == {steps}
side.sync()
assert side.particles == {case.particles}
assert abs(side.smallest_step / {case.step} - 1) < 1e-9
assert side.is_sound()
np.save("{module}.npy", side.positions())
""")
        found, expected = np.load(tmp_path / "ours.npy"), np.load(tmp_path / "peers.npy")
        assert np.abs(found - expected).max() < 1e-12
        fallen = SPEED * steps * case.step + GRAVITY * case.step**2 * steps * (steps + 1) / 2
        assert expected[:, 1].mean() == pytest.approx(case.positions()[:, 1].mean() - fallen, abs=1e-12)

    @pytest.mark.parametrize("name", SMALL_2D.other_peers)
    def test_other_examples_are_the_same_fluid(self, name: str, run_python: Callable, tmp_path: Path) -> None:
        """From a block that is compressed, the pressure pushes as far.

        Theirs is lambda J (J - 1) where mpm88 has E (J - 1), equal to first order in the strain, here 20 steps of
        dt dv/dx = 5e-4 * 2: paths differ by 1 % of what the pressure does.
        """
        for who in ("mpm88", name):
            run_python(f"""
import numpy as np
from mpmcli.bench.cases import BenchCase
from mpmcli.bench.peers import Peer
case = {SMALL_2D!r}
side = Peer(case, "{who}", threads=1, precision="f64", arch="cpu")
middle = case.positions().mean(axis=0)
velocity = case.velocity() - 2 * (case.positions() - middle)
side._velocity.from_numpy(velocity)
side.advance(20)
side.sync()
assert side.is_sound()
np.save("{who}.npy", side.positions() - case.positions() - 20 * case.step * velocity)
""")
        one, other = np.load(tmp_path / "mpm88.npy"), np.load(tmp_path / f"{name}.npy")
        fall = GRAVITY * SMALL_2D.step**2 * 20 * 21 / 2
        one[:, 1] += fall
        other[:, 1] += fall
        assert np.abs(one).max() > 1e-4
        assert np.abs(one - other).max() < 0.02 * np.abs(one).max()


class Clock:
    """A simulation whose steps take 10 ms of a clock of its own."""

    particles = 7
    bytes_per_particle = 64
    threads = 2
    smallest_step = 1e-3

    def __init__(self) -> None:
        self.now = 0.0

    def advance(self, count: int) -> int:
        self.now += 0.01 * count
        return count

    def sync(self) -> None:
        pass

    def is_sound(self) -> bool:
        return True


class TestWorker:
    def test_block_lasts_as_long_as_asked(self, monkeypatch: pytest.MonkeyPatch) -> None:
        clock = Clock()
        monkeypatch.setattr(contestant.time, "perf_counter", lambda: clock.now)
        steps, seconds = contestant.run_block(clock, 1.0)
        assert seconds == pytest.approx(steps * 0.01)
        assert 1.0 <= seconds <= 1.02

    def test_commands_are_answered_line_by_line(self, monkeypatch: pytest.MonkeyPatch) -> None:
        clock, answers = Clock(), []
        monkeypatch.setattr(contestant.time, "perf_counter", lambda: clock.now)
        assert (
            contestant.serve(
                lambda: clock, ["first\n", "run 0.1\n", "finish\n"], lambda **values: answers.append(values)
            )
            == 0
        )
        ready, first, block, end = answers
        assert ready == {"particles": 7, "bytes_per_particle": 64, "threads": 2}
        assert first == {"seconds": pytest.approx(0.01)}
        assert block["steps"] in (10, 11)
        assert end["sound"] is True
        assert end["smallest_step"] == 1e-3
        assert end["peak_memory"] > 1e6

    def test_expected_errors_become_an_answer(self) -> None:
        def fail() -> Clock:
            raise RunError("There is no such example.")

        answers = []
        assert contestant.serve(fail, [], lambda **values: answers.append(values)) == 1
        assert answers == [{"error": "There is no such example."}]

    def test_a_peer_runs_in_its_own_process(self) -> None:
        with start_worker("peer", SMALL_2D, Setting(threads=1)) as process:
            assert process.ready == {"particles": 200, "bytes_per_particle": None, "threads": 1}
            assert process.ask("first")["seconds"] > 0
            assert process.ask("run 0.01")["steps"] > 0
            assert process.ask("finish")["sound"] is True

    def test_a_process_that_dies_is_a_sentence_with_its_last_words(self) -> None:
        with pytest.raises(RunError, match=r"stopped: it ended with status 1\..*no_such_arch"):
            start_worker("peer", SMALL_2D, Setting(threads=1, arch="no_such_arch"))


# Of a step on one thread.
SECONDS = {"ours": 0.002, "peer": 0.008, "yardstick": 0.001, "mpm99": 0.01, "mpm128": 0.0152}


class TestComparison:
    def run(
        self,
        particles: int = 200,
        threads: tuple[int, ...] = (2,),
        cases: tuple[BenchCase, ...] = (SMALL_2D,),
        **options,
    ) -> tuple[dict, list[tuple[str, str]], list[FakeWorker]]:
        log, started = [], []

        def start(who: str, case: BenchCase, setting: Setting) -> FakeWorker:
            # On one thread there are as many other processes again.
            each, wall = SECONDS[who] / setting.threads, 2 - (setting.threads > 1)
            started.append(FakeWorker(who, each, particles, SMALL_2D.step, log=log, wall=wall))
            return started[-1]

        try:
            record = run_bench(cases, BenchOptions(threads, 1.5, blocks=3, start=start, **options))
        finally:
            assert all(fake.closed for fake in started)
        return record, log, started

    def test_blocks_alternate(self) -> None:
        _, log, _ = self.run()
        assert [who for who, command in log if command == "run 1.5"] == ["ours", "peer"] * 3

    def test_medians_and_ratio(self) -> None:
        record, _, _ = self.run()
        (case,) = record["cases"]
        assert case["ours"]["particle_steps_per_s_blocks"] == pytest.approx([200 / 0.001] * 3)
        assert case["ratio"] == pytest.approx(4)
        assert case["ours"]["compile_s"] == pytest.approx(2.0)

    def test_the_yardstick_and_other_examples_take_their_turns(self) -> None:
        record, log, _ = self.run(yardstick=True, peers=True)
        assert [who for who, command in log if command == "run 1.5"] == [
            "ours",
            "peer",
            "yardstick",
            "mpm99",
            "mpm128",
        ] * 3
        found = json.loads(json.dumps(record))["cases"][0]
        assert found["times_slower_than_yardstick"] == pytest.approx(2)
        assert found["others"]["mpm128"]["particle_steps_per_s"] == pytest.approx(200 / 0.0076)
        row = bench_table(record).splitlines()[4].split()
        assert row[10:12] == ["0.40", "2.00"]
        assert row[-2:] == ["0.04", "0.03"]

    def test_a_yardstick_that_cannot_start_is_left_out(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The table has its columns where it started at another size."""

        def begin(side: Side, *arguments: object) -> None:
            if side.who == "yardstick" and side.case.dimension == 2:
                raise RunError("gcc fell over.")
            usual(side, *arguments)

        usual = Side.begin
        monkeypatch.setattr(Side, "begin", begin)
        lines = []
        record, _, _ = self.run(yardstick=True, progress=lines.append, cases=(SMALL_2D, SMALL_3D))
        assert [bool(case["yardstick"]) for case in record["cases"]] == [False, True]
        assert "2d-32, 2 threads: yardstick is left out. gcc fell over." in lines
        assert record["cases"][0]["yardstick"] is None
        rows = [line.split() for line in bench_table(record).splitlines()[4:6]]
        assert len(rows[1]) == len(rows[0]) + 2

    def test_numbers_of_threads_in_turn(self) -> None:
        """Twice as fast on 2 threads, and on 3 a half faster than that: all efficiencies are 1."""
        record, _, started = self.run(threads=(1, 2, 3))
        assert len(started) == 6
        assert [case["speed_up"] for case in record["cases"]] == pytest.approx([1, 2, 3])
        assert [case["efficiency"] for case in record["cases"]] == pytest.approx([1, 1, 1])
        assert record["threads"] == [1, 2, 3]
        assert "cpu, 1, 2 and 3 threads, f32" in bench_table(record)
        assert bench_table(record).split("\n\n")[1].splitlines()[-1].split()[-2:] == ["3.00", "100%"]

    def test_one_number_of_threads_has_no_speed_up(self) -> None:
        record, _, _ = self.run()
        assert record["cases"][0]["speed_up"] is None
        assert "speed-up" not in bench_table(record)

    def test_progress_is_told(self) -> None:
        lines = []
        self.run(progress=lines.append)
        assert len(lines) == 4
        assert lines[-1].startswith("2d-32, 2 threads: block 3 of 3, 0.20 against 0.05")

    def test_unequal_numbers_of_particles_are_refused(self) -> None:
        with pytest.raises(RunError, match="199 particles instead of 200"):
            self.run(particles=199)


class TestReport:
    ours = figures_of(
        "ours",
        CASES[-1],
        (1 / 2e6, 1 / 4e6, 1 / 3e6),
        2,
        start_s=0.51,
        compile_s=1.24,
        peak_memory_bytes=150_000_000,
        device_bytes_per_particle=96,
    )
    peer = figures_of(
        "peer",
        CASES[-1],
        (1e-6, 1e-6, 1 / 2e6),
        2,
        start_s=0.51,
        compile_s=1.24,
        peak_memory_bytes=150_000_000,
        device_bytes_per_particle=None,
        threads_used=2,
    )

    def record(self, ours: dict = ours, peer: dict = peer) -> dict:
        machine = {"processor": "A processor", "taichi": "1.7.4"}
        return bench_record([{"ours": ours, "peer": peer}], BenchOptions((2,))) | {"machine": machine}

    def test_table(self) -> None:
        lines = bench_table(self.record()).splitlines()
        assert lines[0] == "A processor, cpu, 2 threads, f32, taichi 1.7.4"
        row = next(line for line in lines if line.startswith("3d-128"))
        found = " ".join(row.split())
        assert found == "3d-128 524,288 1 / 2 3.00 mpm3d 1.00 3.00 1.50-4.00 0.5+1.2 / 0.5+1.2 150 / 150"
        assert lines[-1] == "Device memory at 3d-128: 96 bytes per particle."

    def test_table_warns_of_a_run_that_broke_down(self) -> None:
        assert "Beware" not in bench_table(self.record())
        broken = self.record(peer=self.peer | {"sound": False})
        assert "Beware: mpm3d broke down at 3d-128" in bench_table(broken)

    def test_table_warns_of_smaller_steps(self) -> None:
        def table_of(step: float) -> str:
            return bench_table(self.record(self.ours | {"smallest_step_s": step}))

        assert "Beware" not in table_of((1 - 1e-9) * 8e-5)
        assert "Beware: at 3d-128 mpmcli's own limits asked for steps down to 4e-05 s" in table_of(4e-5)

    def test_record_is_json_with_every_block(self) -> None:
        found = json.loads(json.dumps(self.record()))
        (case,) = found["cases"]
        assert found["threads"] == [2]
        assert case["threads"] == 2
        assert case["ours"]["particle_steps_per_s_blocks"] == pytest.approx([2e6, 4e6, 3e6], rel=1e-12)
        assert (case["ours"]["threads"], case["peer"]["threads"]) == (1, 2)
        assert case["ratio"] == pytest.approx(3, rel=1e-12)
        assert (case["ratio_min"], case["ratio_max"]) == pytest.approx((1.5, 4), rel=1e-12)
        assert case["ours"]["device_bytes_per_particle"] == 96

    def test_machine_is_described(self) -> None:
        found = describe_machine()
        assert found["processor"]
        assert found["taichi"].startswith("1.7")

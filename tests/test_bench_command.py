"""The options of `mpmcli bench`: what each table takes, what it refuses, and the documents made from the JSON."""

import importlib.util
import json
from collections.abc import Callable
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

import pytest
from command import run_here
from fake_contestant import figures_of

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.compare import COUNTS, bench_record, scaling_record
from mpmcli.bench.device import device_record, device_table
from mpmcli.bench.features import feature_record
from mpmcli.bench.materials import cost_record
from mpmcli.bench.profile import profile_record
from mpmcli.bench.side import BenchOptions

SCRIPTS = Path(__file__).parent.parent / "scripts"
MACHINE = {"processor": "A processor", "taichi": "1.7.4"}
TABLE = {"bytes": 4 << 20, "copy_gb_per_s": 12.5, "read_random_g_per_s": 0.25, "read_sorted_g_per_s": 1.5} | {
    f"atomic_add_{order}_g_per_s": rate for order, rate in (("random", 0.125), ("sorted", 0.5), ("same", 0.0625))
}
DEVICE = {
    "arch": "cuda",
    "threads": 1,
    "launch_us": {"1": 3.0, "2": 6.0, "3": 9.0, "4": 12.0},
    "launch_us_per_loop": 3.0,
    "launch_with_argument_us": 4.0,
    "launch_and_wait_us": 10.0,
    "tables": {"large": TABLE, "small": TABLE},
}


ASKED = ("threads", "seconds", "blocks", "arch", "yardstick", "peers")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--threads", "0"], "invalid value for '--threads': 0 is no number of threads; give 2, or 1,2"),
        (["--threads", "1,x"], "invalid value for '--threads': 1,x is no number of threads"),
        (["--threads", "1,,2"], "invalid value for '--threads': 1,,2 is no number of threads"),
        (["--scaling", "--profile"], "--scaling and --profile make a table each: give one of them."),
        (["--scaling", "--quick"], "--scaling takes --largest: leave out --quick."),
        (["--scaling", "--case", "3d-128"], 'there is no case "3d-128"; the cases are 2d, 3d.'),
        (["--scaling", "--largest", "10"], "invalid value for '--largest'"),
        (["--scaling", "--budget", "soon"], "invalid value for '--budget': soon is no time"),
        (["--scaling", "--arch", "cuda"], "--scaling runs on the CPU: leave out --arch."),
        (["--budget", "1m"], "only --scaling has sizes of its own: leave out --budget."),
        (["--materials", "--largest", "1e5"], "only --scaling has sizes of its own: leave out --largest."),
        (["--materials", "--threads", "1,2"], "--materials takes one number of threads: give --threads 1."),
        (["--profile", "--peers"], "--profile has no peers: leave out --peers."),
        (["--profile", "--case", "3d-65"], 'there is no case "3d-65"; the cases are 2d-128, 3d-64.'),
        (["--device", "--case", "3d-64"], "--device has one table: leave out --case."),
        (["--device", "--arch", "cuda"], "--arch cuda needs a device that this machine does not have"),
    ],
)
def test_what_a_table_does_not_have_is_refused(arguments: list[str], sentence: str) -> None:
    if "cuda" in arguments and Path("/dev/nvidia0").exists() and "--device" in arguments:
        pytest.skip("this machine has a CUDA device")
    outcome = run_here("bench", *arguments)
    assert outcome.status == 2
    assert outcome.stderr.lower().startswith(f"error: {sentence}".lower())
    assert outcome.stdout == ""


class TestChoices:
    @pytest.fixture
    def asked(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, dict], list]:
        """Return `replaced(name, record)`: the first arguments, options and others of each call of a benchmark."""

        def replaced(name: str, record: dict) -> list[tuple[object, dict, dict]]:
            calls = []

            def run(first: object, options: BenchOptions, **others: object) -> dict:
                calls.append((first, {key: getattr(options, key) for key in ASKED}, others))
                return record

            monkeypatch.setattr(f"mpmcli.bench.{name}", run)
            return calls

        return replaced

    def test_comparison(self, asked: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
        calls = asked("compare.run_bench", bench_record([], BenchOptions((1, 2))))
        monkeypatch.setattr("mpmcli.bench.peers.is_here", lambda: False)
        outcome = run_here("bench", "--case", "3d-32", "--threads", "1, 2", "--seconds", "0.5", "--peers", "--json")
        usual = {"threads": (1, 2), "seconds": 0.5, "blocks": 5, "arch": "cpu", "yardstick": False, "peers": True}
        assert [([case.name for case in cases], *others) for cases, *others in calls] == [(["3d-32"], usual, {})]
        assert json.loads(outcome.stdout)["threads"] == [1, 2]
        assert outcome.stderr == "note: gcc is not here: the table has no column of the yardstick in C.\n"
        assert run_here("bench", "--arch", "vulkan", "--quick").stderr == ""
        assert (calls[1][1]["arch"], calls[1][1]["yardstick"], calls[1][1]["peers"]) == ("vulkan", False, False)

    def test_scaling(self, asked: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
        calls = asked("compare.run_scaling", scaling_record([], [], BenchOptions()))
        monkeypatch.setattr("mpmcli.bench.peers.is_here", lambda: True)
        run_here("bench", "--scaling")
        run_here(
            "bench", "--scaling", "--case", "3d", "--largest", "1e5", "--budget", "5m", "--threads", "4", "--peers"
        )
        usual = {"threads": (1, 2), "seconds": 2.0, "blocks": 3, "arch": "cpu", "yardstick": True, "peers": False}
        assert calls[0] == ((2, 3), usual, {"budget": 1200.0, "counts": list(COUNTS)})
        counts = [10_000, 30_000, 100_000]
        assert calls[1] == ((3,), usual | {"threads": (4,), "peers": True}, {"budget": 300.0, "counts": counts})

    def test_profile(self, asked: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
        calls = asked("profile.run_profile", profile_record([], [], BenchOptions()))
        monkeypatch.setattr("mpmcli.bench.peers.is_here", lambda: True)
        run_here("bench", "--profile", "--case", "3d-64", "--blocks", "2")
        ((cases, options, _),) = calls
        assert [case.name for case in cases] == ["3d-64"]
        assert [options[key] for key in ("threads", "seconds", "blocks", "yardstick")] == [(1,), 2.0, 2, True]

    @pytest.mark.parametrize(
        ("table", "run", "record", "usual"),
        [
            ("materials", "materials.run_costs", cost_record, (["2d-128", "3d-64"], (1,), 2.0, 5)),
            ("features", "features.run_features", feature_record, (["2d-128", "3d-32"], (1, 2), 0.5, 15)),
        ],
    )
    def test_costs(self, asked: Callable, table: str, run: str, record: Callable, usual: tuple) -> None:
        calls = asked(run, record([], [], BenchOptions()))
        first = run_here("bench", f"--{table}", "--json")
        run_here("bench", f"--{table}", "--case", usual[0][1], "--threads", "2", "--blocks", "3")
        keys = ("threads", "seconds", "blocks")
        found = [([case.name for case in cases], *(options[key] for key in keys)) for cases, options, _ in calls]
        assert found == [usual, (usual[0][1:], (2,), usual[2], 3)]
        assert json.loads(first.stdout)[{"materials": "results"}.get(table, table)] == []


def scaling() -> dict:
    results = [
        figures_of(who, BenchCase(dimension, 16, particles, 1e-3), (1e-9 * each,))
        for dimension in (2, 3)
        for particles in (10_000, 100_000)
        for who, each in (("ours", 40.0), ("yardstick", 20.0), ("peer", 200.0))
    ]
    return scaling_record(results, ["3d: left out."], BenchOptions()) | {"machine": MACHINE}


class TestDocuments:
    @pytest.fixture
    def script(self, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
        monkeypatch.syspath_prepend(str(SCRIPTS))
        monkeypatch.setattr("sys.dont_write_bytecode", True)
        loader = SourceFileLoader("bench_table", str(SCRIPTS / "bench_table"))
        module = importlib.util.module_from_spec(importlib.util.spec_from_loader("bench_table", loader))
        loader.exec_module(module)
        return module

    def test_scaling(self, script: ModuleType) -> None:
        lines = script.scaling_tables(scaling()).splitlines()
        assert "| particles, 3D, 1 thread | mpmcli | C | mpm3d | times slower than C |" in lines
        assert "| 100,000 | 40.0 | 20.0 | 200.0 | 2.0 |" in lines
        assert "| exponent | 1.00 | 1.00 | 1.00 |  |" in lines
        assert lines[-1] == "* 3d: left out."

    def test_figure_is_the_same_every_time_and_names_every_line(self, script: ModuleType) -> None:
        from scaling_figure import draw_scaling

        report = scaling()
        figure = draw_scaling(report)
        assert figure == draw_scaling(json.loads(json.dumps(report)))
        for text in (b"mpmcli, 1 thread", b"C, 1 thread", b"mpm88, 1 thread", b"2D fluid", b"3D fluid"):
            assert text in figure

    def test_profile(self, script: ModuleType) -> None:
        case = BenchCase(3, 64, 100, 1e-3)
        results = [
            figures_of("profile:fluid", case, (15e-9,), phases={"p2g": [10.0], "volumes": [1.0]}),
            figures_of("yardstick", case, (6e-9,), phases={"p2g": [5.0]}),
        ]
        record = profile_record(results, [], BenchOptions()) | {"machine": MACHINE}
        lines = script.profile_table(record).splitlines()
        assert lines[2] == "| case | law | p2g | volumes | rest | total |"
        assert lines[4:] == [
            "| 3d-64 | fluid | 10.0 | 1.0 | 4.0 | 15.0 |",
            "| 3d-64 | fluid in C | 5.0 |  | 1.0 | 6.0 |",
        ]

    def test_device(self, script: ModuleType) -> None:
        record = device_record(DEVICE) | {"machine": MACHINE}
        lines = script.device_table(record).splitlines()
        assert lines[0] == "A processor, cuda, 1 thread, Taichi 1.7.4."
        assert "| atomic add, random | 0.125 | 0.125 | 1e9/s |" in lines
        assert "| launch, 4 loops | 12.0 |  | us |" in lines
        rows = [" ".join(line.split()) for line in device_table(record).splitlines()]
        assert "copy 12.5 12.5 GB/s" in rows
        loops = "1 loop 3.0, 2 loops 6.0, 3 loops 9.0, 4 loops 12.0"
        assert f"Launch of a kernel, us: {loops}; with a number from the host 4.0; and" in rows

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
from mpmcli.bench.compare import bench_record
from mpmcli.bench.profile import profile_record
from mpmcli.bench.side import BenchOptions

SCRIPTS = Path(__file__).parent.parent / "scripts"
MACHINE = {"processor": "A processor", "taichi": "1.7.4"}
ASKED = ("threads", "seconds", "blocks", "arch", "yardstick", "peers")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--threads", "0"], "invalid value for '--threads': 0 is no number of threads; give 2, or 1,2"),
        (["--threads", "1,x"], "invalid value for '--threads': 1,x is no number of threads"),
        (["--threads", "1,,2"], "invalid value for '--threads': 1,,2 is no number of threads"),
        (["--dataset", "--profile"], "--dataset has one scene and one table"),
        (["--profile", "--quick"], "--profile takes --case: leave out --quick."),
        (["--profile", "--threads", "1,2"], "--profile takes one number of threads: give --threads 1."),
        (["--profile", "--arch", "cuda"], "--profile runs on the CPU: leave out --arch."),
        (["--profile", "--peers"], "--profile has no peers: leave out --peers."),
        (["--profile", "--case", "3d-65"], 'there is no case "3d-65"; the cases are 2d-128, 3d-64.'),
    ],
)
def test_what_a_table_does_not_have_is_refused(arguments: list[str], sentence: str) -> None:
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

    def test_profile(self, asked: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
        calls = asked("profile.run_profile", profile_record([], [], BenchOptions()))
        monkeypatch.setattr("mpmcli.bench.peers.is_here", lambda: True)
        run_here("bench", "--profile", "--case", "3d-64", "--blocks", "2")
        ((cases, options, _),) = calls
        assert [case.name for case in cases] == ["3d-64"]
        assert [options[key] for key in ("threads", "seconds", "blocks", "yardstick")] == [(1,), 2.0, 2, True]


class TestDocuments:
    @pytest.fixture
    def script(self, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
        monkeypatch.syspath_prepend(str(SCRIPTS))
        monkeypatch.setattr("sys.dont_write_bytecode", True)
        loader = SourceFileLoader("bench_table", str(SCRIPTS / "bench_table"))
        module = importlib.util.module_from_spec(importlib.util.spec_from_loader("bench_table", loader))
        loader.exec_module(module)
        return module

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

"""Limits on the time and memory of a run, and how they are written."""

import json
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from command import SCENE, run_here

from mpmcli.cli.options import duration
from mpmcli.cli.options import size as size_of
from mpmcli.output import open_result
from mpmcli.simulation import settings as limits
from mpmcli.simulation.settings import Limits, StopCondition
from mpmcli.solver.machine.backend import is_out_of_memory

LONG = SCENE.replace("end = 0.05", "end = 5000.0").replace("frames = 4", "frames = 2000")


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("2h", 7200), ("90m", 5400), ("90 min", 5400), ("45s", 45), ("0.5h", 1800), ("1h30m", 5400), ("1:30:00", 5400),
     ("0:00:05", 5), ("1-12:00:00", 129600), ("100:00:00", 360000), ("1D", 86400)],
)  # fmt: skip
def test_times(text: str, seconds: float) -> None:
    assert duration(text) == seconds


@pytest.mark.parametrize(
    ("text", "size"), [("8GB", 8e9), ("8GiB", 2**33), ("500MB", 5e8), ("1.5 kB", 1500), ("2tib", 2**41)]
)
def test_sizes(text: str, size: float) -> None:
    assert size_of(text) == size


@pytest.mark.parametrize("text", ["", "2", "h", "-2h", "0s", "1:30", "1:75:00", "2 hours", "nan", "1e400s", "2h x"])
def test_what_is_no_time(text: str) -> None:
    with pytest.raises(click.BadParameter, match=r"is not a time; give 2h.*1:30:00"):
        duration(text)


@pytest.mark.parametrize("text", ["", "8", "GB", "-1GB", "0MB", "8 bytes", "1e9GB", "8GB8"])
def test_what_is_no_size(text: str) -> None:
    with pytest.raises(click.BadParameter, match=r"is not a size; give 8GB"):
        size_of(text)


class Clock:
    """A clock that a test sets; the process began at 0."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(limits.time, "monotonic", lambda: self.now)
        monkeypatch.setattr(limits, "_process_began", lambda: 0.0)


@pytest.mark.parametrize(
    ("written", "seconds", "compress"), [(0, 0.0, False), (10**9, 4.0, False), (3 * 10**8, 1.0, True)]
)
def test_a_run_stops_in_time_to_pack(monkeypatch, written: int, seconds: float, compress: bool) -> None:
    """It asks every 3 s. What is left when it stops holds one more such pause and the packing."""
    clock = Clock(monkeypatch)
    halt = StopCondition(lambda: False, Limits(max_time=100.0), compress=compress)
    halt.wrote(written, seconds)
    while not halt():
        clock.now += 3.0
        assert clock.now < 100
    packing = limits.PACKING * seconds + compress * written / limits.COMPRESSION
    assert 3.0 + packing < 100 - clock.now + 3.0 <= limits.RESERVE + limits.PAUSES * 3.0 + packing + 3.0
    assert halt.status == "stopped" and "--max-time of 0:01:40" in halt.message
    assert not halt.packing()
    clock.now = 99.9
    assert halt.packing()


def test_packing_ends_soon_after_a_signal(monkeypatch) -> None:
    clock, said = Clock(monkeypatch), [""]
    halt = StopCondition(lambda: said[0], Limits())
    assert not halt() and not halt.packing()
    said[0] = "SIGTERM"
    assert halt() and (halt.status, halt.signal) == ("interrupted", "SIGTERM")
    assert not halt.packing()
    clock.now = limits.PACKING_LEFT + 0.1
    assert halt.packing()


def test_a_signal_during_packing_ends_it(monkeypatch) -> None:
    Clock(monkeypatch)
    said = [False]
    halt = StopCondition(lambda: said[0], Limits())
    assert not halt()
    said[0] = True
    assert halt.packing() and halt.status == "interrupted"


@pytest.fixture
def start(tmp_path: Path) -> Callable:
    (tmp_path / "scene.toml").write_text(LONG, encoding="utf-8")
    return lambda *words: run_here("simulate", tmp_path / "scene.toml", "-o", tmp_path / "result", "--json", *words)


@pytest.mark.slow
def test_a_run_ends_packed_before_its_time(start: Callable, tmp_path: Path, monkeypatch) -> None:
    # The time of this process, not that of the tests, counts.
    began = limits.time.monotonic()
    monkeypatch.setattr(limits, "_process_began", lambda: began)
    outcome = start("--max-time", "6s")
    summary = json.loads(outcome.stdout)
    assert outcome.status == 1 and summary["status"] == "stopped"
    assert "error: the run stopped before its --max-time of 6 s" in outcome.stderr
    result = open_result(tmp_path / "result")
    assert (result.kind, result.status, result.frame_count) == ("packed", "stopped", summary["frames"])
    checked = json.loads(run_here("check", tmp_path / "result", "--json").stdout)
    assert "stopped-run" in [finding["rule"] for finding in checked["findings"]]


def test_a_run_stops_at_its_memory(start: Callable, tmp_path: Path, monkeypatch) -> None:
    sizes = iter([10**8, 2 * 10**8])
    monkeypatch.setattr(limits, "resident_bytes", lambda: next(sizes, 5 * 10**9))
    outcome = start("--max-memory", "4GB")
    assert outcome.status == 1 and json.loads(outcome.stdout)["status"] == "stopped"
    assert "takes 5 GB of memory and stopped at its --max-memory of 4 GB" in outcome.stderr
    assert open_result(tmp_path / "result").frame_count >= 1


def test_a_plan_above_the_memory_is_refused(start: Callable, tmp_path: Path) -> None:
    outcome = start("--max-memory", "1MB")
    assert outcome.status == 2 and "--max-memory is 1 MB" in outcome.stderr
    assert not (tmp_path / "result").exists()


CUDA = (
    "[cuda_driver.h:operator()@92] CUDA Error CUDA_ERROR_OUT_OF_MEMORY: out of memory while calling malloc (cuMemAlloc)"
)


@pytest.mark.parametrize("error", [RuntimeError(CUDA), MemoryError()])
def test_a_device_without_memory_is_a_sentence(start: Callable, tmp_path: Path, monkeypatch, error: Exception) -> None:
    """Before the run, where nothing is written yet, and in it, where no frame has come."""

    def refuse(*_: object, **__: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr("mpmcli.simulation.simulate.build_run", refuse)
        outcome = start()
    assert outcome.status == 2
    assert outcome.stderr.splitlines()[-1].startswith("error: There is not enough memory on this machine")
    assert not (tmp_path / "result").exists()
    monkeypatch.setattr("mpmcli.solver.engine.run.Run.frames", refuse)
    outcome = start()
    assert outcome.status == 1 and json.loads(outcome.stdout)["status"] == "failed"
    assert "not enough memory" in outcome.stderr and "a fault of mpmcli" not in outcome.stderr


def test_other_errors_are_no_want_of_memory() -> None:
    assert not is_out_of_memory(RuntimeError("a kernel is broken")) and not is_out_of_memory(
        ValueError("out of memory")
    )

"""Runs in processes of their own: side by side, ended when late, kept one by one, and never lost."""

import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from multiprocessing import active_children
from pathlib import Path
from types import SimpleNamespace

import pytest
from invented_case import CASE, result

from mpmcli.errors import InputError
from mpmcli.solver.frames.diagnosis import Diagnosis, UnstableRunError
from mpmcli.solver.machine.backend import Backend
from mpmcli.validation import runs as runs_module
from mpmcli.validation.case import Measure, Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import CaseRun, Journal, RunResult, carry_out, carry_out_all, run_key, runs_of

RUNS = runs_of(CASE, "coarse")
BAR = all_cases()["bar_fixed_free"]
BAR_RUN = CaseRun("bar_fixed_free", 13, Setting())
# Nothing is ever computed on it.
BACKEND = Backend("cpu", 1, "f64", True)


def answers(run: CaseRun) -> RunResult:
    """Say something, which is no answer, and then answer."""
    print("noise", flush=True)
    return result(0.5)


def dies(run: CaseRun) -> RunResult:
    """End the process of the run at n = 16."""
    if run.n == 16:
        os._exit(3)
    return result(0.5)


def breaks(run: CaseRun) -> RunResult:
    """Raise what no run should raise."""
    raise KeyError(run.n)


def sleeps(run: CaseRun) -> RunResult:
    """Answer at n = 8, and never at another n."""
    if run.n != 8:
        time.sleep(600)
    return result(0.5)


def counts(place: Path, run: CaseRun) -> RunResult:
    """Tell how many of these processes there are when it starts and when it ends, at most."""
    mine = place / str(os.getpid())
    mine.touch()
    seen = len(list(place.iterdir()))
    time.sleep(0.3)
    seen = max(seen, len(list(place.iterdir())))
    mine.unlink()
    return replace(result(0.5), particles=seen)


def test_every_run_comes_back_with_its_result(capfd: pytest.CaptureFixture) -> None:
    assert dict(carry_out_all(RUNS, workers=2, work=answers)) == dict.fromkeys(RUNS, result(0.5))
    assert capfd.readouterr() == ("", "")


def test_a_process_that_dies_is_a_failure_and_does_no_harm_to_others() -> None:
    lost = RunResult("failed", "The run failed: its process ended with exit code 3.")
    assert dict(carry_out_all(RUNS[:2], workers=2, work=dies)) == {RUNS[0]: result(0.5), RUNS[1]: lost}


def test_an_unforeseen_error_is_a_failure() -> None:
    assert dict(carry_out_all(RUNS[:1], 1, work=breaks)) == {
        RUNS[0]: RunResult("failed", "The run failed: KeyError: 8.")
    }


def test_a_run_that_takes_too_long_is_ended() -> None:
    late = RunResult("failed", "The run failed: it took longer than 0.5 s.")
    assert dict(carry_out_all(RUNS[1:], workers=1, timeout=0.5, work=sleeps)) == dict.fromkeys(RUNS[1:], late)
    assert active_children() == []


def test_no_more_run_at_a_time_than_asked_for(tmp_path: Path) -> None:
    runs = [CaseRun("invented", n, Setting()) for n in range(3)]
    seen = [found.particles for _, found in carry_out_all(runs, workers=2, work=partial(counts, tmp_path))]
    assert len(seen) == 3 and max(seen) <= 2


@pytest.mark.parametrize("how", ["stop", "consumer"])
def test_no_process_is_left_when_it_is_stopped(how: str) -> None:
    ended = []
    runs = carry_out_all(RUNS[:2], 2, stop=lambda: how == "stop" and ended, work=sleeps)
    ended.append(next(runs))
    assert ended == [(RUNS[0], result(0.5))] and len(active_children()) == 1
    if how == "stop":
        with pytest.raises(KeyboardInterrupt):
            next(runs)
    else:
        runs.close()
    assert active_children() == []


def test_results_are_kept_but_for_failures(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "report")
    finer = replace(BAR_RUN, n=26)
    journal.keep(BAR_RUN, result(0.1 + 0.2))
    journal.keep(finer, RunResult("unstable", "Lost."))
    again = Journal(tmp_path / "report", resume=True)
    assert again.find(BAR_RUN) == result(0.1 + 0.2) and again.find(finer).status == "unstable"
    assert again.find(replace(BAR_RUN, n=52)) is None
    again.keep(finer, RunResult("failed", "The run took longer than 15 s."))
    assert Journal(tmp_path / "report", resume=True).find(finer) is None


def test_a_directory_is_used_again_only_when_told_to(tmp_path: Path) -> None:
    directory = tmp_path / "report"
    Journal(directory).keep(BAR_RUN, result(0.5))
    (directory / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"--overwrite .* --resume"):
        Journal(directory)
    assert Journal(directory, overwrite=True).find(BAR_RUN) is None
    assert (directory / "notes.txt").read_text() == "mine"
    with pytest.raises(InputError, match="is a file, not a directory"):
        Journal(directory / "notes.txt", resume=True)


def test_the_key_tells_scenes_settings_and_programs_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_key(BAR_RUN) == run_key(BAR_RUN)
    keys = {
        run_key(run) for run in (BAR_RUN, replace(BAR_RUN, n=26), replace(BAR_RUN, setting=Setting(precision="f32")))
    }
    monkeypatch.setattr("mpmcli.validation.cases.bar.SPEED", 0.02)
    keys.add(run_key(BAR_RUN))
    monkeypatch.undo()
    monkeypatch.setattr("mpmcli.validation.runs.program", lambda: ("changed",))
    keys.add(run_key(BAR_RUN))
    assert len(keys) == 5


class Still:
    """In place of the clock of a run: three frames of nothing."""

    seconds = 0.25

    def __init__(self, run: object) -> None:
        pass

    def frames(self) -> Iterator[tuple[None, None]]:
        yield from [(None, None)] * 3


class Broken(type(BAR)):
    """The bar with two measures, measured wrongly."""

    def __init__(self, found: Callable[[], dict]) -> None:
        super().__init__("broken", "Broken", 1, 4)
        self.measures = tuple(Measure(f"{name}: Some number.") for name in ("period error", "energy loss"))
        self.found = found

    def measure(self, n: int, scene: object, frames: Iterable) -> dict[str, float]:
        assert len(list(frames)) == 3
        return self.found()


def lost() -> dict:
    place = Diagnosis(12, 0.5, 3, "bar", (1.0, 2.0), "left the domain", "wave", 1e-3, "try again")
    raise UnstableRunError(place)


@pytest.mark.parametrize(
    ("found", "status", "message"),
    [
        (
            lambda: {"period error": math.nan, "energy loss": 1.0},
            "failed",
            "The run finished, but period error is nan.",
        ),
        (lambda: {"period error": 1.0}, "failed", "The run finished, but there is no energy loss."),
        (lambda: {"period error": 1 / 0}, "failed", "The frames cannot be measured: division by zero."),
        (lost, "unstable", 'at step 12, t = 0.5 s: particle 3 of body "bar"'),
    ],
    ids=["nan", "missing", "raised", "lost"],
)
def test_what_cannot_be_measured_is_a_failure(
    monkeypatch: pytest.MonkeyPatch, found: Callable, status: str, message: str
) -> None:
    run = SimpleNamespace(particle_count=7, step_count=4, first_step_seconds=0.5)
    monkeypatch.setattr(runs_module, "build_run", lambda scene, backend: run)
    monkeypatch.setattr(runs_module, "SteppingClock", Still)
    entry = carry_out(Broken(found), 13, Setting(), BACKEND)
    assert message in entry.message
    assert replace(entry, message="") == RunResult(status, "", {}, 7, 4, 0.25, 0.5)


def test_a_scene_that_is_refused_is_a_failure() -> None:
    entry = carry_out(BAR, 13, Setting(safety=-1.0), BACKEND)
    assert entry.status == "failed" and "time.safety" in entry.message

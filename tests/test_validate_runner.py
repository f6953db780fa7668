"""Runs in processes of their own: side by side, ended when late, kept one by one, and never lost."""

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from invented_case import CASE, result

from mpmcli.errors import InputError
from mpmcli.solver.frames.diagnosis import Diagnosis, UnstableRunError
from mpmcli.solver.machine.backend import Backend
from mpmcli.validation import study
from mpmcli.validation.carry_out import carry_out
from mpmcli.validation.case import Measure, Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.journal import PACKAGE, Journal, case_files, code_digest, run_key
from mpmcli.validation.runner import carry_out_all, case_command
from mpmcli.validation.runs import Run, RunResult, failure, runs_of

RUNS = runs_of(CASE, "coarse")
BAR = all_cases()["bar_fixed_free"]
BAR_RUN = Run("bar_fixed_free", 13, Setting())
# Nothing is ever computed on it.
BACKEND = Backend("cpu", 1, "f64", True)
ANSWER = f"print('noise'); print({json.dumps(json.dumps(result(0.5).as_dict()))})"


def python(code: str) -> Callable[[Run], list[str]]:
    """Return a command for each run that executes some code, which knows the run's n."""
    return lambda run: [sys.executable, "-S", "-c", f"n = {run.n}\n{code}"]


def test_every_run_comes_back_with_its_result() -> None:
    found = dict(carry_out_all(RUNS, workers=2, command=python(ANSWER)))
    assert found == dict.fromkeys(RUNS, result(0.5))


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("import sys; sys.exit('no memory left')", "The process of the run exited with 1. no memory left"),
        ("import os; os.kill(os.getpid(), 9)", "The process of the run died by SIGKILL."),
        ("print('{}')", "The process of the run gave no answer."),
        ("print('[')", "The process of the run gave no answer."),
    ],
    ids=["exit", "kill", "wrong", "garbage"],
)
def test_a_process_that_dies_or_babbles_is_a_failure(code: str, words: str) -> None:
    """The run at n = 16 fails, and does no harm to the other."""
    code = f"if n == 16:\n    {code}\nelse:\n    {ANSWER}"
    found = dict(carry_out_all(RUNS[:2], workers=2, command=python(code)))
    assert found == {RUNS[0]: result(0.5), RUNS[1]: failure(words)}


def test_a_run_that_takes_too_long_is_ended(tmp_path: Path) -> None:
    code = f"open({str(tmp_path / 'pid')!r}, 'w').write(str(__import__('os').getpid()))\nimport time\ntime.sleep(600)"
    ((_, found),) = carry_out_all(RUNS[:1], workers=1, timeout=2.0, command=python(code))
    assert found == failure("The process of the run took longer than 2 s.")
    assert_gone(int((tmp_path / "pid").read_text()))


def assert_gone(process: int) -> None:
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_no_more_run_at_a_time_than_asked_for(tmp_path: Path) -> None:
    """Each process counts those that are there when it starts and when it ends."""
    code = (
        "import os, time\n"
        f"place = {str(tmp_path)!r}\n"
        "mine = os.path.join(place, str(os.getpid()))\n"
        "open(mine, 'w').close()\n"
        "seen = len(os.listdir(place)); time.sleep(0.3); seen = max(seen, len(os.listdir(place)))\n"
        "os.unlink(mine)\n"
        "import json\n"
        f"print(json.dumps(dict({result(0.5).as_dict()!r}, particles=seen)))"
    )
    runs = [Run("invented", n, Setting()) for n in range(5)]
    seen = [found.particles for _, found in carry_out_all(runs, workers=2, command=python(code))]
    assert len(seen) == 5 and max(seen) == 2


@pytest.mark.parametrize("how", ["stop", "consumer"])
def test_no_process_is_left_when_it_is_stopped(tmp_path: Path, how: str) -> None:
    sleeping = f"open(__import__('os').path.join({str(tmp_path)!r}, str(n)), 'w').write(str(__import__('os').getpid()))"
    code = f"if n == 8:\n    {ANSWER}\nelse:\n    {sleeping}\n    import time; time.sleep(600)"
    started = tmp_path / "16"

    def came() -> bool:
        return started.exists() and started.read_text() != ""

    runs = carry_out_all(RUNS[:2], workers=2, stop=lambda: how == "stop" and came(), command=python(code))
    if how == "stop":
        with pytest.raises(KeyboardInterrupt):
            list(runs)
    else:
        assert next(runs) == (RUNS[0], result(0.5))
        while not came():
            time.sleep(0.05)
        runs.close()
    assert_gone(int(started.read_text()))


def test_the_worker_ends_with_its_parent() -> None:
    """Its input is closed when its parent is gone, even killed; so it does not go on for itself."""
    with subprocess.Popen(case_command(BAR_RUN), stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdin.close()
        assert process.wait(timeout=120) == -signal.SIGTERM
        assert process.stdout.read() == b""


def test_results_survive_the_journal_and_hold_only_for_their_key(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "report", resume=False, overwrite=False)
    entry = result(0.1 + 0.2)
    journal.keep(RUNS[0], "a", entry)
    again = Journal(tmp_path / "report", resume=True, overwrite=False)
    assert again.find(RUNS[0], "a") == entry
    assert again.find(RUNS[0], "b") is None and again.find(RUNS[1], "a") is None
    journal.keep(RUNS[0], "a", failure("Lost.", "unstable"))
    assert again.find(RUNS[0], "a").status == "unstable"
    journal.keep(RUNS[0], "a", failure("It took too long."))
    assert again.find(RUNS[0], "a") is None
    (tmp_path / "report" / "runs" / f"{RUNS[0].name}.json").write_text('{"key": "a", "resu')
    assert again.find(RUNS[0], "a") is None


def test_a_directory_is_used_again_only_when_told_to(tmp_path: Path) -> None:
    directory = tmp_path / "report"
    Journal(directory, resume=False, overwrite=False).keep(RUNS[0], "a", result(0.5))
    (directory / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"--resume keeps .* --overwrite does all again"):
        Journal(directory, resume=False, overwrite=False)
    assert Journal(directory, resume=False, overwrite=True).find(RUNS[0], "a") is None
    assert (directory / "notes.txt").read_text() == "mine"
    with pytest.raises(InputError, match="is a file, not a directory"):
        Journal(directory / "notes.txt", resume=True, overwrite=False)


def test_the_key_tells_scenes_settings_machines_and_programs_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    key = run_key(BAR, BAR_RUN, "a processor")
    assert key == run_key(BAR, BAR_RUN, "a processor")
    others = [replace(BAR_RUN, n=26), replace(BAR_RUN, setting=Setting(precision="f32"))]
    keys = {key, *(run_key(BAR, run, "a processor") for run in others), run_key(BAR, BAR_RUN, "another")}
    monkeypatch.setattr("mpmcli.validation.cases.bar.SPEED", 0.02)
    keys.add(run_key(BAR, BAR_RUN, "a processor"))
    monkeypatch.undo()
    monkeypatch.setattr("mpmcli.validation.journal.code_digest", lambda files: "changed")
    keys.add(run_key(BAR, BAR_RUN, "a processor"))
    assert len(keys) == 6


def test_the_digest_is_of_the_code_that_a_run_depends_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """The solver, laws, the case and what it imports are in it; the report and other cases are not."""
    read = []
    monkeypatch.setattr(Path, "read_bytes", lambda path, real=Path.read_bytes: (read.append(path), real(path))[1])
    code_digest.__wrapped__(case_files(BAR))
    names = {str(path.relative_to(PACKAGE)) for path in read}
    assert {
        "solver/engine/step_size.py",
        "materials/sand.py",
        "scene/sampling.py",
        "validation/carry_out.py",
        "validation/cases/bar.py",
        "validation/measuring.py",
        "validation/tables.py",
    } <= names
    assert not {name for name in names if "report" in name or "figure" in name or name.startswith(("cli", "check"))}
    assert {name for name in names if name.startswith("validation/cases/")} <= {
        "validation/cases/bar.py",
        "validation/cases/__init__.py",
    }
    # Every room that these files import is in it too; `processes` starts a run, and computes nothing of it.
    found = {room for path in read if path.suffix == ".py" for room in re.findall(r"\bmpmcli\.(\w+)", path.read_text())}
    rooms = {room for room in found if (PACKAGE / room).is_dir()}
    assert rooms - {"processes"} <= {name.partition("/")[0] for name in names}


class Still:
    """In place of a timed run: three frames of nothing."""

    run = SimpleNamespace(particle_count=7)

    def __init__(self, scene: object, backend: object) -> None:
        pass

    def frames(self) -> Iterator[tuple[None, None]]:
        yield from [(None, None)] * 3

    def facts(self) -> dict[str, float]:
        return {"steps": 4, "compile_seconds": 0.5}


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
        (lambda: {"period error": 1.0}, "failed", "The case returned no energy loss."),
        (lambda: {"period error": 1 / 0}, "failed", "The frames cannot be measured: division by zero."),
        (lost, "unstable", 'at step 12, t = 0.5 s: particle 3 of body "bar"'),
    ],
    ids=["nan", "missing", "raised", "lost"],
)
def test_what_cannot_be_measured_is_a_failure(
    monkeypatch: pytest.MonkeyPatch, found: Callable, status: str, message: str
) -> None:
    monkeypatch.setattr("mpmcli.validation.carry_out.TimedRun", Still)
    entry = carry_out(Broken(found), 13, Setting(), BACKEND)
    assert (entry.status, entry.values) == (status, {}) and message in entry.message
    assert (entry.particles, entry.steps, entry.compile_seconds, entry.threads) == (7, 4, 0.5, 1)


def test_a_scene_that_is_refused_is_a_failure() -> None:
    entry = carry_out(BAR, 13, Setting(safety=-1.0), BACKEND)
    assert entry.status == "failed" and "time.safety" in entry.message


def test_a_study_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped after one run, it has that one already, and computes the other two once."""
    monkeypatch.setattr(study, "run_key", lambda case, run, machine: f"{run}")
    computed: list[Run] = []

    def command(run: Run) -> list[str]:
        computed.append(run)
        return python(ANSWER)(run)

    def go(stop: Callable[[], bool], *, resume: bool) -> None:
        journal = Journal(tmp_path / "report", resume=resume, overwrite=False)
        kept: list[int] = []
        counts: list[int] = []

        def on_run(run: Run, entry: RunResult, done: int, total: int) -> None:
            counts.append(done)

        try:
            report = study.study(
                [CASE],
                "coarse",
                1,
                journal=journal,
                on_run=on_run,
                resumed=lambda count, total: kept.append(count),
                stop=lambda: stop() and bool(counts),
                command=command,
            )
        finally:
            outcome.append((kept, counts))
        assert list(report.results) == RUNS

    outcome: list[tuple[list[int], list[int]]] = []
    with pytest.raises(KeyboardInterrupt):
        go(lambda: True, resume=False)
    go(lambda: False, resume=True)
    go(lambda: False, resume=True)
    assert outcome == [([], [1]), ([1], [2, 3]), ([3], [])]
    # The second was under way when it was stopped.
    assert computed == [RUNS[0], RUNS[1], RUNS[1], RUNS[2]]

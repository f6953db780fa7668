"""Sweeps: one dataset however it is computed, whatever is killed, with nothing bad in it."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import psutil
import pytest
from command import ROOT, run_here, started
from good_sweep import SWEEP
from made_sweep import COUNT, MadeWorkers, made_workers, make_dataset, small_sweep  # noqa: F401
from test_plugin import LAW
from tiny_sweep import BASE, contents, small_shards, tiny_sweep, told, write_sweep

from mpmcli.check.finding import Finding
from mpmcli.dataset import open as open_dataset
from mpmcli.dataset import sweep_run
from mpmcli.dataset.compute import Task, _with_step, compute
from mpmcli.dataset.draw import draw
from mpmcli.dataset.folder import Manifest, program, source_files, standing_alone
from mpmcli.dataset.merge import merge
from mpmcli.dataset.report import status_of, verify
from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.dataset.sweep_run import LOST, SweepSettings, SweepState, _tasks, discard_beginning, run_sweep, taken_folder
from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.output import open_result
from mpmcli.output.lock import take_lock
from mpmcli.scene.schema import Time
from mpmcli.simulation import runner
from mpmcli.simulation.runner import Recording, Runner

# A law that is stable by its own word, and in truth is not: its pressure pulls.
WRONG_LAW = LAW.replace("spherical = constants[0]", "spherical = -constants[0]")


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The dataset of the tiny sweep, in three shards, by one worker."""
    directory = tmp_path_factory.mktemp("truth")
    with pytest.MonkeyPatch.context() as patch:
        small_shards(patch)
        state = run_sweep(tiny_sweep(directory), SweepSettings(directory / "dataset", workers=1))
    assert (state.status, state.done, state.accepted) == ("finished", 12, 12)
    return directory / "dataset"


def test_a_dataset_holds_each_trajectory_once(truth: Path) -> None:
    """Its numbers, splits, draws and frames are those of the sweep, and its files are in the manifest."""
    dataset = open_dataset(truth)
    sweep = tiny_sweep(truth.parent)
    assert dataset.numbers == tuple(range(12))
    assert {path.name for path in truth.iterdir()} >= {"sweep.toml", "base.toml", "manifest.sqlite", "shards"}
    assert not (truth / "pending").exists()
    assert sorted(path.name for path in (truth / "shards").iterdir()) == ["00000.h5", "00001.h5", "00002.h5"]
    for trajectory, row in zip(dataset, told(truth), strict=True):
        drawn = draw(sweep, trajectory.number)
        assert trajectory.draws == drawn.values == json.loads(row.draws)
        assert trajectory.split == sweep.split_of(trajectory.number) == row.split
        assert trajectory.position.shape == trajectory.velocity.shape == (5, row.particles, 2)
        assert np.isfinite(trajectory.position).all()
        assert (row.verdict, row.accepted, row.retries, row.frames) == ("stable", 1, 0, 5)
        np.testing.assert_allclose(trajectory.times, np.linspace(0, 0.05, 5), rtol=1e-12)
    assert verify(truth).faults == ()


def test_a_trajectory_has_the_bytes_of_its_scene_by_itself(truth: Path, tmp_path: Path) -> None:
    """`simulate` of the scene in the header, and `export` of the trajectory, give the same particles."""
    trajectory = open_dataset(truth)[5]
    (tmp_path / "scene.toml").write_text(trajectory.header.stored["scene"], encoding="utf-8")
    assert run_here("simulate", tmp_path / "scene.toml", "-o", tmp_path / "run", "-q").status == 0
    exported = run_here("export", truth, "--to", "vtkhdf", "--trajectory", 5, "-o", tmp_path / "exported")
    assert exported.status == 0
    alone = open_result(tmp_path / "run")
    again = open_result(next((tmp_path / "exported").rglob("*.vtkhdf")))
    for k, (frame, other) in enumerate(zip(alone.frames(), again.frames(), strict=True)):
        for name in ("position", "velocity", "body", "material"):
            assert np.array_equal(getattr(frame, name), getattr(other, name)), (k, name)
        assert np.array_equal(frame.position, trajectory.position[k])


def test_parts_and_another_number_of_workers_make_the_same_dataset(
    truth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_shards(monkeypatch)
    sweep = tiny_sweep(tmp_path)
    parts = [tmp_path / "first", tmp_path / "second"]
    for i, part in enumerate(parts, 1):
        state = run_sweep(sweep, SweepSettings(part, workers=3 - i, part=(i, 2)))
        assert (state.done, state.expected) == ([8, 4][i - 1],) * 2
    merge(parts[::-1], tmp_path / "whole")
    assert contents(tmp_path / "whole") == contents(truth)
    assert told(tmp_path / "whole") == told(truth)
    with pytest.raises(InputError, match="part 2/2 is missing"):
        merge(parts[:1], tmp_path / "half")
    with pytest.raises(InputError, match="a part is given twice"):
        merge([parts[0], parts[0], parts[1]], tmp_path / "half")
    assert not (tmp_path / "half").exists()


@pytest.mark.parametrize(
    ("said", "count", "threads"), [((), 8, 1), (("--threads", 3), 2, 3), (("--threads", 16, "--workers", 5), 5, 16)]
)
@pytest.mark.usefixtures("made_workers")
def test_workers_have_threads_as_asked(said: tuple, count: int, threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 8 cores each worker takes its threads, unless the number of workers is given."""
    small_sweep()
    counts: list[int] = []
    made: list[Task] = []
    monkeypatch.setattr(sweep_run, "available_cores", lambda: 8)
    monkeypatch.setattr(sweep_run, "local_workers", lambda count: counts.append(count) or nullcontext(MadeWorkers()))
    monkeypatch.setattr(sweep_run, "_tasks", lambda *given: made.extend(_tasks(*given)) or made)
    run_here("sweep", "sweep.toml", "-o", "d", "-q", "--count", COUNT, *said)
    assert counts == [count] and {task.threads for task in made} == {threads}


@pytest.mark.parametrize("column", ["version", "taichi", "arch"])
@pytest.mark.usefixtures("made_workers")
def test_trajectories_of_another_program_are_not_joined(column: str) -> None:
    """By --resume or merge; both are named, and nothing changes. Those that failed are computed again anyway."""
    make_dataset("d", broken_after=0)
    parts = [make_dataset(f"part{i}", (i, 2)) for i in (1, 2)]
    for dataset, words in ((Path("d"), ("sweep", "sweep.toml", "-o", "d")), (parts[1], ("dataset", "merge"))):
        manifest = Manifest(dataset)
        manifest.put(replace(row, **{column: "older"}) for row in manifest.rows() if row.accepted)
        before, now = files_of(dataset), {"arch": "cpu", **program()}[column]
        more = ("--resume", "--count", 12, "--arch", "cpu") if dataset == Path("d") else (*parts, "-o", "whole")
        outcome = run_here(*words, *more)
        name = {"version": "mpmcli", "taichi": "Taichi", "arch": "--arch"}[column]
        assert outcome.status == 2 and f"computed with {name} older; those of {now} would" in outcome.stderr, outcome
        assert files_of(dataset) == before and not Path("whole").exists()
        manifest.put(replace(row, verdict="failed", accepted=0) for row in manifest.rows())
    if column != "arch":
        assert run_here("sweep", "sweep.toml", "-o", "d", "--resume", "--count", 12, "-q").status == 1
        assert {getattr(row, column) for row in Manifest(Path("d")).rows()} == {now}


@pytest.mark.usefixtures("made_workers")
def test_a_merge_that_was_killed_goes_on() -> None:
    """At any of its syncs of a file or directory; what is left is known as not whole, and other parts cannot go on."""
    parts = [make_dataset(f"part{i}", (i, 2)) for i in (1, 2)]
    merge(parts, Path("whole"))
    expected, other = contents(Path("whole")), make_dataset("other", count=6)
    for killed in range(0, 100, 4):
        shutil.rmtree("d", ignore_errors=True)
        if not (child := os.fork()):
            syncs = 0

            def sync(_: int, last: int = killed) -> None:
                nonlocal syncs
                syncs += 1
                if syncs > last:
                    os._exit(9)

            os.fsync = sync
            merge(parts, Path("d"))
            os._exit(0)
        if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0:
            break
        if (Path("d") / "manifest.sqlite").exists():
            status = status_of(Path("d"))
            there = len(list(Path("d/shards").glob("*.h5")))
            assert (status.accepted == 10) == (there == 4 and len(status.rows) == 12)
            with pytest.raises(InputError, match="holds another dataset"):
                merge([other], Path("d"))
        merge(parts, Path("d"))
        assert contents(Path("d")) == expected and told(Path("d")) == told(Path("whole"))
        with pytest.raises(InputError, match="exists and is not empty"):
            merge(parts, Path("d"))
    assert killed > 10


def test_a_dataset_that_is_being_written_is_refused(tmp_path: Path) -> None:
    sweep, settings = tiny_sweep(tmp_path), SweepSettings(tmp_path / "dataset")
    with taken_folder(sweep, settings):
        before = {path.name: path.read_bytes() for path in settings.directory.iterdir()}
        for resume in (False, True):
            with pytest.raises(InputError, match=rf"is being written by process {os.getpid()} on"):
                run_sweep(sweep, replace(settings, resume=resume))
        assert {path.name: path.read_bytes() for path in settings.directory.iterdir()} == before
    assert "run.lock" in before and not (settings.directory / "run.lock").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("usual_optimisations")
def test_workers_of_a_running_scheduler_make_the_same_dataset(
    truth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scheduler and two workers, each a process of its own, as a batch system starts them.

    They have the optimisations of every sweep.
    """
    small_shards(monkeypatch)
    address = tmp_path / "address.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": ROOT}
    programs = [
        [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"],
        *[[sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads", "1", "--no-dashboard"]] * 2,
    ]
    processes = [subprocess.Popen([*words, "--scheduler-file", str(address)], **quiet) for words in programs]
    try:
        _wait(lambda: address.exists() and address.read_text().endswith("}"), 60)
        where = json.loads(address.read_text())["address"]
        _wait(lambda: _worker_count(where) == 2, 60)
        state = run_sweep(tiny_sweep(tmp_path), SweepSettings(tmp_path / "dataset", scheduler=where))
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert state.accepted == 12
    assert contents(tmp_path / "dataset") == contents(truth)
    assert told(tmp_path / "dataset") == told(truth)


def _worker_count(address: str) -> int:
    from distributed import Client

    with Client(address) as client:
        return len(client.scheduler_info(n_workers=-1)["workers"])


def _wait(ready: object, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < end
        time.sleep(0.1)


def _kill_often(command: list[str], directory: Path, kills: int, draws: random.Random, pause: float) -> int:
    """Run a command again and again, killing it or one of its children, and return how often anything was killed."""
    done = 0
    while True:
        with started(directory, *command) as process:
            while done < kills:
                try:
                    process.wait(draws.uniform(0.2, 1.0) * pause)
                    break
                except subprocess.TimeoutExpired:
                    pass
                children = psutil.Process(process.pid).children(recursive=True)
                victim = draws.choice([process.pid, *(child.pid for child in children)])
                os.kill(victim, signal.SIGKILL)
                done += 1
                if victim == process.pid:
                    break
            out, err = process.communicate(timeout=300)
        if process.returncode != -signal.SIGKILL:
            assert process.returncode == 0, (out, err)
            return done


@pytest.mark.parametrize(("count", "kills"), [(16, 2), pytest.param(200, 5, marks=pytest.mark.slow)], ids=["16", "200"])
def test_a_sweep_that_is_killed_and_resumed_makes_the_same_dataset(tmp_path: Path, count: int, kills: int) -> None:
    """SIGKILL at random times, to the command and to its workers."""
    base = BASE.replace("end = 0.05", "end = 0.5").replace("cells = [16, 16]", "cells = [32, 32]")
    path = write_sweep(tmp_path, count, base)
    began = time.monotonic()
    with started(tmp_path, "sweep", path, "-o", "whole", "--workers", 1, "-q") as process:
        _, err = process.communicate()
    assert process.returncode == 0, err
    took = time.monotonic() - began
    command = ["sweep", path, "-o", "killed", "--resume", "--workers", "2", "-q"]
    killed = _kill_often(list(map(str, command)), tmp_path, kills, random.Random(5), took / 2)
    assert killed >= 1, f"nothing was killed; one worker takes {took:.1f} s"
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")
    assert told(tmp_path / "killed") == told(tmp_path / "whole")
    assert run_here("dataset", "verify", tmp_path / "killed", "-q").status == 0


def test_the_rate_is_that_since_every_worker_has_ended_a_task() -> None:
    """10 of 20 trajectories were there; 2 came in the first 5 s, 6 in the next 3."""
    state = SweepState(Path(), 20, kept=10, seconds=5.0)
    state.verdicts["stable"] = 12
    assert state.per_hour == pytest.approx(3600 * 2 / 5)
    state.settled = 12, 5.0
    assert state.per_hour == pytest.approx(3600 * 2 / 5)
    state.verdicts["stable"], state.seconds = 18, 8.0
    assert state.per_hour == pytest.approx(3600 * 6 / 3)


def test_an_interrupt_keeps_what_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C: exit code 130, and --resume computes the rest only."""
    small_shards(monkeypatch, 2)
    sweep, settings = tiny_sweep(tmp_path, 6), SweepSettings(tmp_path / "dataset", workers=1, resume=True)
    seen: list[int] = []
    state = run_sweep(sweep, settings, lambda state: seen.append(state.done), lambda: bool(seen))
    assert state.status == "interrupted" and 0 < state.done < 6
    status = status_of(tmp_path / "dataset")
    assert (len(status.rows), status.expected) == (state.done, 6)
    missing = f"{6 - state.done} trajectories not computed; mpmcli sweep --resume goes on."
    assert verify(tmp_path / "dataset").faults == (missing,)
    again = run_sweep(sweep, settings)
    assert (again.status, again.kept, again.done) == ("finished", state.done, 6)
    assert verify(tmp_path / "dataset").faults == ()


def test_local_workers_open_no_port(tmp_path: Path) -> None:
    """Nobody else can send them code: while a sweep runs, none of its processes listens, and none is connected."""
    path = write_sweep(tmp_path, 40, BASE.replace("end = 0.05", "end = 0.5"))
    manifest = tmp_path / "dataset" / "manifest.sqlite"
    with started(tmp_path, "sweep", path, "-o", "dataset", "--workers", 2, "-q", own_group=True) as process:
        _wait(lambda: manifest.exists() and status_of(tmp_path / "dataset").rows, 120)
        workers = psutil.Process(process.pid).children(recursive=True)
        assert len(workers) >= 2
        for one in (psutil.Process(process.pid), *workers):
            assert one.net_connections("inet") == []
        os.killpg(process.pid, signal.SIGINT)
        process.communicate(timeout=60)


def test_a_trajectory_that_kills_its_workers_is_left_out(tmp_path: Path) -> None:
    """A law that ends each process but the first: three workers are lost, and the sweep goes on to its end."""
    law = tmp_path / "fatal.py"
    fatal = "import multiprocessing, os\n\nif multiprocessing.parent_process():\n    os._exit(7)\n"
    law.write_text(fatal + LAW, encoding="utf-8")
    path = write_sweep(tmp_path, 1)
    outcome = run_here("sweep", path, "-o", tmp_path / "dataset", "--workers", 1, "--plugin", law, "-q")
    assert (outcome.status, outcome.stderr) == (1, "")
    (row,) = status_of(tmp_path / "dataset").rows
    assert (row.verdict, row.reason) == ("failed", LOST)


def test_ctrl_c_reaches_all_processes_and_shows_no_traceback(tmp_path: Path) -> None:
    """As a terminal sends it, to the whole group."""
    path = write_sweep(tmp_path, 400, BASE.replace("end = 0.05", "end = 0.5"))
    words = ("sweep", path, "-o", "dataset", "--workers", 2)
    manifest = tmp_path / "dataset" / "manifest.sqlite"
    with started(tmp_path, *words, own_group=True) as process:
        _wait(lambda: manifest.exists() and status_of(tmp_path / "dataset").rows, 120)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and out.startswith("interrupted: "), (out, err)
    assert "Traceback" not in err and "Error" not in err
    assert 0 < len(status_of(tmp_path / "dataset").rows) < 400


def test_a_bad_trajectory_is_tried_again_and_then_left_out(tmp_path: Path) -> None:
    """A law of the wrong sign: three runs of each, with ever smaller steps."""
    law = tmp_path / "wrong.py"
    law.write_text(WRONG_LAW, encoding="utf-8")
    base = BASE.replace(
        '{ preset = "sand", friction_angle = 30.0 }', '{ law = "log_fluid", density = 1e3, sound_speed = 100.0 }'
    )
    path = write_sweep(tmp_path, 2, base)
    text = path.read_text(encoding="utf-8").replace("material.friction_angle", "material.density")
    # The block stands on the floor: in free fall nothing disturbs it.
    path.write_text(text[: text.index("[place]")].replace("[25, 40]", "[900, 1100]"), encoding="utf-8")
    outcome = run_here("sweep", path, "-o", tmp_path / "dataset", "--plugin", law, "--workers", 1, "--json", "-q")
    assert outcome.status == 1, outcome.stderr
    report = json.loads(outcome.stdout)
    assert report["accepted"] == 0 and report["dataset"]["retried"] == 2
    for row, one in zip(told(tmp_path / "dataset"), report["dataset"]["excluded"], strict=True):
        assert row.verdict in ("unstable", "escaped") and row.retries == 2 and not row.accepted
        assert "the run became unstable at step" in row.reason and one["reason"] == row.reason
        with h5py.File(tmp_path / "dataset" / row.file) as file:
            group = file[f"{row.number:06d}"]
            assert len(group["time"]) == row.frames < 5
            scene = tomllib.loads(json.loads(group.attrs["header"])["scene"])
            assert scene["time"]["safety"] == Time.model_fields["safety"].default / 4
    assert not (tmp_path / "dataset" / "shards").exists()
    assert run_here("dataset", "verify", tmp_path / "dataset", "-q").status == 0
    status = run_here("dataset", "status", tmp_path / "dataset").stdout
    assert "0 of 2 trajectories included" in status and "000001" in status


def test_a_fault_in_one_trajectory_does_not_end_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets a row that says so, and the next ones are computed."""

    calls, run = [], Runner.run

    def faulty(*arguments: object) -> Recording:
        calls.append(arguments)
        if len(calls) == 2:
            raise ZeroDivisionError("division by zero")
        return run(*arguments)

    sweep = tiny_sweep(tmp_path, 3)
    monkeypatch.setattr(Runner, "run", faulty)
    first, second, third = compute(Task(tmp_path / "dataset", sweep, (0, 1, 2)))
    assert (second.number, second.verdict, second.accepted) == (1, "failed", 0)
    assert second.reason == "ZeroDivisionError: division by zero (a fault of mpmcli)."
    assert first.verdict == third.verdict == "stable" and len(calls) == 3


@pytest.mark.parametrize(("rules", "retries"), [(("turns",), 0), (("energy",), 2), (("compressed", "courant"), 2)])
def test_a_retry_that_cannot_help_is_not_made(tmp_path, monkeypatch, rules, retries) -> None:
    """A shorter step changes no water that turns, but energy that grows."""
    found, check = tuple(Finding("warning", rule, f"{rule}.", "Change it.") for rule in rules), runner.check_kept
    monkeypatch.setattr(runner, "check_kept", lambda *run: replace(check(*run), findings=found))
    (row,) = compute(Task(tmp_path / "dataset", tiny_sweep(tmp_path, 1), (0,)))
    assert (row.verdict, row.reason, row.retries, row.accepted) == ("suspect", f"{rules[0]}.", retries, 0)


@pytest.mark.parametrize("count", [60, pytest.param(500, marks=pytest.mark.slow)])
def test_memory_stays_flat(tmp_path: Path, count: int) -> None:
    """Of the process of a worker, over trajectories of many sizes."""
    sweep = tiny_sweep(tmp_path, count)
    process, sizes = psutil.Process(), []
    for number in range(count):
        compute(Task(tmp_path / "dataset", sweep, (number,)))
        sizes.append(process.memory_info().rss)
    # The first ones compile kernels and fill caches.
    assert max(sizes[-20:]) < 1.02 * max(sizes[20:40])


def test_what_has_changed_is_found(truth: Path, tmp_path: Path) -> None:
    """One bit, a file that is gone, a file that nobody wrote."""
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(truth, copy)
    with h5py.File(copy / "shards" / "00001.h5", "r+") as file:
        file["000006/position"][2, 3, 1] = np.nextafter(file["000006/position"][2, 3, 1], np.float32(9))
    (copy / "shards" / "00002.h5").unlink()
    (copy / "shards" / "00009.h5").write_bytes(b"")
    outcome = run_here("dataset", "verify", copy, "-q")
    assert outcome.status == 1
    assert "trajectory 6 in" in outcome.stdout and "its checksum differs" in outcome.stdout
    assert "00002.h5 is missing" in outcome.stdout and "00009.h5 is in no row" in outcome.stdout
    assert "3 faults" in outcome.stdout


def test_bad_input_has_one_sentence(truth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is written; exit code 2."""
    path = write_sweep(tmp_path)

    def refused(*words: object) -> str:
        before = sorted(tmp_path.rglob("*"))
        outcome = run_here("sweep", path, *words)
        assert outcome.status == 2 and outcome.stdout == "" and outcome.stderr.count("\n") == 1, outcome
        assert sorted(tmp_path.rglob("*")) == before
        return outcome.stderr

    assert "holds a dataset: --resume goes on with it" in refused("-o", truth)
    assert "another sweep, or of another count" in refused("-o", truth, "--resume", "--count", 11)
    assert "holds part 1/1 of the sweep" in refused("-o", truth, "--resume", "--shard", "1/2")
    assert "--shard 2/2 is empty: 12 trajectories fill 1 shard" in refused("-o", tmp_path / "d", "--shard", "2/2")
    assert "3/2 is not a part" in refused("-o", tmp_path / "d", "--shard", "3/2")
    assert "exists and is not empty" in refused("-o", tmp_path)
    assert "no scheduler answers there" in refused("-o", tmp_path / "d", "--scheduler", "tcp://127.0.0.1:1")
    monkeypatch.setattr("mpmcli.dataset.sweep_run.shutil.disk_usage", lambda _: SimpleNamespace(free=5))
    assert "but the dataset needs about" in refused("-o", tmp_path / "d")
    assert run_here("dataset", "status", tmp_path).status == 2


def test_keys_of_the_base_are_set_and_a_dataset_is_replaced(tmp_path: Path) -> None:
    """As if the base said so; what is no dataset stays."""
    sweep = write_sweep(tmp_path, 2)
    words = ("--set", "time.frames=2", "--quiet", "--workers", "1")
    assert run_here("sweep", sweep, "-o", tmp_path / "d", *words).status == 0
    assert [each.frame_count for each in open_dataset(tmp_path / "d")] == [3, 3]
    refused = run_here("sweep", sweep, "-o", tmp_path / "d", *words)
    assert refused.status == 2 and "holds a dataset" in refused.stderr
    both = run_here("sweep", sweep, "-o", tmp_path / "d", "--overwrite", "--resume")
    assert both.status == 2 and "give one of them" in both.stderr
    assert run_here("sweep", sweep, "-o", tmp_path / "d", "--overwrite", "--quiet", "--workers", "1").status == 0
    assert [each.frame_count for each in open_dataset(tmp_path / "d")] == [5, 5]
    other = run_here("sweep", sweep, "-o", tmp_path, "--overwrite")
    assert other.status == 2 and "holds no dataset" in other.stderr and sweep.exists()
    bad = run_here("sweep", sweep, "-o", tmp_path / "e", "--set", "time.frmes=2")
    assert bad.status == 2 and 'did you mean "frames"' in bad.stderr and not (tmp_path / "e").exists()


@pytest.mark.parametrize("name", ["one%20way", "100%", "a?mode=memory", "#1", "one way"])
@pytest.mark.usefixtures("made_workers")
def test_the_rows_are_those_of_the_path_that_is_given(name: str) -> None:
    """Whatever a URI would read in it, beside a dataset whose name is what it would read."""
    if name != "one way":
        make_dataset("one way/d", count=3)
    dataset = make_dataset(f"{name}/d", count=9)
    assert status_of(dataset).expected == len(Manifest(dataset).rows()) == 9
    outcome = run_here("dataset", "verify", dataset, "--json")
    assert outcome.status == 0 and json.loads(outcome.stdout)["trajectories"] == 9


def test_a_path_that_is_not_utf_8_gets_a_sentence(tmp_path: Path) -> None:
    """As an option or an argument; nothing is written."""
    sweep, bad = write_sweep(tmp_path), Path(os.fsdecode(bytes(tmp_path / "caf") + b"\xe9"))
    bad.mkdir()
    for words in (
        ("sweep", sweep, "-o", bad / "d"),
        ("dataset", "status", bad),
        ("info", bad),
        ("check", bad / "s.toml"),
    ):
        outcome = run_here(*words)
        assert outcome.status == 2 and "is not UTF-8" in outcome.stderr and outcome.stderr.count("\n") == 1, outcome
    assert list(bad.iterdir()) == []


def files_of(directory: Path) -> dict[str, bytes]:
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


@pytest.mark.usefixtures("made_workers")
def test_nothing_is_removed_before_all_is_known_to_be_right(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a dataset nor what lies beside it, where a scheduler, a part, the disk or a file is not as needed."""
    dataset = make_dataset("d")
    (dataset / "notes.txt").write_text("mine", encoding="utf-8")
    (dataset / "mine.toml").write_text(Path("sweep.toml").read_text(encoding="utf-8"), encoding="utf-8")
    before = files_of(dataset)

    def refused(sweep: object, *words: object) -> str:
        outcome = run_here("sweep", sweep, "-o", "d", "--overwrite", *words)
        assert outcome.status == 2 and files_of(dataset) == before, outcome
        return outcome.stderr

    assert "no scheduler answers there" in refused("sweep.toml", "--scheduler", "tcp://127.0.0.1:1")
    assert "--shard 900/901 is empty" in refused("sweep.toml", "--count", "12", "--shard", "900/901")
    assert "d/base.toml is read by this sweep" in refused("d/mine.toml", "--count", "12", "--set", "time.frames=2")
    with monkeypatch.context() as patch:
        patch.setattr("mpmcli.dataset.sweep_run.shutil.disk_usage", lambda _: SimpleNamespace(free=5))
        assert "but the dataset needs about" in refused("sweep.toml")
    with take_lock(dataset):
        before = files_of(dataset)
        assert "is being written by" in refused("sweep.toml")
    before.pop("run.lock")
    text = Path("base.toml").read_text(encoding="utf-8")
    moved = text.replace("ball = { center = [0.7, 0.2], radius = 0.1 }", 'points = { file = "no.csv", spacing = 0.02 }')
    Path("base.toml").write_text(moved, encoding="utf-8")
    assert "no.csv" in refused("sweep.toml")


@pytest.mark.usefixtures("made_workers")
def test_overwrite_removes_files_of_mpmcli_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Through a link and in the present directory, too; neither what the owner has written nor what the sweep reads."""
    make_dataset("there")
    Path("d").symlink_to("there", target_is_directory=True)
    mine = ["notes.txt", "shards/notes.txt", "pending/000001.txt", "quarantine/seen.h5", "mine.toml"]
    for name in mine:
        (Path("d") / name).parent.mkdir(exist_ok=True)
        (Path("d") / name).write_text(SWEEP.replace("1000", "6"), encoding="utf-8")
    readme = Path("d/README.md")
    readme.write_bytes(b"# Ours\r\n" + readme.read_bytes() + b"Cite us.\r\n")
    for sweep, directory in (("sweep.toml", "d"), ("d/mine.toml", "d"), ("d/sweep.toml", "d"), ("mine.toml", ".")):
        if directory == ".":
            monkeypatch.chdir("d")
        words = ("--count", 6) if sweep == "sweep.toml" else ()
        outcome = run_here("sweep", sweep, "-o", directory, "--overwrite", "--quiet", *words)
        assert outcome.status == 1, outcome.stderr
        there = Path(directory)
        found = files_of(there)
        made = {"sweep.toml", "base.toml", "manifest.sqlite", "README.md", "quarantine/000004.h5"}
        made |= {"train.jsonl", "valid.jsonl"}
        assert set(found) == {*mine, *made, "shards/00000.h5", "shards/00001.h5"}
        assert all(found[name].decode() == SWEEP.replace("1000", "6") for name in mine)
        _, front, text = found["README.md"].split(b"---\n", 2)
        assert b"split: train" in front and text.startswith(b"\n# Ours\r\n<!--") and text.endswith(b"Cite us.\r\n")
        assert verify(there).faults == () and len(open_dataset(there)) == 5


@pytest.mark.usefixtures("made_workers")
def test_an_interrupt_leaves_what_the_sweep_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before its first trajectory, in the directory of the sweep file."""
    make_dataset("d", count=6)
    (Path("d") / "notes.txt").write_text("mine", encoding="utf-8")
    kept = {
        name: data for name, data in files_of(Path("d")).items() if name in ("sweep.toml", "base.toml", "notes.txt")
    }
    monkeypatch.setattr("mpmcli.cli.dataset.interrupt_came", lambda: True)
    assert run_here("sweep", "d/sweep.toml", "-o", "d", "--overwrite").status == 130
    assert files_of(Path("d")) == kept


def test_a_copied_file_takes_no_place(of_points: Sweep) -> None:
    """Of a file that the owner has put there, or has changed; the copy goes, but not where it is the file itself."""
    settings = SweepSettings(Path("dataset"), workers=1)
    with taken_folder(of_points, settings):
        pass
    again, copy = replace(settings, overwrite=True), Path("dataset/grains.csv")
    with taken_folder(of_points, again):
        assert copy.read_bytes() == Path("grains.csv").read_bytes()
    own = load_sweep("dataset/sweep.toml", laws=parameter_models())
    with taken_folder(own, again):
        assert copy.read_bytes() == Path("grains.csv").read_bytes()
    copy.write_text("x,y\n0.3,0.3\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"dataset/grains.csv would be replaced"), taken_folder(of_points, again):
        pass
    assert copy.read_text(encoding="utf-8") == "x,y\n0.3,0.3\n"


def test_a_rule_on_particles_is_of_those_that_a_run_has(truth: Path, tmp_path: Path) -> None:
    """Of the trajectories with the fewest and the most particles, the second is held out, in row and file."""
    counts = {row.particles: row.number for row in told(truth)}
    numbers = [counts[min(counts)], counts[max(counts)]]
    rule = f"[split]\ntrain = 1\n[split.test]\nparticles = [{max(counts)}, {max(counts)}]\n"
    path = write_sweep(tmp_path)
    path.write_text(path.read_text(encoding="utf-8") + rule, encoding="utf-8")
    sweep = load_sweep(path, laws=parameter_models())
    rows = [row for task in _tasks(sweep, SweepSettings(tmp_path / "d"), numbers, 1) for row in compute(task)]
    assert [(row.particles, row.split) for row in rows] == [(min(counts), "train"), (max(counts), "test")]
    for row in rows:
        with h5py.File(tmp_path / "d" / row.file) as file:
            assert file[f"{row.number:06d}"].attrs["split"] == row.split


def test_a_rehearsal_tells_draws_disk_and_time(truth: Path, tmp_path: Path) -> None:
    """Its bytes are those of the dataset, within what headers take, and its draws those that come."""
    outcome = run_here("sweep", write_sweep(tmp_path), "--dry-run", "--json", "-o", tmp_path / "d")
    assert outcome.status == 0, outcome.stderr
    report = json.loads(outcome.stdout)
    rows = told(truth)
    assert [one["values"] for one in report["trajectories"]] == [json.loads(row.draws) for row in rows]
    assert all(one["particles"] == row.particles for one, row in zip(report["trajectories"], rows, strict=True))
    stored = sum(path.stat().st_size for path in (truth / "shards").iterdir())
    assert report["bytes"] == pytest.approx(stored, rel=0.3)
    assert report["seconds"] > 0 and not (tmp_path / "d").exists()
    one = run_here("sweep", write_sweep(tmp_path), "--dry-run", "--count", 1, "-o", tmp_path / "d")
    notes = [line for line in one.stdout.splitlines() if line.startswith("note: no trajectory is in the split")]
    assert len(notes) == 2 and one.stdout.endswith("compilation apart\n")


@pytest.mark.usefixtures("drawing")
def test_workers_draw_images_of_trajectories_that_are_there(truth: Path, tmp_path: Path) -> None:
    """Of a finished dataset, to which [images] is added; each particle is on the mask of its body."""
    shutil.copytree(truth, tmp_path / "d")
    sweep = tiny_sweep(tmp_path, more='images = { what = ["mask"], frames = "last" }\n')
    state = run_sweep(sweep, SweepSettings(tmp_path / "d", workers=2, resume=True))
    assert (state.status, state.kept, state.imaged) == ("finished", 12, 12) and verify(tmp_path / "d").faults == ()
    for trajectory in open_dataset(tmp_path / "d"):
        (mask,), camera = trajectory.images("camera", "mask"), trajectory.cameras["camera"]
        x, y = (trajectory.position[-1] - 0.5).T * camera.K[0, 0]
        assert (mask[(128 - y).astype(int), (128 + x).astype(int)] == trajectory.body + 1).mean() > 0.95
    assert run_sweep(sweep, SweepSettings(tmp_path / "d", workers=2, resume=True)).imaged == 0


POINTS = BASE.replace(
    "box = { min = [0.2, 0.0], max = [0.5, 0.3] }", 'points = { file = "grains.csv", spacing = 0.02 }'
)
OF_POINTS = 'base = "base.toml"\ncount = 2\n[vary]\n"domain.gravity.1" = { uniform = [-9.81, -3.7] }\n'


@pytest.fixture
def of_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sweep:
    """A sweep of particles from a file in the present directory, which has a namesake with fewer in `elsewhere`."""
    (tmp_path / "base.toml").write_text(POINTS.replace('sampling = "jittered"\n', ""), encoding="utf-8")
    (tmp_path / "sweep.toml").write_text(OF_POINTS, encoding="utf-8")
    for directory, count in ((tmp_path, 30), (tmp_path / "elsewhere", 20)):
        directory.mkdir(exist_ok=True)
        rows = [f"{0.2 + 0.005 * k},0.2" for k in range(count)]
        (directory / "grains.csv").write_text("\n".join(["x,y", *rows]), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return load_sweep("sweep.toml", laws=parameter_models())


def test_a_worker_reads_the_files_of_the_sweep(of_points: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever it runs; a file that differs there ends the sweep."""
    task, _ = _tasks(of_points, SweepSettings(Path("dataset")), [0, 1], 1)
    monkeypatch.chdir("elsewhere")
    assert [row.particles for row in compute(task)] == [30]
    Path("../grains.csv").write_text(Path("grains.csv").read_text(encoding="utf-8"), encoding="utf-8")
    changed = replace(task, sources=(*task.sources, *task.sources))
    with pytest.raises(InputError, match=r"grains.csv: a worker on .* finds another file there than the sweep has"):
        compute(changed)


def test_a_dataset_is_not_resumed_with_other_files(of_points: Sweep) -> None:
    settings = SweepSettings(Path("dataset"), workers=1)
    with taken_folder(of_points, settings):
        pass
    with taken_folder(of_points, replace(settings, resume=True)):
        pass
    Path("grains.csv").write_text("x,y\n0.3,0.3\n", encoding="utf-8")
    refused = pytest.raises(InputError, match=r"grains.csv has changed since dataset was begun")
    with refused, taken_folder(of_points, replace(settings, resume=True)):
        pass


def test_a_file_that_the_sweep_names_for_all_is_one_of_its_files(of_points: Sweep) -> None:
    Path("other.csv").write_text("x,y\n0.3,0.3\n", encoding="utf-8")
    Path("sweep.toml").write_text(OF_POINTS + '"bodies.sand.shape.points.file" = "other.csv"\n', encoding="utf-8")
    sweep = load_sweep("sweep.toml", laws=parameter_models())
    assert set(source_files(sweep, [])) == {"grains.csv", "other.csv"}


def test_a_dataset_goes_on_from_its_own_sweep(of_points: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    """With its base, its geometry and its count, though all that it was made of is gone."""
    Path("grains").mkdir()
    Path("grains.csv").rename("grains/of sand.csv")
    base = Path("base.toml").read_text(encoding="utf-8").replace("grains.csv", "grains/of sand.csv")
    Path("scene.toml").write_text(base, encoding="utf-8")
    Path("sweep.toml").write_text(OF_POINTS.replace("base.toml", "scene.toml"), encoding="utf-8")
    sweep = load_sweep("sweep.toml", laws=parameter_models(), count=3)
    settings = SweepSettings(Path("dataset").absolute(), workers=1)
    with taken_folder(sweep, settings):
        pass
    for name in ("base.toml", "scene.toml", "sweep.toml", "grains/of sand.csv"):
        Path(name).unlink()
    monkeypatch.chdir("elsewhere")
    own = load_sweep(settings.directory / "sweep.toml", laws=parameter_models())
    assert own.key == sweep.key and own.count == 3
    with taken_folder(own, replace(settings, resume=True)) as (folder, _):
        assert folder.count == 3
    made = sorted(path.name for path in settings.directory.iterdir())
    assert "grains" in made
    discard_beginning(sweep, settings.directory, [settings.directory])
    assert not settings.directory.exists()


@pytest.mark.parametrize("text", [
    'base = "a.toml"\ncount = 5\n[vary]\nx = { uniform = [0, 1] }',
    'seed = 3\n  base="a.toml" # of old\n[vary]\ncount = { choice = [1, 2] }\nbase = { choice = [1] }',
    "count = 9\r\nbase = 'a.toml'\r\n",
    'base = """\na.toml"""\ncount = 3\n',
    "[vary]\nx = 1\n[split]\ntrain = 1.0",
    'place = [\n  { template = "a" },\n]\nbase = "a.toml"',
])  # fmt: skip
def test_a_sweep_that_stands_alone_says_the_same(text: str) -> None:
    data = tomllib.loads(text)
    found = tomllib.loads(standing_alone(SimpleNamespace(text=text, data=data, count=7)))
    assert found in ({**data, "base": "base.toml", "count": 7}, data)
    assert found != data or '"""' in text


def test_parts_without_a_shard_are_not_asked_for(tmp_path: Path) -> None:
    """Two trajectories are one shard, and the second of two parts has none."""
    state = run_sweep(tiny_sweep(tmp_path, count=2), SweepSettings(tmp_path / "first", workers=1, part=(1, 2)))
    assert (state.done, state.expected) == (2, 2)
    merge([tmp_path / "first"], tmp_path / "whole")
    assert open_dataset(tmp_path / "whole").numbers == (0, 1)


@pytest.mark.parametrize(("change", "said"), [
    ({"split": "other"}, "other draws or another split"),
    ({"draws": "{}"}, "other draws or another split"),
    ({"frames": 4}, "other counts"),
    ({"particles": 1}, "other counts"),
    ({"checksum": "0" * 8}, "has changed"),
])  # fmt: skip
def test_a_row_that_contradicts_its_trajectory_is_a_fault(truth: Path, change: dict, said: str) -> None:
    manifest = Manifest(truth)
    row = manifest.rows()[3]
    manifest.put([replace(row, **change)])
    faults = verify(truth).faults
    manifest.put([row])
    assert len(faults) == 1 and said in faults[0]


@pytest.mark.parametrize("step", ["auto", 1e-4])
def test_a_retry_halves_whatever_sets_the_step(tmp_path, step):
    more = "" if step == "auto" else f"step = {step}\n"
    sweep = tiny_sweep(tmp_path, 1, BASE.replace("frames = 4\n", f"frames = 4\n{more}"))
    scene = draw(sweep, 0).scene(parameter_models()).scene
    assert _with_step(scene, 1) == scene
    shorter = _with_step(scene, 0.25)
    assert shorter.time.safety == 0.25 * scene.time.safety
    assert shorter.time.step == ("auto" if step == "auto" else 0.25 * step)
    assert shorter.model_copy(update={"time": scene.time}) == scene

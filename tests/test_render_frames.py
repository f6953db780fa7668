"""Tests of rendering in several processes: every frame once, errors as they are, and no process left behind."""

import os
import subprocess
import sys
import time
from multiprocessing import resource_tracker
from pathlib import Path

import psutil
import pytest
from frame_jobs import WritingJob

from mpmcli.errors import InputError, RunError
from mpmcli.processes import pool
from mpmcli.processes.pool import available_cores, render_frames

FRAMES = [0, 2, 4, 6, 8, 9]
# Seconds that anything here may take.
PATIENCE = 60.0


@pytest.fixture(autouse=True)
def no_process_is_left():
    # multiprocessing keeps this one.
    resource_tracker.ensure_running()
    before = psutil.Process().children(recursive=True)
    yield
    assert psutil.Process().children(recursive=True) == before


def frames_in(folder: Path) -> set[int]:
    return {int(path.name.removeprefix("frame_")) for path in folder.glob("frame_*")}


@pytest.mark.parametrize("workers", [1, 2])
def test_every_frame_is_rendered_once_and_told(tmp_path, monkeypatch, workers):
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    told = {}
    job = WritingJob(tmp_path, "alone" if workers > 1 else "", at=0)
    render_frames(job, FRAMES, workers, watch=told.__setitem__)
    assert {k: outcome["square"] for k, outcome in told.items()} == {k: k * k for k in FRAMES}
    assert frames_in(tmp_path) == set(FRAMES)
    processes = {outcome["process"] for outcome in told.values()}
    assert len(processes) == workers and (os.getpid() in processes) == (workers == 1)
    # The job is started once in each process.
    assert {int(path.name.removeprefix("process_")) for path in tmp_path.glob("process_*")} == processes
    assert "LP_NUM_THREADS" not in os.environ
    if workers > 1:
        assert {outcome["threads"] for outcome in told.values()} == {str(max(1, available_cores() // 2))}
        assert all(outcome["ctrl_c"] for outcome in told.values())


def test_one_frame_needs_no_other_process_and_no_frame_none_at_all(tmp_path):
    told = {}
    render_frames(WritingJob(tmp_path), [5], 4, watch=told.__setitem__)
    assert told[5]["process"] == os.getpid()
    render_frames(WritingJob(tmp_path, trouble="start"), [], 4)


def test_threads_that_the_user_has_set_are_left_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("LP_NUM_THREADS", "7")
    told = {}
    render_frames(WritingJob(tmp_path), [0, 1], 2, watch=told.__setitem__)
    assert {outcome["threads"] for outcome in told.values()} == {"7"}


@pytest.mark.parametrize(
    ("trouble", "error", "sentence"),
    [
        ("start", InputError, r"^There is no GL\.$"),
        ("input", InputError, r"^Frame 3 is damaged\.$"),
        ("run", RunError, r"^The disk is full\.$"),
        ("fault", KeyError, r"^'nothing'"),
        ("killed", RunError, r"^A process that rendered frames was killed or crashed. Finished frames are kept"),
        ("exit", RunError, r"^A process that rendered frames was killed or crashed. Finished frames are kept"),
    ],
)
def test_what_goes_wrong_in_a_process_arrives_here(tmp_path, trouble, error, sentence):
    told = {}
    with pytest.raises(error, match=sentence) as caught:
        render_frames(WritingJob(tmp_path, trouble), [0, 1, 2, 3, 4, 5], 2, watch=told.__setitem__)
    assert type(caught.value) is error
    assert set(told) <= frames_in(tmp_path) and 3 not in told
    if trouble == "fault":
        # --debug shows where it was.
        assert 'raise KeyError("nothing")' in str(caught.value.__cause__)


def test_an_error_is_the_same_in_this_process(tmp_path):
    with pytest.raises(InputError, match=r"^Frame 3 is damaged\.$"):
        render_frames(WritingJob(tmp_path, "input"), [0, 3, 4], 1)
    assert frames_in(tmp_path) == {0}


@pytest.mark.parametrize("trouble", ["sleep", "deaf"])
def test_a_stop_ends_all_processes_and_keeps_what_is_done(tmp_path, monkeypatch, trouble):
    """Frame 3 takes a minute; it cleans up behind itself, unless it hears nothing and is killed."""
    monkeypatch.setattr(pool, "GRACE", 0.2 if trouble == "deaf" else PATIENCE)
    unfinished, began = tmp_path / "unfinished.tmp", time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        render_frames(WritingJob(tmp_path, trouble), [0, 1, 2, 3], 2, stop=unfinished.exists)
    assert time.monotonic() - began < PATIENCE
    assert len(frames_in(tmp_path)) >= 2 and unfinished.exists() == (trouble == "deaf")


def test_a_stop_is_heard_between_frames_in_this_process(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        render_frames(WritingJob(tmp_path), FRAMES, 1, stop=lambda: (tmp_path / "frame_4").exists())
    assert frames_in(tmp_path) == {0, 2, 4}


def test_an_exception_of_the_watcher_ends_all_processes_too(tmp_path):
    def interrupted(k: int, outcome: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_frames(WritingJob(tmp_path, "sleep"), [0, 3], 2, watch=interrupted)


def test_no_process_outlives_the_one_that_was_killed(tmp_path):
    code = (
        f"import sys; sys.path[:] = {sys.path!r}\n"
        "from pathlib import Path; from frame_jobs import WritingJob\n"
        "from mpmcli.processes.pool import render_frames\n"
        f"render_frames(WritingJob(Path({str(tmp_path)!r})), range(10**6), 2)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL) as process:
        until = time.monotonic() + PATIENCE
        while len(list(tmp_path.glob("process_*"))) < 2:
            assert process.poll() is None and time.monotonic() < until
            time.sleep(0.02)
        process.kill()
    workers = [int(path.name.removeprefix("process_")) for path in tmp_path.glob("process_*")]
    while any(psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE for pid in workers):
        assert time.monotonic() < until
        time.sleep(0.02)

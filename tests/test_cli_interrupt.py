"""A run that is ended from outside: every sealed frame stays, packed where there was time for it."""

import itertools
import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from command import SCENE, run_here, started

from mpmcli.cli.interrupt import catch_interrupts, interrupt_came, interrupts_wait
from mpmcli.errors import DiskFullError
from mpmcli.output import open_result, store
from mpmcli.solver.engine.run import Run

# The run is longer than any machine needs until the signal comes.
LONG = SCENE.replace("end = 0.05", "end = 5000.0").replace("frames = 4", "frames = 2000")
SEALS_BEFORE = 2
PATIENCE = 120  # s


def end_with(number: signal.Signals, directory: Path, *, ctrl_c_off: bool = False) -> tuple[int, str, str]:
    """Start a long run, send a signal once some frames are sealed, and return its status, stdout and stderr."""
    (directory / "scene.toml").write_text(LONG, encoding="utf-8")
    with started(directory, "simulate", "scene.toml", "-o", "result", ctrl_c_off=ctrl_c_off) as process:
        waited_until = time.monotonic() + PATIENCE
        while len(list((directory / "result" / "segments").glob("*.vtkhdf"))) < SEALS_BEFORE:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < waited_until, "no frame came"
            time.sleep(0.05)
        process.send_signal(number)
        stdout, stderr = process.communicate(timeout=PATIENCE)
    return process.returncode, stdout, stderr


@pytest.mark.parametrize(
    ("number", "ctrl_c_off", "code"),
    [(signal.SIGINT, False, 130), (signal.SIGTERM, True, 143), (signal.SIGHUP, False, 143)],
    ids=["Ctrl-C", "SIGTERM of a run in the background", "the end of the terminal"],
)
def test_an_interrupt_packs_what_is_done(tmp_path, number, ctrl_c_off, code):
    status, stdout, stderr = end_with(number, tmp_path, ctrl_c_off=ctrl_c_off)
    assert status == code and "Traceback" not in stderr
    assert f"error: the run was interrupted ({number.name})" in stderr.splitlines()
    parts = [line.split(":")[0] for line in stdout.splitlines()]
    assert parts == ["interrupted", "seconds", "energy", "volume ratio J at the end", "result"]
    assert stdout.splitlines()[-1] == f"result: {Path('result/particles.vtkhdf')}"
    directory = tmp_path / "result"
    expected = ["checkpoints", "particles.vtkhdf", "run.json", "scene.toml"]
    assert sorted(path.name for path in directory.iterdir()) == expected
    record = json.loads((directory / "run.json").read_text(encoding="utf-8"))
    assert record["status"] == "interrupted" and record["ended"] and record["failure"]["signal"] == number.name
    check_readable(directory, "packed", record["frames_written"])


def test_sealed_frames_survive_a_kill(tmp_path):
    status, _, _ = end_with(signal.SIGKILL, tmp_path)
    assert status == -signal.SIGKILL
    # The record is written after the seal, so it may be one seal behind.
    directory = tmp_path / "result"
    record = json.loads((directory / "run.json").read_text(encoding="utf-8"))
    assert record["status"] == "running" and open_result(directory).status == "died"
    check_readable(directory, "segments", record["frames_written"])


def check_readable(directory: Path, kind: str, count: int) -> None:
    """Read every frame of a result that should hold `count` frames, or those of one more seal after a kill."""
    result = open_result(directory)
    assert result.kind == kind
    assert result.frame_count >= SEALS_BEFORE
    assert result.frame_count == count if kind == "packed" else result.frame_count >= count
    for frame, row in zip(result.frames(), result.ledger, strict=True):
        assert np.isfinite(frame.position).all() and frame.time == row.time


def test_an_interrupt_ends_the_run_at_its_next_frame(tmp_path, monkeypatch):
    """It waits for the end of a step: an exception in the middle of one may fall into a callback and be lost."""
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    asked = itertools.count()
    # The first question comes before anything is written.
    monkeypatch.setattr("mpmcli.cli.simulate.interrupt_came", lambda: next(asked) > 0)
    outcome = run_here("simulate", tmp_path / "scene.toml", "-o", tmp_path / "result")
    assert outcome.status == 130 and "error: the run was interrupted" in outcome.stderr
    assert open_result(tmp_path / "result").frame_count == 1


@pytest.mark.parametrize("fault", ["Ctrl-C", "a full disk", "none"])
def test_an_earlier_result_stays_until_a_frame_takes_its_place(tmp_path, monkeypatch, fault):
    """Computed again from the scene in its own directory; until then it is as it was, byte for byte."""
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    directory = tmp_path / "result"
    assert run_here("simulate", tmp_path / "scene.toml", "-o", directory, "-q").status == 0
    before = {path.name: path.read_bytes() for path in directory.iterdir()}
    sealed = store.Unsealed.seal

    def seal(file: store.Unsealed) -> None:
        # The first new frame is written, and has not its name yet.
        if file.path.name == "frame_000000.vtkhdf":
            assert sorted(os.listdir(directory)) == ["run.json", "run.lock", "scene.toml", "segments"]
        sealed(file)

    def refuse(*_: object, **__: object) -> None:
        raise KeyboardInterrupt if fault == "Ctrl-C" else DiskFullError("The disk is full.")

    monkeypatch.setattr(store.Unsealed, "seal", seal)
    if fault != "none":
        place, name = {"Ctrl-C": (Run, "frames"), "a full disk": (store, "require_free_space")}[fault]
        monkeypatch.setattr(place, name, refuse)
    outcome = run_here("simulate", directory / "scene.toml", "-o", directory, "--overwrite", "--set", "time.frames=2")
    after = {path.name: path.read_bytes() for path in directory.iterdir()}
    if fault == "none":
        assert outcome.status == 0 and open_result(directory).frame_count == 3 and sorted(after) == sorted(before)
    else:
        assert outcome.status == {"Ctrl-C": 130, "a full disk": 1}[fault], outcome
        assert outcome.stderr.endswith(f"; the earlier result in {directory} is kept.\n"), outcome
        assert after == before


def test_an_interrupt_that_became_another_error_is_still_one(tmp_path, monkeypatch):
    def interrupted_import(path: Path) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None

    monkeypatch.setattr("mpmcli.output.open_result", interrupted_import)
    outcome = run_here("info", tmp_path)
    assert (outcome.status, outcome.stdout, outcome.stderr) == (143, "", "interrupted\n")


def test_the_first_interrupt_waits_where_a_run_asks_for_it_and_the_second_does_not():
    catch_interrupts()
    with interrupts_wait():
        signal.raise_signal(signal.SIGTERM)
        assert interrupt_came()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    catch_interrupts()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)

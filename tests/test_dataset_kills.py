"""Sweeps, merges and exports that are killed at random instants (SIGKILL) lose nothing, and the next call ends them."""

import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from made_sweep import made_workers, make_dataset, small_sweep  # noqa: F401
from scenes import slow
from tiny_sweep import contents, told

from mpmcli.dataset.dataset import open_dataset
from mpmcli.dataset.export import ExportSettings, export, verify_export
from mpmcli.dataset.folder import MANIFEST, Manifest
from mpmcli.dataset.merge import merge
from mpmcli.dataset.report import verify
from mpmcli.dataset.sweep_run import SweepSettings, run_sweep
from mpmcli.errors import InputError
from mpmcli.output.lock import LOCK

pytestmark = [pytest.mark.usefixtures("made_workers"), pytest.mark.parametrize("kills", [2, slow(10)])]
DATASET = Path("d")


def kill_often(work: Callable[[], object], kills: int, after: Callable[[], object]) -> None:
    """Let child processes do some work, each killed within the time that it takes; `after` each kill, look.

    A child that has ended its work before does not count.
    """
    draws, done = random.Random(kills), 0
    began = time.monotonic()
    seconds = 0.0
    while done < kills:
        if not (child := os.fork()):
            try:
                work()
            finally:
                os._exit(0)
        if seconds:
            time.sleep(draws.uniform(0.0, seconds))
            os.kill(child, signal.SIGKILL)
        ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert ended in (0, -signal.SIGKILL)
        done += ended != 0
        # The first one is left alone, which tells how long it takes.
        seconds = seconds or time.monotonic() - began
        after()


def test_a_sweep(kills: int) -> None:
    """Its rows only become more, and the files are those of one that was left alone."""
    whole, counts = make_dataset("whole"), [0]

    def look() -> None:
        rows = Manifest(DATASET).rows() if (DATASET / MANIFEST).exists() else []
        assert len(rows) >= counts[-1]
        counts.append(len(rows))
        if len(rows) == 12 and not (DATASET / "pending").exists():
            run_sweep(small_sweep(), SweepSettings(DATASET, resume=True))
            assert contents(DATASET) == contents(whole) and told(DATASET) == told(whole)
            shutil.rmtree(DATASET)
            counts.append(0)

    kill_often(lambda: run_sweep(small_sweep(), SweepSettings(DATASET, resume=True)), kills, look)
    run_sweep(small_sweep(), SweepSettings(DATASET, resume=True))
    assert contents(DATASET) == contents(whole) and verify(DATASET).faults == ()


def test_a_sweep_that_overwrites(kills: int) -> None:
    """Foreign files, and those that the sweep reads, are there after each kill, and --resume ends it."""
    whole = make_dataset("whole")
    shutil.copytree(whole, DATASET)
    mine = {DATASET / name: b"mine" for name in ("notes.txt", "shards/notes.txt")}
    for path, data in mine.items():
        path.write_bytes(data)
    readme = DATASET / "README.md"
    readme.write_bytes(b"Ours.\n" + readme.read_bytes() + b"Cite us.\n")
    mine |= {DATASET / name: (whole / name).read_bytes() for name in ("sweep.toml", "base.toml")}

    def look() -> None:
        assert all(path.read_bytes() == data for path, data in mine.items())
        # Front matter is first, once it is written.
        assert readme.read_bytes().count(b"Ours.\n") == 1 and readme.read_bytes().endswith(b"Cite us.\n")
        again = SweepSettings(DATASET, resume=True)
        assert run_sweep(small_sweep(), again).status == "finished" and verify(DATASET).faults == ()
        assert told(DATASET) == told(whole)

    kill_often(lambda: run_sweep(small_sweep(), SweepSettings(DATASET, overwrite=True)), kills, look)


def test_a_merge(kills: int) -> None:
    """The parts are as they were, and the same call ends it, with the files of one that was left alone."""
    parts = [make_dataset(f"part{i}", (i, 2)) for i in (1, 2)]
    merge(parts, Path("whole"))
    before = [contents(part) for part in parts]

    def look() -> None:
        try:
            merge(parts, DATASET)
        except InputError as error:
            assert "exists and is not empty" in str(error)
            # A lock that was not released, which the next one to write takes.
            (DATASET / LOCK).unlink(missing_ok=True)
        assert contents(DATASET) == contents(Path("whole")) and told(DATASET) == told(Path("whole"))
        assert [contents(part) for part in parts] == before
        shutil.rmtree(DATASET)

    kill_often(lambda: merge(parts, DATASET), kills, look)


def test_an_export_that_overwrites(kills: int) -> None:
    """One of the two, and all of it, is there for the next call, which refuses to replace it unasked."""
    dataset, target = open_dataset(make_dataset("whole")), Path("out")
    settings = ExportSettings("npz", target)
    former = replace(settings, form="gns", overwrite=True)
    export(dataset, former)
    names = {tuple(sorted(path.name for path in target.iterdir()))}

    def look() -> None:
        with pytest.raises(InputError, match="exists and is not empty"):
            export(dataset, settings)
        assert verify_export(target).sound
        names.add(tuple(sorted(path.name for path in target.iterdir())))
        export(dataset, former)

    kill_often(lambda: export(dataset, replace(settings, overwrite=True)), kills, look)
    assert len(names) == 2

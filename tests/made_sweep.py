"""A sweep whose trajectories no solver computes: their frames are made up, and their verdicts chosen by number."""

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from good_sweep import BASE, SWEEP, sweep_of
from made_dataset import made_trajectory

from mpmcli.dataset import sweep_run
from mpmcli.dataset.certify import write_certificate
from mpmcli.dataset.compute import Task
from mpmcli.dataset.draw import draw
from mpmcli.dataset.folder import Row, program
from mpmcli.dataset.images import draw_images
from mpmcli.dataset.shard import PENDING, QUARANTINE, checksum, file_name, group_name, write_trajectory
from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.sweep_run import SweepSettings, run_sweep
from mpmcli.output.checksums import append_checksum

COUNT, PER_SHARD = 12, 3
# Of the numbers that are not stable.
VERDICTS = {4: "unstable", 9: "suspect"}


def small_sweep(count: int = COUNT) -> Sweep:
    """Return a sweep of boxes of sand beside a stone, in files of the present directory."""
    return sweep_of(SWEEP, BASE, count)


def made_row(task: Task, number: int) -> Row:
    """Write the made-up frames of a trajectory where a worker would, and return its row."""
    drawn, verdict = draw(task.sweep, number), VERDICTS.get(number, "stable")
    accepted = verdict == "stable"
    drawn = replace(drawn, split=task.sweep.split_of(number, 20 + number))
    data = made_trajectory(number, particles=20 + number, split=drawn.split)
    data = replace(data, draws=drawn.values)
    file = f"{PENDING if accepted else QUARANTINE}/{file_name(number)}"
    path = task.directory / file
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as opened:
        write_trajectory(opened, data)
        found = checksum(opened[group_name(number)])
    append_checksum(path)
    return Row(
        number=number,
        split=drawn.split,
        draws=json.dumps(drawn.values, sort_keys=True),
        scene="",
        verdict=verdict,
        reason="" if accepted else f"{task.sweep.path}: trajectory {number}: it blew up.",
        accepted=int(accepted),
        retries=0 if accepted else 2,
        steps=100,
        frames=len(data.time),
        particles=20 + number,
        # What differs from one run to the next.
        seconds=1.0 + id(path) % 1000,
        arch="cpu",
        precision="f32",
        **program(),
        file=file,
        checksum=found,
    )


def made_certificate(number: int) -> dict:
    """Return errors that grow as the square of the time."""
    time = [0.01 * k for k in range(11)]
    places = {
        name: [size * t**2 for t in time] for name, size in (("moved", 1.0), ("grid", 0.1 + number), ("rounding", 1e-5))
    }
    measured = {"time_s": time, "position_m": {"cell": [0.05] * 11, **places}, "observables": {"density": time}}
    measured["one_step"] = {"1": {"error": [0.003, 0.004], "std": [0.01, 0.01]}}
    return {"number": number, "left_out": [], "parted_s": None, "measured": measured}


class MadeWorkers:
    """In place of the workers of a cluster."""

    count = 1

    def outcomes(self, tasks: Iterable[Task], stop: Callable[[], bool]) -> Iterator[tuple[Task, list[Row]]]:
        for task in tasks:
            if stop():
                raise KeyboardInterrupt
            if task.certified:
                write_certificate(task.directory, made_certificate(task.certified.number))
            if task.imaged:
                draw_images(task.directory, task.imaged, task.sweep)
            kept = task.certified or task.imaged
            yield task, [kept] if kept else [made_row(task, number) for number in task.numbers]


@pytest.fixture
def made_workers(tmp_path, monkeypatch) -> None:
    """Let sweeps of this test be computed by nobody, in shards of a few trajectories, in an empty directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweep_run, "local_workers", lambda count: nullcontext(MadeWorkers()))
    monkeypatch.setattr(sweep_run, "_per_shard", lambda size: PER_SHARD)


def make_dataset(name: str, part: tuple[int, int] = (1, 1), *, count: int = COUNT, broken_after: int = 0) -> Path:
    """Run the sweep into a directory; with `broken_after`, interrupted after so many tasks and then resumed."""
    sweep, asked = small_sweep(count), 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        return asked > broken_after

    settings = SweepSettings(Path(name), part=part)
    if broken_after:
        assert run_sweep(sweep, settings, stop=stop).status == "interrupted"
        settings = replace(settings, resume=True)
    assert run_sweep(sweep, settings).status == "finished"
    return Path(name)

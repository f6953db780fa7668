"""Runs that find no more room: on a disk that fills while they go on, or with a limit on the size of a file.

Each run is a process of its own, forked from one that has imported everything and started nothing, and ends as any
interpreter does, so that a crash at its exit counts.
"""

import ctypes
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

from mpmcli.errors import MpmcliError
from mpmcli.materials.registry import parameter_models
from mpmcli.output import durable, open_result
from mpmcli.output.segments import PACKED
from mpmcli.scene import LoadedScene, parse_scene
from mpmcli.simulation import stored_run
from mpmcli.simulation.settings import RunSettings
from mpmcli.simulation.simulate import simulate
from mpmcli.solver.engine import exchange

Kind = Literal["disk", "limit"]
# What the run knows of the room: less the usual margin, all of it, or nothing, as where there is a quota.
Sight = Literal["margin", "exact", "blind"]
SIGHTS: tuple[Sight, ...] = ("margin", "exact", "blind")
DISK = 64 * 1024 * 1024
# Steps in a launch, after each of which a checkpoint is taken.
STEPS = 8
# Bytes that the system needs for the names of files.
GRAIN = 4096


@dataclass(frozen=True)
class Outcome:
    """What came of one run.

    Attributes:
        kind: what ended; sight: what it knew of the room; room: bytes that it had.
        ended: "fit" where the room sufficed, "told" where a sentence was written, "crashed" otherwise.
        sentence: what it said; reported: frames that it had reported.
        fault: what is wrong, "" where nothing is.
    """

    kind: Kind
    sight: Sight
    room: int
    ended: str
    sentence: str
    reported: int
    fault: str


@dataclass(frozen=True)
class Reference:
    """The run that had room: the bytes of its packed file, of its largest segment and of all that it had at once."""

    packed: bytes
    segment: int
    most: int
    path: Path


def falling_block() -> LoadedScene:
    """Return a scene of 2,500 particles and 9 frames."""
    data = {
        "domain": {"size": [1.0, 1.0], "cells": [50, 50], "gravity": [0.0, -9.81]},
        "time": {"end": 8 / 512, "frames": 8},
        "bodies": [
            {
                "name": "block",
                "material": {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5},
                "shape": {"box": {"min": [0.25, 0.05], "max": [0.75, 0.55]}},
            }
        ],
    }
    return parse_scene(data, laws=parameter_models(), source="block.toml")


def may_mount() -> str:
    """Return why no small file system can be mounted here, "" where it can."""
    if os.geteuid() != 0 or shutil.which("mount") is None:
        return "only root can mount a file system"
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder], capture_output=True, text=True, check=False
        )
        if done.returncode == 0:
            subprocess.run(["umount", folder], check=True)
    return done.stderr.strip()


def campaign(kind: Kind, runs: int, seed: int, scratch: Path, tell: Callable[[int, Outcome], None]) -> list[Outcome]:
    """Let so many runs find no more room, and resume each after room is made.

    Args:
        scratch: an empty folder on a disk with room.
        tell: is told the number of each run, and its outcome.
    """
    # A process with a limit may spoil what it keeps there.
    os.environ["XDG_CACHE_HOME"] = str(scratch / "cache")
    reference = _reference(scratch)
    drawn = random.Random(seed)
    outcomes = []
    for k in range(1, runs + 1):
        most = len(reference.packed) if kind == "limit" else reference.most
        # As many below a tenth of what is needed as above.
        room = int(most * 100 ** -drawn.random()) // GRAIN * GRAIN
        outcomes.append(_one(kind, room, SIGHTS[k % 3], scratch / f"{kind}{k}", reference))
        tell(k, outcomes[-1])
    return outcomes


def _reference(scratch: Path) -> Reference:
    folder = scratch / "reference"
    told = scratch / "told"
    status = _forked(lambda: _simulate(folder, told))
    if status != 0:
        raise RuntimeError(f"the run with room ended with {status}: {told.read_text()}")
    packed = (folder / PACKED).read_bytes()
    segment = len(packed) // 9
    # All segments, the packed file, and three checkpoints.
    return Reference(packed, segment, 2 * len(packed) + 6 * segment, folder)


def _one(kind: Kind, room: int, sight: Sight, folder: Path, reference: Reference) -> Outcome:
    """Run once without room and once with it."""
    folder.mkdir()
    told = folder.with_suffix(".told")
    try:
        if kind == "disk":
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(folder)], check=True)
        result, filler = folder / "result", folder / "filler" if kind == "disk" else None
        free = room + (durable.SPACE_MARGIN if sight == "margin" else 0)
        limit = room if kind == "limit" else None
        status = _forked(lambda: _simulate(result, told, limit=limit, sight=sight, filler=filler, free=free))
        text = told.read_text() if told.exists() else ""
        reported, _, sentence = text.partition("\n")
        outcome = Outcome(kind, sight, room, "fit" if status == 0 else "told", sentence, int(reported or 0), "")
        fault = _fault(status, sentence, result, outcome.reported, reference)
        if status < 0:
            outcome = Outcome(kind, sight, room, "crashed", sentence, outcome.reported, "")
        if not fault:
            if filler is not None:
                filler.unlink(missing_ok=True)
            told.unlink(missing_ok=True)
            status = _forked(lambda: _simulate(result, told, resume=True))
            if status != 0:
                fault = f"resumed with room, it ended with {status}: {told.read_text()}"
            elif (result / PACKED).read_bytes() != reference.packed:
                fault = "resumed with room, it ended with other bytes"
        return Outcome(**{**vars(outcome), "fault": fault})
    finally:
        if kind == "disk":
            subprocess.run(["umount", str(folder)], check=False)
        shutil.rmtree(folder, ignore_errors=True)


def _fault(status: int, sentence: str, result: Path, reported: int, reference: Reference) -> str:
    """Return what is wrong after the run without room."""
    if status < 0 or status not in (0, 1, 2):
        return f"the process ended with {status}: {sentence}"
    if status != 0 and (not sentence.strip().endswith(".") or "Traceback" in sentence or "\n" in sentence.strip()):
        return f"it said: {sentence!r}"
    if reported:
        found, expected = open_result(result), open_result(reference.path)
        if found.frame_count < reported:
            return f"{found.frame_count} of {reported} reported frames are left"
        for k in range(reported):
            a, b = found.frame(k), expected.frame(k)
            if a.step != b.step or any(
                getattr(a, name).tobytes() != getattr(b, name).tobytes() for name in ("position", "velocity")
            ):
                return f"frame {k} reads back otherwise"
    if list(result.glob("**/*.tmp")):
        return f"{next(result.glob('**/*.tmp'))} was left"
    return ""


def _simulate(
    result: Path,
    told: Path,
    *,
    resume: bool = False,
    limit: int | None = None,
    sight: Sight = "margin",
    filler: Path | None = None,
    free: int = 0,
) -> int:
    """Simulate, in a forked process; write the number of reported frames and a sentence to `told`.

    Args:
        limit: on the size of a file, bytes; sight: what the run knows of the room.
        filler: a file that takes all room but `free` bytes of its disk once the run has begun.

    Returns:
        The exit status of `mpmcli simulate`.
    """
    stored_run.HOLD = 0.0
    exchange.FIRST, exchange.LAUNCH = STEPS * 2500, 0.02
    # Before the limit, as this file is no part of the run.
    with open(told, "w+", encoding="utf-8") as tale:
        reported, status, sentence = 0, 1, ""

        def fill(_: object) -> None:
            if filler is not None:
                with open(filler, "wb") as file:
                    os.posix_fallocate(file.fileno(), 0, max(GRAIN, shutil.disk_usage(filler.parent).free - free))

        def count(row: object, summary: object) -> None:
            nonlocal reported
            reported = summary.frames

        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        if sight != "margin":
            durable.SPACE_MARGIN = 0
        if sight == "blind":
            durable.shutil = SimpleNamespace(disk_usage=lambda _: SimpleNamespace(free=10**12))
        settings = RunSettings(result, arch="cpu", threads=1, resume=resume, checkpoint_every=0.0)
        try:
            summary = simulate(falling_block(), settings, fill, count)
            status, sentence = (0 if summary.status == "finished" else 1), summary.message
        except MpmcliError as error:
            status, sentence = error.exit_code, str(error)
        except BaseException:
            status, sentence = 99, traceback.format_exc()
        tale.write(f"{reported}\n{sentence}")
    return status


def _forked(run: Callable[[], int]) -> int:
    """Run in a process of its own, which ends as an interpreter does; return its status, negative for a signal."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        status = 98
        try:
            status = run()
        finally:
            # Not os._exit, which would leave out the end of the interpreter, where HDF5 closes what is open.
            ctypes.pythonapi.Py_Exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

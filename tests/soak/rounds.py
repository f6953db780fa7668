"""Rounds of a soak: every scene once, by a `Runner` or by `simulate`, and the memory after it."""

import gc
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mpmcli.errors import MpmcliError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output import open_result
from mpmcli.simulation.runner import Runner
from mpmcli.simulation.settings import RunSettings
from mpmcli.simulation.simulate import simulate
from mpmcli.solver.machine.backend import stop_backend
from soak.laws import broken_laws, digest, energy_growth, resting_speed
from soak.scenes import SoakScene

# Growth of the memory over the last half of the rounds that counts as flat, as a fraction.
FLAT = 0.01


@dataclass(frozen=True)
class Round:
    """One pass over the scenes.

    Attributes:
        steps: of all runs; seconds: of wall time; memory: resident at the end, bytes.
        speed: largest speed at rest, m/s; growth: of energy, largest of all scenes.
        faults: sentences on what is broken.
    """

    steps: int
    seconds: float
    memory: int
    speed: float
    growth: float
    faults: tuple[str, ...]


def rounds(cases: Sequence[SoakScene]) -> Iterator[Round]:
    """Yield rounds without end; the runs of each are compared with those of the first, bit by bit."""
    first: dict[str, str] = {}
    while True:
        began = time.monotonic()
        steps, speeds, growths, faults = 0, [0.0], [0.0], []
        # One process, one backend: what is stored is computed after the others.
        runner = Runner("cpu", 1)
        for case in sorted(cases, key=lambda case: case.stored):
            try:
                frames, rows = _stored(case) if case.stored else _kept(case, runner)
            except MpmcliError as error:
                faults.append(f"{case.name}: {error}")
                continue
            steps += frames[-1].step
            faults += broken_laws(case, frames, rows)
            growths.append(energy_growth(case, rows))
            if case.rest is not None:
                speeds.append(resting_speed(rows))
            found = digest(frames, rows)
            if first.setdefault(case.name, found) != found:
                faults.append(f"{case.name}: the numbers differ from those of the first round.")
        del runner
        stop_backend()
        gc.collect()
        yield Round(steps, time.monotonic() - began, resident(), max(speeds), max(growths), tuple(faults))


def memory_growth(memory: Sequence[int]) -> float:
    """Return the growth over the last half of the rounds by a straight line through them, as a fraction of the mean."""
    half = np.array(memory[len(memory) // 2 :], float)
    if len(half) < 2:
        return 0.0
    slope = np.polyfit(np.arange(len(half)), half, 1)[0]
    return float(slope * (len(half) - 1) / half.mean())


def resident() -> int:
    """Return the resident memory of this process, bytes."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return 1024 * int(next(line.split()[1] for line in lines if line.startswith("VmRSS:")))


def soak(
    cases: Sequence[SoakScene], goes_on: Callable[[list[Round]], bool], tell: Callable[[int, Round], None]
) -> list[str]:
    """Compute rounds while `goes_on`, and return what is broken, a sentence each.

    Args:
        tell: is told the number of each round, and the round.
    """
    done: list[Round] = []
    for one in rounds(cases):
        done.append(one)
        tell(len(done), one)
        if not goes_on(done):
            break
    faults = [f"Round {k}: {fault}" for k, one in enumerate(done, 1) for fault in one.faults]
    growth = memory_growth([one.memory for one in done])
    if growth > FLAT:
        faults.append(
            f"The resident memory grew by {growth:.1%} over the last half of the rounds, more than {FLAT:.0%}."
        )
    return faults


def _kept(case: SoakScene, runner: Runner) -> tuple[Sequence[Frame], Sequence[LedgerRow]]:
    recording = runner.run(case.loaded.scene)
    if recording.verdict != "stable":
        raise MpmcliError(f"the run was {recording.verdict}: {recording.reason}")
    return recording.frames, recording.ledger


def _stored(case: SoakScene) -> tuple[Sequence[Frame], Sequence[LedgerRow]]:
    stop_backend()
    with tempfile.TemporaryDirectory() as folder:
        summary = simulate(case.loaded, RunSettings(Path(folder) / "result", arch="cpu", threads=1))
        if summary.status != "finished":
            raise MpmcliError(f"the run was {summary.status}: {summary.message}")
        result = open_result(summary.path)
        return [result.frame(k) for k in range(result.frame_count)], result.ledger

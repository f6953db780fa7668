"""The runs of a level: each case at its resolutions and settings, in separate processes, with stored results."""

import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

from mpmcli.bench.report import describe_machine
from mpmcli.errors import InputError, MpmcliError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import parameter_models
from mpmcli.output.directory import check_directory
from mpmcli.output.durable import write_text, writing
from mpmcli.processes.pool import Fault, in_processes
from mpmcli.scene import Scene, parse_scene
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import Backend, start_backend
from mpmcli.validation.case import KNOBS, Case, Level, Setting
from mpmcli.validation.cases import all_cases

PACKAGE = Path(__file__).resolve().parent.parent
RESULTS, PAGE, FIGURES = "results.json", "report.md", "figures"
# NumPy uses one thread in the process of a run, so that concurrent runs do not compete for cores.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class CaseRun:
    """One case at resolution n with one setting."""

    case: str
    n: int
    setting: Setting


def variants(knob: str) -> list[Setting]:
    """Return the settings that differ from the default one in one field."""
    usual = getattr(Setting(), knob)
    return [Setting(**{knob: value}) for value in KNOBS[knob] if value != usual]


def runs_of(case: Case, level: Level) -> list[CaseRun]:
    """Return the runs of a case at a level, the default setting first, each setting from coarse to fine.

    The level "coarse" has the default setting, and f32 at the finest resolution. Other levels vary every field in
    `case.varies` at every resolution, except for the Courant fraction, which is varied at the (lower) median.
    """
    resolutions = sorted(case.levels[level])
    median, finest = resolutions[(len(resolutions) - 1) // 2], resolutions[-1]
    runs = [CaseRun(case.name, n, Setting()) for n in resolutions]
    for knob in KNOBS:
        if knob not in case.varies or (level == "coarse" and knob != "precision"):
            continue
        at = [finest] if level == "coarse" else [median] if knob == "safety" else resolutions
        runs += [CaseRun(case.name, n, variant) for variant in variants(knob) for n in at]
    return runs


def matrix(cases: Iterable[Case], level: Level) -> list[CaseRun]:
    """Return the runs of several cases, case by case."""
    return [run for case in cases for run in runs_of(case, level)]


@dataclass(frozen=True)
class RunResult:
    """Outcome, measures and cost of a run; times are in s."""

    status: Literal["finished", "unstable", "failed"]  # "unstable" if the solver stopped it
    message: str = ""
    values: dict[str, float] = field(default_factory=dict)  # the measures by name; empty if the run did not finish
    particles: int = 0
    steps: int = 0
    # Processor time of the time steps, without the first one, which compiles the kernels, and without frames and rows.
    seconds: float = 0.0
    compile_seconds: float = 0.0  # of the first step

    @property
    def finished(self) -> bool:
        """Whether the run finished; only finished runs have values."""
        return self.status == "finished"

    @property
    def rate(self) -> float:
        """Particle-steps per second, without the first step; 0 if nothing was timed."""
        return self.particles * max(self.steps - 1, 0) / self.seconds if self.seconds > 0 else 0.0

    def error(self, measure: str) -> float | None:
        """Return the absolute value of a measure; None if the run did not finish."""
        return abs(self.values[measure]) if self.finished else None


Results = Mapping[CaseRun, RunResult]


def scene_of(case: Case, n: int, setting: Setting) -> Scene:
    """Return the scene of a case at resolution n. Raises InputError if it is not valid."""
    return parse_scene(case.scene_tables(n, setting), laws=parameter_models(), source=f"<{case.name}>").scene


def carry_out(case: Case, n: int, setting: Setting, backend: Backend | None = None) -> RunResult:
    """Run a case and return its measures; errors are reported in the result.

    If `backend` is None, the CPU backend is started with one thread and the precision of the setting.
    """
    try:
        scene = scene_of(case, n, setting)
        run = build_run(scene, backend or start_backend("cpu", 1, scene.solver.precision))
    except MpmcliError as error:
        return RunResult("failed", str(error))
    status, values, clock = "failed", {}, SteppingClock(run)
    try:
        values = {name: float(value) for name, value in case.measure(n, scene, clock.frames()).items()}
        odd = [f"{name} is {value}" for name, value in values.items() if not math.isfinite(value)]
        odd += [f"there is no {measure.name}" for measure in case.measures if measure.name not in values]
        message = f"The run finished, but {' and '.join(odd)}." if odd else ""
        status = "failed" if odd else "finished"
    except UnstableRunError as error:
        status, message = "unstable", str(error)
    except MpmcliError as error:
        message = str(error)
    except (ArithmeticError, ValueError) as error:
        # The solver did not detect the instability, but the state cannot be evaluated.
        message = f"The frames cannot be measured: {error}."
    values = values if status == "finished" else {}
    facts = run.particle_count, run.step_count, clock.seconds, run.first_step_seconds
    return RunResult(status, message, values, *facts)


class SteppingClock:
    """Measures the processor time of the steps of a run, s. It excludes the time of other programs."""

    def __init__(self, run: Run) -> None:
        self.seconds = 0.0
        self._run = run

    def frames(self) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the frames. Compilation and the caller's processing of the frames are not counted."""
        self._run.begin()
        frames = self._run.frames()
        while True:
            began, before = time.process_time(), self._run.frame_processor_seconds
            try:
                found = next(frames, None)
            finally:
                passed = time.process_time() - began - (self._run.frame_processor_seconds - before)
                self.seconds = max(self.seconds + passed, 0.0)
            if found is None:
                return
            yield found


def carry_out_run(run: CaseRun) -> RunResult:
    """Carry out a run in this process."""
    return carry_out(all_cases()[run.case], run.n, run.setting)


def carry_out_all(
    runs: Sequence[CaseRun],
    workers: int,
    timeout: float = 1800.0,
    stop: Callable[[], object] = lambda: False,
    work: Callable[[CaseRun], RunResult] = carry_out_run,
) -> Iterator[tuple[CaseRun, RunResult]]:
    """Yield (run, result) as runs end; see `in_processes`. A run that crashes or exceeds `timeout` s has failed."""
    os.environ.update(ONE_THREAD)
    for run, answer in in_processes(runs, workers, work, timeout, stop):
        yield run, RunResult("failed", f"The run failed: {answer.words}.") if isinstance(answer, Fault) else answer


class Journal:
    """The stored results of earlier runs in the directory of a report, by `run_key`."""

    def __init__(self, directory: Path, *, resume: bool = False, overwrite: bool = False) -> None:
        """Create the directory, and clear it or read its results. Raises InputError if it cannot be used."""
        check_directory(directory, overwrite, resume=resume)
        self._file = directory / RESULTS
        self._kept: dict[str, dict] = {}
        try:
            directory.mkdir(parents=True, exist_ok=True)
            if overwrite:
                for path in (self._file, directory / PAGE, *directory.glob(f"{FIGURES}/*.svg")):
                    path.unlink(missing_ok=True)
            elif self._file.exists():
                self._kept = json.loads(self._file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{directory} cannot be used ({reason}): give another place with -o.") from error

    def find(self, run: CaseRun) -> RunResult | None:
        """Return the stored result of a run by the same program on this processor; None if absent or failed."""
        found = self._kept.get(run_key(run))
        return None if found is None or found["status"] == "failed" else RunResult(**found)

    def keep(self, run: CaseRun, result: RunResult) -> None:
        """Store the result of a run. Raises RunError if the file cannot be written."""
        self._kept[run_key(run)] = asdict(result)
        with writing(self._file):
            write_text(self._file, json.dumps(self._kept, indent=1) + "\n")


def run_key(run: CaseRun) -> str:
    """Return the digest of the case, n, the scene, the program and the processor, on which times depend."""
    scene = all_cases()[run.case].scene_tables(run.n, run.setting)
    return hashlib.sha256(json.dumps([run.case, run.n, scene, *program()]).encode()).hexdigest()


@cache
def program() -> tuple[str, ...]:
    """Return a digest of the sources, the version of Taichi and the processor."""
    sources = sorted(path for path in PACKAGE.rglob("*") if path.is_file() and path.suffix != ".pyc")
    digest = hashlib.sha256(b"\0".join(path.read_bytes() for path in sources)).hexdigest()
    machine = describe_machine()
    return digest, machine["taichi"], machine["processor"]

"""Carries out the runs of a level, each in a process of its own, and keeps their results in the report's directory."""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path

from mpmcli.bench.report import describe_machine
from mpmcli.errors import InputError, RunError
from mpmcli.output.directory import check_directory
from mpmcli.output.durable import write_text
from mpmcli.processes.each import Fault, in_processes
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import Run, RunResult, carry_out

PACKAGE = Path(__file__).resolve().parent.parent
RESULTS, PAGE, FIGURES = "results.json", "report.md", "figures"
# Default time limit of a run, s.
TIMEOUT = 1800.0
# Numpy in the process of a run takes one thread, so that concurrent runs do not compete for cores.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def carry_out_run(run: Run) -> RunResult:
    """Carry out a run in this process."""
    return carry_out(all_cases()[run.case], run.n, run.setting)


def carry_out_all(
    runs: Sequence[Run],
    workers: int,
    timeout: float = TIMEOUT,
    stop: Callable[[], object] = lambda: False,
    work: Callable[[Run], RunResult] = carry_out_run,
) -> Iterator[tuple[Run, RunResult]]:
    """Yield (run, result) as runs end; see `in_processes`. A crash, or being late, is reported in the result."""
    os.environ.update(ONE_THREAD)
    for run, answer in in_processes(runs, workers, work, timeout, stop):
        yield run, RunResult("failed", f"The run failed: {answer.words}.") if isinstance(answer, Fault) else answer


class Journal:
    """The results of earlier runs in the directory of a report, by the digest of all that a run depends on."""

    def __init__(self, directory: Path, *, resume: bool = False, overwrite: bool = False) -> None:
        """Make the directory, or read the results in it, or clear it; InputError where it cannot be used."""
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

    def find(self, run: Run) -> RunResult | None:
        """Return the result of a run by the same program on this processor; None for a failure, such as a late run."""
        found = self._kept.get(run_key(run))
        return None if found is None or found["status"] == "failed" else RunResult(**found)

    def keep(self, run: Run, result: RunResult) -> None:
        """Store the result of a run; RunError where that fails."""
        self._kept[run_key(run)] = asdict(result)
        try:
            write_text(self._file, json.dumps(self._kept, indent=1) + "\n")
        except OSError as error:
            raise RunError(f"{self._file} could not be written ({error.strerror or error}).") from error


def run_key(run: Run) -> str:
    """Return the digest of a run: its case, its scene, the program, and the processor, on which times depend."""
    scene = all_cases()[run.case].scene_tables(run.n, run.setting)
    return hashlib.sha256(json.dumps([run.case, run.n, scene, *_program()]).encode()).hexdigest()


@cache
def _program() -> tuple[str, ...]:
    sources = sorted(path for path in PACKAGE.rglob("*") if path.is_file() and path.suffix != ".pyc")
    digest = hashlib.sha256(b"\0".join(path.read_bytes() for path in sources)).hexdigest()
    machine = describe_machine()
    return digest, machine["taichi"], machine["processor"]

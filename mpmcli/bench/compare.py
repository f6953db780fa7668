"""The comparison: all processes run at once and are measured in turn, so that other load affects all equally."""

import json
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Self

from mpmcli.bench.cases import CASES, BenchCase
from mpmcli.bench.report import BenchReport, CaseResult, ContestantResult
from mpmcli.errors import RunError
from mpmcli.plain_text import counted
from mpmcli.processes.questions import module_command

# Measured blocks of each contestant.
BLOCKS = 5
# Duration of the first block, s, which is not measured: the remaining kernels compile.
WARM_UP = 0.3


class Worker:
    """A process of `mpmcli.bench.contestant` and the pipe to it.

    Attributes:
        ready: its first answer.
        start_seconds: time from the start of the process to that answer.
    """

    def __init__(self, arguments: list[str]) -> None:
        self._what = " ".join(arguments)
        # Settings of taichi from outside would reach only one side, or both differently.
        environment = {key: value for key, value in os.environ.items() if not key.startswith("TI_")}
        # A file rather than a pipe: nobody reads it while the worker runs, and it must not fill up.
        self._stderr = tempfile.TemporaryFile(mode="w+", encoding="utf-8", errors="replace")  # noqa: SIM115
        begin = time.perf_counter()
        self._process = subprocess.Popen(
            module_command("mpmcli.bench.contestant", *arguments),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            text=True,
            encoding="utf-8",
            env=environment,
        )
        try:
            self.ready = self._answer()
        except BaseException:
            self.close()
            raise
        self.start_seconds = time.perf_counter() - begin

    def ask(self, command: str) -> dict:
        """Send one command and return the answer.

        Raises:
            RunError: the worker reports an error, or has died.
        """
        try:
            self._process.stdin.write(command + "\n")
            self._process.stdin.flush()
        except OSError:
            pass  # it has died; the answer contains the reason
        return self._answer()

    def close(self) -> None:
        """Kill the process if it is still running, and close its streams."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._stderr):
            try:
                stream.close()
            except OSError:
                continue  # unsent input of a process that has ended

    def _answer(self) -> dict:
        line = self._process.stdout.readline()
        answer = json.loads(line) if line else {"error": self._last_words()}
        if "error" in answer:
            raise RunError(f"The benchmark process `{self._what}` stopped: {answer['error']}")
        return answer

    def _last_words(self) -> str:
        status = self._process.wait()
        self._stderr.seek(0)
        said = self._stderr.read().strip().splitlines()[-3:]
        return " ".join([f"it ended with status {status}.", *said])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(frozen=True)
class Setting:
    """Settings of all contestants.

    Attributes:
        threads: of the processor, that each may use.
        precision: "f32" or "f64".
        arch: device, "cpu", "cuda" or "vulkan".
    """

    threads: int
    precision: str = "f32"
    arch: str = "cpu"


def start_worker(who: str, case: BenchCase, setting: Setting) -> Worker:
    """Start the process of a contestant (see `contestant`) for a case, and wait until it can step."""
    sizes = {"dimension": case.dimension, "cells": case.cells, "particles": case.particles, "step": case.step}
    values = {**sizes, **vars(setting)}
    return Worker([who, *(text for key, value in values.items() for text in (f"--{key}", f"{value}"))])


def run_bench(
    cases: Iterable[BenchCase] = CASES,
    threads: int | Sequence[int] = 1,
    seconds: float = 1.0,
    progress: Callable[[str], None] | None = None,
    *,
    blocks: int = BLOCKS,
    precision: str = "f32",
    arch: str = "cpu",
    yardstick: bool = False,
    peers: bool = False,
    start: Callable[[str, BenchCase, Setting], Worker] = start_worker,
) -> BenchReport:
    """Measure every case, blocks of ours, the peer's and the yardstick's in turn (A B C A B C), and return the report.

    Args:
        cases: sizes to measure, of mpmcli.bench.cases.
        threads: of the processor, for all, one number or several; ours takes one for each 2,500 particles, as
            `mpmcli simulate` does.
        seconds: length of one block.
        progress: called with a line of text for each case and each round of blocks.
        blocks: measured blocks of each contestant.
        precision: "f32" or "f64", for all.
        arch: device, for all.
        yardstick: whether the yardstick in C is measured, which computes in f32 on the CPU.
        peers: whether all examples that compute a fluid are measured, or the fastest one of each dimension.
        start: makes the process of a contestant; tests replace it.

    The yardstick, or another example than the peer, that cannot start is left out.

    Raises:
        RunError: ours or the peer could not start, or a contestant failed.
    """
    counts = (threads,) if isinstance(threads, int) else tuple(threads)
    tell = progress or (lambda line: None)
    who = ("ours", "peer", *(["yardstick"] if yardstick else []))
    results = [
        _run_case(
            case,
            Setting(count, precision, arch),
            (*who, *(case.other_peers if peers else ())),
            seconds,
            blocks,
            tell,
            start,
        )
        for case in cases
        for count in counts
    ]
    return BenchReport(tuple(results), threads=counts, precision=precision, arch=arch, seconds=seconds)


def _run_case(
    case: BenchCase,
    setting: Setting,
    who: Sequence[str],
    seconds: float,
    blocks: int,
    tell: Callable[[str], None],
    start: Callable[[str, BenchCase, Setting], Worker],
) -> CaseResult:
    where = f"{case.name}, {counted(setting.threads, 'thread')}"
    tell(f"{where}: {case.particles:,} particles, {case.cells}^{case.dimension} cells, against {case.peer}")
    with ExitStack() as stack:
        sides = []
        for name in who:
            side = Side(name, case)
            try:
                side.begin(stack, setting, start, min(WARM_UP, seconds))
            except RunError as error:
                if name in ("ours", "peer"):
                    raise
                tell(f"{where}: {name} is left out. {error}")
            else:
                sides.append(side)
        for block in range(blocks):
            for side in sides:
                side.measure(seconds)
            last = " against ".join(f"{side.rates[-1] / 1e6:.2f}" for side in sides)
            tell(f"{where}: block {block + 1} of {blocks}, {last} million particle-steps/s")
        found = {side.who: side.finish() for side in sides}
    main = {name: found.pop(name, None) for name in ("ours", "peer", "yardstick")}
    return CaseResult(case, setting.threads, **main, others=found)


class Side:
    """One contestant at one case, and the process that runs it.

    Attributes:
        who: see `start_worker`.
        rates: particle-steps/s of each block so far, by processor time on one thread, and else by wall time.
    """

    worker: Worker
    clock: str
    first_seconds: float

    def __init__(self, who: str, case: BenchCase) -> None:
        self.who, self.case = who, case
        self.rates: list[float] = []

    def begin(
        self,
        stack: ExitStack,
        setting: Setting,
        start: Callable[[str, BenchCase, Setting], Worker],
        warm_up: float = WARM_UP,
    ) -> None:
        """Start, compile, and take a block that is not measured.

        Raises:
            RunError: it could not start, or runs another number of particles.
        """
        self.worker = stack.enter_context(start(self.who, self.case, setting))
        # The processor time of one thread excludes that of other processes.
        self.clock = "processor_seconds" if setting.threads == 1 and setting.arch == "cpu" else "seconds"
        if self.worker.ready["particles"] != self.case.particles:
            name = {"ours": "mpmcli", "peer": self.case.peer}.get(self.who, self.who)
            raise RunError(
                f"{name} runs {self.worker.ready['particles']} particles instead of {self.case.particles}: "
                "they would not solve the same problem."
            )
        self.first_seconds = self.worker.ask("first")["seconds"]
        self.worker.ask(f"run {warm_up}")

    def measure(self, seconds: float) -> None:
        """Measure one block."""
        answer = self.worker.ask(f"run {seconds}")
        self.rates.append(self.case.particles * answer["steps"] / answer[self.clock])

    def finish(self) -> ContestantResult:
        """Return the result, and end the process."""
        end, ready = self.worker.ask("finish"), self.worker.ready
        return ContestantResult(
            rates=tuple(self.rates),
            start_seconds=self.worker.start_seconds,
            # Time of the first step beyond that of a usual step.
            compile_seconds=max(0.0, self.first_seconds - self.case.particles / statistics.median(self.rates)),
            peak_memory=end["peak_memory"],
            bytes_per_particle=ready["bytes_per_particle"],
            threads=ready["threads"],
            smallest_step=end["smallest_step"],
            sound=end["sound"],
        )

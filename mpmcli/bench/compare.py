"""The comparison: both processes run at once and are measured alternately, so that other load affects both equally."""

import json
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Self

from mpmcli.bench.cases import CASES, BenchCase
from mpmcli.bench.report import BenchReport, CaseResult, ContestantResult
from mpmcli.errors import RunError
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
    """Settings of both contestants.

    Attributes:
        threads: of the processor, that each may use.
        precision: "f32" or "f64".
        arch: device, "cpu", "cuda" or "vulkan".
    """

    threads: int
    precision: str = "f32"
    arch: str = "cpu"


def start_worker(who: str, case: BenchCase, setting: Setting) -> Worker:
    """Start one of BLOCKS, "peer" or the column of some laws for a case, and wait until it can step."""
    sizes = {"dimension": case.dimension, "cells": case.cells, "particles": case.particles, "step": case.step}
    values = {**sizes, **vars(setting)}
    return Worker([who, *(text for key, value in values.items() for text in (f"--{key}", f"{value}"))])


def run_bench(
    cases: Iterable[BenchCase] = CASES,
    threads: int = 1,
    seconds: float = 1.0,
    progress: Callable[[str], None] | None = None,
    *,
    blocks: int = BLOCKS,
    precision: str = "f32",
    arch: str = "cpu",
    start: Callable[[str, BenchCase, Setting], Worker] = start_worker,
) -> BenchReport:
    """Measure every case, ours and the peer's blocks in turn (A B A B), and return the report.

    Args:
        cases: sizes to measure, of mpmcli.bench.cases.
        threads: of the processor, for both; ours takes one for each 2,500 particles, as `mpmcli simulate` does.
        seconds: length of one block.
        progress: called with a line of text for each case and each pair of blocks.
        blocks: measured blocks of each contestant.
        precision: "f32" or "f64", for both.
        arch: device, for both.
        start: makes the process of a contestant; tests replace it.

    Raises:
        RunError: a contestant could not start or failed.
    """
    setting = Setting(threads, precision, arch)
    tell = progress or (lambda line: None)
    results = [_run_case(case, setting, seconds, blocks, tell, start) for case in cases]
    return BenchReport(tuple(results), threads=threads, precision=precision, arch=arch, seconds=seconds)


def _run_case(
    case: BenchCase,
    setting: Setting,
    seconds: float,
    blocks: int,
    tell: Callable[[str], None],
    start: Callable[[str, BenchCase, Setting], Worker],
) -> CaseResult:
    tell(f"{case.name}: {case.particles:,} particles, {case.cells}^{case.dimension} cells, against {case.peer}")
    with start("ours", case, setting) as ours, start("peer", case, setting) as peer:
        contestants = (ours, peer)
        for worker, who in zip(contestants, ("mpmcli", case.peer), strict=True):
            if worker.ready["particles"] != case.particles:
                raise RunError(
                    f"{who} runs {worker.ready['particles']} particles instead of {case.particles}: "
                    "the two would not solve the same problem."
                )
        first = [worker.ask("first")["seconds"] for worker in contestants]
        for worker in contestants:
            worker.ask(f"run {min(WARM_UP, seconds)}")
        rates: tuple[list[float], list[float]] = ([], [])
        for block in range(blocks):
            for worker, found in zip(contestants, rates, strict=True):
                answer = worker.ask(f"run {seconds}")
                found.append(case.particles * answer["steps"] / answer["seconds"])
            tell(
                f"{case.name}: block {block + 1} of {blocks}, {rates[0][-1] / 1e6:.2f} against "
                f"{rates[1][-1] / 1e6:.2f} million particle-steps/s"
            )
        sides = [
            _contestant_result(worker, rate, once) for worker, rate, once in zip(contestants, rates, first, strict=True)
        ]
    return CaseResult(case, ours=sides[0], peer=sides[1])


def _contestant_result(worker: Worker, rates: list[float], first: float) -> ContestantResult:
    end = worker.ask("finish")
    typical = worker.ready["particles"] / statistics.median(rates)
    return ContestantResult(
        rates=tuple(rates),
        start_seconds=worker.start_seconds,
        # Time of the first step beyond that of a usual step.
        compile_seconds=max(0.0, first - typical),
        peak_memory=end["peak_memory"],
        bytes_per_particle=worker.ready["bytes_per_particle"],
        threads=worker.ready["threads"],
        smallest_step=end["smallest_step"],
        sound=end["sound"],
    )

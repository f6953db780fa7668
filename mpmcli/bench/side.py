"""A contestant as the benchmark sees it: the process that runs it, its measured blocks, and its figures in the end."""

import json
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Any, Self

from mpmcli.bench.cases import BenchCase
from mpmcli.errors import RunError
from mpmcli.processes.questions import module_command

# Measured blocks of each contestant.
BLOCKS = 5


@dataclass(frozen=True)
class Setting:
    """Threads of the processor that a contestant may use, precision "f32" or "f64", and device, such as "cpu"."""

    threads: int
    precision: str = "f32"
    arch: str = "cpu"


class Worker:
    """A process of `mpmcli.bench.contestant` and the pipe to it; `ready` is its first answer, after `start_seconds`."""

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
        """Send one command and return the answer; RunError: the worker reports an error, or has died."""
        # Where it has died, the answer contains the reason.
        with suppress(OSError):
            self._process.stdin.write(command + "\n")
            self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        """Kill the process if it is still running, and close its streams."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._stderr):
            # A process that has ended leaves input that was not sent.
            with suppress(OSError):
                stream.close()

    def _answer(self) -> dict:
        line = self._process.stdout.readline()
        if line:
            answer = json.loads(line)
        else:
            status = self._process.wait()
            self._stderr.seek(0)
            last_words = self._stderr.read().strip().splitlines()[-3:]
            answer = {"error": " ".join([f"it ended with status {status}.", *last_words])}
        if "error" in answer:
            raise RunError(f"The benchmark process `{self._what}` stopped: {answer['error']}")
        return answer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def start_worker(who: str, case: BenchCase, setting: Setting) -> Worker:
    """Start the process of a contestant (see `contestant`) for a case, and wait until it can step."""
    values = {**vars(case), **vars(setting)}
    return Worker([who, *(text for key, value in values.items() for text in (f"--{key}", f"{value}"))])


Start = Callable[[str, BenchCase, Setting], Worker]


@dataclass(frozen=True)
class BenchOptions:
    """How a table is measured: threads in turn, blocks of `seconds`, which sides; tests replace `start`."""

    threads: tuple[int, ...] = (1,)
    seconds: float | None = 1.0
    blocks: int = BLOCKS
    progress: Callable[[str], None] = lambda line: None
    arch: str = "cpu"
    yardstick: bool = False
    peers: bool = False
    start: Start = start_worker


class Side:
    """One contestant at one case: `clock` is processor time on one thread, else wall time; `answers` of its blocks."""

    worker: Worker
    first_seconds: float

    def __init__(self, who: str, case: BenchCase, setting: Setting, name: str = "", flaw: str = "") -> None:
        self.who, self.case, self.setting, self.name = who, case, setting, name or who
        self.flaw = flaw or f"{self.name} at {case.name} could not be measured."
        self.clock = "processor_seconds" if setting.threads == 1 and setting.arch == "cpu" else "seconds"
        self.answers: list[dict] = []

    def begin(self, stack: ExitStack, start: Start, particles: int | None = None, sentence: str = "It has {}.") -> None:
        """Start, and compile; RunError: it could not start, or has other `particles`, told by `sentence`."""
        self.worker = stack.enter_context(start(self.who, self.case, self.setting))
        if particles not in (None, self.particles):
            raise RunError(sentence.format(f"{self.particles} particles instead of {particles}"))
        self.first_seconds = self.worker.ask("first")["seconds"]

    @property
    def particles(self) -> int:
        """The number of particles."""
        return self.worker.ready["particles"]

    def measure(self, command: str) -> dict:
        """Measure one block, and return the answer."""
        self.answers.append(self.worker.ask(command))
        return self.answers[-1]

    @property
    def costs(self) -> list[float]:
        """Time per particle and step of each block so far, s."""
        return [answer[self.clock] / answer["steps"] / self.particles for answer in self.answers]

    def finish(self, **others: object) -> dict:
        """End, and return figures for JSON in SI units, costs in ns; `compile_s` is a first step's beyond a usual."""
        ready, end = self.worker.ready, self.worker.ask("finish")
        usual, rates = statistics.median(self.costs), [1 / cost for cost in self.costs]
        return {
            "who": self.who,
            "label": {"ours": "mpmcli", "yardstick": "C", "peer": self.case.peer}.get(self.who, self.who),
            "peer_name": self.case.peer,
            "case": self.case.name,
            "dimension": self.case.dimension,
            "cells": self.case.cells,
            "step_s": self.case.step,
            "threads": self.setting.threads,
            "threads_used": ready["threads"],
            "particles": self.particles,
            "ns_per_particle_step": 1e9 * usual,
            "ns_per_particle_step_blocks": [1e9 * cost for cost in self.costs],
            "particle_steps_per_s": statistics.median(rates),
            "particle_steps_per_s_min": min(rates),
            "particle_steps_per_s_max": max(rates),
            "particle_steps_per_s_blocks": rates,
            "start_s": self.worker.start_seconds,
            "compile_s": max(0.0, self.first_seconds - self.particles * usual),
            "peak_memory_bytes": end["peak_memory"],
            "device_bytes_per_particle": ready["bytes_per_particle"],
            "smallest_step_s": end["smallest_step"],
            "sound": end["sound"],
            **others,
        }


class Turns:
    """Contestants in turn (A B ... A B ...), so that load affects all; one that fails is left out, told in `flaws`."""

    def __init__(self, sides: Iterable[Side], flaws: list[str]) -> None:
        self.sides, self.flaws = list(sides), flaws

    def take(self, act: Callable[[Side], Any]) -> list:
        """Apply `act` to each contestant in turn, and return what it returned for those that did not fail."""
        lasting, found = [], []
        for side in self.sides:
            try:
                found.append(act(side))
            except RunError as error:
                self.flaws.append(f"{side.flaw} {error}")
            else:
                lasting.append(side)
        self.sides = lasting
        return found

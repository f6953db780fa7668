"""A worker of a benchmark: a simulation in a separate process that steps on request."""

import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from operator import methodcaller
from typing import Any, Protocol

from mpmcli.errors import MpmcliError, RunError


class Worker(Protocol):
    """A simulation that can be measured."""

    particles: int
    threads: int

    def advance(self, count: int) -> int:
        """Take about `count` time steps and return their number; may return before the device is done."""

    def sync(self) -> None:
        """Wait until every requested step is done."""

    def is_sound(self) -> bool:
        """Return whether every particle is in the domain and every step had the length of the case."""


def run_block(worker: Worker, seconds: float) -> tuple[int, float, float]:
    """Step at least once, for about `seconds`; return (steps, wall time, processor time), s, device included."""
    steps, chunk, elapsed = 0, 1, 0.0
    begin, busy = time.perf_counter(), time.process_time()
    while steps == 0 or elapsed < seconds:
        steps += worker.advance(chunk)
        worker.sync()
        elapsed = time.perf_counter() - begin
        # Few waits for the device and no overshoot: chunks double until the remaining time limits the next one.
        chunk = max(1, min(2 * chunk, int(steps / elapsed * (seconds - elapsed)) + 1))
    return steps, elapsed, time.process_time() - busy


def serve(pipe: Connection, log: str, make: Callable[[], Worker]) -> None:
    """Create a worker and apply the requested functions until a request is None; an MpmcliError is sent and ends it."""
    # The log has the output of Taichi and of a crash. Taichi's environment variables would affect only one side.
    output = os.open(log, os.O_WRONLY)
    os.dup2(output, 1)
    os.dup2(output, 2)
    for name in [name for name in os.environ if name.startswith("TI_")]:
        del os.environ[name]
    try:
        worker = make()
        pipe.send((worker.particles, worker.threads))
        while (asked := pipe.recv()) is not None:
            act, *arguments = asked
            pipe.send(act(worker, *arguments))
    except MpmcliError as error:
        pipe.send(error)


class Side:
    """The process of a worker, and the costs of its blocks."""

    def __init__(self, name: str, make: Callable[[], Worker], *, by_processor: bool) -> None:
        """Start the worker of `make` in its process, and compile the kernels with a first step.

        Costs are processor time, which excludes other processes, or wall time. Raises RunError if the worker fails.
        """
        self.name, self._by_processor = name, by_processor
        self.blocks: list[float] = []
        self._log = tempfile.NamedTemporaryFile(mode="r", errors="replace")  # noqa: SIM115
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, self._log.name, make), daemon=True)
        begin = time.perf_counter()
        self._process.start()
        theirs.close()
        try:
            self.particles, self.threads = self._answer()
            self.start_seconds = time.perf_counter() - begin
            self.compile_seconds = self.ask(run_block, 0.0)[1]
        except BaseException:
            self.close()
            raise

    def ask(self, act: Callable[..., Any], *arguments: object) -> Any:
        """Return act(worker, *arguments), computed in its process. Raises RunError if it fails."""
        self._pipe.send((act, *arguments))
        return self._answer()

    def measure(self, seconds: float) -> int:
        """Measure a block and return its number of steps; append its cost, ns per particle and step, to `blocks`."""
        steps, wall, processor = self.ask(run_block, seconds)
        self.blocks.append(1e9 * (processor if self._by_processor else wall) / steps / self.particles)
        return steps

    @property
    def cost(self) -> float:
        """Median of the blocks, ns per particle and step."""
        return statistics.median(self.blocks)

    def facts(self) -> dict[str, Any]:
        """Return the measurements, for JSON."""
        return {
            "threads": self.threads,
            "ns_per_particle_step": self.cost,
            "ns_per_particle_step_blocks": self.blocks,
            "start_s": self.start_seconds,
            "compile_s": self.compile_seconds,
            "sound": self.ask(methodcaller("is_sound")),
        }

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._pipe.close()
        self._log.close()

    def _answer(self) -> Any:
        try:
            answer = self._pipe.recv()
        except EOFError:
            self._process.join()
            words = " ".join(self._log.read().strip().splitlines()[-3:])
            answer = RunError(f"its process ended with {self._process.exitcode}. {words}")
        if isinstance(answer, MpmcliError):
            raise RunError(f"{self.name} cannot be measured: {answer}")
        return answer

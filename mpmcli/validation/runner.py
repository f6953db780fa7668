"""Runs many cases side by side, each in a process of its own, so that none can harm another."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import IO

from mpmcli.validation.matrix import Run
from mpmcli.validation.run_result import RunResult, failure
from mpmcli.validation.setting import Setting

# Seconds between two looks at the processes.
PAUSE = 0.05
# Seconds that a run may take.
TIMEOUT = 1800.0
# Lines of what a dead process said that are told.
LAST_WORDS = 3
# One thread each: numpy's own would stand in each other's way.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def worker_command(run: Run) -> list[str]:
    """Return the command line that carries out a run."""
    setting = json.dumps(run.setting.changed_from(Setting()))
    return [sys.executable, "-m", "mpmcli.validation.worker", run.case, str(run.n), setting]


@dataclass
class _Process:
    run: Run
    process: subprocess.Popen
    said: IO[bytes]
    complained: IO[bytes]
    began: float

    def close(self) -> None:
        """End it, whatever it is doing."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.said, self.complained):
            if stream is not None:
                stream.close()

    def result(self) -> RunResult:
        """Return what it said, or why it said nothing."""
        self.said.seek(0)
        lines = self.said.read().decode("utf-8", errors="replace").strip().splitlines()
        try:
            return RunResult.from_dict(json.loads(lines[-1]))
        except (IndexError, ValueError, KeyError, TypeError):
            self.complained.seek(0)
            words = self.complained.read().decode("utf-8", errors="replace").strip().splitlines()[-LAST_WORDS:]
            status = self.process.returncode
            return failure(" ".join([f"The process of the run ended with status {status}.", *words]))


def carry_out_all(
    runs: Sequence[Run],
    workers: int,
    timeout: float = TIMEOUT,
    stop: Callable[[], bool] = lambda: False,
    command: Callable[[Run], list[str]] = worker_command,
) -> Iterator[tuple[Run, RunResult]]:
    """Yield each run with what came of it, as they end; a run that fails says so in its result.

    Args:
        workers: how many run at a time; timeout: seconds that each may take.
        stop: asked again and again whether to end all.
        command: the command line of a run; tests replace it.

    Raises:
        KeyboardInterrupt: `stop` said so. No process is left then, nor after any other end.
    """
    waiting = list(reversed(runs))
    going: list[_Process] = []
    try:
        while waiting or going:
            while waiting and len(going) < workers:
                going.append(_start(waiting.pop(), command))
            if stop():
                raise KeyboardInterrupt
            ended = [entry for entry in going if entry.process.poll() is not None]
            late = [entry for entry in going if entry not in ended and time.monotonic() - entry.began > timeout]
            for entry in [*ended, *late]:
                if entry in late:
                    result = failure(f"It took longer than {timeout:g} s, and was ended.")
                else:
                    result = entry.result()
                going.remove(entry)
                entry.close()
                yield entry.run, result
            if not (ended or late):
                time.sleep(PAUSE)
    finally:
        for entry in going:
            entry.close()


def _start(run: Run, command: Callable[[Run], list[str]]) -> _Process:
    # Settings of taichi from outside would change what is measured.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("TI_")} | ONE_THREAD
    # Files rather than pipes: nobody reads them while it runs, and they must not fill up.
    said, complained = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115
    process = subprocess.Popen(
        command(run),
        stdin=subprocess.PIPE,
        stdout=said,
        stderr=complained,
        env=environment,
        # Ctrl-C at the terminal is for this process, which then ends the others.
        start_new_session=True,
    )
    return _Process(run, process, said, complained, time.monotonic())

"""Runs the parts, one after another, each in a process of its own, within their times and that of the call."""

import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from gpu_parts.parts import Part
from gpu_parts.records import DONE, FAILED, UNFINISHED, Record, record_of
from gpu_parts.report import write_report

ROOT = Path(__file__).resolve().parent.parent.parent
# Seconds of a call that the times of the parts are made for.
BUDGET = 540.0
# Time below which no process is started, s, and what a part leaves for ending and writing.
LEAST, MARGIN = 3.0, 2.0
# What is kept of the words of a process that failed.
LAST_LINES = 12
# In place of a task, where a process fails before, between or after its tasks.
OUTSIDE = "process"


class Runner:
    """One call of scripts/gpu.

    Attributes:
        folder: of the results.
    """

    def __init__(
        self,
        folder: Path,
        arch: str,
        scale: str,
        budget: float,
        tell: Callable[[str], None],
        command: Sequence[str] = (sys.executable, "-m", "gpu_parts"),
    ) -> None:
        """Note when the call must end.

        Args:
            budget: s, from now on; what exceeds BUDGET is shared among the parts in proportion to their times.
            tell: takes a line of text for each row.
            command: that starts the process of a part; tests replace it.
        """
        self.folder, self._arch, self._scale, self._tell, self._command = folder, arch, scale, tell, command
        self._end = time.monotonic() + budget
        self._share = max(1.0, budget / BUDGET)

    def run(self, parts: Sequence[Part]) -> list[Record]:
        """Run the parts that are not done, and again, while there is time, those that ran out of theirs."""
        self.folder.mkdir(parents=True, exist_ok=True)
        records = [record_of(self.folder, part.name, self._arch, self._scale) for part in parts]
        waiting = [pair for pair in zip(parts, records, strict=True) if pair[1].state != DONE]
        while waiting and self._end - time.monotonic() >= LEAST:
            for part, record in waiting:
                left = self._end - time.monotonic()
                if left >= LEAST:
                    self._run_part(record, min(self._share * part.seconds, left))
                    write_report(self.folder)
            waiting = [pair for pair in waiting if pair[1].state == UNFINISHED]
        for part, record in waiting:
            self._tell(f"{part.name}: no time is left; call again with the same --out.")
            record.write(self.folder)
        return records

    def _run_part(self, record: Record, seconds: float) -> None:
        """Run one part, again from the task after the one that failed, until it is done or the time is up."""
        end = time.monotonic() + seconds
        began, before = time.monotonic(), record.seconds
        goes_on = True
        while goes_on:
            left = end - time.monotonic()
            record.state = UNFINISHED
            goes_on = left >= LEAST and self._run_process(record, left - MARGIN)
            record.seconds = before + time.monotonic() - began
            record.write(self.folder)
        self._tell(f"{record.part}: {record.state}, {record.seconds:.0f} s")

    def _run_process(self, record: Record, seconds: float) -> bool:
        """Start the process of a part and keep its rows; set the record's state, and return whether a task failed."""
        end = time.monotonic() + seconds
        left_out = [*record.finished, *record.failures]
        arguments = [record.part, record.arch, record.scale, f"{seconds:.0f}", record.missing, *left_out]
        with tempfile.TemporaryFile(mode="w+", encoding="utf-8", errors="replace") as words:
            process = subprocess.Popen(
                [*self._command, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=words,
                text=True,
                cwd=ROOT,
                env=environment(),
                start_new_session=True,
            )
            try:
                running, in_time = self._take_rows(process, record, end)
            finally:
                end_group(process)
            if not in_time:
                record.state, record.missing = UNFINISHED, running
            elif process.returncode == 0:
                unfinished = len(record.finished) < len(record.rows)
                record.state = FAILED if record.failures else UNFINISHED if unfinished else DONE
                record.missing = ""
            else:
                record.state = FAILED
                record.failures[running or OUTSIDE] = last_words(process.returncode, words)
                self._tell(f"{record.part}, {running or OUTSIDE}: failed")
                # A process that ends outside of tasks would end there again.
                return bool(running)
            return False

    def _take_rows(self, process: subprocess.Popen, record: Record, end: float) -> tuple[str, bool]:
        """Keep rows until the process ends or the time is up; return the task under way, and whether it ended."""
        lines: queue.Queue[str | None] = queue.Queue()

        def read() -> None:
            for line in process.stdout:
                lines.put(line)
            lines.put(None)

        threading.Thread(target=read, daemon=True).start()
        running = ""
        while True:
            try:
                line = lines.get(timeout=max(0.0, end - time.monotonic()))
            except queue.Empty:
                return running, False
            if line is None:
                process.wait()
                return running, True
            answer = json.loads(line)
            if "begin" in answer:
                running = answer["begin"]
                continue
            record.rows[answer["key"]] = answer["row"]
            running = ""
            record.write(self.folder)
            self._tell(f"{record.part}, {answer['key']}: {short(answer['row'])}")


def environment() -> dict[str, str]:
    """Return the variables of a part: this checkout first, none of Taichi's settings, and a place for kernels."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith("TI_")}
    path = [str(ROOT), str(ROOT / "scripts"), *filter(None, [os.environ.get("PYTHONPATH")])]
    # Ignored by git: it outlives the call, and does not count among the results.
    cache = ROOT / "build" / "gpu-cache"
    cache.mkdir(parents=True, exist_ok=True)
    return {
        "XDG_CACHE_HOME": str(cache),
        "CUDA_CACHE_PATH": str(cache / "cuda"),
        **kept,
        "PYTHONPATH": os.pathsep.join(path),
        "PYTHONUNBUFFERED": "1",
    }


def end_group(process: subprocess.Popen) -> None:
    """Kill what is left of a process and of those that it has started, and wait for it."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()


def last_words(status: int, words: object) -> str:
    """Return why a process ended: its exit status or signal, and the last lines that it wrote."""
    words.seek(0)
    said = words.read().strip().splitlines()[-LAST_LINES:]
    cause = f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
    return "\n".join([cause, *said])


def short(row: dict) -> str:
    """Return a row as a line of progress."""
    text = json.dumps(row)
    return text if len(text) <= 160 else text[:157] + "..."

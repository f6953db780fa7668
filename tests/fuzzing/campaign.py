"""Many inputs in a forked process with limits: 20 s of processor time each, and 1 GiB of memory."""

import json
import mmap
import os
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import IO

from fuzzing.outcome import Fault, fault_of
from fuzzing.seeds import Files
from fuzzing.targets import TARGETS, Input

MOST_SECONDS = 20.0
MOST_BYTES = 2**30
# Inputs of one process; what it has cached counts as its memory.
OF_ONE_PROCESS = 200
KEPT_OF_A_KIND = 3


@dataclass
class Campaign:
    """Inputs first to first + count - 1 of a target; the n-th one follows from target, seed and n alone.

    Attributes:
        directory: where the inputs are written, one after the other; best in memory.
        given: inputs in place of those that follow; findings: where those with a forbidden outcome are kept.
        done: inputs that ran; faults: how many of each kind were found.
    """

    target: str
    seed: int
    first: int
    count: int
    directory: Path
    findings: Path
    given: Sequence[Input] = ()
    done: int = 0
    faults: Counter[str] = field(default_factory=Counter)

    def run(self, tell: Callable[["Campaign"], None] = lambda campaign: None) -> None:
        """Run all of them."""
        at, end = self.first, self.first + self.count
        if not self.given:
            # What seeds need is loaded once.
            TARGETS[self.target].make(Random(0))
        while at < end:
            at = self._in_a_process(at, min(at + OF_ONE_PROCESS, end))
            self.done = at - self.first
            tell(self)

    def input(self, number: int) -> Input:
        """Return an input."""
        if self.given:
            return self.given[number]
        return TARGETS[self.target].make(Random(f"{self.target}/{self.seed}/{number}"))

    def _in_a_process(self, first: int, end: int) -> int:
        """Run inputs in a process, and return the number of the one to go on with."""
        shared = mmap.mmap(-1, 16)
        shared[:] = struct.pack("qq", first, 0)
        with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as lines:
            pid = os.fork()
            if pid == 0:
                code = 1
                try:
                    self._child(first, end, shared, lines)
                    code = 0
                finally:
                    os._exit(code)
            status = self._watch(pid, shared)
            lines.seek(0)
            for line in lines:
                number, kind, detail = json.loads(line)
                self._keep(number, Fault(kind, detail), self.input(number))
        at = struct.unpack("qq", shared[:])[0]
        if status == 0:
            return end
        name = signal.Signals(-status).name if status < 0 else f"status {status}"
        kind = "hang, killed" if status == -signal.SIGKILL else f"crash {name}"
        self._keep(at, Fault(kind, f"the process ended with {name}"), self.input(at))
        return at + 1

    def _child(self, first: int, end: int, shared: mmap.mmap, out: IO[str]) -> None:
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null, stream)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with open("/proc/self/statm", encoding="ascii") as statm:
            used = int(statm.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, used + MOST_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        before = None
        for number in range(first, end):
            shared[:] = struct.pack("qq", number, time.process_time_ns())
            one = self.input(number)
            place(one, self.directory, before)
            before = one.files
            os.chdir(self.directory)
            for words in one.commands:
                began = time.process_time()
                fault = fault_of(words)
                spent = time.process_time() - began
                if fault is None and spent > MOST_SECONDS:
                    fault = Fault("hang", f"{spent:.1f} s of processor time")
                if fault is not None:
                    out.write(json.dumps([number, fault.kind, f"{' '.join(words)}\n{fault.detail}"]) + "\n")
                    out.flush()
            os.chdir("/")

    def _watch(self, pid: int, shared: mmap.mmap) -> int:
        """Wait for a process, and kill it if an input takes too long; return its status, negative for a signal."""
        ticks = os.sysconf("SC_CLK_TCK")
        number, since = -1, time.monotonic()
        while True:
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.05)
            try:
                with open(f"/proc/{pid}/stat", encoding="ascii") as stat:
                    fields = stat.read().rpartition(")")[2].split()
            except OSError:
                continue
            at = struct.unpack("qq", shared[:])[0]
            if at != number:
                number, since = at, time.monotonic()
            spent = (int(fields[11]) + int(fields[12])) / ticks
            began = struct.unpack("qq", shared[:])[1] / 1e9
            # One that waits for something uses no time.
            if (began and spent - began > 2.5 * MOST_SECONDS) or time.monotonic() - since > 15 * MOST_SECONDS:
                os.kill(pid, signal.SIGKILL)

    def _keep(self, number: int, fault: Fault, one: Input) -> None:
        self.faults[fault.kind] += 1
        if self.faults[fault.kind] > KEPT_OF_A_KIND:
            return
        name = "".join(c if c.isalnum() else "_" for c in fault.kind)
        kept = self.findings / name / f"{self.target}-{self.seed}-{number}"
        place(one, kept)
        (kept / "fault.txt").write_text(
            f"{fault.kind}\n{one.commands}\n{fault.detail}\n", encoding="utf-8", errors="replace"
        )
        print(f"{self.target} {self.seed} {number}: {fault.kind}", file=sys.stderr, flush=True)


def place(one: Input, directory: Path, before: Files | None = None) -> None:
    """Write the files of an input into a directory of this name.

    Args:
        before: the files that the directory holds, if it holds no others; the same ones are left as they are, so that
            mpmcli finds what it has read of them.
    """
    if before is None:
        shutil.rmtree(directory, ignore_errors=True)
        before = {}
    directory.mkdir(parents=True, exist_ok=True)
    for name in before.keys() - one.files.keys():
        (directory / name).unlink(missing_ok=True)
    for name, data in one.files.items():
        if before.get(name) != data:
            path = directory / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

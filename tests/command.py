"""The real command of mpmcli, in a process of its own or in this one, for the tests of the command line."""

import io
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = ROOT / "configs"

# A drop in a small box: starts in no time, and takes a few dozen steps.
SCENE = """\
title = "A drop"
[domain]
size = [1.0, 1.0]
cells = [16, 16]
gravity = [0.0, -9.81]
[time]
end = 0.05
frames = 4
[[bodies]]
name = "drop"
material = { law = "fluid", density = 1000.0 }
shape = { box = { min = [0.25, 0.0], max = [0.75, 0.5] } }
"""


@dataclass(frozen=True)
class Outcome:
    """What a command left."""

    status: int
    stdout: str
    stderr: str


def run_here(*arguments: object) -> Outcome:
    """Run a command in this process; on a fresh backend, should it need one."""
    from mpmcli.cli import program
    from mpmcli.solver.machine.backend import stop_backend

    stop_backend()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with redirect_stdout(io.StringIO()) as stdout, redirect_stderr(io.StringIO()) as stderr:
            status = program.run([str(word) for word in arguments])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return Outcome(status, stdout.getvalue(), stderr.getvalue())


@contextmanager
def started(
    directory: Path, *arguments: object, ctrl_c_off: bool = False, own_group: bool = False
) -> Iterator[subprocess.Popen[str]]:
    """Start a command in a process of its own, as a shell does; `ctrl_c_off` as with an & at the end.

    With `own_group` a signal can be sent to it and its children, as a terminal does.
    """
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    # A process that starts with an ignored signal keeps ignoring it, and so may these tests have been started.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN if ctrl_c_off else signal.default_int_handler)
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "mpmcli", *map(str, arguments)],
            cwd=directory,
            env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=own_group,
        )
    finally:
        signal.signal(signal.SIGINT, before)
    with process:
        try:
            yield process
        finally:
            process.kill()

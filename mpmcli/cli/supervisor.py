"""The process that a user starts: it passes signals to a child process, and kills a child that takes long to end.

Python handles a signal between two instructions. Compilation of kernels, a step of a large scene, or a film in a
library may take longer than a batch system waits, and no code of the same process can act meanwhile. Therefore commands
that take long run in a child process. Exit codes, signals and the time of the end are as of a single process.
"""

import ctypes
import importlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from mpmcli.cli.interrupt import INTERRUPTED, TERMINATED
from mpmcli.cli.streams import flush_streams, print_error

# Commands that may take long.
LONG = ("simulate", "sweep", "render", "validate", "export", "dataset", "plot")
# Time from the first and from a second signal to the kill, s.
PATIENCE, LITTLE = 3.5, 0.5
# Time from the first signal to the preparations for the kill, s.
SOON = 1.0
REQUESTS = ("SIGINT", "SIGTERM", "SIGHUP")
# Linux: the signal that a process gets when its parent is gone (prctl).
DEATH_SIGNAL = 1

_announced: int | None = None


def may_supervise(arguments: Sequence[str]) -> bool:
    """Return whether a command line runs in a child process; --debug keeps it in this one."""
    first = next((word for word in arguments if not word.startswith("-")), "")
    asks = {"-h", "--help", "--debug"} & set(arguments)
    return first in LONG and not asks and hasattr(os, "fork") and hasattr(signal, "sigtimedwait")


def supervise(work: Callable[[], int]) -> int:
    """Run `work` in a child process and return its exit code; a signal that kills the child kills this process too."""
    global _announced
    # Ignored ones, as in `mpmcli ... &` or under nohup, stay ignored.
    requests = {
        getattr(signal, name) for name in REQUESTS if signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN
    }
    watched = requests | {signal.SIGCHLD, signal.SIGTSTP}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, watched)
    told, tells = os.pipe()
    us = os.getpid()
    child = os.fork()
    if not child:
        os.close(told)
        _announced = tells
        # Only the supervisor receives Ctrl-C of the terminal.
        with suppress(OSError):
            os.setpgid(0, 0)
        if sys.platform == "linux":
            with suppress(OSError, AttributeError):
                ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGKILL)
            if os.getppid() != us:
                os._exit(1)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        code = work()
        flush_streams()
        # As after `sys.exit`; the caller must not continue in two processes.
        sys.exit(code)
    os.close(tells)
    with suppress(OSError):
        os.setpgid(child, child)
    # The signals stay blocked: any that arrive now are too late.
    return _attend(child, requests, watched, told)


def announce(directory: Path, inputs: Iterable[Path]) -> None:
    """Tell the supervisor which result this process is about to write from files, to close it after a kill."""
    if _announced is None:
        return
    place = directory.absolute()
    made = [str(path) for path in (place, *place.parents) if not path.exists()]
    facts = {"directory": str(place), "made": made[::-1], "inputs": [str(path) for path in inputs]}
    os.write(_announced, json.dumps(facts).encode() + b"\n")


def _attend(child: int, requests: set[signal.Signals], watched: set[signal.Signals], told: int) -> int:
    """Pass signals on until the child has ended."""
    first: signal.Signals | None = None
    deadline: float | None = None
    ready = False
    while True:
        if deadline is None:
            came = signal.sigwaitinfo(watched)
        else:
            pause = deadline - time.monotonic()
            came = signal.sigtimedwait(watched, max(0.0, pause if ready else min(pause, SOON)))
        if came is None and not ready:
            # Load the modules for the kill, which takes time.
            for name in ("psutil", "mpmcli.output.directory"):
                importlib.import_module(name)
            ready = True
            continue
        if came is None:
            import psutil

            with suppress(psutil.Error):
                process = psutil.Process(child)
                # A stopped child starts no further work.
                process.suspend()
                for one in [*process.children(recursive=True), process]:
                    with suppress(psutil.Error):
                        one.kill()
            os.waitpid(child, 0)
            return _interrupted(child, told, first)
        number = signal.Signals(came.si_signo)
        if number in requests:
            with suppress(ProcessLookupError):
                os.kill(child, number)
            wait = PATIENCE if first is None else LITTLE
            deadline = min(time.monotonic() + wait, deadline or float("inf"))
            first = first or number
        elif number == signal.SIGTSTP:
            # Stop with the child, as Ctrl-Z asks, until this process is continued.
            with suppress(ProcessLookupError):
                os.killpg(child, signal.SIGSTOP)
            os.kill(os.getpid(), signal.SIGSTOP)
            with suppress(ProcessLookupError):
                os.killpg(child, signal.SIGCONT)
        else:
            ended, status = os.waitpid(child, os.WNOHANG)
            if ended and first is not None and os.WIFSIGNALED(status):
                # It arrived at a time when Python cannot handle it, for example at exit.
                return _interrupted(child, told, first)
            if ended:
                return _code(status)


def _code(status: int) -> int:
    """Return the exit code of a child of this wait status; if it was killed, so is this process."""
    if not os.WIFSIGNALED(status):
        return os.waitstatus_to_exitcode(status)
    number = os.WTERMSIG(status)
    try:
        name = signal.Signals(number).name
    except ValueError:
        name = f"signal {number}"
    if number == signal.SIGKILL:
        print_error(
            "error: the process was killed (SIGKILL), perhaps for lack of memory; what it had reported is kept."
        )
        os.kill(os.getpid(), signal.SIGKILL)
    print_error(f"error: the process crashed ({name}); what it had reported is kept.")
    return 1


def _interrupted(child: int, told: int, first: signal.Signals) -> int:
    """Record the end of the child's run in run.json, or remove a result without frames."""
    from mpmcli.errors import MpmcliError

    os.set_blocking(told, False)
    with suppress(MpmcliError, OSError):
        if lines := os.read(told, 2**20).splitlines():
            from mpmcli.output.directory import close_abandoned

            facts = json.loads(lines[-1])
            made, inputs = ([Path(path) for path in facts[name]] for name in ("made", "inputs"))
            close_abandoned(Path(facts["directory"]), made, inputs, child, first.name)
    print_error("interrupted")
    return INTERRUPTED if first == signal.SIGINT else TERMINATED

"""The process that a user starts: it passes signals to the one that computes, and ends that one where it takes long.

Python attends to a signal between two instructions. Compiling kernels, a step of a large scene, or a film in a library
may take longer than a batch system waits, and no code of the same process can do anything meanwhile. So commands that
take long run in a child process. What a user sees is one process: exit codes, signals, and the time of its end.
"""

import ctypes
import importlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from mpmcli.cli.interrupt import INTERRUPTED, TERMINATED
from mpmcli.cli.streams import flush_streams, print_error

# Commands that may take long.
LONG = ("simulate", "sweep", "render", "validate", "export", "dataset", "plot")
# Time from the first and from a second signal to the end by force, s.
PATIENCE, LITTLE = 3.5, 0.5
# Time from the first signal to the preparations for that end, s.
SOON = 1.0
REQUESTS = ("SIGINT", "SIGTERM", "SIGHUP")
# Linux: the signal that a process gets when its parent is gone (prctl).
DEATH_SIGNAL = 1

_announced: int | None = None


def may_supervise(arguments: Sequence[str]) -> bool:
    """Return whether a command line is to run in a child process; --debug keeps it in this one."""
    first = next((word for word in arguments if not word.startswith("-")), "")
    asks = {"-h", "--help", "--debug"} & set(arguments)
    return first in LONG and not asks and hasattr(os, "fork") and hasattr(signal, "sigtimedwait")


def supervise(work: Callable[[], int]) -> int:
    """Do work in a child process and return its exit code; a signal that kills the child kills this process too."""
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
        # Ctrl-C at the terminal goes to the supervisor alone.
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
        # As after `sys.exit`; the caller must not go on in two processes.
        sys.exit(code)
    os.close(tells)
    with suppress(OSError):
        os.setpgid(child, child)
    # The signals stay blocked: what comes now is too late.
    return _attend(child, requests, watched, told)


def announce(directory: Path) -> None:
    """Tell the supervisor which result this process is about to write, in order to close it after an end by force."""
    if _announced is None:
        return
    place = directory.absolute()
    made = [str(path) for path in (place, *place.parents) if not path.exists()]
    os.write(_announced, json.dumps({"directory": str(place), "made": made[::-1]}).encode() + b"\n")


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
            # What is needed then takes a while to load.
            for name in ("psutil", "mpmcli.output.directory"):
                importlib.import_module(name)
            ready = True
            continue
        if came is None:
            import psutil

            with suppress(psutil.Error):
                process = psutil.Process(child)
                # Stopped, it starts no more.
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
                # It came where Python is not ready for it, as at its end.
                return _interrupted(child, told, first)
            if ended:
                return _code(status)


def _code(status: int) -> int:
    if not os.WIFSIGNALED(status):
        return os.waitstatus_to_exitcode(status)
    number = os.WTERMSIG(status)
    try:
        name = signal.Signals(number).name
    except ValueError:
        name = f"signal {number}"
    if number == signal.SIGKILL:
        print_error(
            "error: the process was killed (SIGKILL), perhaps for want of memory; what it had reported is kept."
        )
        os.kill(os.getpid(), signal.SIGKILL)
    print_error(f"error: the process crashed ({name}); what it had reported is kept.")
    return 1


def _interrupted(child: int, told: int, first: signal.Signals) -> int:
    """Write into run.json how the run ended that the child was writing, or remove it where it has no frame."""
    from mpmcli.errors import MpmcliError

    os.set_blocking(told, False)
    with suppress(MpmcliError, OSError):
        if lines := os.read(told, 2**20).splitlines():
            from mpmcli.output.directory import close_abandoned

            facts = json.loads(lines[-1])
            close_abandoned(Path(facts["directory"]), [Path(path) for path in facts["made"]], child, first.name)
    print_error("interrupted")
    return INTERRUPTED if first == signal.SIGINT else TERMINATED

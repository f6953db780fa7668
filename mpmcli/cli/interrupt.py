"""Handles Ctrl-C, and termination requests of a batch system or a closing terminal; written data are sealed.

SIGTERM and SIGHUP are treated like Ctrl-C (SIGINT). The exit code is 130 after SIGINT, and 143 after the others.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

INTERRUPTED, TERMINATED = 130, 143

_came: int = 0
_waits = False


def leave_at_once() -> None:
    """Let the signals end the process with its exit codes, as long as there are no data to keep."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _leave)


def catch_interrupts() -> None:
    """Let the signals raise KeyboardInterrupt.

    SIGTERM does so even if a shell has disabled Ctrl-C (`mpmcli ... &`); SIGHUP does so except under nohup.
    """
    global _came
    _came = 0
    signal.signal(signal.SIGTERM, _interrupt)
    if signal.getsignal(signal.SIGINT) in (signal.default_int_handler, _leave):
        signal.signal(signal.SIGINT, _interrupt)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) in (signal.SIG_DFL, _leave):
        signal.signal(signal.SIGHUP, _interrupt)


def interrupt_came() -> str:
    """Return the name of the first signal received, or ""; modules in C may lose a KeyboardInterrupt."""
    return signal.Signals(_came).name if _came else ""


def interrupted_code() -> int:
    """Return the exit code of an interrupted command."""
    return INTERRUPTED if _came in (0, signal.SIGINT) else TERMINATED


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """In this context the first signal raises no exception, for code that polls `interrupt_came` where it can stop.

    An exception between any two instructions may occur in a callback of a library, which loses it. A second signal
    raises in any case.
    """
    global _waits
    _waits = True
    try:
        yield
    finally:
        _waits = False


def _leave(number: int, _: object) -> None:
    os._exit(INTERRUPTED if number == signal.SIGINT else TERMINATED)


def _interrupt(number: int, _: object) -> None:
    global _came
    first = not _came
    _came = _came or number
    if not (_waits and first):
        raise KeyboardInterrupt

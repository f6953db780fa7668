"""Ctrl-C, and a batch system's request to end (SIGTERM), which is treated alike: what is written is sealed."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

_came = False
_waits = False


def catch_interrupts() -> None:
    """Let both signals raise KeyboardInterrupt, SIGTERM also where a shell has switched Ctrl-C off (`mpmcli ... &`)."""
    global _came
    _came = False
    signal.signal(signal.SIGTERM, _interrupt)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)


def interrupt_came() -> bool:
    """Say whether one of the signals came.

    Modules written in C may lose a KeyboardInterrupt, or make another error of it, while they are imported.
    """
    return _came


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Within this context the first signal raises nothing, for code that polls `interrupt_came` where it can stop.

    An exception that comes between any two instructions may fall into a callback of a library, which loses it. A
    second signal raises all the same.
    """
    global _waits
    _waits = True
    try:
        yield
    finally:
        _waits = False


def _interrupt(*_: object) -> None:
    global _came
    first = not _came
    _came = True
    if not (_waits and first):
        raise KeyboardInterrupt

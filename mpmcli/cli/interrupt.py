"""Ctrl-C, and a batch system's request to end (SIGTERM), which is treated alike: what is written is sealed."""

import signal
from typing import NoReturn

_came = False


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


def _interrupt(*_: object) -> NoReturn:
    global _came
    _came = True
    raise KeyboardInterrupt

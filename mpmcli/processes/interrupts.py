"""Ctrl-C in the processes that this one starts."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block SIGINT for all that is started here: Ctrl-C reaches all processes, and this one ends the others."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # The first process starts this, which unblocks the signal.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

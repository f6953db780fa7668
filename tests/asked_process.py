"""Processes that behave badly when asked, for the tests of what asks them."""

import sys

CRASH = "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n"
HANG = "import time\ntime.sleep(600)\n"
SILENCE = "pass\n"


def running(code: str) -> list[str]:
    """Return the command that runs code in a bare interpreter."""
    return [sys.executable, "-I", "-S", "-c", code]


def answering(text: str) -> str:
    """Return code that writes a text on stdout."""
    return f"print({text!r})\n"

"""Prints answers on stdout, and handles standard streams whose reader has closed them."""

import json
import os
import sys
from contextlib import suppress
from typing import IO, Any

import click

from mpmcli.errors import RunError
from mpmcli.plain_json import finite_json
from mpmcli.plain_text import escaped


def print_answer(answer: Any, as_json: bool, *, quiet: bool = False) -> None:
    """Print an object with `as_dict` and `text` on stdout, as JSON or as text; no text if quiet."""
    if as_json:
        print_json(answer.as_dict())
    elif not quiet:
        print_text(answer.text())


def print_json(content: object) -> None:
    """Print one JSON document on stdout; numbers that are not finite become null. Raises as `print_text` does."""
    # JSON can escape the characters that stdout does not encode.
    encoding = (getattr(sys.stdout, "encoding", None) or "").lower().replace("-", "")
    to_ascii = encoding not in ("utf8", "utf16", "utf32")
    print_text(json.dumps(finite_json(content), indent=2, ensure_ascii=to_ascii, allow_nan=False))


def print_text(text: str) -> None:
    """Print a text with control characters escaped, ignoring a closed pipe; RunError: stdout is closed or disk full."""
    try:
        click.echo(escaped(text))
        # Without a stdout, click writes nothing and raises nothing.
        sys.stdout.flush()
    except BrokenPipeError:
        _discard(sys.stdout)
    except OSError as error:
        _discard(sys.stdout)
        raise RunError(f"The result could not be printed on stdout ({error.strerror}).") from error
    except (AttributeError, ValueError) as error:
        raise RunError("The result could not be printed, as stdout is closed.") from error


def print_note(text: str) -> None:
    """Print a note, a warning or an error on stderr."""
    click.echo(escaped(text), err=True)


def print_error(text: str) -> None:
    """Print an error on stderr, unless its reader has closed it."""
    with suppress(OSError, ValueError, AttributeError):
        print_note(text)


def flush_streams() -> None:
    """Flush stdout and stderr, and discard text that cannot be written.

    Python flushes both at exit, and changes the exit code to 120 if that fails.
    """
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, AttributeError, ValueError):
            _discard(stream)


def _discard(stream: IO[str] | None) -> None:
    """Redirect buffered and later output to the null device."""
    with suppress(OSError, AttributeError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)
        stream.flush()

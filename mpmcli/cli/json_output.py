"""What --json prints."""

import json
import os
import sys

from mpmcli.errors import RunError
from mpmcli.plain_json import finite_json


def print_json(content: object) -> None:
    """Print one JSON document on stdout; what is not finite becomes null.

    Raises:
        RunError: stdout takes nothing, as on a full disk.
    """
    text = json.dumps(finite_json(content), indent=2, ensure_ascii=not _takes_all_letters(), allow_nan=False)
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader went away, which is its right; what is still buffered must not fail at exit.
        _forget()
    except OSError as error:
        _forget()
        raise RunError(f"The JSON could not be written to stdout ({error.strerror}).") from error
    except (AttributeError, ValueError) as error:
        raise RunError("The JSON could not be written, as stdout is closed.") from error


def _takes_all_letters() -> bool:
    """Say whether stdout has a code for every letter; JSON can do without."""
    return (getattr(sys.stdout, "encoding", None) or "").lower().replace("-", "") in ("utf8", "utf16", "utf32")


def _forget() -> None:
    """Let what is still buffered not fail at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

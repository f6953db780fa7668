"""What --json prints."""

import json
import os
import sys

from mpmcli.plain_json import finite_json


def print_json(content: object) -> None:
    """Print one JSON document on stdout; what is not finite becomes null."""
    text = json.dumps(finite_json(content), indent=2, ensure_ascii=False, allow_nan=False)
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader went away, which is its right; what is still buffered must not fail at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

"""One run of a case in a process of its own.

    python -m mpmcli.validation.worker CASE N '{"precision": "f32"}'

It prints one line of JSON, the result, and ends with its parent: when its standard input is closed.
"""

import argparse
import json
import os
import signal
import threading
import time

from mpmcli.validation.carry_out import carry_out
from mpmcli.validation.registry import all_cases
from mpmcli.validation.setting import Setting


def _end_with_parent() -> None:
    """Wait for the end of standard input, which comes when the parent is gone, and end this process."""
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def main(arguments: list[str] | None = None) -> None:
    """Carry out the run; taichi's own lines on stdout go to stderr."""
    began = time.perf_counter()
    parser = argparse.ArgumentParser(prog="python -m mpmcli.validation.worker")
    parser.add_argument("case")
    parser.add_argument("n", type=int)
    parser.add_argument("setting", type=json.loads)
    parsed = parser.parse_args(arguments)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answers:
        os.dup2(2, 1)
        result = carry_out(all_cases()[parsed.case], parsed.n, Setting(**parsed.setting))
        answers.write(json.dumps({**result.as_dict(), "wall_seconds": time.perf_counter() - began}) + "\n")


if __name__ == "__main__":
    main()

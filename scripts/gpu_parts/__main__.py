"""The process of a part: `python -m gpu_parts PART ARCH SCALE SECONDS LAST [DONE ...]`.

DONE are keys of tasks to leave out; LAST is one that comes last, since it took all the time before, or "".

It writes a line of JSON to standard output when a task begins, {"begin": KEY}, and when it ends, {"key": KEY, "row":
ROW}. What else is printed goes to standard error.
"""

import json
import os
import sys
import time
from collections.abc import Collection
from typing import IO

from gpu_parts.parts import PARTS, Setup
from mpmcli.plain_json import finite_json


def run(name: str, setup: Setup, seconds: float, last: str, done: Collection[str], answers: IO[str]) -> None:
    """Measure the rows of a part that are not done, `last` after the others; `seconds` is the time that is left."""
    end = time.monotonic() + seconds

    def answer(value: dict) -> None:
        answers.write(json.dumps(finite_json(value)) + "\n")
        answers.flush()

    part = next(part for part in PARTS if part.name == name)
    waiting = [task for task in part.tasks(setup) if task.key not in done]
    waiting.sort(key=lambda task: task.key == last)
    for task in waiting:
        task.prepare()
    for task in waiting:
        answer({"begin": task.key})
        answer({"key": task.key, "row": task.measure(end - time.monotonic())})


def main() -> None:
    """Run one part."""
    name, arch, scale, seconds, last, *done = sys.argv[1:]
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answers:
        os.dup2(2, 1)
        run(name, Setup(arch, scale), float(seconds), last, set(done), answers)


if __name__ == "__main__":
    main()

"""One run of a case in a process of its own.

    python -m mpmcli.validation.case_process CASE N '{"precision": "f32"}'

It prints one line of JSON, the result, and ends with its parent: when its standard input is closed.
"""

import argparse
import json
import time

from mpmcli.processes.questions import answering, end_with_parent
from mpmcli.validation.carry_out import carry_out
from mpmcli.validation.registry import all_cases
from mpmcli.validation.setting import Setting


def main(arguments: list[str] | None = None) -> None:
    """Carry out the run; taichi's own lines on stdout go to stderr."""
    began = time.perf_counter()
    parser = argparse.ArgumentParser(prog="python -m mpmcli.validation.case_process")
    parser.add_argument("case")
    parser.add_argument("n", type=int)
    parser.add_argument("setting", type=json.loads)
    parsed = parser.parse_args(arguments)
    end_with_parent()
    with answering() as answer:
        result = carry_out(all_cases()[parsed.case], parsed.n, Setting(**parsed.setting))
        answer(**{**result.as_dict(), "wall_seconds": time.perf_counter() - began})


if __name__ == "__main__":
    main()

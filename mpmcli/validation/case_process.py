"""Process that executes one run of a case.

    python -m mpmcli.validation.case_process CASE N '{"precision": "f32"}'

It writes the result to stdout as one line of JSON. It exits when its standard input is closed, that is, when the
parent process ends.
"""

import argparse
import json
import time

from mpmcli.processes.questions import answering, end_with_parent
from mpmcli.validation.carry_out import carry_out
from mpmcli.validation.cases import all_cases
from mpmcli.validation.setting import Setting


def main(arguments: list[str] | None = None) -> None:
    """Execute the run. Output of Taichi to stdout is redirected to stderr."""
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

"""One examination in a process of its own: `python -m mpmcli.doctor.probe_process NAME` answers with its finding."""

import sys
from dataclasses import asdict

from mpmcli.doctor.examination import EXAMINATIONS, attempt
from mpmcli.processes.questions import answering

if __name__ == "__main__":
    with answering() as answer:
        answer(**asdict(attempt(next(each for each in EXAMINATIONS if each.name == sys.argv[1]))))

"""One examination in a process of its own: `python -m mpmcli.doctor.worker NAME` answers with its finding."""

import sys
from dataclasses import asdict

from mpmcli.child_process import answering
from mpmcli.doctor.examination import EXAMINATIONS, attempt

if __name__ == "__main__":
    with answering() as answer:
        answer(**asdict(attempt(next(each for each in EXAMINATIONS if each.name == sys.argv[1]))))

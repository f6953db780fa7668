"""`mpmcli doctor`."""

import click

from mpmcli.cli.options import json_option
from mpmcli.cli.streams import print_json, print_text


@click.command("doctor")
@json_option
def command(as_json: bool) -> int:
    """Say whether everything that mpmcli needs works on this machine.

    Python, Taichi and its backends, VTK and its window, libraries, disk and memory are tried, each in a process of
    its own, and get one line each, with the remedy where something is wrong. The exit code is 1 where something
    needed is missing or broken; a GPU that is not here is neither.
    """
    from mpmcli.doctor.examination import EXAMINATIONS, examine

    width = max(len(each.name) for each in EXAMINATIONS)
    found = []
    for name, result in examine(EXAMINATIONS):
        found.append((name, result))
        if not as_json:
            remedy = f"; {result.remedy}" if result.remedy else ""
            print_text(f"{result.status:<11}  {name:<{width}}  {result.detail}{remedy}")
    faults = [name for name, result in found if result.is_fault]
    if as_json:
        checks = [
            {"name": name, "status": result.status, "detail": result.detail, "remedy": result.remedy}
            for name, result in found
        ]
        print_json({"ok": not faults, "checks": checks})
    elif faults:
        print_text(f"\nnot everything that mpmcli needs works: {', '.join(faults)}")
    else:
        print_text("\neverything that mpmcli needs works")
    return 1 if faults else 0

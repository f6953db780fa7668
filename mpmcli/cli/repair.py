"""`mpmcli repair`."""

from pathlib import Path

import click

from mpmcli.cli.options import json_option
from mpmcli.cli.streams import print_json, print_text


@click.command("repair")
@click.argument("directory", type=click.Path(path_type=Path))
@json_option
def command(directory: Path, as_json: bool) -> int:
    """Make one readable file of the frames of a run in DIRECTORY that died, or whose files have been damaged.

    The frames up to the first one that is damaged or missing are packed. What is damaged or lies beyond stays, and is
    named. A sound result is left alone. The exit code is 1 if anything is lost.
    """
    from mpmcli.output.repair import repair

    done = repair(directory)
    print_json(done.as_dict()) if as_json else print_text(done.text())
    return 1 if done.lost else 0

"""The command line: `mpmcli COMMAND ...`."""

from typing import NoReturn

from mpmcli.cli.interrupt import leave_at_once

__all__ = ["main"]


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line, see `program.main`; interrupts during loading are handled too."""
    leave_at_once()
    from mpmcli.cli import program

    program.main(arguments)

"""The command line: `mpmcli COMMAND ...`."""

from mpmcli.cli.program import main

__all__ = ["main"]

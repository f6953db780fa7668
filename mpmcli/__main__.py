"""Run as `python -m mpmcli`."""

from mpmcli.cli import main

main()

"""The errors that a user may see; each carries one full sentence and an exit code."""


class MpmcliError(Exception):
    """Base of every expected error: its text is what the user reads.

    Attributes:
        exit_code: process exit code that the command line returns for it.
    """

    exit_code = 1


class InputError(MpmcliError):
    """Bad input or usage: nothing was written."""

    exit_code = 2


class RunError(MpmcliError):
    """A run that started and could not go on: everything written before stays."""

    exit_code = 1


class DiskFullError(RunError):
    """What is to be written does not fit onto the disk: everything written before stays."""

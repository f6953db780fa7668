"""Examines the Python interpreter and the mpmcli package."""

import platform
import sys
from pathlib import Path

from mpmcli import __version__
from mpmcli.doctor.probe_result import ProbeResult

# As in pyproject.toml.
OLDEST, NEWEST = (3, 11), (3, 13)


def python(version: tuple[int, int] = sys.version_info[:2]) -> ProbeResult:
    """Examine the version of the interpreter."""
    place = (
        f"virtual environment {sys.prefix}"
        if sys.prefix != sys.base_prefix
        else f"no virtual environment, {sys.prefix}"
    )
    detail = f"{platform.python_version()}, {place}"
    if OLDEST <= version <= NEWEST:
        return ProbeResult("ok", detail)
    oldest, newest = (".".join(map(str, numbers)) for numbers in (OLDEST, NEWEST))
    return ProbeResult("broken", detail, f"install mpmcli into an environment of Python {oldest} to {newest}")


def mpmcli() -> ProbeResult:
    """Examine the package."""
    return ProbeResult("ok", f"{__version__}, {Path(__file__).resolve().parent.parent}")

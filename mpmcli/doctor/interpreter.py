"""Python and mpmcli themselves."""

import platform
import sys
from pathlib import Path

from mpmcli import __version__
from mpmcli.doctor.finding import Finding

# As pyproject.toml says.
OLDEST, NEWEST = (3, 11), (3, 13)


def python(version: tuple[int, int] = sys.version_info[:2]) -> Finding:
    """Examine the interpreter, of this version."""
    place = (
        f"virtual environment {sys.prefix}"
        if sys.prefix != sys.base_prefix
        else f"no virtual environment, {sys.prefix}"
    )
    detail = f"{platform.python_version()}, {place}"
    if OLDEST <= version <= NEWEST:
        return Finding("ok", detail)
    oldest, newest = (".".join(map(str, numbers)) for numbers in (OLDEST, NEWEST))
    return Finding("broken", detail, f"install mpmcli into an environment of Python {oldest} to {newest}")


def mpmcli() -> Finding:
    """Examine the package."""
    return Finding("ok", f"{__version__}, {Path(__file__).resolve().parent.parent}")

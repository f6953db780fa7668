"""What an examination found."""

import importlib.metadata
import re
from dataclasses import dataclass
from typing import Literal

# "missing" and "broken" are faults: something that mpmcli needs is not there, or does not work.
Status = Literal["ok", "information", "missing", "broken"]
STATUSES: tuple[Status, ...] = ("ok", "information", "missing", "broken")


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        status: "ok", "information", "missing" or "broken".
        detail: what was found, in a line.
        remedy: what the user can do about it, "" where there is nothing to do.
    """

    status: Status
    detail: str
    remedy: str = ""

    @property
    def is_fault(self) -> bool:
        """Whether something that mpmcli needs does not work."""
        return self.status in ("missing", "broken")


def package_remedy(package: str, *, again: bool = False) -> str:
    """Return the command that installs a package in the version that mpmcli asks for."""
    return f"{'install it again' if again else 'install it'} by `python -m pip install {_requirement(package, again)}`"


def _requirement(package: str, again: bool) -> str:
    try:
        listed = importlib.metadata.requires("mpmcli") or []
    except importlib.metadata.PackageNotFoundError:
        listed = []
    # Without extras such as "; extra == 'test'".
    found = [line for line in listed if re.split(r"[^\w.-]", line)[0].lower() == package.lower() and ";" not in line]
    return ("--force-reinstall " if again else "") + f'"{found[0] if found else package}"'

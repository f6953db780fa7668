"""Results of the probes of `mpmcli doctor`, and remedies."""

import importlib.metadata
import re
from dataclasses import dataclass
from typing import Literal

# "missing" and "broken" are faults: a required component is absent or does not work.
Status = Literal["ok", "information", "missing", "broken"]
# System libraries that the wheels of required packages load, and their Debian and Ubuntu packages.
SYSTEM_PACKAGES = {
    "libX11.so.6": "libx11-6",
    "libXrender.so.1": "libxrender1",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libstdc++.so.6": "libstdc++6",
    "libgcc_s.so.1": "libgcc-s1",
    "libz.so.1": "zlib1g",
}
STATUSES: tuple[Status, ...] = ("ok", "information", "missing", "broken")


@dataclass(frozen=True)
class ProbeResult:
    """One line of the report.

    Attributes:
        status: "ok", "information", "missing" or "broken".
        detail: the result, in one line.
        remedy: what the user can do; "" if nothing is required.
    """

    status: Status
    detail: str
    remedy: str = ""

    @property
    def is_fault(self) -> bool:
        """Whether a required component is missing or broken."""
        return self.status in ("missing", "broken")


def package_remedy(package: str, *, again: bool = False) -> str:
    """Return the command that installs a package in the version that mpmcli requires.

    Args:
        again: reinstall the package.
    """
    return f"{'install it again' if again else 'install it'} by `python -m pip install {_requirement(package, again)}`"


def library_remedy(complaint: str) -> str:
    """Return how to install the system library that the dynamic linker did not find; "" if none is named."""
    missed = re.search(r"(lib[\w.+-]*\.so[\d.]*): (?:cannot open shared object|file too short)", complaint)
    if missed is None:
        return ""
    library = missed[1]
    package = SYSTEM_PACKAGES.get(library)
    by = f", on Debian and Ubuntu by `apt-get install {package}`" if package else ""
    return f"install the system's package of {library}{by}"


def _requirement(package: str, again: bool) -> str:
    try:
        listed = importlib.metadata.requires("mpmcli") or []
    except importlib.metadata.PackageNotFoundError:
        listed = []
    # Without extras such as "; extra == 'test'".
    found = [line for line in listed if re.split(r"[^\w.-]", line)[0].lower() == package.lower() and ";" not in line]
    return ("--force-reinstall " if again else "") + f'"{found[0] if found else package}"'

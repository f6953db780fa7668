"""How a run stands: what its record says, unless its process has ended without closing the record."""

from pathlib import Path
from typing import Any

from mpmcli.output.lock import lock_is_held
from mpmcli.output.owner import Owner

DIED, ELSEWHERE = "died", "running on another machine, or died"


def run_status(directory: Path, record: dict[str, Any] | None) -> str:
    """Return the status of a run.

    Args:
        directory: of the result; record: its run.json, None where there is none.

    Returns:
        The status of the record. For one that says "running": "running" where the lock of the directory is held or
        the process lives, "died" where it has ended, `ELSEWHERE` where that cannot be seen from here. "unknown"
        without a record.
    """
    status = str((record or {}).get("status", "unknown"))
    if record is None or status != "running":
        return status
    if lock_is_held(directory):
        return status
    owner = Owner.read(record.get("process"))
    if owner is None:
        # Written by a version that kept no such facts.
        return ELSEWHERE
    return {"lives": status, "ended": DIED, "elsewhere": ELSEWHERE}[owner.life]

"""The environment of a report: machine, versions, commit, date."""

import subprocess
from datetime import UTC, datetime
from pathlib import Path

from mpmcli.bench.report import describe_machine

PACKAGE = Path(__file__).resolve().parent.parent


def describe_environment(workers: int) -> dict:
    """Return the environment as a dictionary.

    Args:
        workers: number of concurrent runs, of one thread each.
    """
    return {
        **describe_machine(),
        "commit": commit(),
        "arch": "cpu",
        "threads": 1,
        "workers": workers,
        "date": datetime.now(UTC).date().isoformat(),
    }


def commit() -> str | None:
    """Return the commit of the package, with "+" if files are modified; None outside a git repository of mpmcli."""

    def git(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(PACKAGE), *words], capture_output=True, text=True)
        except OSError:
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    # The package may be installed within another repository.
    if git("ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    head = git("rev-parse", "--short=12", "HEAD")
    return head and head + ("+" if git("status", "--porcelain", "--", ".") else "")

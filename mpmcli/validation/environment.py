"""What the figures of a report depend on: machine, versions, commit, date."""

import subprocess
from datetime import UTC, datetime
from pathlib import Path

from mpmcli.bench.report import describe_machine

PACKAGE = Path(__file__).resolve().parent.parent


def describe_environment(workers: int) -> dict:
    """Return it by name.

    Args:
        workers: how many runs went on at a time, one thread each.
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
    """Return the commit that the package is of, with a + where files differ; None where git does not hold it."""

    def git(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(PACKAGE), *words], capture_output=True, text=True)
        except OSError:
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    # It may be installed below somebody else's repository.
    if git("ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    head = git("rev-parse", "--short=12", "HEAD")
    return head and head + ("+" if git("status", "--porcelain", "--", ".") else "")

"""The cache of compiled kernels: what one process compiled serves the next, and processes may start at once."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from cached_kernel import TOTAL

from mpmcli.solver.machine import backend

pytestmark = pytest.mark.usefixtures("own_kernels")

KERNEL = Path(__file__).with_name("cached_kernel.py")
PROCESSES = 4


def begun(cache: Path) -> subprocess.Popen:
    """Return a process that compiles, or finds in the cache, and computes."""
    return subprocess.Popen(
        [sys.executable, KERNEL],
        env={**os.environ, "XDG_CACHE_HOME": str(cache)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def outcome(process: subprocess.Popen) -> tuple[int, str]:
    """Return the exit status of a process and the last line that it printed."""
    printed, errors = process.communicate(timeout=120)
    return process.returncode, (printed.splitlines() or [errors])[-1]


def kernels(cache: Path) -> set[Path]:
    """Return the files of the kernels in a cache."""
    return set((cache / "taichi" / "ticache").glob("*.tic"))


def truncate(cache: Path) -> None:
    """Cut the file of each kernel in two."""
    for path in kernels(cache):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def overwrite(cache: Path) -> None:
    """Fill the file of each kernel, and the list of them, with zeros."""
    for path in [*kernels(cache), cache / "taichi" / "ticache" / "ticache.tcb"]:
        path.write_bytes(bytes(path.stat().st_size))


def lock(cache: Path) -> None:
    """Leave the lock of a process that was killed just now."""
    (cache / "taichi" / "ticache" / "ticache.lock").touch()


@pytest.mark.parametrize("count", [1, PROCESSES])
def test_the_next_process_finds_functions_that_call_each_other(tmp_path: Path, count: int) -> None:
    """Their order in the key of a kernel must be the same in each process; several may begin an empty cache at once."""
    assert [outcome(p) for p in [begun(tmp_path) for _ in range(count)]] == [(0, str(TOTAL))] * count
    compiled = kernels(tmp_path)
    assert compiled
    assert outcome(begun(tmp_path)) == (0, str(TOTAL))
    assert kernels(tmp_path) == compiled


@pytest.mark.parametrize("damage", [truncate, overwrite, lock])
def test_processes_may_share_a_damaged_cache_at_once(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    """What cannot be read is compiled again; a lock makes nobody wait for ever."""
    assert outcome(begun(tmp_path)) == (0, str(TOTAL))
    damage(tmp_path)
    assert [outcome(p) for p in [begun(tmp_path) for _ in range(PROCESSES)]] == [(0, str(TOTAL))] * PROCESSES


def test_runs_without_a_home_share_a_cache_of_their_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One among temporary files that nobody else can write to; where somebody has made it, a new one."""

    def settled() -> Path:
        # Empty is as if it were not set, and what was before comes back after the test.
        monkeypatch.setenv("XDG_CACHE_HOME", "")
        backend._settle_cache()
        return Path(os.environ["XDG_CACHE_HOME"])

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(backend.Path, "home", homeless)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    first = settled()
    assert first.parent == tmp_path and first == settled() and first.stat().st_mode & 0o777 == 0o700
    first.chmod(0o777)
    assert settled() != first
    first.rmdir()
    first.symlink_to(tmp_path)
    assert settled() not in (first, tmp_path)

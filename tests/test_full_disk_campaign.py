"""The campaign of full disks in its short form."""

from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import ROOT, PythonRun


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="limits and forks as on Linux")
def test_runs_without_room_end_with_a_sentence_and_are_resumed(run_module: Callable[..., PythonRun]) -> None:
    done = run_module(ROOT / "scripts" / "full_disk", "--runs", 3)
    assert done.status == 0, done.stderr
    rows = [line.split(" | ") for line in done.stdout.splitlines()[2:]]
    assert "limit" in rows[-1][0]
    for row in rows:
        assert row[1] == "3"
        assert row[4] == "0"

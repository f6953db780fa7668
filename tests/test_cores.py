"""How many cores a process may use, where a container confines it."""

import os
from pathlib import Path

import pytest

from mpmcli import cores


@pytest.mark.parametrize(("files", "expected"), [
    ({}, 8),
    ({"cpu.max": "max 100000\n"}, 8),
    ({"cpu.max": "150000 100000\n"}, 2),
    ({"cpu.max": "50000 100000\n"}, 1),
    ({"cpu.max": "1600000 100000\n"}, 8),
    ({"quota": "-1\n", "period": "100000\n"}, 8),
    ({"quota": "300000\n", "period": "100000\n"}, 3),
    ({"cpu.max": "unknown\n"}, 8),
])  # fmt: skip
def test_a_share_of_the_processor_counts_in_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: dict[str, str], expected: int
) -> None:
    """Eight cores, of which the files of a control group leave some; both versions of its files are read."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    monkeypatch.setattr(
        cores, "QUOTAS", ((str(tmp_path / "cpu.max"),), (str(tmp_path / "quota"), str(tmp_path / "period")))
    )
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert cores.available_cores() == expected

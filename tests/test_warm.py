"""`mpmcli warm`: stored kernels are made ahead, and found."""

import json
from pathlib import Path

import pytest
from command import SCENE, run_here


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of Taichi's files of its own, with the store."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "taichi" / "ticache"


def scene_in(folder: Path, name: str, old: str = "", new: str = "") -> Path:
    path = folder / f"{name}.toml"
    path.write_text(SCENE.replace(old, new) if old else SCENE, encoding="utf-8")
    return path


def test_kernels_are_compiled_ahead_once(tmp_path: Path, folder: Path) -> None:
    path = scene_in(tmp_path, "drop")
    first = run_here("warm", path)
    assert (first.status, first.stderr) == (0, "")
    assert first.stdout.startswith(f"{path}: compiled, ")
    second = run_here("warm", path, "--json")
    found = json.loads(second.stdout)
    assert found["ok"] and found["scenes"][str(path)]["stored"]
    assert found["scenes"][str(path)]["fault"] == ""


def test_a_scene_that_cannot_be_compiled_is_named(tmp_path: Path, folder: Path) -> None:
    """A faulty scene, or a backend that is not there, is bad input, and nothing is compiled."""
    good, bad = scene_in(tmp_path, "good"), scene_in(tmp_path, "bad", "drop", "drop\\q")
    refused = run_here("warm", good, bad)
    assert (refused.status, refused.stdout) == (2, "")
    assert "bad.toml" in refused.stderr
    done = run_here("warm", good, "--threads", 10**6)
    assert (done.status, done.stdout) == (2, "")
    assert "--threads 1000000 is not possible" in done.stderr
    assert not folder.exists()

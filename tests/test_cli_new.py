"""`mpmcli new`, and examples by their names."""

import json
import tomllib
from pathlib import Path

import pytest
from command import CONFIGS, run_here

from mpmcli.scene.examples import caption, examples, files_of


def test_it_lists_all_examples_with_their_titles() -> None:
    known = examples()
    assert set(known.values()) == set(CONFIGS.glob("*.toml"))
    outcome = run_here("new")
    assert outcome.status == 0 and outcome.stderr == ""
    for line, (name, path) in zip(outcome.stdout.splitlines(), known.items(), strict=True):
        assert line.split(maxsplit=1) == [name, tomllib.loads(path.read_text(encoding="utf-8"))["title"]]
        assert len(caption(path)) > 40 and "#" not in caption(path) and caption(path).endswith(".")
    told = json.loads(run_here("new", "--json").stdout)
    assert told["silo_3d"] == {"title": "A silo of sand runs empty", "shows": caption(known["silo_3d"])}


def test_it_copies_one_with_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = run_here("new", "silo_3d", "-o", "mine/silo.toml")
    assert outcome.status == 0 and outcome.stdout == f"{Path('mine/silo.toml')}\n"
    assert "mpmcli simulate" in outcome.stderr and caption(CONFIGS / "silo_3d.toml") in outcome.stderr
    assert Path("mine/silo.toml").read_bytes() == (CONFIGS / "silo_3d.toml").read_bytes()
    assert files_of(Path("mine/silo.toml")) == [Path("meshes/silo.stl")]
    assert json.loads(run_here("info", "mine/silo.toml", "--json").stdout)["colliders"] == ["silo: mesh"]
    for words, said in (
        (("silo_3d", "-o", "mine/silo.toml"), "silo.toml is there already"),
        (("silo_3d", "-o", "mine/silo.toml/inside.toml"), "inside.toml could not be written"),
        (("silo",), 'there is no example "silo"; did you mean "silo_3d"?'),
    ):
        refused = run_here("new", *words)
        assert refused.status == 2 and said in refused.stderr and len(refused.stderr.splitlines()) == 1
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_file()) == ["silo.stl", "silo.toml"]


def test_an_example_runs_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is there under that name comes first."""
    monkeypatch.chdir(tmp_path)
    words = ("--set", "time.end=1e-3", "--set", "time.frames=1", "--quiet")
    assert run_here("simulate", "couette_2d", *words).status == 0
    assert (tmp_path / "results" / "couette_2d" / "particles.vtkhdf").exists()
    assert json.loads(run_here("info", "couette_2d", "--json").stdout)["title"] == "Couette flow from rest"
    (tmp_path / "couette_2d").mkdir()
    assert run_here("info", "couette_2d").status == 2

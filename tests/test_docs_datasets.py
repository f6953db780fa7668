"""The page on datasets: its tables are complete, its code runs, and its workflow for CI makes a dataset."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from command import ROOT
from made_sweep import made_workers, make_dataset  # noqa: F401

import mpmcli.dataset
from mpmcli.dataset.shard import LABELS, MOVING, TABLES
from mpmcli.dataset.sweep import Placement, SweepTable, read_distribution

PAGE = (ROOT / "docs" / "datasets.md").read_text(encoding="utf-8")
# In place of the sweep of the workflow: eight trajectories of four steps, in shards of two.
SCENE = """\
[domain]
size = [1.0, 1.0]
cells = [16, 16]
gravity = [0.0, -9.81]
[time]
end = 0.005
frames = 3
[[bodies]]
name = "sand"
material = { law = "fluid", density = 1000.0 }
shape = { box = { min = [0.25, 0.0], max = [0.75, 0.5] } }
"""
SWEEP = 'base = "scene.toml"\ncount = 8\n[vary]\n"domain.gravity.1" = { uniform = [-9.81, -3.7] }\n'
# The command, with one worker, as a second compiles the same, and with shards small enough that two parts have some.
PROGRAM = """\
#!{python}
import sys
sys.path.insert(0, {root!r})
from mpmcli import cores
cores.available_cores = lambda: 1
from mpmcli.cli import main
from mpmcli.dataset import sweep_run
sweep_run._per_shard = lambda size: 2
if __name__ == "__main__":
    main()
"""


def block(language: str) -> str:
    """Return the fenced block of a language on the page, of which there is one."""
    (found,) = re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return found


def test_the_tables_of_keys_and_distributions_are_complete():
    told = PAGE[PAGE.index("## A sweep file") : PAGE.index("## Computing it")]
    rows = re.findall(r"^\| (`.*)$", told, re.MULTILINE)
    named = set(re.findall(r"\w+", " ".join(row.split("|")[0] for row in rows)))
    assert set(SweepTable.model_fields) <= named
    placement = next(row for row in rows if row.startswith("`[place]`"))
    assert set(Placement.model_fields) <= set(re.findall(r"`(\w+)`", placement))
    for kind in ("uniform", "loguniform", "normal", "integers", "choice", "grid"):
        assert any(row.startswith(f"`{kind} = ") for row in rows)
        assert read_distribution({kind: [1, 2]})


def test_the_tables_of_files_are_complete():
    told = PAGE[PAGE.index("## The files") : PAGE.index("## In Python")]
    for name in (*MOVING, *LABELS, *TABLES, "number", "split", "draws", "header", "quarantine", "manifest.sqlite"):
        assert name in told


@pytest.mark.usefixtures("made_workers")
def test_the_code_of_the_page_runs():
    make_dataset("results/drops")
    names: dict = {}
    exec(block("python"), names)
    np.testing.assert_array_equal(names["window"], names["position"][2:8])


def test_the_cluster_of_the_page_is_python():
    compile(block("py"), "cluster.py", "exec")


def test_the_commands_of_the_workflow_make_a_dataset(tmp_path):
    """Its run lines, in the order of its jobs; what it uploads and downloads lies in one place here."""
    jobs = yaml.safe_load(block("yaml"))["jobs"]
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "mpmcli").write_text(PROGRAM.format(python=sys.executable, root=str(ROOT)), encoding="utf-8")
    (programs / "mpmcli").chmod(0o755)
    environment = {**os.environ, "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    sweep = tmp_path / "configs" / "sweeps" / "sand_boxes_2d.toml"
    sweep.parent.mkdir(parents=True)
    sweep.write_text(SWEEP, encoding="utf-8")
    sweep.with_name("scene.toml").write_text(SCENE, encoding="utf-8")

    def run_steps(job: dict, part: int | None) -> list[str]:
        places = []
        for step in job["steps"]:
            text = yaml.safe_dump(step, width=1000).replace("${{ matrix.part }}", str(part))
            filled = yaml.safe_load(text)
            if "upload-artifact" in filled.get("uses", ""):
                places.append(filled["with"]["path"])
            if filled.get("run", "").startswith("mpmcli"):
                done = subprocess.run(
                    ["bash", "-c", filled["run"]], cwd=tmp_path, env=environment, capture_output=True, text=True
                )
                assert done.returncode == 0, done.stderr
        return places

    parts = jobs["part"]["strategy"]["matrix"]["part"]
    uploaded = [place for part in parts for place in run_steps(jobs["part"], part)]
    assert sorted(str(path.relative_to(tmp_path)) for path in (tmp_path / "parts").iterdir()) == uploaded
    assert run_steps(jobs["merge"], None) == ["dataset"]
    assert mpmcli.dataset.open(tmp_path / "dataset").numbers == tuple(range(8))
    assert (tmp_path / "dataset" / "README.md").exists()


def test_the_page_names_no_machine():
    assert not re.search(r"/(home|work|tmp)/", PAGE)
    assert Path(ROOT / "docs" / "datasets.md").stat().st_size < 15_000

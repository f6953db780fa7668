"""What visitors find at the root: a wheel and an sdist that work alone, a citation, workflows, forms."""

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml
from command import CONFIGS, ROOT

import mpmcli


def test_the_citation_names_this_version() -> None:
    told = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert told["version"] == mpmcli.__version__ and told["license"] == "MIT" and told["authors"]


@pytest.mark.parametrize(
    "path",
    [*sorted(str(path.relative_to(ROOT)) for path in (ROOT / ".github").rglob("*.yml")), ".pre-commit-config.yaml"],
)
def test_forms_and_workflows_are_yaml(path: str) -> None:
    told = yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))
    steps = [step for job in told.get("jobs", {}).values() for step in job["steps"]]
    assert not steps or any(step.get("run", "").startswith(".ci/run") for step in steps)


@pytest.mark.slow
def test_wheel_and_sdist_run_an_example_in_an_empty_environment(tmp_path: Path) -> None:
    """Both are made from a copy of the checkout; a wheel made of the sdist has the same files."""

    def done(*words: object) -> str:
        return subprocess.run([*map(str, words)], check=True, capture_output=True, text=True, cwd=tmp_path).stdout

    quiet = ("--quiet", "--disable-pip-version-check")
    done(sys.executable, "-m", "venv", "tools")
    done("tools/bin/pip", "install", *quiet, "build")
    done("tools/bin/python", "-m", "build", ROOT, "--outdir", "dist")
    (wheel,), (sdist,) = (list((tmp_path / "dist").glob(f"*{end}")) for end in (".whl", ".tar.gz"))
    names = zipfile.ZipFile(wheel).namelist()
    assert {f"mpmcli/examples/{path.name}" for path in CONFIGS.glob("*.toml")} <= set(names)
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert {"CHANGELOG.md", "constraints.txt", "mpmcli/__init__.py"} <= inside
    done(sys.executable, "-m", "venv", "empty")
    done("empty/bin/pip", "install", *quiet, "-c", ROOT / "constraints.txt", wheel)
    words = ["dam_break_2d", "-o", "result", "--set", "time.end=0.02", "--set", "time.frames=2", "--quiet"]
    done("empty/bin/mpmcli", "simulate", *words)
    assert "frames" in done("empty/bin/mpmcli", "info", "result")

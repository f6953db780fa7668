"""`--plugin law.py`: a law in a file of its own is shown, completed by editors, and run; a scene alone runs no code."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command import run_here
from conftest import ROOT

from mpmcli.materials.registry import laws, load_plugins

LAW = '''\
"""Fluid whose pressure goes with the logarithm of the volume."""

import math
from typing import Annotated, Literal

import taichi as ti
from pydantic import Field

from mpmcli.materials.law import Law, Mode
from mpmcli.scene.material import Knob
from mpmcli.scene.material import MaterialParameters
from mpmcli.scene.quantity import Positive


class LogFluidParameters(MaterialParameters):
    """Parameters of the logarithmic fluid."""

    law: Literal["log_fluid"] = "log_fluid"
    sound_speed: Annotated[
        Positive, Field(description="Speed of sound c, m/s."), Knob("swiftness", 1.0, 100.0, "0 is slow, 1 swift")
    ]


@ti.data_oriented
class LogFluid(Law):
    """tau = density c^2 ln(J) I."""

    name = "log_fluid"
    parameters = LogFluidParameters
    deformation = "J"

    def constants(self, parameters):
        return (parameters.density * parameters.sound_speed**2,)

    def modes(self, parameters, bound):
        return [Mode(self.dimension * self.constants(parameters)[0])]

    @ti.func
    def respond(
        self, deformation: ti.template(), internal: ti.template(), C: ti.template(), dt: float, constants: ti.template()
    ):
        spherical = constants[0] * ti.log(deformation)
        return spherical * ti.Matrix.identity(float, C.n), spherical, deformation, internal

    @ti.func
    def energy(self, deformation: ti.template(), internal: ti.template(), constants: ti.template()):
        return 0.5 * constants[0] * ti.log(deformation) ** 2


LAW = LogFluid
'''

SCENE = """\
title = "A block of a new law"
domain = { size = [1.0, 1.0], cells = [16, 16], gravity = [0.0, -9.81] }
time = { end = 0.05, frames = 4 }
[[bodies]]
name = "block"
material = { law = "log_fluid", density = 1000.0, swiftness = 0.75 }
shape = { box = { min = [0.25, 0.0], max = [0.75, 0.5] } }
"""


@pytest.fixture(autouse=True)
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """law.py and scene.toml in the present directory; no plugin outlives its test."""
    monkeypatch.chdir(tmp_path)
    Path("law.py").write_text(LAW, encoding="utf-8")
    Path("scene.toml").write_text(SCENE, encoding="utf-8")
    yield
    load_plugins(())


def refused(*arguments: str) -> str:
    """Return the one line with which a command was refused."""
    before = sorted(Path.cwd().rglob("*"))
    outcome = run_here(*arguments)
    assert outcome.status == 2 and outcome.stdout == ""
    assert sorted(Path.cwd().rglob("*")) == before, "something was written"
    (line,) = outcome.stderr.splitlines()
    return line.removeprefix("error: ")


def test_materials_shows_the_law():
    (law,) = json.loads(run_here("materials", "log_fluid", "--plugin", "law.py", "--json").stdout)["laws"]
    assert law["summary"] == "Fluid whose pressure goes with the logarithm of the volume"
    assert law["parameters"][1] == {
        "name": "sound_speed",
        "unit": "m/s",
        "range": "> 0",
        "default": None,
        "description": "Speed of sound c, m/s.",
    }
    assert [knob["name"] for knob in law["knobs"]] == ["swiftness"]
    assert "log_fluid" in run_here("materials", "--plugin", "law.py").stdout
    assert not list(Path.cwd().rglob("*.pyc"))


def test_the_schema_knows_the_law():
    schema = json.loads(run_here("schema", "--plugin", "law.py").stdout)
    assert schema["$defs"]["LogFluidParameters"]["properties"].keys() == {"law", "density", "sound_speed", "swiftness"}


def test_info_reads_a_scene_of_the_law():
    facts = json.loads(run_here("info", "scene.toml", "--plugin", "law.py", "--json").stdout)
    assert facts["bodies"] == ["block: log_fluid, box"]
    assert facts["notes"][0] == "block: swiftness = 0.75 sets sound_speed = 31.6 m/s"


def test_simulate_runs_the_law():
    """From one file to a result: and the effective scene runs again, to the same positions."""
    outcome = run_here("simulate", "scene.toml", "--plugin", "law.py", "-o", "result", "--json")
    assert outcome.status == 0, outcome.stderr
    summary = json.loads(outcome.stdout)
    assert summary["status"] == "finished" and summary["frames"] == 5

    from mpmcli.output import open_result

    result = open_result(Path("result"))
    assert [law.name for law in result.header.laws] == ["log_fluid"]
    first, last = result.frame(0), result.frame(4)
    assert (first.position != last.position).any()
    # Nothing dissipates but the transfers: energy is not made, to rounding in f32.
    energies = [row.energy for row in result.ledger]
    assert energies[-1] <= energies[0] * (1 + 1e-5)
    assert result.ledger[-1].elastic > 0

    again = run_here("simulate", "result/scene.toml", "--plugin", "law.py", "-o", "again", "--quiet")
    assert again.status == 0, again.stderr
    assert (open_result(Path("again")).frame(4).position == last.position).all()


def test_a_scene_alone_runs_no_code():
    said = refused("simulate", "scene.toml")
    assert said.startswith('scene.toml:6: bodies[0].material.law: unknown law "log_fluid"; ')
    # Nor is the law of one command there for the next.
    run_here("materials", "--plugin", "law.py")
    assert "log_fluid" in laws()
    assert refused("info", "scene.toml") == said


def test_several_plugins_make_several_laws():
    """Of files and classes of the same name, too, which may even be that of a class of mpmcli."""
    Path("more").mkdir()
    for file, word in {"more/law.py": "log_fluid_2", "third.py": "log_fluid_3"}.items():
        text = LAW.replace("log_fluid", word)
        Path(file).write_text(text.replace("LogFluid", "Fluid") if file == "third.py" else text, encoding="utf-8")
    plugins = ("--plugin", "law.py", "--plugin", "more/law.py", "--plugin", "third.py")
    listed = json.loads(run_here("materials", *plugins, "--json").stdout)["laws"]
    assert {"log_fluid", "log_fluid_2", "log_fluid_3", "fluid"} <= {law["name"] for law in listed}
    schema = json.loads(run_here("schema", *plugins).stdout)
    references = [form["$ref"] for form in schema["$defs"]["Body"]["properties"]["material"]["oneOf"][1:]]
    tables = [schema["$defs"][reference.removeprefix("#/$defs/")]["properties"] for reference in references]
    assert sorted(table["law"]["const"] for table in tables if "law" in table) == sorted(laws())


# What is replaced in the law, by what, and what is said.
FAULTS = {
    "no LAW": (("LAW = LogFluid", ""), "law.py: the file defines no LAW; end it with LAW = YourLaw"),
    "no class": (("LAW = LogFluid", "LAW = 3"), "law.py: LAW must be a subclass of mpmcli.materials.law.Law; found 3"),
    "another class": (("LAW = LogFluid", "LAW = LogFluidParameters"),
        "law.py: LAW must be a subclass of mpmcli.materials.law.Law; found <class 'mpmcli_plugin_0_law.LogFluidParam"),
    "name taken": (("log_fluid", "fluid"), 'law.py: "fluid" is the name of a law of mpmcli; give LAW another name'),
    "two names": (('name = "log_fluid"', 'name = "other"'),
        "law.py: LogFluid.name is \"other\", and law in its parameters is 'log_fluid'; both must be the same word"),
    "no name": (('    name = "log_fluid"\n', ""), "law.py: LogFluid does not define name"),
    "no modes": (("def modes(", "def mode("), "law.py: LogFluid does not define modes()"),
    "no energy": (("def energy(", "def energies("), "law.py: LogFluid does not define energy()"),
    "no parameters": (("parameters = LogFluidParameters", "parameters = dict"),
        "law.py: LogFluid.parameters must be a subclass of MaterialParameters; found <class 'dict'>"),
    "raises": (("import math\n", "import math\n1 / 0\n"), "law.py:4: ZeroDivisionError: division by zero"),
    "raises deeper": (
        ("import math\n", "import math\nmath.sqrt(\n    -1)\n"),
        "law.py:4: ValueError: math domain error",
    ),
    "no module": (("import math\n", "import maths\n"), "law.py:3: ModuleNotFoundError: No module named 'maths'"),
    "syntax": (("import math\n", "import math math\n"), "law.py:3: SyntaxError: invalid syntax"),
    "exits": (("import math\n", "raise SystemExit('enough')\n"), "law.py:3: SystemExit: enough"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_plugin_is_refused_with_one_sentence(fault):
    (old, new), sentence = FAULTS[fault]
    assert old in LAW
    Path("law.py").write_text(LAW.replace(old, new), encoding="utf-8")
    assert refused("simulate", "scene.toml", "--plugin", "law.py").startswith(sentence)


def test_a_file_that_cannot_be_read_is_refused():
    Path("binary.py").write_bytes(b"\xff\xfe")
    Path("folder.py").mkdir()
    for path, sentence in {
        "nothing.py": "there is no such file; give a Python file that defines LAW",
        "binary.py": "the file cannot be read: it is not text in UTF-8",
        "folder.py": "the file cannot be read: Is a directory",
    }.items():
        assert refused("materials", "--plugin", path) == f"{path}: {sentence}"


def test_two_plugins_of_one_name_are_refused():
    Path("other.py").write_text(LAW, encoding="utf-8")
    said = refused("schema", "--plugin", "law.py", "--plugin", "other.py")
    assert said == 'other.py: "log_fluid" is the name of the law in law.py; give LAW another name'


def test_a_result_needs_no_plugin():
    Path("result").mkdir()
    assert refused("info", "result", "--plugin", "law.py") == (
        "--plugin is for scenes, and result is not one; leave it out."
    )


def test_a_law_is_one_file_of_the_package(tmp_path: Path) -> None:
    """A file put beside the laws of mpmcli is listed, completed by editors, checked, run, and its result checked."""
    shutil.copytree(ROOT / "mpmcli", tmp_path / "mpmcli", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "mpmcli" / "materials" / "log_fluid.py").write_text(LAW, encoding="utf-8")

    def said(*words: str) -> dict:
        done = subprocess.run(
            [sys.executable, "-m", "mpmcli", *words],
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": str(tmp_path)},
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    (law,) = said("materials", "log_fluid", "--json")["laws"]
    assert [knob["name"] for knob in law["knobs"]] == ["swiftness"]
    assert "LogFluidParameters" in said("schema")["$defs"]
    assert said("check", "scene.toml", "--json")["ok"]
    summary = said("simulate", "scene.toml", "-o", "result", "--json")
    assert (summary["status"], summary["frames"]) == ("finished", 5)
    assert said("check", "result", "--json")["verdict"] == "stable"


def test_a_run_is_not_resumed_with_a_law_that_has_changed():
    run_here("simulate", "scene.toml", "--plugin", "law.py", "-o", "result", "--quiet")
    again = ("simulate", "scene.toml", "--plugin", "law.py", "-o", "result", "--resume")
    assert run_here(*again).status == 0
    law = Path("law.py")
    law.write_text(law.read_text(encoding="utf-8") + "\n# Another one.\n", encoding="utf-8")
    assert refused(*again).startswith("the plugin of the law log_fluid has changed since the run in result began")

"""Bad input to the real command: exit code 2, one clear sentence on stderr, and nothing written."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest
from command import ROOT, SCENE, Outcome, run_here

from mpmcli.cli.program import program


@pytest.fixture
def refused(tmp_path, monkeypatch):
    """Return `refused(*arguments, scene=TEXT)`: the one line with which a command was refused.

    The scene lies in scene.toml of an otherwise empty present directory, which must not change.
    """
    monkeypatch.chdir(tmp_path)

    def refused(*arguments: object, scene: str = SCENE) -> str:
        Path("scene.toml").write_text(scene, encoding="utf-8")
        before = content(tmp_path)
        outcome: Outcome = run_here(*arguments)
        assert outcome.status == 2, outcome
        assert outcome.stdout == ""
        assert content(tmp_path) == before, "something was written"
        assert "Traceback" not in outcome.stderr
        lines = [line for line in outcome.stderr.splitlines() if not line.startswith("drop: bulk_modulus")]
        assert len(lines) == 1, outcome.stderr
        assert lines[0].startswith("error: ")
        return lines[0].removeprefix("error: ")

    return refused


def content(directory: Path) -> dict[str, bytes | None]:
    """Every path below a directory, and what the files hold."""
    return {str(p.relative_to(directory)): p.read_bytes() if p.is_file() else None for p in directory.rglob("*")}


# What is replaced in the scene, by what, and what the sentence says.
SCENES = {
    "unknown key": (
        ("density = ", "densty = "),
        'scene.toml:11: bodies[0].material.densty: unknown key; did you mean "density"?',
    ),
    "wrong type": (("end = 0.05", 'end = "0.05"'), 'scene.toml:7: time.end: must be a number; found "0.05"'),
    "negative density": (("density = 1000.0", "density = -1000.0"),
        "scene.toml:11: bodies[0].material.density: must be greater than 0; found -1000.0"),
    "zero frames": (("frames = 4", "frames = 0"), "scene.toml:8: time.frames: must be at least 1; found 0"),
    "body outside": (("max = [0.75, 0.5]", "max = [0.75, 1.5]"),
        'scene.toml:12: bodies[0].shape: body "drop" leaves the domain through y_max by 0.5 m '
        "(it reaches y = 1.5, the face is at 1); move it or enlarge the domain"),
    "1D": (("size = [1.0, 1.0]", "size = [1.0]"),
        "scene.toml:3: domain.size: needs two numbers (2D) or three (3D); found 1"),
    "TOML syntax": (
        ("cells = [16, 16]", "cells = [16, 16"),
        "scene.toml:5:1: not valid TOML: a list is not closed with ]",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", SCENES)
def test_a_bad_scene_is_refused_with_one_sentence(refused, fault):
    (old, new), sentence = SCENES[fault]
    assert SCENE.count(old) == 1
    assert refused("simulate", "scene.toml", scene=SCENE.replace(old, new)) == sentence


def test_bodies_that_overlap_are_both_named(refused):
    second = SCENE[SCENE.index("[[bodies]]") :].replace('"drop"', '"other"')
    said = refused("simulate", "scene.toml", scene=SCENE + second)
    assert said == (
        'scene.toml:16: bodies[1].shape: body "other" overlaps body "drop", for example at [0.5, 0.25]; '
        "bodies may touch but not overlap"
    )


def test_every_fault_is_told_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE.replace("frames = 4", "frames = 0"), encoding="utf-8")
    outcome = run_here("simulate", "scene.toml", "--set", "time.endd=1", "--set", "domain.walls=slippery")
    assert outcome.status == 2 and outcome.stdout == ""
    places = [line.removeprefix("error: ").split(": ")[0] for line in outcome.stderr.splitlines()]
    assert sorted(places) == ["--set domain.walls=slippery", "--set time.endd=1", "scene.toml:8"]


# Arguments after `simulate scene.toml`, and what the sentence says.
OPTIONS = {
    "no value": (["--set", "time.end"], "--set time.end: an override is KEY=VALUE"),
    "no key": (["--set", "=3"], '--set =3: "" is not a key'),
    "unknown key": (["--set", "time.ende=3"], '--set time.ende=3: time.ende: unknown key; did you mean "end"?'),
    "not a TOML": (["--set", "time.end=[1"], "--set time.end=[1: [1 is not a TOML value"),
    "no entry": (["--set", "bodies[3].name=a"], "--set bodies[3].name=a: bodies has 1 entry, counted from 0"),
    "unknown arch": (["--arch", "gpu"], "invalid value for '--arch': 'gpu' is not one of 'auto', 'cpu'"),
    "no threads": (["--threads", "0"], "invalid value for '--threads': 0 is not in the range x>=1"),
    "unknown precision": (["--precision", "f16"], "invalid value for '--precision': 'f16' is not one of"),
    "unknown format": (["--format", "vtu"], "invalid value for '--format': 'vtu' is not one of"),
    "unknown option": (["--thread", "2"], "no such option '--thread'. Did you mean '--threads'?"),
    "f64 on vulkan": (["--arch", "vulkan", "--precision", "f64"], "precision f64 is not available on vulkan"),
}


@pytest.mark.parametrize("fault", OPTIONS)
def test_a_bad_option_is_refused_with_one_sentence(refused, fault):
    arguments, sentence = OPTIONS[fault]
    assert refused("simulate", "scene.toml", *arguments).startswith(sentence)


def test_a_backend_that_is_not_there_is_refused(refused, monkeypatch):
    monkeypatch.setattr("mpmcli.solver.machine.backend.backend_is_here", lambda arch: arch == "cpu")
    said = refused("simulate", "scene.toml", "--arch", "cuda")
    assert said == "--arch cuda needs a device that this machine does not have; use --arch cpu."


@pytest.mark.parametrize(("arguments", "sentence"), [
    (["simulat"], 'there is no command "simulat"; did you mean "simulate"? See mpmcli --help.'),
    (["paint"], 'there is no command "paint"; the commands are new, check, simulate, materials, info, '),
    (["--verbose"], "no such option '--verbose'"),
    (["simulate"], "missing argument 'SCENE'. See mpmcli simulate --help."),
    (["simulate", "a.toml", "b.toml"], "got unexpected extra argument (b.toml). See mpmcli simulate --help."),
    (["simulate", "nothing.toml"], "nothing.toml: there is no such file"),
    (["simulate", "."], ".: this is a directory; did you mean scene.toml?"),
    (["info", "nothing.toml"], "nothing.toml: there is no such file"),
    (["info", "nothing"], "nothing does not exist"),
    (["info", "."], ". holds no result of mpmcli"),
    (["completion", "tcsh"], "invalid value"),
    (["bench", "--case", "4d-1"], 'there is no case "4d-1"; the cases are 2d-64, '),
])  # fmt: skip
def test_a_bad_command_is_refused_with_one_sentence(refused, arguments, sentence):
    assert refused(*arguments).startswith(sentence)


def test_no_command_at_all_shows_the_help():
    outcome = run_here()
    assert outcome.status == 2 and outcome.stdout == ""
    assert "simulate" in outcome.stderr


# (0.5 m / 1e-6 m)^2 cells of 4 particles each.
HUGE = SCENE.replace("cells = [16, 16]", "spacing = 1e-6")


def test_too_many_particles_are_refused_before_any_is_made(refused, monkeypatch):
    def unreachable(*_: object) -> None:
        raise AssertionError("particles were made")

    monkeypatch.setattr("mpmcli.simulation.simulate.build_run", unreachable)
    said = refused("simulate", "scene.toml", scene=HUGE)
    assert said.startswith("scene.toml: The scene needs 1e+12 particles and 1.03e+12 grid nodes, 19")
    assert " TB of memory, but " in said and said.endswith("fewer particles_per_cell.")


def test_info_describes_even_a_scene_that_is_too_large(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(HUGE, encoding="utf-8")
    outcome = run_here("info", scene, "--json")
    assert outcome.status == 0 and json.loads(outcome.stdout)["particles"] == pytest.approx(1e12)


# Root may write everywhere but below a file and in /proc.
PLACES = {
    "a result": ("full", "full exists and is not empty: give another directory with -o, or --overwrite to replace"),
    "a file": ("file", "file is a file, not a directory: give another place with -o."),
    "below a file": ("file/result", "file/result cannot be made (Not a directory): give another place with -o."),
    "/proc": ("/proc/mpmcli/result", "/proc/mpmcli/result cannot be made ("),
}


@pytest.mark.parametrize("place", PLACES)
def test_an_output_directory_that_cannot_be_used_is_refused(refused, place):
    Path("full").mkdir()
    Path("full/something.txt").write_text("mine")
    Path("file").write_text("mine")
    directory, sentence = PLACES[place]
    if directory.startswith("/proc") and not Path("/proc/self").exists():
        pytest.skip("this system has no /proc")
    assert refused("simulate", "scene.toml", "-o", directory).startswith(sentence)


def test_what_was_not_written_by_mpmcli_is_never_replaced(refused):
    """`-o .` beside the scene, whose name is that of the effective scene of a result."""
    said = refused("simulate", "scene.toml", "-o", ".", "--overwrite")
    assert said == "scene.toml was not written by mpmcli: give another directory with -o."


def test_a_directory_that_is_gone_has_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    command = f'cd gone && rmdir ../gone && exec "{sys.executable}" -m mpmcli simulate "{tmp_path}/drop.toml"'
    (tmp_path / "drop.toml").write_text(SCENE, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", command], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr == "error: the working directory no longer exists: go to another one.\n"


def commands() -> list[tuple[str, click.Command]]:
    """Return every command with its words."""
    context = click.Context(program)
    found = [(name, program.get_command(context, name)) for name in program.list_commands(context)]
    groups = [(name, one) for name, one in found if isinstance(one, click.Group)]
    inner = [(f"{name} {key}", one) for name, group in groups for key, one in group.commands.items()]
    return [(name, one) for name, one in found if not isinstance(one, click.Group)] + inner


@pytest.mark.parametrize(("name", "command"), commands(), ids=lambda value: value if isinstance(value, str) else "")
def test_the_help_of_each_command_has_an_example_that_it_takes(name: str, command: click.Command) -> None:
    example = command.epilog
    assert example.startswith(f"Example: mpmcli {name}")
    words = shlex.split(example.partition(">")[0])[2 + len(name.split()) :]
    command.make_context(name, words)

"""From a sweep file to a checked sweep, or to one error that names everything wrong with it."""

from os import PathLike
from pathlib import Path as File
from typing import Any

from pydantic import ValidationError

from mpmcli.dataset.sweep import Sweep, SweepTable
from mpmcli.dataset.sweep_check import sweep_problems
from mpmcli.errors import InputError
from mpmcli.scene import parse_scene
from mpmcli.scene.expand import Laws
from mpmcli.scene.geometry_file import absence
from mpmcli.scene.load import read_toml, report
from mpmcli.scene.locate import key_lines, line_of
from mpmcli.scene.problem import Path, Problem
from mpmcli.scene.quantity import dimension_of
from mpmcli.scene.sentences import problems_of, written


def load_sweep(path: str | PathLike[str], *, laws: Laws, count: int | None = None) -> Sweep:
    """Read a sweep and its base scene from TOML files, and try the scenes that they make.

    The base scene is sought in the directory of the sweep, then in the working directory. Trajectory 0 must be a
    valid scene, also with every distribution at either of its ends and with every value of a choice or grid, one
    key at a time.

    Args:
        path: the sweep file.
        laws: parameter models of the constitutive laws that a material may follow.
        count: number of trajectories; default: that of the file.

    Raises:
        InputError: one line per fault: `FILE:LINE: KEY: what is wrong and what would be right`; the faults of a base
            scene that is itself no valid scene are told as `mpmcli.scene.load_scene` tells them.
    """
    text, data = read_toml(path, "sweep")
    read = data if count is None else {**data, "count": count}
    base = _base_file(File(path), text, data)
    base_text, base_data = read_toml(base)
    table, problems = _validate(read, dimension_of(base_data))
    if table is None:
        raise InputError(report(problems, str(path), text))
    parse_scene(base_data, laws=laws, source=str(base), text=base_text, directory=base.parent)
    sweep = Sweep(
        path=File(path),
        text=text,
        data=data,
        base=base,
        base_text=base_text,
        base_data=base_data,
        count=table.count,
        seed=table.seed,
        method=table.method,
        accept=table.accept,
        vary=table.vary,
        placements=table.place,
        split=table.split,
    )
    if problems := sweep_problems(sweep, laws):
        raise InputError(report([_as_written(p, data) for p in problems], str(path), text))
    return sweep


def _base_file(path: File, text: str, data: dict[str, Any]) -> File:
    """Return the file of the base scene; relative to the sweep, or to the working directory."""
    name = data.get("base")
    line = line_of(("base",), key_lines(text))
    place = f"{path}: base" if line is None else f"{path}:{line}: base"
    if name is None:
        raise InputError(f'{place}: missing key: the base scene, such as base = "scene.toml"')
    if not isinstance(name, str):
        raise InputError(f"{place}: must be text in quotes; found {written(name)}")
    beside = path.parent / name
    found = next((file for file in (beside, File(name)) if not absence(file)), None)
    if found is None:
        raise InputError(f"{place}: there is no such file: neither {beside} nor {File.cwd() / name} is one")
    return found


def _validate(data: dict[str, Any], dimension: int | None) -> tuple[SweepTable | None, list[Problem]]:
    place = data.get("place")
    listed = {**data, "place": [place]} if isinstance(place, dict) else data
    try:
        return SweepTable.model_validate(listed, context={"dimension": dimension}), []
    except ValidationError as error:
        return None, [_as_written(p, data) for p in problems_of(error, listed, SweepTable)]


def _as_written(problem: Problem, data: dict[str, Any]) -> Problem:
    """Take the index out of the path to a placement where the file has one [place] table instead of a list."""
    path: Path = problem.path
    if path[:1] == ("place",) and isinstance(data["place"], dict):
        path = ("place", *path[2:])
    return Problem(path, problem.sentence)

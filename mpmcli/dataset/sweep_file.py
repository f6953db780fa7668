"""Loads a checked sweep from a sweep file, or raises one error that lists every fault."""

import copy
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from os import PathLike
from pathlib import Path as File
from typing import Any

import tomli_w
from pydantic import ValidationError

from mpmcli.dataset.draw import PlacementError, draw, template_extent
from mpmcli.dataset.hold_out import PARTICLES, is_range, meets
from mpmcli.dataset.image_folder import image_frames
from mpmcli.dataset.sweep import ROUND_OFF, Numbers, Placement, Sweep, SweepTable, is_number
from mpmcli.errors import InputError
from mpmcli.scene import Scene, parse_scene
from mpmcli.scene.camera_file import valid_cameras
from mpmcli.scene.load import read_scene, report, scene_problems
from mpmcli.scene.material import Laws
from mpmcli.scene.points import absence
from mpmcli.scene.problem import Path, Problem, hint_at, listed, path_text, problems_of, quoted, several, written
from mpmcli.scene.quantity import AXES, LARGEST, NUMBER_WORDS, dimension_of
from mpmcli.scene.sampling import count_sources
from mpmcli.scene.shapes import COMBINED
from mpmcli.scene.toml_file import apply_overrides, key_parts, read_toml, set_value

MOST_BODIES = 1000
# Trajectories in which rules of splits are tried.
MOST_DRAWN = 2000
# The key of a placement by the list that its template is in.
KINDS = {"bodies": "body", "colliders": "collider"}


def load_sweep(
    path: str | PathLike[str], *, laws: Laws, count: int | None = None, overrides: Sequence[str] = ()
) -> Sweep:
    """Read a sweep and its base scene from TOML files, and validate the resulting scenes.

    The base is searched in the directory of the sweep, then in the working directory. Trajectory 0 must be valid, also
    with each distribution at its ends, one key at a time. `count` replaces that of the file, `overrides` replace keys
    of the base scene (`apply_overrides`). InputError has one line per fault: `FILE:LINE: KEY: fault and correction`.
    """
    text, data = read_toml(path, "sweep")
    read = data if count is None else {**data, "count": count}
    base = _base_file(File(path), text, data)
    base_text, base_data = read_scene(base)
    if overrides:
        base_text, (base_data, _) = "", apply_overrides(base_data, overrides)
    place = read.get("place")
    tables = {**read, "place": [place]} if isinstance(place, dict) else read
    try:
        table = SweepTable.model_validate(tables, context={"dimension": dimension_of(base_data)})
    except ValidationError as error:
        problems = [_as_written(p, read) for p in problems_of(error, tables, SweepTable)]
        raise InputError(report(problems, str(path), text)) from None
    parse_scene(base_data, laws=laws, source=str(base), text=base_text, directory=base.parent)
    base_text = base_text or tomli_w.dumps(base_data)
    same = {name: getattr(table, name) for name in SweepTable.model_fields if name not in ("base", "place")}
    sweep = Sweep(File(path), text, data, base, base_text, base_data, placements=table.place, **same)
    problems = [*_misplaced(sweep), *_misheld(sweep)]
    if not problems:
        set_by, problems = _owners(sweep)
        problems = problems or _faulty_scenes(sweep, laws, set_by)
    problems = problems or _emptied(sweep, laws)
    if not problems and sweep.images:
        sweep, problems = _with_cameras(sweep, laws)
    if problems:
        raise InputError(report([_as_written(p, data) for p in problems], str(path), text))
    return sweep


def _with_cameras(sweep: Sweep, laws: Laws) -> tuple[Sweep, list[Problem]]:
    """Return a sweep with its file of cameras, if any, and the problems of [images]; InputError: the file is faulty."""
    scene, problems = draw(sweep, 0).scene(laws).scene, []
    if sweep.images.cameras is not None:
        file = sweep.path.parent / sweep.images.cameras
        text, tables = read_toml(file, "file of cameras")
        valid_cameras(tables, scene.dimension, scene.constants, scene.time.end, str(file), text)
        sweep = replace(sweep, cameras=tables)
    elif not scene.cameras and scene.dimension == 3:
        said = 'needs cameras: add [[cameras]] to the base scene, or name a file of cameras, cameras = "cameras.toml"'
        problems.append(Problem(("images",), said))
    try:
        image_frames(sweep, scene)
    except InputError as error:
        problems.append(Problem(("images", "frames"), str(error).rstrip(".")))
    return sweep, problems


def _base_file(path: File, text: str, data: dict[str, Any]) -> File:
    """Return the file of the base scene; relative to the sweep, or to the working directory."""
    name = data.get("base")
    if name is None:
        fault = 'missing key: the base scene, such as base = "scene.toml"'
    elif not isinstance(name, str):
        fault = f"must be text in quotes; found {written(name)}"
    else:
        beside = path.parent / name
        for file in (beside, File(name)):
            if not absence(file):
                return file
        fault = f"there is no such file: neither {beside} nor {File.cwd() / name} is one"
    raise InputError(report([Problem(("base",), fault)], str(path), text))


def _as_written(problem: Problem, data: dict[str, Any]) -> Problem:
    """Remove the index from the path of a placement or a rule if the file has one table instead of a list."""
    if problem.path[:1] == ("place",) and isinstance(data["place"], dict):
        return Problem(("place", *problem.path[2:]), problem.sentence)
    if problem.path[:1] == ("split",) and len(problem.path) > 2 and isinstance(data["split"][problem.path[1]], dict):
        return Problem((*problem.path[:2], *problem.path[3:]), problem.sentence)
    return problem


def _misheld(sweep: Sweep) -> Iterator[Problem]:
    """Find keys and values that no split can hold out."""
    ends: dict[str, list[Any]] = {PARTICLES: [0, LARGEST]}
    for key, one in sweep.drawn_once.items():
        values = one.extremes()
        if isinstance(one, Numbers) and one.vector:
            ends |= {f"{key}.{k}": list(both) for k, both in enumerate(zip(*values, strict=True))}
        elif len(values) > 1:
            ends[key] = values
    for split, rules in sweep.split.rules.items():
        for k, rule in enumerate(rules):
            for key, given in rule.items():
                if said := _not_held(key, given, ends):
                    yield Problem(("split", split, k, key), said)


def _not_held(key: str, given: object, ends: dict[str, list[Any]]) -> str:
    """Return why a condition of a rule is wrong, by the values at the ends of each key, or all; "" if it is right."""
    if key not in ends:
        parts = [known for known in ends if known.startswith(f"{key}.")]
        return f"no key that varies; {hint_at(key, parts[:1] or [*ends], f'those are {several(quoted([*ends]))}')}"
    drawn = ends[key]
    if not all(map(is_number, drawn)):
        if not isinstance(given, list) or not given or not all(one in drawn for one in given):
            values = several([written(one) for one in drawn])
            return f"must be a list of values that it draws, {values}; found {written(given)}"
        return ""
    if not is_range(given) or not all(map(is_number, given)) or given[0] > given[1]:
        return f"must be a range, [lower, upper]; found {written(given)}"
    low, high = min(drawn), max(drawn)
    return "" if given[0] <= high and given[1] >= low else f"is from {low:g} to {high:g}; {written(given)} is outside"


def _emptied(sweep: Sweep, laws: Laws) -> list[Problem]:
    """Find rules that hold out none of the trajectories, or all; of many trajectories only some are looked at."""
    rules = {("split", split, k): rule for split, its in sweep.split.rules.items() for k, rule in enumerate(its)}
    counting, unmet, rest = any(PARTICLES in rule for rule in rules.values()), {**rules}, False
    for number in range(min(sweep.count, MOST_DRAWN)):
        if rest and not unmet:
            break
        draws, particles = sweep.values_of(number), None
        if counting:
            with suppress(InputError):
                particles = sum(count_sources(draw(sweep, number).scene(laws).scene))
        met = [path for path, rule in rules.items() if meets(rule, draws, particles)]
        rest, unmet = rest or not met, {path: rule for path, rule in unmet.items() if path not in met}
    if sweep.count > MOST_DRAWN:
        return []
    said = f"holds out none of the {sweep.count} trajectories: raise count, or widen it"
    all_out = "the rules hold out all trajectories, and leave none for the fractions: narrow them"
    return [Problem(path, said) for path in unmet] + [Problem(("split",), all_out)] * (not rest)


def _misplaced(sweep: Sweep) -> Iterator[Problem]:
    """Yield problems of placements: unknown or repeated templates, names that are taken, regions outside the domain."""
    domain = sweep.base_data["domain"]
    for index, place in enumerate(sweep.placements):
        path = ("place", index)
        kind, name = KINDS[place.list], place.template
        there = {entry["name"]: entry for entry in sweep.base_data.get(place.list, [])}
        names = [other.template for other in sweep.placements if other.list == place.list]
        if name not in there:
            known = f"the {place.list} are {listed(quoted(list(there)), 'and')}" if there else "it has none"
            hint = hint_at(name, list(there), known)
            yield Problem((*path, kind), f'no {kind} of the base scene has the name "{name}"; {hint}')
        elif place.key in [other.key for other in sweep.placements[:index]]:
            yield Problem((*path, kind), f'"{name}" is placed already; a template is for one placement')
        else:
            taken = [n for n in there if n not in names and re.fullmatch(rf"{re.escape(name)}_\d+", n)]
            if taken:
                said = f'makes {place.list} of names such as "{taken[0]}", which the base scene has; rename one of them'
                yield Problem((*path, kind), said)
            yield from _misshapen(place, path, there[name]["shape"])
        size = domain["size"]
        for k, (axis, low, high) in enumerate(zip(AXES, place.region.min, place.region.max, strict=False)):
            start = domain.get("origin", [0.0] * len(size))[k]
            end = start + size[k]
            if low < start - ROUND_OFF * size[k] or high > end + ROUND_OFF * size[k]:
                found = f"{axis} = {low:g} to {high:g} of {start:g} to {end:g} m"
                yield Problem((*path, "region"), f"must lie in the domain; found {found}")


def _misshapen(place: Placement, path: Path, shape: dict[str, Any]) -> Iterator[Problem]:
    """Find extents that do not fit the shape of the template, and invalid counts."""
    form = next((name for name in shape if name not in COMBINED), "shape without a form")
    if form not in ("box", "ball") or set(shape) & set(COMBINED):
        found = f"{form} with others" if set(shape) & set(COMBINED) else form
        yield Problem((*path, KINDS[place.list]), f'must be a box or a ball; "{place.template}" is a {found}')
        return
    foreign, own = ("radius", "size") if form == "box" else ("size", "radius")
    if getattr(place, foreign) is not None:
        yield Problem((*path, foreign), f'"{place.template}" is a {form}, which has no {foreign}; give {own}')
    least = 1 if place.list == "bodies" else 0
    counts = [
        count
        for count in place.count.extremes()
        if not isinstance(count, int) or isinstance(count, bool) or not least <= count <= MOST_BODIES
    ]
    if counts:
        right = f"must be whole numbers from {least} to {MOST_BODIES}, such as {{ integers = [1, 3] }}"
        yield Problem((*path, "count"), f"{right}; found {written(counts[0])}")
    room = [high - low for low, high in zip(place.region.min, place.region.max, strict=True)]
    drawn = getattr(place, own)
    for extent in [template_extent(shape)] if drawn is None else drawn.extremes():
        sized = isinstance(extent, list) and len(extent) == len(room) and all(is_number(x) and x > 0 for x in extent)
        if form == "box" and not sized:
            right = f"must be {NUMBER_WORDS[len(room)]} numbers greater than 0"
            yield Problem((*path, own), f"{right}; found {written(extent)}")
        elif form == "ball" and not (is_number(extent) and extent > 0):
            yield Problem((*path, own), f"must be a number greater than 0; found {written(extent)}")
        else:
            size = extent if form == "box" else [2 * extent] * len(room)
            if any(x > r * (1 + ROUND_OFF) for x, r in zip(size, room, strict=True)):
                sides, found = (" x ".join(f"{x:.6g}" for x in lengths) for lengths in (room, size))
                yield Problem((*path, own), f"must fit into the region, {sides} m; found {found} m")


def _owners(sweep: Sweep) -> tuple[dict[Path, Path], list[Problem]]:
    """Return the place in the sweep file that sets each path of the base scene, and the faults of keys of [vary]."""
    names = {name: [entry["name"] for entry in sweep.base_data.get(name, [])] for name in KINDS}
    problems: list[Problem] = []
    set_by: dict[Path, Path] = {}
    for k, place in enumerate(sweep.placements):
        index = names[place.list].index(place.template)
        set_by[(place.list, index, "shape")] = ("place", k)
        if place.velocity is not None:
            set_by[(place.list, index, "velocity")] = ("place", k, "velocity")
    data = copy.deepcopy(sweep.base_data)
    for key, distribution in sweep.vary.items():
        at = ("vary", key)
        try:
            path = set_value(data, key_parts(key), distribution.extremes()[0])
        except InputError as fault:
            problems.append(Problem(at, str(fault)))
            continue
        if path[0] in (*KINDS, "forces") and (len(path) < 3 or path[2] == "name"):
            said = "vary what a body, a collider or a force holds, such as bodies.NAME.velocity, and not its name"
            problems.append(Problem(at, said))
            continue
        for other, owner in set_by.items():
            shared = min(len(path), len(other))
            if path[:shared] == other[:shared]:
                same = path_text(owner) if owner[0] == "vary" else f'the placement of "{names[path[0]][path[1]]}"'
                problems.append(Problem(at, f"sets what {same} sets as well; leave one of them out"))
                break
        else:
            set_by[path] = at
    return set_by, problems


def _faulty_scenes(sweep: Sweep, laws: Laws, set_by: dict[Path, Path]) -> list[Problem]:
    """Find problems of trajectory 0, also at the ends of each distribution, where placement may fail."""
    try:
        usual = _scene_problems(sweep, laws, set_by, {})
    except PlacementError as error:
        return [Problem(("place", error.placement), error.sentence)]
    found = [p if p.path else Problem((), f"trajectory 0: {p.sentence}") for p in usual]
    places = {key: ("vary", key) for key in sweep.vary}
    for k, place in enumerate(sweep.placements):
        places |= {key: ("place", k, key.rpartition(".")[2]) for key in place.distributions}
    for key, distribution in sweep.distributions.items():
        for value in distribution.extremes():
            try:
                variant = _scene_problems(sweep, laws, set_by, {key: value})
            except PlacementError:
                continue
            for problem in variant:
                if problem.path != places[key] and problem not in usual:
                    where = f"{path_text(problem.path)}: " if problem.path else ""
                    problem = Problem(places[key], f"with {written(value)}: {where}{problem.sentence}")
                if problem not in usual and problem not in found:
                    found.append(problem)
    return found


def _scene_problems(sweep: Sweep, laws: Laws, set_by: dict[Path, Path], given: dict[str, Any]) -> list[Problem]:
    """Return problems of trajectory 0, with `given` values, at their paths in the sweep file by `set_by`, if any."""
    drawn = draw(sweep, 0, given)
    found: list[Problem] = []
    scene, problems = scene_problems(drawn.data, laws, drawn.directory)
    for problem in problems or _unfit(scene):
        path = problem.path
        for name, origins in (("bodies", drawn.origins), ("colliders", drawn.collider_origins)):
            if path[:1] == (name,) and len(path) > 1:
                path = (name, origins[int(path[1])], *path[2:])
        owner = next((owner for base, owner in set_by.items() if path[: len(base)] == base), None)
        sentence = problem.sentence if owner else f"{path_text(problem.path)}: {problem.sentence}"
        new = Problem(owner or (), sentence)
        # Each body of a placement repeats the faults of its template.
        if new not in found:
            found.append(new)
    return found


def _unfit(scene: Scene) -> Iterator[Problem]:
    """Find what a run may have, and a trajectory of a dataset may not."""
    if scene.output.drop_retired:
        said = "a trajectory of a dataset has the same particles in all frames; leave it out"
        yield Problem(("output", "drop_retired"), said)
    elastic = [source.name for source in scene.sources if source.has_surface]
    if scene.solver.solids == "total" and scene.contact.default != "stick" and len(elastic) > 1:
        said = (
            f"elastic bodies would not separate: {several(quoted(elastic))} meet a quarter of a cell early, and slide "
            'on each other without friction; set contact.default = "stick" if this will do, or leave solids out'
        )
        yield Problem(("solver", "solids"), said)

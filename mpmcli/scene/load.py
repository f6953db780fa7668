"""Loads a complete scene from a TOML file, or raises one error that lists every fault.

A scene may extend another one: `base = "other.toml"`, with changes, additions and removals.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path as File
from types import MappingProxyType
from typing import Any

from pydantic import BaseModel, ValidationError

from mpmcli.errors import InputError
from mpmcli.scene.bounds import body_places, reaching, scene_bounds
from mpmcli.scene.checks import problems_in
from mpmcli.scene.entry import definitions
from mpmcli.scene.expand import expand_materials
from mpmcli.scene.material import Laws
from mpmcli.scene.problem import (
    Path,
    Problem,
    Renames,
    hint_at,
    known_keys,
    listed,
    nearest,
    nearest_entry,
    path_in,
    path_text,
    problems_of,
    quoted,
    several,
    value_at,
)
from mpmcli.scene.quantity import dimension_of
from mpmcli.scene.sampling import missing_state, points_per_cell, rest_volume
from mpmcli.scene.schema import Scene, scene_model
from mpmcli.scene.toml_file import apply_overrides, copied, key_lines, line_of, read_toml


def repaired(
    data: dict[str, Any], unknown: list[Path], model: type[BaseModel]
) -> tuple[set[Path], dict[str, Any], Renames]:
    """Return the paths of keys at pydantic's locations `unknown`, the data without them, and the renamed keys.

    A misspelled key is renamed to its nearest neighbour; any other is dropped. The result serves only to find further
    faults: a scene with an unknown key is always refused.
    """
    paths: set[Path] = set()
    renames: Renames = {}
    result = copied(data)
    for loc in unknown:
        path = path_in(data, loc)
        paths.add(path)
        table: Any = value_at(result, path[:-1])
        value = table.pop(path[-1])
        guess = nearest(str(path[-1]), known_keys(model, loc[:-1]))
        if guess and guess not in table:
            table[guess] = value
            renames[(*path[:-1], guess)] = path
    return paths, result, renames


def original_path(path: Path, renames: Renames) -> Path:
    """Return the path in the scene as written of a path in repaired data."""
    found = nearest_entry(path, renames)
    return path if found is None else (*found[0], *found[1])


def _as_written(problems: list[Problem], *renames: Renames) -> list[Problem]:
    """Return problems at their paths in the scene as written; the latest renames come first."""
    for one in renames:
        problems = [Problem(original_path(p.path, one), p.sentence) for p in problems]
    return problems


@dataclass(frozen=True)
class LoadedScene:
    """A complete scene and the choices made while loading it.

    Attributes:
        scene: the scene, with no "auto" left in its materials.
        notes: one sentence for every choice, each beginning with the names of its bodies.
        source: the file it came from, as it was given.
    """

    scene: Scene
    notes: tuple[str, ...]
    source: str

    @property
    def inputs(self) -> set[File]:
        """The scene's file and those of its shapes, as resolved paths."""
        names = [name for entry in (*self.scene.sources, *self.scene.colliders) for name in entry.shape.files]
        return {File(self.source).resolve(), *((File(self.source).parent / name).resolve() for name in names)}


def load_scene(
    path: str | PathLike[str], overrides: Sequence[str] = (), *, laws: Laws, original: str | PathLike[str] = ""
) -> LoadedScene:
    """Read a scene from a TOML file.

    Args:
        path: the file.
        overrides: values to replace, `KEY=VALUE` each; see `toml_file.apply_overrides`.
        laws: parameter models of the constitutive laws that a material may follow.
        original: the scene of which this one is the copy in a result: what it names is relative to that.

    Raises:
        InputError: one line per fault: `FILE:LINE: KEY PATH: fault and correction`.
    """
    text, data = read_scene(path)
    source = original or path
    return parse_scene(
        data, laws=laws, source=str(source), text=text, overrides=overrides, directory=File(source).parent
    )


def parse_scene(
    data: dict[str, Any],
    *,
    laws: Laws,
    source: str = "<scene>",
    text: str = "",
    overrides: Sequence[str] = (),
    directory: str | PathLike[str] = ".",
) -> LoadedScene:
    """Build a scene from parsed TOML.

    Args:
        data: what `tomllib` reads from a scene; lists and dictionaries.
        laws: parameter models of the constitutive laws that a material may follow.
        source: what to call the scene in errors.
        text: the TOML text of `data`, for line numbers in errors.
        overrides: as for `load_scene`.
        directory: that of the scene, to which the paths in it are relative.

    Raises:
        InputError: as for `load_scene`.
    """
    data, overridden = apply_overrides(data, overrides)
    scene, problems, knobs = _validate(data, laws, directory)
    if problems or scene is None:
        raise InputError(report(problems, source, text, overridden))
    # Set the "auto" parameters of every material from the speeds and pressures that can reach its body.
    scene = _with_accelerations(scene)
    whole = scene_bounds(scene)
    resolved: dict[str, tuple] = {}
    # The names of bodies by the sentence.
    notes: dict[str, list[str]] = {}
    for table in ("bodies", "emitters"):
        found = []
        for i, body in enumerate(getattr(scene, table)):
            others = reaching(body, scene)
            bounds = whole if len(others) == len(scene.sources) else scene_bounds(scene, others)
            material, sentences = body.material.resolve(bounds)
            # Then `model_fields_set` lacks what was chosen here, and nothing else.
            material.model_fields_set.update(type(material).model_fields)
            material.model_fields_set.difference_update(name for name, value in body.material if value == "auto")
            changes: dict[str, object] = {"material": material}
            if table == "bodies":
                changes["particles_per_cell"] = points_per_cell(body, scene.domain.spacing)
            found.append(body.model_copy(update=changes))
            for sentence in (*knobs.get((table, i), []), *sentences):
                notes.setdefault(sentence, []).append(body.name)
        resolved[table] = tuple(found)
    for one in (*scene.sources, *scene.colliders):
        for sentence in one.shape.notes:
            notes.setdefault(sentence, []).append(one.name)
    for body in scene.bodies:
        if missing := missing_state(body):
            said = f"{body.shape.points.file} has no {listed(missing, 'and')} (output.fields): as at rest"
            notes.setdefault(said, []).append(body.name)
    told = tuple(f"{several(names)}: {sentence}" for sentence, names in notes.items())
    return LoadedScene(scene.model_copy(update=resolved), told, source)


def scene_problems(
    data: dict[str, Any], laws: Laws, directory: str | PathLike[str] = "."
) -> tuple[Scene | None, list[Problem]]:
    """Return the scene of parsed TOML, None if it has no form, and everything for which `parse_scene` refuses it."""
    return _validate(data, laws, directory)[:2]


def _validate(
    data: dict[str, Any], laws: Laws, directory: str | PathLike[str]
) -> tuple[Scene | None, list[Problem], dict[tuple[str, int], list[str]]]:
    """Expand and validate until no key is unknown, so that a misspelled key does not hide other faults.

    Returns the scene, its problems at the user's own paths, and the effects of the knobs of each body.
    """
    model = scene_model(laws)
    problems: list[Problem] = []
    renames: Renames = {}
    while True:
        expansion = expand_materials(data, laws)
        unknown: list[Path] = []
        found: list[Problem] = []
        scene = None
        try:
            dimension = dimension_of(data)
            constants, _ = definitions(data.get("constants"), dimension)
            context = {"dimension": dimension, "constants": constants, "directory": directory}
            scene = model.model_validate(expansion.data, context=context)
        except ValidationError as error:
            unknown = [one["loc"] for one in error.errors() if one["type"] == "extra_forbidden"]
            # A faulty material has a problem already.
            found = [p for p in problems_of(error, expansion.data, model) if p.path[:3] not in expansion.faulty]
        if not unknown:
            found += expansion.problems + (problems_in(scene) if scene is not None else [])
            # The value of an unknown key says nothing about the key that was guessed.
            found = [p for p in found if not any(p.path[: len(guessed)] == guessed for guessed in renames)]
            return scene, problems + _as_written(found, expansion.renames, renames), expansion.notes
        unknown_paths, data, new = repaired(data, unknown, model)
        problems += _as_written([p for p in found if p.path in unknown_paths], expansion.renames, renames)
        renames = {**renames, **{p: original_path(old, renames) for p, old in new.items()}}


def _with_accelerations(scene: Scene) -> Scene:
    """Convert forces, and loads on a region, to accelerations that depend on the start of a particle."""
    forces = []
    for force in scene.forces:
        if force.force is None and force.region is None:
            forces.append(force)
            continue
        mass = next((one.moments.mass for one in scene.colliders if one.free and one.name == force.body), 0.0)
        for index, body in enumerate(scene.bodies):
            if force.force is not None and body.name == force.body:
                mass = body.material.density * rest_volume(body, scene.domain)
                if force.region is not None:
                    mass *= float(force.region.form.contains(body_places(body, index, scene.domain.spacing)).mean())
        forces.append(force.spread(mass))
    return scene.model_copy(update={"forces": tuple(forces)})


def report(
    problems: list[Problem], source: str, text: str, overridden: Mapping[Path, str] = MappingProxyType({})
) -> str:
    """Write problems one per line, in the order of the file.

    Args:
        problems: the problems.
        source: the file as it was given, or a name for it.
        text: its TOML text, for line numbers.
        overridden: texts of the overrides by the paths that they set.
    """
    lines, rows = key_lines(text), []
    for problem in sorted(problems, key=lambda p: line_of(p.path, lines) or 0):
        line, override = line_of(problem.path, lines), nearest_entry(problem.path, overridden)
        place = override[0] if override else source if line is None else f"{source}:{line}"
        rows.append(": ".join(filter(None, [place, path_text(problem.path), problem.sentence])))
    return "\n".join(rows)


def read_scene(path: str | PathLike[str], seen: Sequence[File] = ()) -> tuple[str, dict[str, Any]]:
    """Return the text of a scene and its parsed data, merged with its base; with a base the text is empty.

    Raises:
        InputError: a file cannot be read or is not TOML, a base contains itself, or a name to remove does not exist.
    """
    text, data = read_toml(path)
    name, remove = data.pop("base", None), data.pop("remove", [])
    if name is None and not remove:
        return text, data
    if name is None:
        raise InputError(f"{path}: base: missing key: the scene whose names `remove` leaves out")
    if not isinstance(name, str) or "\0" in name:
        raise InputError(f"{path}: base: must be the path of a scene in quotes; found {name!r}")
    if not isinstance(remove, list) or not all(isinstance(one, str) for one in remove):
        raise InputError(f"{path}: remove: must be a list of names in quotes; found {remove!r}")
    file, seen = File(path).parent / name, (*seen, File(path).resolve())
    if file.resolve() in seen:
        raise InputError(f"{path}: base: {name} has this scene as its base in turn; give another one")
    _, base = read_scene(file, seen)
    lists = [value for value in base.values() if isinstance(value, list)]
    named = {one.get("name") for entries in lists for one in entries if isinstance(one, dict)}
    for one in remove:
        if one not in named:
            known = sorted(word for word in named if isinstance(word, str))
            hint = hint_at(one, known, f"those of {name} are {', '.join(quoted(known)) or 'none'}")
            raise InputError(f'{path}: remove: nothing has the name "{one}"; {hint}')
    kept = {
        key: [one for one in value if not isinstance(one, dict) or one.get("name") not in remove]
        if isinstance(value, list)
        else value
        for key, value in base.items()
    }
    return "", merged(_moved(kept, File(name).parent), data)


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return a table with changes: tables are merged, as are list entries of the same name; other entries are appended.

    Any other value is replaced, as is a shape, and a material for which the changes give a preset or a law. `cells` and
    `spacing` replace each other.
    """
    result = dict(base)
    for key, value in changes.items():
        before = base.get(key)
        if key == "material" and isinstance(before, str):
            before = {"preset": before}
        other = key == "material" and isinstance(value, dict) and value.keys() & {"preset", "law"}
        if isinstance(value, dict) and isinstance(before, dict) and key != "shape" and not other:
            result[key] = merged(before, value)
        elif isinstance(value, list) and isinstance(before, list) and all(isinstance(one, dict) for one in value):
            entries = result[key] = list(before)
            places = {one.get("name"): k for k, one in enumerate(before) if isinstance(one, dict) and "name" in one}
            for one in value:
                if (k := places.get(one.get("name"))) is None:
                    entries.append(one)
                else:
                    entries[k] = merged(entries[k], one)
        else:
            if key in ("cells", "spacing"):
                result = {name: one for name, one in result.items() if name not in ("cells", "spacing")}
            result[key] = value
    return result


def _moved(tree: Any, directory: File) -> Any:
    """Return tables in which file paths relative to `directory` are prefixed with it."""
    if isinstance(tree, list):
        return [_moved(one, directory) for one in tree]
    if not isinstance(tree, dict):
        return tree
    return {
        key: str(directory / value) if key == "file" and isinstance(value, str) else _moved(value, directory)
        for key, value in tree.items()
    }

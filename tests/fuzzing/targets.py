"""What is fuzzed: how an input is made from a seed, and the commands that must not break on it."""

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random

import tomli_w

from fuzzing import seeds
from fuzzing.file_mutation import hdf5_mutant, npz_mutant, sqlite_mutant
from fuzzing.from_schema import revised, scene_of
from fuzzing.mutation import bytes_mutant, json_mutant, text_mutant, tree_mutant, value_mutant
from fuzzing.new_checksums import with_new_checksums
from fuzzing.seeds import Files

Words = Sequence[str]
TEXT = (".toml", ".csv", ".obj", ".pvd", ".json", ".vtp", ".vtu", ".vtk", ".ply", ".stl")

VTK = (".vtp", ".vtu", ".vtk")


@dataclass(frozen=True)
class Input:
    """Files, and the commands that read them; both relative to one directory."""

    files: Files
    commands: tuple[Words, ...]


@dataclass(frozen=True)
class Target:
    """A kind of input.

    Attributes:
        make: returns the input that follows from a generator of random numbers.
        title: of the table.
    """

    make: Callable[[Random], Input]
    title: str


def _check(rng: Random) -> tuple[Words, ...]:
    return (("info", "scene.toml"),) if rng.random() < 0.1 else (("check", "scene.toml", "--no-probe"),)


def _toml(data: dict, otherwise: bytes) -> bytes:
    try:
        return tomli_w.dumps(data).encode("utf-8", "surrogatepass")
    except (TypeError, ValueError, AttributeError, RecursionError):
        return otherwise


def _tree(text: bytes, rng: Random) -> bytes:
    found = tree_mutant(tomllib.loads(text.decode()), rng)
    return _toml(found, text_mutant(text, rng)) if isinstance(found, dict) else text_mutant(text, rng)


def _scene_values(rng: Random) -> Input:
    files = seeds.chosen(seeds.scenes(), rng)
    files["scene.toml"] = _tree(files["scene.toml"], rng)
    return Input(files, _check(rng))


def _scene_schema(rng: Random) -> Input:
    files = seeds.chosen(seeds.scenes(), rng)
    text = files["scene.toml"]
    whole = rng.random() < 0.2
    files["scene.toml"] = _toml(scene_of(rng) if whole else revised(tomllib.loads(text.decode()), rng), text)
    return Input(files, _check(rng))


def _scene_text(rng: Random) -> Input:
    files = seeds.chosen(seeds.scenes(), rng)
    files["scene.toml"] = text_mutant(files["scene.toml"], rng)
    return Input(files, _check(rng))


def _override(rng: Random) -> Input:
    files = seeds.chosen(seeds.scenes(), rng)
    keys = (
        "time.end",
        "bodies[0].velocity",
        "bodies.0.material.density",
        "domain.gravity",
        "solver.precision",
        "title",
    )
    said = f"{rng.choice(keys)}={value_mutant(rng)}".encode("utf-8", "replace")
    word = text_mutant(said, rng) if rng.random() < 0.5 else said
    word = word.replace(b"\0", b"0").decode("utf-8", "replace")
    return Input(files, (("info", "scene.toml", f"--set={word}"),))


def _sweep(rng: Random) -> Input:
    files = seeds.chosen(seeds.sweeps(), rng)
    name = "base.toml" if rng.random() < 0.15 else "sweep.toml"
    files[name] = (_tree if rng.random() < 0.6 else text_mutant)(files[name], rng)
    return Input(files, (("load-sweep", "sweep.toml"),))


def _body_file(made: tuple[Files, ...], rng: Random) -> Input:
    # A process of its own reads those that VTK reads, which takes a hundred times as long.
    slow = rng.random() < 0.02
    files = dict(rng.choice([one for one in made if any(n.endswith(VTK) for n in one) == slow]))
    name = next(name for name in files if name != "scene.toml")
    textual = name.endswith((".csv", ".obj")) or name.startswith("b.") or name == "a.vtk" or rng.random() < 0.3
    files[name] = (text_mutant if textual and rng.random() < 0.8 else bytes_mutant)(files[name], rng)
    return Input(files, _check(rng))


def _result(form: str, rng: Random) -> Input:
    files = seeds.chosen(seeds.results(form), rng)
    name = rng.choice(list(files))
    if form == "packed" and rng.random() < 0.6:
        name = "result/particles.vtkhdf"
    files[name] = _damaged(name, files[name], rng)
    if rng.random() < 0.5:
        # As if mpmcli had written it so: what the checksums would tell of reaches the readers.
        files = with_new_checksums(files, name)
    if rng.random() < 0.03:
        del files[name]
    commands = [("info", "result"), ("check", "result"), ("read", "result")]
    if rng.random() < 0.1:
        commands.append(("info", "result", "--json"))
    if rng.random() < 0.1:
        commands.append(("export", "result", "--to", rng.choice(("npz", "vtkhdf")), "-o", "out", "--quiet"))
    return Input(files, tuple(commands))


def _damaged(name: str, data: bytes, rng: Random) -> bytes:
    if name.endswith((".vtkhdf", ".h5")):
        return (hdf5_mutant if rng.random() < 0.6 else bytes_mutant)(data, rng)
    if name.endswith(".sqlite"):
        return (sqlite_mutant if rng.random() < 0.7 else bytes_mutant)(data, rng)
    if name.endswith(".json"):
        return (json_mutant if rng.random() < 0.7 else text_mutant)(data, rng)
    if name.endswith(TEXT):
        return (text_mutant if rng.random() < 0.8 else bytes_mutant)(data, rng)
    return bytes_mutant(data, rng)


def _checkpoint(rng: Random) -> Input:
    files = seeds.chosen(seeds.checkpoints(), rng)
    name = rng.choice(list(files))
    files[name] = (npz_mutant if rng.random() < 0.6 else bytes_mutant)(files[name], rng)
    return Input(files, (("checkpoints", "run"),))


def _dataset(rng: Random) -> Input:
    files = seeds.chosen(seeds.datasets(), rng)
    name = rng.choice(("data/manifest.sqlite", "data/shards/00000.h5", "data/shards/00001.h5"))
    files[name] = _damaged(name, files[name], rng)
    commands = [("dataset", "status", "data"), ("dataset", "verify", "data", "--quiet"), ("trajectories", "data")]
    if rng.random() < 0.2:
        form = rng.choice(("npz", "vtkhdf", "gns", "lagrangebench"))
        commands.append(("export", "data", "--to", form, "-o", "out", "--quiet"))
    return Input(files, tuple(commands))


TARGETS = {
    "scene-schema": Target(_scene_schema, "scenes that follow the schema, whole ones and parts of examples"),
    "scene-values": Target(_scene_values, "scenes, values of examples replaced, removed, moved"),
    "scene-text": Target(_scene_text, "scenes, text of examples damaged"),
    "override": Target(_override, "--set"),
    "sweep": Target(_sweep, "sweeps and their base scenes"),
    "mesh": Target(lambda rng: _body_file(seeds.meshes(), rng), "meshes: STL, OBJ, PLY, VTP, VTU, VTK"),
    "points": Target(lambda rng: _body_file(seeds.points(), rng), "points: CSV, NPY, PLY, VTP, VTU, VTK"),
    "packed": Target(lambda rng: _result("packed", rng), "packed results and their run.json"),
    "segments": Target(lambda rng: _result("segments", rng), "segments"),
    "series": Target(lambda rng: _result("series", rng), "VTK series: PVD, VTU, CSV, JSON"),
    "checkpoint": Target(_checkpoint, "checkpoints"),
    "dataset": Target(_dataset, "datasets: shards and manifest"),
}

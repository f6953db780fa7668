"""What is fuzzed: how an input is made from a seed, and the commands that must not break on it."""

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random

import tomli_w

from fuzzing import seeds
from fuzzing.from_schema import revised, scene_of
from fuzzing.mutation import text_mutant, tree_mutant, value_mutant
from fuzzing.seeds import Files

Words = Sequence[str]


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
    return (("info", "scene.toml"),) if rng.random() < 0.1 else (("check", "scene.toml"),)


def _toml(data: dict, otherwise: bytes) -> bytes:
    try:
        return tomli_w.dumps(data).encode("utf-8", "surrogatepass")
    except (TypeError, ValueError, AttributeError, RecursionError):
        return otherwise


def _tree(text: bytes, rng: Random) -> bytes:
    found = tree_mutant(tomllib.loads(text.decode()), rng)
    return _toml(found, text_mutant(text, rng)) if isinstance(found, dict) else text_mutant(text, rng)


def _by_schema(text: bytes, rng: Random) -> bytes:
    whole = rng.random() < 0.2
    return _toml(scene_of(rng) if whole else revised(tomllib.loads(text.decode()), rng), text)


def _scene(change: Callable[[bytes, Random], bytes]) -> Callable[[Random], Input]:
    def made(rng: Random) -> Input:
        files = seeds.chosen(seeds.scenes(), rng)
        files["scene.toml"] = change(files["scene.toml"], rng)
        return Input(files, _check(rng))

    return made


def _override(rng: Random) -> Input:
    files = seeds.chosen(seeds.scenes(), rng)
    keys = (
        "time.end", "bodies[0].velocity", "bodies.0.material.density", "domain.gravity", "solver.precision", "title",
    )  # fmt: skip
    said = f"{rng.choice(keys)}={value_mutant(rng)}".encode("utf-8", "replace")
    word = text_mutant(said, rng) if rng.random() < 0.5 else said
    word = word.replace(b"\0", b"0").decode("utf-8", "replace")
    return Input(files, (("info", "scene.toml", f"--set={word}"),))


def _sweep(rng: Random) -> Input:
    files = seeds.chosen(seeds.sweeps(), rng)
    name = "base.toml" if rng.random() < 0.15 else "sweep.toml"
    files[name] = (_tree if rng.random() < 0.6 else text_mutant)(files[name], rng)
    return Input(files, (("load-sweep", "sweep.toml"),))


TARGETS = {
    "scene-schema": Target(_scene(_by_schema), "scenes that follow the schema, whole ones and parts of examples"),
    "scene-values": Target(_scene(_tree), "scenes, values of examples replaced, removed, moved"),
    "scene-text": Target(_scene(text_mutant), "scenes, text of examples damaged"),
    "override": Target(_override, "--set"),
    "sweep": Target(_sweep, "sweeps and their base scenes"),
}

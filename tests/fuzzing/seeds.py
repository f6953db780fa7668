"""Valid scenes and sweeps: the examples, files by name."""

from functools import cache
from random import Random

from command import CONFIGS

Files = dict[str, bytes]


@cache
def scenes() -> tuple[Files, ...]:
    """Return the examples of the repository, with the files that they name."""
    meshes = {f"meshes/{path.name}": path.read_bytes() for path in (CONFIGS / "meshes").iterdir()}
    found = []
    for path in sorted(CONFIGS.glob("*.toml")):
        text = path.read_bytes()
        files = {"scene.toml": text} | {name: data for name, data in meshes.items() if name.encode() in text}
        # Those with meshes take a hundred times as long.
        found += [files] * (1 if len(files) > 1 else 10)
    return tuple(found)


@cache
def sweeps() -> tuple[Files, ...]:
    """Return the example sweeps with their base scenes."""
    base = {f"base/{path.name}": path.read_bytes() for path in (CONFIGS / "sweeps" / "base").iterdir()}
    base |= {f"../{path.name}": path.read_bytes() for path in CONFIGS.glob("*.toml")}
    found = []
    for path in sorted((CONFIGS / "sweeps").glob("*.toml")):
        text = path.read_bytes()
        name = text.split(b'base = "')[1].split(b'"')[0]
        found.append({"sweep.toml": text.replace(name, b"base.toml"), "base.toml": base[name.decode()]})
    return tuple(found)


def chosen(seeds: tuple[Files, ...], rng: Random) -> Files:
    """Return a copy of one of the seeds."""
    return dict(rng.choice(seeds))

"""Inputs that once had a forbidden outcome, one of each kind: a directory each.

It holds the files that differ from those of a seed, compressed, and input.json with the seed and the commands.
"""

import gzip
import json
from pathlib import Path

from fuzzing import seeds
from fuzzing.targets import Input

CORPUS = Path(__file__).resolve().parent.parent / "corpus"
DESCRIPTION = "input.json"
SEEDS = {
    "scenes": seeds.scenes,
    "sweeps": seeds.sweeps,
    "meshes": seeds.meshes,
    "points": seeds.points,
    "packed": lambda: seeds.results("packed"),
    "segments": lambda: seeds.results("segments"),
    "series": lambda: seeds.results("series"),
    "datasets": seeds.datasets,
}


def corpus() -> dict[str, Input]:
    """Return the inputs by name."""
    found = {}
    for place in sorted(path.parent for path in CORPUS.glob(f"*/{DESCRIPTION}")):
        facts = json.loads((place / DESCRIPTION).read_text(encoding="utf-8"))
        files = {} if facts["seed"] is None else dict(SEEDS[facts["seed"][0]]()[facts["seed"][1]])
        for path in sorted(place.rglob("*.gz")):
            files[str(path.relative_to(place))[:-3]] = gzip.decompress(path.read_bytes())
        found[place.name] = Input(files, tuple(map(tuple, facts["commands"])))
    return found


def keep(name: str, kind: str, one: Input) -> None:
    """Add an input, made from a seed of some kind."""
    place = CORPUS / name
    place.mkdir(parents=True)
    made = SEEDS[kind]()
    same = [sum(seed.get(n) == data for n, data in one.files.items()) for seed in made]
    best = same.index(max(same))
    for path, data in one.files.items():
        if made[best].get(path) != data:
            target = place / f"{path}.gz"
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(gzip.compress(data, mtime=0))
    seed = [kind, best] if max(same) else None
    facts = {"seed": seed, "commands": one.commands}
    (place / DESCRIPTION).write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")

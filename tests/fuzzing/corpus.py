"""Inputs that once had a forbidden outcome, the smallest of each kind: a directory each, with commands.json."""

import json
from pathlib import Path

from fuzzing.targets import Input

CORPUS = Path(__file__).resolve().parent.parent / "corpus"
COMMANDS = "commands.json"


def corpus() -> dict[str, Input]:
    """Return the inputs by name."""
    found = {}
    for place in sorted(path.parent for path in CORPUS.glob(f"*/{COMMANDS}")):
        files = {str(path.relative_to(place)): path.read_bytes() for path in sorted(place.rglob("*")) if path.is_file()}
        commands = json.loads(files.pop(COMMANDS))
        found[place.name] = Input(files, tuple(map(tuple, commands)))
    return found

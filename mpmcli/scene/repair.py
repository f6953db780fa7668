"""Reading on past unknown keys: a misspelled key is taken for its nearest neighbour, any other is dropped.

Only to find what else is wrong; a scene with an unknown key is always refused.
"""

from typing import Any

from pydantic import BaseModel

from mpmcli.scene.problem import Path, value_at
from mpmcli.scene.sentences import known_keys, nearest, path_in
from mpmcli.scene.tables import copied

# Path in the repaired data -> path in the scene as it was written.
Renames = dict[Path, Path]


def repaired(
    data: dict[str, Any], unknown: list[Path], model: type[BaseModel]
) -> tuple[set[Path], dict[str, Any], Renames]:
    """Return the paths of the unknown keys, the data without them, and which keys got other names.

    Args:
        data: parsed TOML.
        unknown: pydantic's locations of the unknown keys.
        model: the scene's model.
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
    """Return a path in repaired data as it is in the scene as it was written."""
    for end in range(len(path), 0, -1):
        if path[:end] in renames:
            return renames[path[:end]] + path[end:]
    return path

"""One thing that is wrong with a scene, and where."""

from dataclasses import dataclass

Path = tuple[str | int, ...]


@dataclass(frozen=True)
class Problem:
    """A fault of one value of a scene.

    Attributes:
        path: keys and indices that lead to the value; the last one may be missing in the scene.
        sentence: what is wrong, and what would be right.
    """

    path: Path
    sentence: str


def path_text(path: Path) -> str:
    """Write a path as users do, for example `bodies[0].material.density`."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def value_at(data: object, path: Path) -> object:
    """Return the value that a path leads to in parsed TOML.

    Raises:
        LookupError: there is no such value.
    """
    for part in path:
        if (isinstance(data, dict) and part in data) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        ):
            data = data[part]
        else:
            raise LookupError(path_text(path))
    return data

"""The example scenes, in an installation as in a checkout."""

import re
import tomllib
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def examples() -> dict[str, Path]:
    """Return the file of each example scene by its name, in alphabetical order."""
    installed = PACKAGE / "examples"
    directory = installed if installed.is_dir() else PACKAGE.parent / "configs"
    return {path.stem: path for path in sorted(directory.glob("*.toml"))}


def example_path(path: Path) -> Path:
    """Return the file of an example if a path is its name and no file has that name, else the path."""
    return path if path.suffix or path.parent != Path() or path.exists() else examples().get(path.name, path)


def caption(path: Path) -> str:
    """Return the caption of an example from its header."""
    text = path.read_text(encoding="utf-8")
    said = re.search(r"^# What you will see: (.*?)^#$", text, re.MULTILINE | re.DOTALL)
    lines = said[1].splitlines() if said else []
    return " ".join(line.removeprefix("#").strip() for line in lines)


def title(path: Path) -> str:
    """Return the title of a scene."""
    return tomllib.loads(path.read_text(encoding="utf-8")).get("title", "")


def files_of(path: Path) -> list[Path]:
    """Return the files that an example needs besides itself, relative to it."""
    return [Path(name) for name in re.findall(r'file = "([^"]+)"', path.read_text(encoding="utf-8"))]

"""The files that the scenes of a sweep read, beside their TOML files: geometry and plugins; and their digests."""

import socket
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mpmcli.dataset.sweep import Sweep
from mpmcli.errors import InputError
from mpmcli.output.checksums import path_digest
from mpmcli.scene.toml_file import key_parts

FILE = "file"


def source_files(sweep: Sweep, plugins: Sequence[Path]) -> dict[str, Path]:
    """Return the absolute paths of the files that are there, by their names in the scenes, and `--plugin NAME`."""
    names = set(_named(sweep.base_data))
    for key, distribution in sweep.distributions.items():
        for value in getattr(distribution, "values", ()):
            names.update(_named({str(key_parts(key)[-1]): value}))
    found = {name: (sweep.base.parent / name).absolute() for name in sorted(names)}
    same = Counter(path.name for path in plugins)
    for path in plugins:
        name = path.name if same[path.name] == 1 else f"{path.parent.name}/{path.name}"
        found[f"--plugin {name}"] = path.absolute()
    return {name: path for name, path in found.items() if path.is_file()}


def source_digests(sweep: Sweep, plugins: Sequence[Path]) -> dict[str, str]:
    """Return the SHA-256, hexadecimal, of each of `source_files`."""
    return {name: path_digest(path) for name, path in source_files(sweep, plugins).items()}


def require_same_sources(files: Sequence[tuple[Path, str]]) -> None:
    """Refuse with an InputError to compute where one of these paths has no file with this digest."""
    for path, digest in files:
        if not path.is_file() or path_digest(path) != digest:
            what = "another" if path.is_file() else "no"
            raise InputError(
                f"{path}: a worker on {socket.gethostname()} finds {what} file there than the sweep has; let all "
                "workers see the same files."
            )


def _named(value: Any) -> Iterator[str]:
    """Yield the names of files in tables."""
    if isinstance(value, dict):
        for key, entry in value.items():
            if key == FILE and isinstance(entry, str):
                yield entry
            else:
                yield from _named(entry)
    elif isinstance(value, list | tuple):
        for entry in value:
            yield from _named(entry)

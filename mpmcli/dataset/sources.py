"""The files that the scenes of a sweep read, beside their TOML files: geometry and plugins; digests and copies."""

import re
import shutil
import socket
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mpmcli.dataset.shard import BASE, PENDING, QUARANTINE, SHARDS, SWEEP
from mpmcli.dataset.sweep import Sweep
from mpmcli.errors import InputError
from mpmcli.output.checksums import path_digest
from mpmcli.scene.toml_file import key_parts

FILE, PLUGIN = "file", "--plugin"
# Names in a dataset that no copy takes.
OWN = {SWEEP, BASE, SHARDS, PENDING, QUARANTINE}


def source_files(sweep: Sweep, plugins: Sequence[Path]) -> dict[str, Path]:
    """Return the absolute paths of the files that are there, by their names in the scenes, and `--plugin NAME`."""
    names = set(_named(sweep.base_data))
    for key, distribution in sweep.distributions.items():
        for value in getattr(distribution, "values", None) or (getattr(distribution, "constant", None),):
            names.update(_named({str(key_parts(key)[-1]): value}))
    found = {name: (sweep.base.parent / name).absolute() for name in sorted(names)}
    same = Counter(path.name for path in plugins)
    for path in plugins:
        name = path.name if same[path.name] == 1 else f"{path.parent.name}/{path.name}"
        found[f"{PLUGIN} {name}"] = path.absolute()
    return {name: path for name, path in found.items() if path.is_file()}


def source_digests(sweep: Sweep, plugins: Sequence[Path]) -> dict[str, str]:
    """Return the SHA-256, hexadecimal, of each of `source_files`."""
    return {name: path_digest(path) for name, path in source_files(sweep, plugins).items()}


def copied_files(names: Iterable[str]) -> list[str]:
    """Return those names of `source_files` of which a dataset has copies, at the same places beside its base.

    Files whose names are absolute, or lead out of the directory of the base, stay where they are, as plugins do.
    """
    found = [name for name in names if not name.startswith(PLUGIN)]
    return [name for name in found if not Path(name).is_absolute() and not {"..", *OWN} & {*Path(name).parts}]


def copy_sources(names: Iterable[str], origin: Path, directory: Path) -> None:
    """Copy files into a dataset from where the base scene is, or from another dataset; those that are there."""
    for name in copied_files(names):
        if (origin / name).is_file():
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(origin / name, directory / name)


def remove_copies(names: Iterable[str], directory: Path) -> None:
    """Remove the copies of files from a dataset, and directories that they leave empty."""
    for name in copied_files(names):
        (directory / name).unlink(missing_ok=True)
        for parent in list(Path(name).parents)[:-1]:
            with suppress(OSError):
                (directory / parent).rmdir()


def standing_alone(sweep: Sweep) -> str:
    """Return the text of a sweep with BASE as its base, and its count; one that is written oddly as it is."""
    head, tables = re.match(r"(?ms)(.*?)(^[ \t]*\[.*|\Z)", sweep.text).groups()
    for key, value in (("base", f'"{BASE}"'), ("count", str(sweep.count))):
        line = f"{key} = {value}"
        head, found = re.subn(rf"(?m)^[ \t]*{key}[ \t]*=.*$", line, head)
        head = head if found else f"{line}\n{head}"
    try:
        same = tomllib.loads(head + tables) == {**sweep.data, "base": BASE, "count": sweep.count}
    except tomllib.TOMLDecodeError:
        same = False
    return head + tables if same else sweep.text


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

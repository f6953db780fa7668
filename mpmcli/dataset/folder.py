"""The directory of a dataset: its manifest, a SQLite file with a row per trajectory, its shards, and copied files.

Copied files are those that the scenes of a sweep read besides their TOML files, such as geometry.
"""

import json
import re
import shutil
import sqlite3
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import astuple, dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import h5py
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from mpmcli import __version__
from mpmcli.check.finding import Verdict
from mpmcli.dataset.shard import (
    BASE,
    CERTIFICATES,
    IMAGES,
    PENDING,
    QUARANTINE,
    SHARDS,
    SWEEP,
    checksum,
    group_name,
    join_trajectories,
)
from mpmcli.dataset.sweep import Sweep
from mpmcli.errors import InputError, RunError
from mpmcli.output.checksums import first_line, path_digest, require_format
from mpmcli.output.directory import check_directory
from mpmcli.output.durable import TEMPORARY_SUFFIX, require_free_space, sealed, writing
from mpmcli.output.lock import LOCK
from mpmcli.scene.toml_file import key_parts

MANIFEST = "manifest.sqlite"
FORMAT = 1
# Approximate bytes of a shard: large enough for file systems and network copies, small enough to recompute.
SHARD_BYTES = 256e6
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)


@dataclass(frozen=True)
class Row:
    """The record of a trajectory in the manifest.

    Attributes:
        draws: drawn values, JSON; scene: SHA-256 of the complete scene. verdict: one of VERDICTS; reason: why it is not
            "stable", "" if it is. accepted: 1 if the dataset includes it. retries: number of runs with a halved step;
            steps, frames, particles: counts of the last run.
        seconds: wall time of all runs.
        arch, precision, version, taichi: backend, and versions of mpmcli and Taichi.
        file: file of the frames, relative to the dataset, "" if none were kept; checksum: `shard.checksum`.
    """

    number: int
    split: str
    draws: str
    scene: str
    verdict: str
    reason: str
    accepted: int
    retries: int
    steps: int
    frames: int
    particles: int
    seconds: float
    arch: str
    precision: str
    version: str
    taichi: str
    file: str
    checksum: str

    @classmethod
    def failed(cls, number: int, split: str, reason: str = "") -> "Row":
        """Return the row of a failed trajectory without further facts."""
        values: dict[str, Any] = {f.name: f.type() for f in fields(cls)}
        values |= {"number": number, "split": split, "draws": "{}", "verdict": "failed", "reason": reason}
        return cls(**{**values, **program()})


def program() -> dict[str, str]:
    """Return the versions of mpmcli and Taichi, on which the bytes of a trajectory depend."""
    return {"version": __version__, "taichi": version("taichi")}


class _SweepFacts(BaseModel):
    """The validated facts of a sweep; other facts are kept as they are."""

    model_config = ConfigDict(extra="allow")

    key: str
    count: int = Field(gt=0)
    per_shard: int = Field(gt=0)
    part: list[int] = Field(min_length=2, max_length=2)


# Columns on which the bytes of a trajectory depend, in words.
PROGRAM = {"version": "mpmcli", "taichi": "Taichi", "arch": "--arch"}
_ROWS = TypeAdapter(list[Row])
_COLUMNS = ", ".join(f.name for f in fields(Row))
_TYPES = {int: "INTEGER", float: "REAL", str: "TEXT"}


class Manifest:
    """Rows of a dataset and facts about its sweep; each call opens and closes the file, and only one process writes."""

    def __init__(self, directory: Path) -> None:
        self.path = directory / MANIFEST

    def create(self, facts: Mapping[str, Any]) -> None:
        """Make the file, with facts as JSON."""
        columns = ", ".join(f"{f.name} {_TYPES[f.type]} NOT NULL" for f in fields(Row))
        # A file with its name is never incomplete.
        with sealed(self.path) as temporary, self._open("create", temporary) as connection:
            connection.execute("CREATE TABLE sweep (name TEXT PRIMARY KEY, value TEXT NOT NULL)")
            connection.execute(f"CREATE TABLE trajectories ({columns}, PRIMARY KEY (number))")
            told = {"format": FORMAT, **facts}
            values = [(name, json.dumps(value, sort_keys=True)) for name, value in told.items()]
            connection.executemany("INSERT INTO sweep VALUES (?, ?)", values)

    def facts(self) -> dict[str, Any]:
        """Return the facts about the sweep."""
        with self._reading() as connection:
            facts = {name: json.loads(value) for name, value in connection.execute("SELECT name, value FROM sweep")}
            require_format(self.path, facts.get("format"), FORMAT)
            return _SweepFacts.model_validate(facts).model_dump()

    def tell(self, name: str, value: Any) -> None:
        """Add a fact about the sweep, or replace it."""
        with self._open("write", self.path) as connection:
            connection.execute("INSERT OR REPLACE INTO sweep VALUES (?, ?)", (name, json.dumps(value, sort_keys=True)))

    def rows(self) -> list[Row]:
        """Return all rows, by number."""
        with self._reading() as connection:
            connection.row_factory = sqlite3.Row
            rows = connection.execute(f"SELECT {_COLUMNS} FROM trajectories ORDER BY number")
            return _ROWS.validate_python([dict(row) for row in rows])

    def put(self, rows: Iterable[Row]) -> None:
        """Add rows, or replace those with the same numbers, atomically and durably."""
        insert = f"INSERT OR REPLACE INTO trajectories ({_COLUMNS}) VALUES ({', '.join('?' * len(fields(Row)))})"
        with self._open("write", self.path) as connection:
            connection.executemany(insert, map(astuple, rows))

    @contextmanager
    def _open(self, verb: str, path: Path) -> Iterator[sqlite3.Connection]:
        try:
            with closing(sqlite3.connect(path)) as connection:
                connection.execute("PRAGMA synchronous = FULL")
                with connection:
                    yield connection
        except sqlite3.Error as error:
            raise RunError(f"mpmcli could not {verb} {path} ({error}); rows written before are kept.") from error

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        if not self.path.is_file():
            raise InputError(f"{self.path.parent} is not a dataset: it has no {MANIFEST}.")
        try:
            # Not mode=ro, which cannot roll back the changes of a killed writer.
            with closing(sqlite3.connect(f"{self.path.absolute().as_uri()}?mode=rw", uri=True)) as connection:
                yield connection
        except (sqlite3.Error, ValueError) as error:
            what = first_line(error)
            raise InputError(f"{self.path} cannot be read ({what}); copy it again, or run the sweep again.") from error


def require_empty(directory: Path, *, locked: bool = False) -> None:
    """Refuse a directory that is not empty, is being written or cannot be written; `locked`: by this process."""
    if directory.is_dir() and any(path.name != LOCK for path in directory.iterdir()):
        raise InputError(f"{directory} exists and is not empty: give another directory with -o.")
    check_directory(directory, overwrite=False, locked=locked)


def require_same_program(place: Path, facts: Mapping[str, Any], rows: Iterable[Row], now: Mapping[str, str]) -> None:
    """Refuse a dataset of another version of mpmcli or Taichi or backend than `now`, by column; "auto" is any."""
    for before in (facts, *(vars(row) for row in rows if row.verdict != "failed")):
        for name, value in now.items():
            if value not in ("auto", before.get(name, value)):
                raise InputError(
                    f"{place} holds trajectories computed with {PROGRAM[name]} {before[name]}; those of {value} would "
                    "differ: compute all of them with one."
                )


def is_beginning(directory: Path) -> bool:
    """Return whether a directory holds what a process leaves that is killed before its dataset has a manifest."""
    names = [path.name for path in directory.iterdir()] if directory.is_dir() else [MANIFEST]
    done = {name.removesuffix("-journal").removesuffix(TEMPORARY_SUFFIX) for name in names}
    return MANIFEST not in names and done <= {SWEEP, BASE, MANIFEST, LOCK}


class Folder:
    """Places of the trajectories in a dataset.

    Each shard has `per_shard` of `count` trajectories; the last one may have fewer. With `part` (i, n) this directory
    has every n-th shard, from the i-th on, counted from 1.
    """

    def __init__(self, path: Path, count: int, per_shard: int, part: tuple[int, int]) -> None:
        self.path, self.count, self.per_shard, self.part = path, count, per_shard, part

    @property
    def shards(self) -> range:
        """Numbers of the shards of this part."""
        first, parts = self.part
        return range(first - 1, -(-self.count // self.per_shard), parts)

    @property
    def expected(self) -> int:
        """Number of trajectories of this part."""
        return sum(len(self.numbers(shard)) for shard in self.shards)

    def all_numbers(self) -> Iterator[int]:
        """Yield the numbers of the trajectories of this part."""
        return (number for shard in self.shards for number in self.numbers(shard))

    def numbers(self, shard: int) -> range:
        """Return the numbers of the trajectories of a shard."""
        return range(shard * self.per_shard, min((shard + 1) * self.per_shard, self.count))

    def shard_file(self, shard: int) -> str:
        """Return the path of a shard in the dataset."""
        return f"{SHARDS}/{shard:05d}.h5"

    def seal(self, shard: int, rows: Mapping[int, Row]) -> list[Row]:
        """Join accepted trajectories to a shard durably, return changed rows; RunError: the single files are kept."""
        accepted = [rows[n] for n in self.numbers(shard) if rows[n].accepted]
        target = self.path / self.shard_file(shard)
        if not accepted:
            return []
        files = {row.number: self.path / row.file for row in accepted}
        # Trajectories sealed earlier are in the shard that is replaced.
        size = sum(file.stat().st_size for file in set(files.values()))
        kept = f"its trajectories are kept in {self.path / PENDING}"
        target.parent.mkdir(exist_ok=True)
        require_free_space(target.parent, size, f"shard {shard}", kept)
        with writing(target, kept, faults=(RuntimeError, KeyError)), sealed(target, size) as temporary:
            join_trajectories(files, temporary)
            with h5py.File(temporary, "r") as joined:
                damaged = [r.number for r in accepted if checksum(joined[group_name(r.number)]) != r.checksum]
            if damaged:
                raise RunError(f"{target} does not hold trajectory {damaged[0]} as it was computed; {kept}.")
        return [replace(row, file=self.shard_file(shard)) for row in accepted]


FILE, PLUGIN = "file", "--plugin"
# Names in a dataset that copied files cannot have.
OWN = {SWEEP, BASE, SHARDS, PENDING, QUARANTINE, CERTIFICATES, IMAGES}


def source_files(sweep: Sweep, plugins: Sequence[Path]) -> dict[str, Path]:
    """Return the absolute paths of existing files, by their names in scenes and sweep, and `--plugin NAME`."""
    names = set(_named(sweep.base_data))
    for key, distribution in sweep.distributions.items():
        for value in getattr(distribution, "values", ()):
            names.update(_named({str(key_parts(key)[-1]): value}))
    found = {name: (sweep.base.parent / name).absolute() for name in sorted(names)}
    same = Counter(path.name for path in plugins)
    for path in plugins:
        name = path.name if same[path.name] == 1 else f"{path.parent.name}/{path.name}"
        found[f"{PLUGIN} {name}"] = path.absolute()
    if sweep.cameras:
        found[sweep.images.cameras] = (sweep.path.parent / sweep.images.cameras).absolute()
    return {name: path for name, path in found.items() if path.is_file()}


def source_digests(sweep: Sweep, plugins: Sequence[Path]) -> dict[str, str]:
    """Return the SHA-256, hexadecimal, of each of `source_files`."""
    return {name: path_digest(path) for name, path in source_files(sweep, plugins).items()}


def copied_files(names: Iterable[str]) -> list[str]:
    """Return the names of `source_files` that a dataset copies, to the same paths relative to its base scene.

    Plugins are not copied, nor files whose name is absolute or has a part that is ".." or in OWN.
    """
    found = [name for name in names if not name.startswith(PLUGIN)]
    return [name for name in found if not Path(name).is_absolute() and not {"..", *OWN} & {*Path(name).parts}]


def copy_sources(files: Mapping[str, Path], directory: Path) -> None:
    """Copy existing files by name to a dataset."""
    for name in copied_files(files):
        if files[name].is_file():
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            with suppress(shutil.SameFileError):
                shutil.copyfile(files[name], directory / name)


def standing_alone(sweep: Sweep) -> str:
    """Return the text of a sweep with BASE as its base, and its count; text of unusual layout is not changed."""
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


def _named(value: Any) -> Iterator[str]:
    """Yield the names of files in nested tables."""
    if isinstance(value, dict):
        for key, entry in value.items():
            if key == FILE and isinstance(entry, str):
                yield entry
            else:
                yield from _named(entry)
    elif isinstance(value, list | tuple):
        for entry in value:
            yield from _named(entry)

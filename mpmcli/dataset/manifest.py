"""The manifest of a dataset: a SQLite file with a row for each trajectory that has been tried."""

import json
import re
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import astuple, dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

from mpmcli import __version__
from mpmcli.check.finding import Verdict
from mpmcli.errors import InputError, RunError
from mpmcli.output.durable import sealed
from mpmcli.plain_text import one_line

MANIFEST = "manifest.sqlite"
FORMAT = 1
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)


@dataclass(frozen=True)
class Row:
    """What is known of a trajectory.

    Attributes:
        number: of the trajectory; split: "train", "valid" or "test".
        draws: what was drawn, JSON; scene: SHA-256 of its complete scene.
        verdict: one of VERDICTS; reason: why it is not "stable", "" where it is.
        accepted: 1 where the dataset includes it.
        retries: runs with half the step of the one before; steps, frames, particles: counts of the last run.
        seconds: wall time of all runs.
        arch, precision, version, taichi: backend, and versions of mpmcli and Taichi.
        file: where the frames are, relative to the dataset, "" where none were kept; checksum: of the trajectory, see
            `shard.checksum`.
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
        """Return the row of a trajectory of which nothing is known but that it failed."""
        values: dict[str, Any] = {f.name: f.type() for f in fields(cls)}
        values |= {"number": number, "split": split, "draws": "{}", "verdict": "failed", "reason": reason}
        return cls(**{**values, "version": __version__, "taichi": version("taichi")})


COLUMNS = tuple(f.name for f in fields(Row))
_TYPES = {int: "INTEGER", float: "REAL", str: "TEXT"}


class Manifest:
    """The rows of a dataset, and facts about its sweep. One process writes; any number may read.

    Each call opens the file and closes it again.

    Attributes:
        path: the file.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / MANIFEST

    def create(self, facts: Mapping[str, Any]) -> None:
        """Make the file, with facts that JSON can hold.

        Raises:
            RunError: the disk is full or refuses.
        """
        columns = ", ".join(f"{f.name} {_TYPES[f.type]} NOT NULL" for f in fields(Row))
        # Under its name there is never half a manifest.
        with sealed(self.path) as temporary, self._open("create", temporary) as connection:
            connection.execute("CREATE TABLE sweep (name TEXT PRIMARY KEY, value TEXT NOT NULL)")
            connection.execute(f"CREATE TABLE trajectories ({columns}, PRIMARY KEY (number))")
            told = {"format": FORMAT, **facts}
            values = [(name, json.dumps(value, sort_keys=True)) for name, value in told.items()]
            connection.executemany("INSERT INTO sweep VALUES (?, ?)", values)

    def facts(self) -> dict[str, Any]:
        """Return the facts about the sweep.

        Raises:
            InputError: there is no manifest, or it cannot be read.
        """
        with self._reading() as connection:
            facts = {name: json.loads(value) for name, value in connection.execute("SELECT name, value FROM sweep")}
        if facts.get("format") != FORMAT:
            raise InputError(f"{self.path} has format {facts.get('format')}; this version of mpmcli reads {FORMAT}.")
        wrong = [name for name, sound in _SOUND.items() if not sound(facts.get(name))]
        if wrong:
            raise InputError(f"{self.path} is damaged: what it says of {wrong[0]} cannot be; copy it again.")
        return facts

    def rows(self) -> list[Row]:
        """Return all rows, by number.

        Raises:
            InputError: there is no manifest, or it cannot be read.
        """
        with self._reading() as connection:
            rows = [Row(*row) for row in connection.execute(f"{_SELECT} ORDER BY number")]
        for row in rows:
            if wrong := [f.name for f in fields(Row) if type(getattr(row, f.name)) is not f.type]:
                raise InputError(f"{self.path} is damaged: the {wrong[0]} of trajectory {row.number} cannot be read.")
            # Paths are data: none leads out of the dataset.
            if row.file and not _PLACE.fullmatch(row.file):
                raise InputError(f"{self.path} places trajectory {row.number} in {one_line(row.file)}: it is damaged.")
        return rows

    def put(self, rows: Iterable[Row]) -> None:
        """Add rows, or replace those of the same numbers, all at once and durably.

        Raises:
            RunError: the disk is full or refuses.
        """
        places = ", ".join("?" * len(COLUMNS))
        with self._open("write", self.path) as connection:
            connection.executemany(
                f"INSERT OR REPLACE INTO trajectories ({', '.join(COLUMNS)}) VALUES ({places})", map(astuple, rows)
            )

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
            raise InputError(f"{self.path.parent} is no dataset: it has no {MANIFEST}.")
        try:
            # Not mode=ro, which could not roll back what a killed writer left.
            with closing(sqlite3.connect(f"file:{self.path}?mode=rw", uri=True)) as connection:
                yield connection
        except (sqlite3.Error, TypeError, ValueError, RecursionError, MemoryError) as error:
            raise InputError(f"{self.path} cannot be read ({error}); copy it again, or run the sweep again.") from error


_PLACE = re.compile(r"(shards|pending|quarantine)/\w+\.h5")


def _is_count(value: object) -> bool:
    return type(value) is int and 0 < value <= 10**9


def _is_part(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_count, value)) and value[0] <= value[1]


# What the facts of a sweep must be.
_SOUND = {
    "key": lambda value: isinstance(value, str),
    "count": _is_count,
    "per_shard": _is_count,
    "part": _is_part,
}
_SELECT = f"SELECT {', '.join(COLUMNS)} FROM trajectories"

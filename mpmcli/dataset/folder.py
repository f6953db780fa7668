"""The directory of a dataset: where its trajectories lie, and how those of a shard become one file."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import h5py

from mpmcli.dataset.manifest import Row
from mpmcli.dataset.paths import PENDING, SHARDS, file_name
from mpmcli.dataset.shard import CHECKSUMS, FORMAT, VERSION, add_checksums, checksum, group_name
from mpmcli.errors import InputError, RunError
from mpmcli.output.directory import check_directory
from mpmcli.output.durable import require_free_space, sealed
from mpmcli.output.file_checksum import append_checksum
from mpmcli.output.lock import LOCK

# Bytes of a shard, about: large enough for a file system and for copies over a network, small enough to lose.
SHARD_BYTES = 256e6


def require_empty(directory: Path, *, locked: bool = False) -> None:
    """Refuse a directory that holds something, is being written or cannot be.

    Args:
        locked: whether this process has the lock of the directory.

    Raises:
        InputError: it does; nothing was made.
    """
    if directory.is_dir() and any(path.name != LOCK for path in directory.iterdir()):
        raise InputError(f"{directory} exists and is not empty: give another directory with -o.")
    check_directory(directory, overwrite=False, locked=locked)


class Folder:
    """Places of the trajectories in a dataset.

    Attributes:
        path: of the dataset.
        count: trajectories of the sweep; per_shard: of which a shard has so many, the last one fewer.
        part: (i, n): this directory has every n-th shard, from the i-th on, counted from 1.
    """

    def __init__(self, path: Path, count: int, per_shard: int, part: tuple[int, int]) -> None:
        self.path, self.count, self.per_shard, self.part = path, count, per_shard, part

    @property
    def shards(self) -> range:
        """Numbers of the shards of this part."""
        first, parts = self.part
        return range(first - 1, -(-self.count // self.per_shard), parts)

    def numbers(self, shard: int) -> range:
        """Return the numbers of the trajectories of a shard."""
        return range(shard * self.per_shard, min((shard + 1) * self.per_shard, self.count))

    def shard_of(self, number: int) -> int:
        """Return the number of the shard that a trajectory belongs to."""
        return number // self.per_shard

    def shard_file(self, shard: int) -> str:
        """Return the path of a shard in the dataset."""
        return f"{SHARDS}/{shard:05d}.h5"

    def is_kept(self, row: Row) -> bool:
        """Return whether a row is final: its frames are where it says. A failed one is tried again."""
        return row.verdict != "failed" and (not row.file or (self.path / row.file).is_file())

    def seal(self, shard: int, rows: Mapping[int, Row]) -> list[Row]:
        """Join the accepted trajectories of a shard in one file, durably, and return the rows that it changes.

        Args:
            rows: of all its trajectories, by number.

        Raises:
            RunError: the disk refuses, or a trajectory does not read back; the files of the trajectories are kept.
        """
        accepted = [rows[n] for n in self.numbers(shard) if rows[n].accepted]
        target = self.path / self.shard_file(shard)
        if not accepted:
            return []
        sources = [self.path / row.file for row in accepted]
        size = sum(source.stat().st_size for source in sources)
        kept = f"its trajectories are kept in {self.path / PENDING}"
        target.parent.mkdir(exist_ok=True)
        require_free_space(target.parent, size, f"shard {shard}", kept)
        try:
            with sealed(target, size) as temporary:
                with h5py.File(temporary, "w") as joined:
                    joined.attrs["format"], joined.attrs["version"] = FORMAT, VERSION
                    for row, path in zip(accepted, sources, strict=True):
                        with h5py.File(path, "r") as source:
                            source.copy(group_name(row.number), joined)
                            if CHECKSUMS not in joined[group_name(row.number)]:
                                # An older version has computed it.
                                add_checksums(joined[group_name(row.number)])
                append_checksum(temporary)
                damaged = _differing(temporary, accepted)
                if damaged is not None:
                    raise RunError(f"{target} does not hold trajectory {damaged} as it was computed; {kept}.")
        except (OSError, RuntimeError, KeyError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RunError(f"{target} could not be written ({reason}); {kept}.") from error
        return [replace(row, file=self.shard_file(shard)) for row in accepted]

    def clear(self, rows: Sequence[Row]) -> None:
        """Remove the files of single trajectories that shards hold."""
        for row in rows:
            (self.path / PENDING / file_name(row.number)).unlink(missing_ok=True)

    def close(self) -> None:
        """Remove what unfinished work has left."""
        shutil.rmtree(self.path / PENDING, ignore_errors=True)


def _differing(path: Path, rows: Sequence[Row]) -> int | None:
    """Return the first trajectory whose checksum is not that of its row."""
    with h5py.File(path, "r") as file:
        return next((row.number for row in rows if checksum(file[group_name(row.number)]) != row.checksum), None)

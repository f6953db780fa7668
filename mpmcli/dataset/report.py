"""What a dataset holds, as its manifest and its files tell: counts, reasons, and whether every checksum is right."""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py

from mpmcli.dataset.folder import Folder
from mpmcli.dataset.manifest import VERDICTS, Manifest, Row
from mpmcli.dataset.paths import SHARDS
from mpmcli.dataset.shard import checksum, group_name, open_shard
from mpmcli.dataset.stored_trajectory import StoredGroup
from mpmcli.errors import InputError
from mpmcli.output.file_checksum import checksum_is_right
from mpmcli.output.hdf5_items import held
from mpmcli.plain_text import counted, one_line

# Trajectories that a text names.
MOST_NAMED = 10


@dataclass(frozen=True)
class Status:
    """Counts of a dataset.

    Attributes:
        path: of the dataset; part: (i, n) of the sweep.
        expected: trajectories of the part; rows: those that have been tried.
    """

    path: Path
    part: tuple[int, int]
    expected: int
    rows: tuple[Row, ...]

    @property
    def accepted(self) -> int:
        """Trajectories that the dataset includes."""
        return sum(row.accepted for row in self.rows)

    def as_dict(self) -> dict:
        """Return the counts, and the reason of each trajectory that is not included."""
        verdicts = Counter(row.verdict for row in self.rows)
        splits = Counter(row.split for row in self.rows if row.accepted)
        return {
            "path": str(self.path),
            "part": list(self.part),
            "trajectories": self.expected,
            "done": len(self.rows),
            "accepted": self.accepted,
            "retried": sum(row.retries > 0 for row in self.rows),
            "verdicts": {verdict: verdicts[verdict] for verdict in VERDICTS},
            "splits": dict(sorted(splits.items())),
            "steps": sum(row.steps for row in self.rows),
            "seconds": sum(row.seconds for row in self.rows),
            "excluded": [
                {"number": row.number, "verdict": row.verdict, "reason": row.reason, "file": row.file}
                for row in self.rows
                if not row.accepted
            ],
        }

    def text(self) -> str:
        """Return it as text: a line of counts, one for each verdict, and the reasons of the first exclusions."""
        told = self.as_dict()
        lines = [
            f"{self.path}: {self.accepted} of {counted(self.expected, 'trajectory')} included, "
            f"{self.expected - len(self.rows)} to compute, {told['retried']} retried"
        ]
        lines += [f"  {verdict:<9} {count}" for verdict, count in told["verdicts"].items() if count]
        lines += [f"  {split:<9} {count}" for split, count in told["splits"].items()]
        excluded = told["excluded"]
        lines += [f"  {one['number']:06d} {one['verdict']}: {one['reason']}" for one in excluded[:MOST_NAMED]]
        if len(excluded) > MOST_NAMED:
            lines.append(f"  and {len(excluded) - MOST_NAMED} more; --json lists all")
        return "\n".join(lines)


def status_of(path: Path) -> Status:
    """Read the counts of a dataset.

    Raises:
        InputError: it is none, or its manifest cannot be read.
    """
    manifest = Manifest(path)
    facts, rows = manifest.facts(), manifest.rows()
    folder = Folder(path, facts["count"], facts["per_shard"], tuple(facts["part"]))
    return Status(path, folder.part, sum(len(folder.numbers(shard)) for shard in folder.shards), tuple(rows))


@dataclass(frozen=True)
class Verification:
    """Outcome of a comparison of a dataset with its manifest.

    Attributes:
        path: of the dataset; trajectories: compared; faults: one sentence each.
    """

    path: Path
    trajectories: int
    faults: tuple[str, ...]

    def as_dict(self) -> dict:
        """Return it as JSON can hold it."""
        return {
            "path": str(self.path),
            "ok": not self.faults,
            "trajectories": self.trajectories,
            "faults": list(self.faults),
        }

    def text(self) -> str:
        """Return the outcome, and a line for each fault."""
        outcome = counted(len(self.faults), "fault") if self.faults else "all checksums and counts are right"
        return "\n".join([f"{self.path}: {counted(self.trajectories, 'trajectory')} read, {outcome}", *self.faults])


def verify(path: Path, on_file: Callable[[int, int], None] = lambda done, total: None) -> Verification:
    """Read every trajectory of a dataset, and compare checksums and counts with the manifest.

    Args:
        on_file: called after each file with the number of files read, and of all.

    Raises:
        InputError: it is no dataset, or its manifest cannot be read.
    """
    status = status_of(path)
    faults = []
    missing = status.expected - len(status.rows)
    if missing:
        faults.append(f"{counted(missing, 'trajectory')} not computed; mpmcli sweep --resume goes on.")
    by_file: dict[str, list[Row]] = {}
    for row in status.rows:
        if row.file:
            by_file.setdefault(row.file, []).append(row)
        elif row.accepted:
            faults.append(f"trajectory {row.number} is included, but has no file.")
    known = {path / name for name in by_file}
    faults += [
        f"{found} is in no row of the manifest." for found in sorted((path / SHARDS).glob("*.h5")) if found not in known
    ]
    for done, (name, rows) in enumerate(sorted(by_file.items()), 1):
        faults += _faults_of(path / name, rows)
        on_file(done, len(by_file))
    return Verification(path, sum(len(rows) for rows in by_file.values()), tuple(faults))


def _faults_of(file: Path, rows: list[Row]) -> list[str]:
    faults = []
    try:
        with open_shard(file) as opened:
            names = {group_name(row.number): row for row in rows}
            others = sorted(opened.keys() - names.keys())
            faults += [f"{file} holds {one_line(name)}, which the manifest does not place there." for name in others]
            for name, row in names.items():
                if opened.get(name, getlink=True) is None:
                    faults.append(f"{file} lacks trajectory {row.number}.")
                else:
                    faults += _trajectory_faults(opened, row)
            checked = opened.attrs["version"] > 1
        if checked and not faults and not checksum_is_right(file):
            faults.append(f"{file} has changed between its data: the checksum at its end differs.")
    except InputError as error:
        faults.append(str(error))
    return faults


def _trajectory_faults(file: h5py.File, row: Row) -> list[str]:
    """Compare a trajectory with its row, and with its own checksums, where its version has any."""
    try:
        stored = StoredGroup(file, row.number)
        if checksum(stored.group) != row.checksum:
            return [f"trajectory {row.number} in {file.filename} has changed: its checksum differs."]
        if held(stored.group, "position").shape[:2] != (row.frames, row.particles):
            return [f"trajectory {row.number} in {file.filename} has other counts than its row."]
        if stored.attribute("split") != row.split or stored.attribute("draws") != json.loads(row.draws):
            return [f"trajectory {row.number} in {file.filename} has other draws or another split than its row."]
        stored.require_all()
    except (OSError, RuntimeError, ValueError, KeyError, TypeError):
        return [f"trajectory {row.number} in {file.filename} is damaged: it cannot be read."]
    except InputError as error:
        return [str(error)]
    return []

"""What a dataset holds, as its manifest and its files tell: counts, reasons, and whether every checksum is right."""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py

from mpmcli.dataset.folder import VERDICTS, Folder, Manifest, Row
from mpmcli.dataset.shard import SHARDS, StoredGroup, checksum, group_name, open_shard
from mpmcli.errors import InputError
from mpmcli.output.checksums import checksum_is_right
from mpmcli.plain_text import counted, one_line

# Trajectories that a text names.
MOST_NAMED = 10


@dataclass(frozen=True)
class Status:
    """Counts of a dataset with `part` (i, n) of a sweep: trajectories `expected` in it, and `rows` of those tried."""

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
        told = ("number", "verdict", "reason", "file")
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
            "excluded": [{name: getattr(row, name) for name in told} for row in self.rows if not row.accepted],
        }

    def lack(self) -> str:
        """Return what of the sweep is not in the dataset, other than what its verdict excludes, "" if nothing is."""
        failed, waiting = sum(row.verdict == "failed" for row in self.rows), self.expected - len(self.rows)
        told = [f"{n} {what}" for n, what in ((waiting, "not computed"), (failed, "failed")) if n]
        (i, n), of = self.part, counted(self.expected, "trajectory")
        if n > 1:
            told.append(f"this is part {i} of {n} of the sweep")
        return f"{self.accepted} of {of} included, {', '.join(told)}" if told else ""

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
    """Read the counts of a dataset; an InputError says that it is none, or that its manifest cannot be read."""
    manifest = Manifest(path)
    facts, rows = manifest.facts(), manifest.rows()
    folder = Folder(path, facts["count"], facts["per_shard"], tuple(facts["part"]))
    return Status(path, folder.part, folder.expected, tuple(rows))


@dataclass(frozen=True)
class Verification:
    """Outcome of a comparison of a dataset with its manifest: how many trajectories, and a sentence for each fault."""

    path: Path
    trajectories: int
    faults: tuple[str, ...]

    def as_dict(self) -> dict:
        """Return it as JSON can hold it."""
        read = {"trajectories": self.trajectories, "faults": list(self.faults)}
        return {"path": str(self.path), "ok": not self.faults, **read}

    def text(self) -> str:
        """Return the outcome, and a line for each fault."""
        outcome = counted(len(self.faults), "fault") if self.faults else "all checksums and counts are right"
        return "\n".join([f"{self.path}: {counted(self.trajectories, 'trajectory')} read, {outcome}", *self.faults])


def verify(path: Path, on_file: Callable[[int, int], None] = lambda done, total: None) -> Verification:
    """Compare a dataset with its manifest; `on_file` is told files read, and their number, after each."""
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
    others = set((path / SHARDS).glob("*.h5")) - {path / name for name in by_file}
    faults += [f"{other} is in no row of the manifest." for other in sorted(others)]
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
                there = name in opened
                faults += _trajectory_faults(opened, row) if there else [f"{file} lacks trajectory {row.number}."]
        if not faults and not checksum_is_right(file):
            faults.append(f"{file} has changed between its data: the checksum at its end differs.")
    except InputError as error:
        faults.append(str(error))
    return faults


def _trajectory_faults(file: h5py.File, row: Row) -> list[str]:
    """Compare a trajectory with its row, and with its own checksums."""
    it = f"trajectory {row.number} in {file.filename}"
    try:
        stored = StoredGroup(file, row.number)
        if checksum(stored.group) != row.checksum:
            return [f"{it} has changed: its checksum differs."]
        if stored.group["position"].shape[:2] != (row.frames, row.particles):
            return [f"{it} has other counts than its row."]
        if stored.attribute("split") != row.split or stored.attribute("draws") != json.loads(row.draws):
            return [f"{it} has other draws or another split than its row."]
        stored.require_all()
    except (OSError, RuntimeError, ValueError, KeyError, TypeError):
        return [f"{it} is damaged: it cannot be read."]
    except InputError as error:
        return [str(error)]
    return []

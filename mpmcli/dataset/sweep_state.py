"""The settings of a sweep, and how far it is."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from mpmcli.dataset.manifest import VERDICTS, Row
from mpmcli.simulation.engine import Arch


@dataclass(frozen=True)
class SweepSettings:
    """Settings of a sweep that are not part of its file.

    Attributes:
        directory: where the dataset goes.
        workers: processes on this machine, None for one on each core; scheduler: address of a running Dask
            scheduler instead, "" for none.
        part: (i, n): compute every n-th shard, from the i-th on.
        resume: whether to go on with the dataset in the directory.
        arch, threads: backend of each worker.
        plugins: files with further laws.
    """

    directory: Path
    workers: int | None = None
    scheduler: str = ""
    part: tuple[int, int] = (1, 1)
    resume: bool = False
    arch: Arch = "auto"
    threads: int | None = 1
    plugins: tuple[Path, ...] = ()


@dataclass
class SweepState:
    """How far a sweep is.

    Attributes:
        directory: of the dataset.
        expected: trajectories of this part; kept: of these, done by an earlier command.
        verdicts: count of each verdict so far; accepted: trajectories that the dataset includes.
        particle_steps: of this command.
        seconds: wall time of this command since its workers started; start_seconds: before.
        settled: done and seconds when each worker had ended a task; until then kernels compile.
        status: "running", "finished" or "interrupted".
    """

    directory: Path
    expected: int
    kept: int = 0
    verdicts: Counter[str] = field(default_factory=Counter)
    accepted: int = 0
    particle_steps: float = 0.0
    seconds: float = 0.0
    start_seconds: float = 0.0
    settled: tuple[int, float] | None = None
    status: str = "running"

    @property
    def done(self) -> int:
        """Trajectories that have a verdict."""
        return self.verdicts.total()

    @property
    def per_hour(self) -> float:
        """Trajectories per hour of this command, since it has settled where it has."""
        done, seconds = self.settled if self.settled is not None and self.done > self.settled[0] else (self.kept, 0.0)
        return 3600 * (self.done - done) / (self.seconds - seconds) if self.seconds > seconds else 0.0

    def count(self, row: Row) -> None:
        """Count a row."""
        self.verdicts[row.verdict] += 1
        self.accepted += row.accepted

    def as_dict(self) -> dict:
        """Return it as JSON can hold it."""
        return {
            "status": self.status,
            "directory": str(self.directory),
            "trajectories": self.expected,
            "done": self.done,
            "kept": self.kept,
            "accepted": self.accepted,
            "verdicts": {verdict: self.verdicts[verdict] for verdict in VERDICTS},
            "per_hour": self.per_hour,
            "seconds": self.seconds,
            "start_seconds": self.start_seconds,
            "particle_steps": self.particle_steps,
        }

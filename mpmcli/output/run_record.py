"""run.json: command, machine, progress and outcome of a run."""

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from mpmcli import __version__
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.durable import write_text, writing
from mpmcli.output.lock import Owner, lock_is_held, time_now
from mpmcli.plain_json import finite_json

RECORD = "run.json"
PROGRAM = "mpmcli"
DIED, ELSEWHERE = "died", "running on another machine, or died"
Status = Literal["running", "finished", "unstable", "interrupted", "stopped", "failed"]


@dataclass
class RunRecord:
    """The record of one run; `write` replaces run.json in one durable step, at any moment.

    Attributes:
        directory: directory of run.json; not part of it.
        command: command line; the program's name comes first, without its path.
        scene: path of the scene; the names of the files that it reads are relative to its directory.
        backend: arch, threads, precision, and device name if known, of the backend in use.
        files: SHA-256 of each file that the scene reads, by name.
        resumed: for each resumption: its time (at), the frames kept, and the first step.
        seeds: seed of each body by name, for those that have one.
        forced: whether --force keeps time.step as given.
        frames_expected, particles: as planned.
        notes: sentences about automatic choices ("auto" values).
        status: "running" until `close`; "interrupted" by a signal, "stopped" at a limit or for lack of space.
        frames_written, steps, time: progress of the run; time in s.
        timings: seconds by name: compile_s, solve_s, output_s, wall_s.
        limits: number of frames in which each bound on the step was the smallest.
        energy: J; first, last, largest and smallest total.
        failure: reason of an early end: message, and step, time, particle, ... if known.
    """

    directory: Path
    command: Sequence[str] = ()
    scene: str = ""
    backend: dict[str, Any] = field(default_factory=dict)
    seeds: dict[str, int] = field(default_factory=dict)
    forced: bool = False
    files: dict[str, str] = field(default_factory=dict)
    frames_expected: int = 0
    particles: int = 0
    notes: Sequence[str] = ()
    status: Status = "running"
    frames_written: int = 0
    steps: int = 0
    time: float = 0.0
    timings: dict[str, float] = field(default_factory=dict)
    limits: dict[str, int] = field(default_factory=dict)
    energy: dict[str, float] = field(default_factory=dict)
    failure: dict[str, Any] | None = None
    resumed: list[dict[str, Any]] = field(default_factory=list)
    started: str = field(default_factory=time_now)
    ended: str | None = None

    def observe(self, row: LedgerRow) -> None:
        """Count one written frame; does not write."""
        self.frames_written += 1
        self.steps += row.steps
        self.time = row.time
        if row.limit:
            self.limits[row.limit] = self.limits.get(row.limit, 0) + 1
        energy = row.energy
        self.energy.setdefault("first", energy)
        self.energy["last"] = energy
        self.energy["smallest"] = min(energy, self.energy.get("smallest", energy))
        self.energy["largest"] = max(energy, self.energy.get("largest", energy))

    def go_on_from(self, earlier: Mapping[str, Any], rows: Sequence[LedgerRow], step: int) -> None:
        """Continue an earlier run.json from `step`, after `rows`, those of the existing frames."""
        for row in rows:
            self.observe(row)
        self.started = str(earlier.get("started", self.started))
        self.resumed = [*earlier.get("resumed", ()), {"at": time_now(), "frames": len(rows), "step": step}]

    def close(self, status: Status, message: str = "", **facts: Any) -> None:
        """Set the outcome of the run, its reason as a sentence and `facts` (step, time, particle, ...), and write."""
        self.status = status
        self.ended = time_now()
        if message or facts:
            self.failure = {"message": message, **facts}
        self.write()

    def write(self) -> None:
        """Replace run.json by the current state, in one durable step; RunError: the disk is full or a write failed."""
        facts = asdict(self)
        del facts["directory"]
        facts["command"] = [Path(word).name if i == 0 else word for i, word in enumerate(self.command)]
        try:
            taichi = version("taichi")
        except PackageNotFoundError:
            taichi = None
        # Facts that timings depend on and file names do not; "process" identifies the machine.
        host = {
            "python": platform.python_version(),
            "taichi": taichi,
            "system": platform.system(),
            "machine": platform.machine(),
            "cpu_count": os.cpu_count(),
        }
        content = {"program": PROGRAM, "version": __version__, **facts}
        content |= {"process": asdict(Owner.here()), "host": host}
        text = json.dumps(finite_json(content), indent=2, ensure_ascii=False, default=_plain)
        with writing(RECORD, to=self.directory):
            write_text(Path(self.directory) / RECORD, text + "\n")


class _StoredRecord(BaseModel):
    """The validated entries of run.json; other entries are kept as they are."""

    model_config = ConfigDict(extra="allow")

    program: Literal["mpmcli"]
    status: str = "unknown"
    scene: str = ""
    backend: dict[str, str | int] = {}
    files: dict[str, str] = {}
    forced: bool = False
    frames_expected: int = 0
    frames_written: int = 0
    steps: int = 0
    timings: dict[str, float | None] = {}
    limits: dict[str, int] = {}
    failure: dict[str, Any] | None = None
    process: dict[str, Any] = {}
    resumed: list[dict[str, Any]] = []


def read_record(directory: Path) -> dict[str, Any] | None:
    """Read run.json; None if it does not exist, is damaged, or is not of mpmcli."""
    try:
        text = (Path(directory) / RECORD).read_bytes()
        return _StoredRecord.model_validate_json(text).model_dump(exclude_unset=True)
    except (OSError, ValidationError):
        return None


def _plain(value: Any) -> Any:
    """Convert numpy values and paths to JSON values."""
    return finite_json(value.tolist()) if hasattr(value, "tolist") else str(value)


def run_status(directory: Path, record: dict[str, Any] | None) -> str:
    """Return the status of a run from its record and the lock of its directory, "unknown" without a record.

    "running" without a lock or living process becomes "died", or `ELSEWHERE` if this process cannot tell.
    """
    status = str((record or {}).get("status", "unknown"))
    if record is None or status != "running":
        return status
    if lock_is_held(directory):
        return status
    owner = Owner.read(record.get("process"))
    if owner is None:
        return ELSEWHERE
    return {"lives": status, "ended": DIED, "elsewhere": ELSEWHERE}[owner.life]

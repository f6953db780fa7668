"""What is kept of a part: a JSON file, renewed after each row."""

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path

# States of a part.
DONE, FAILED, UNFINISHED = "done", "failed", "out of time"


@dataclass
class Record:
    """What was found by a part.

    Attributes:
        part: its name; arch, scale: what it was measured with.
        state: DONE, FAILED or UNFINISHED.
        seconds: that it took, over all calls.
        rows: by key, in order; those with "ended": false are measured again.
        failures: by key of the task, or "process" outside of them: why its process ended.
        missing: key of the task that the time ended, "" for none.
    """

    part: str
    arch: str
    scale: str
    state: str = UNFINISHED
    seconds: float = 0.0
    rows: dict[str, dict] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    missing: str = ""

    @property
    def finished(self) -> list[str]:
        """Keys of the rows that are complete."""
        return [key for key, row in self.rows.items() if row.get("ended", True)]

    def write(self, folder: Path) -> None:
        """Replace the file of the part, whole or not at all."""
        text = json.dumps(asdict(self), indent=1) + "\n"
        write_whole(folder / f"{self.part}.json", text)


def write_whole(path: Path, text: str) -> None:
    """Replace a file, so that it is the old one or the new one whenever the process ends."""
    fresh = path.with_suffix(path.suffix + ".new")
    fresh.write_text(text, encoding="utf-8")
    os.replace(fresh, path)


def read_record(path: Path) -> Record | None:
    """Return what a file holds, None where there is none or it is not one."""
    try:
        return Record(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def record_of(folder: Path, part: str, arch: str, scale: str) -> Record:
    """Return the record of a part to go on with: that of the folder if it is of this device and scale.

    What failed there is tried again.
    """
    found = read_record(folder / f"{part}.json")
    if found is None or (found.arch, found.scale) != (arch, scale):
        return Record(part, arch, scale)
    if found.state != DONE:
        found.failures = {}
    return found

"""One small real run, and copies of it that were changed on purpose, in all the forms that a result has."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import numpy as np
from changed_result import changed
from command import run_here

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output import SegmentStore, open_result
from mpmcli.output.layout import PACKED
from mpmcli.output.run_record import RECORD

FORMS = ("packed", "segments")
# A drop falls on the floor and splashes, and a jelly ball falls freely; it starts in no time.
SCENE = """\
title = "A drop and a ball"
domain = { size = [2.0, 1.0], origin = [-0.5, 0.0], cells = [32, 16], gravity = [0.0, -9.81] }
time = { end = 0.2, frames = 10 }
[[bodies]]
name = "drop"
material = { law = "fluid", density = 1000.0, bulk_modulus = 1e5 }
shape = { box = { min = [0.25, 0.1], max = [0.6, 0.5] } }
[[bodies]]
name = "ball"
material = { law = "neo_hookean", density = 700.0, youngs_modulus = 1e5, poissons_ratio = 0.3 }
shape = { ball = { center = [1.0, 0.7], radius = 0.15 } }
velocity = [0.3, 0.0]
[contact]
default = "stick"
[output]
fields = ["velocity", "density", "volume_ratio", "mass", "affine"]
"""

_PLACE = TemporaryDirectory()


@dataclass(frozen=True)
class StoredRun:
    """A run in memory.

    Attributes:
        directory: where the real result is.
        record: text of its run.json.
    """

    directory: Path
    frames: tuple[Frame, ...]
    rows: tuple[LedgerRow, ...]
    header: dict
    record: str

    @property
    def particles(self) -> int:
        """Number of particles."""
        return len(self.frames[0].position)

    def write(
        self,
        directory: Path,
        form: str = "packed",
        frames: Sequence[Frame] | None = None,
        rows: Sequence[LedgerRow] | None = None,
    ) -> Path:
        """Store it, with other frames or rows if given, and return the directory."""
        shutil.rmtree(directory, ignore_errors=True)
        directory.mkdir(parents=True)
        # No copy needs to outlive a power cut.
        with mock.patch("os.fsync"):
            self._store(directory, form, frames or self.frames, rows or self.rows)
        (directory / RECORD).write_text(self.record, encoding="utf-8")
        return directory

    def _store(self, directory: Path, form: str, frames: Sequence[Frame], rows: Sequence[LedgerRow]) -> None:
        # Frames that are packed in the end are sealed at once: a segment of each takes most of the time.
        hold = np.inf if form == "packed" else 0.0
        store = SegmentStore(directory, self.header, hold=hold)
        for frame, row in zip(frames, rows, strict=True):
            store.write(frame, row)
        if form != "segments":
            store.finish()

    def patched(self, directory: Path, k: int, name: str, p: int, value: object) -> Path:
        """Copy the packed result, change one value in the file itself, and return the directory."""
        shutil.copytree(self.directory, directory)
        with changed(directory / PACKED) as file:
            array = file["VTKHDF"]["Points" if name == "position" else f"PointData/{name}"]
            row = k * self.particles + p
            # Vectors of the plane have a third component, which is 0.
            array[row] = [*value, 0.0] if np.ndim(value) else value
        return directory

    def with_array(self, k: int, name: str, array: np.ndarray) -> list[Frame]:
        """Return the frames with another array in the k-th of them."""
        frames = list(self.frames)
        own = name in ("position", "velocity", "body", "material")
        change = {name: array} if own else {"fields": {**frames[k].fields, name: array}}
        frames[k] = replace(frames[k], **change)
        return frames

    def with_value(self, k: int, name: str, p: int, value: object) -> list[Frame]:
        """Return the frames with another value at one particle in the k-th of them."""
        frame = self.frames[k]
        array = (getattr(frame, name) if hasattr(frame, name) else frame.fields[name]).copy()
        array[p] = value
        return self.with_array(k, name, array)

    def with_row(self, k: int, **values: object) -> list[LedgerRow]:
        """Return the ledger with other values in the k-th row."""
        return [replace(row, **values) if j == k else row for j, row in enumerate(self.rows)]


@cache
def real_run() -> StoredRun:
    """Return the run as it is, which is made once for all modules of a process."""
    return stored_run(Path(_PLACE.name))


def stored_run(directory: Path, *overrides: str) -> StoredRun:
    """Run the scene in a directory and read all of it."""
    scene = directory / "drop.toml"
    scene.write_text(SCENE, encoding="utf-8")
    words = [word for override in overrides for word in ("--set", override)]
    outcome = run_here("simulate", scene, "-o", directory / "result", "--threads", 1, "--quiet", *words)
    assert outcome.status == 0, outcome.stderr
    result = open_result(directory / "result")
    record = (directory / "result" / RECORD).read_text(encoding="utf-8")
    return StoredRun(directory / "result", tuple(result.frames()), tuple(result.ledger), result.header.stored, record)

"""Exports by the command line, and readers of them, for their tests."""

import json
import os
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from command import run_here
from made_dataset import made_trajectory, write_dataset

import mpmcli.dataset
from mpmcli.dataset.formats import FORMATS, format_named
from mpmcli.dataset.shard import TrajectoryData

FORMS = [
    pytest.param(form, marks=pytest.mark.skipif(find_spec(package or "numpy") is None, reason=f"{package} is absent"))
    for form, package in ((form, format_named(form).package) for form in FORMATS)
]
FRAMES, INPUTS = 11, 6


class GnsReader:
    """What the SamplesDataset of GNS does, with the shape (N, m) for several properties."""

    def __init__(self, path: Path) -> None:
        with np.load(path, allow_pickle=True) as file:
            self.data = file["gns_data"] if "gns_data" in file else [item for _, item in file.items()]
        self.with_property = len(self.data[0]) >= 3
        self.ends = np.cumsum([entry[0].shape[0] - INPUTS for entry in self.data])

    def __len__(self) -> int:
        return int(self.ends[-1])

    def __getitem__(self, index: int) -> tuple[tuple, np.ndarray]:
        k = int(np.searchsorted(self.ends - 1, index, side="left"))
        time = INPUTS + index - (int(self.ends[k - 1]) if k else 0)
        entry = self.data[k]
        position = np.transpose(entry[0][time - INPUTS : time], (1, 0, 2))
        n = len(position)
        kind = np.full(n, entry[1], dtype=int)
        shape = (n,) if not self.with_property or entry[2].ndim == 1 else entry[2].shape
        properties = (np.full(shape, entry[2], dtype=float),) if self.with_property else ()
        return (position, kind, *properties, n), entry[0][time]


def exported(path: Path, form: str, target: Path, *options: object) -> dict:
    """Export by the command line, and return its answer as JSON."""
    outcome = run_here("export", path, "--to", form, "-o", target, "--json", *options)
    assert outcome.status == 0, outcome.stderr
    answer = json.loads(outcome.stdout)
    assert sorted(answer["files"]) == sorted(os.listdir(target))
    assert sorted(os.listdir(target.parent)) == sorted({path.name, target.name}), "something temporary was left"
    for note in answer["notes"]:
        assert f"note: {note}" in outcome.stderr
    return answer


def metadata_of(directory: Path) -> dict:
    return json.loads((directory / "metadata.json").read_text())


def positions(path: Path, split: str, stride: int = 1) -> list[np.ndarray]:
    dataset = mpmcli.dataset.open(path)
    return [dataset[number].position[::stride] for number in dataset.splits[split]]


def coming_and_going(tmp_path: Path) -> tuple[Path, TrajectoryData, np.ndarray]:
    """Return a dataset whose particles wait up to frame 4, a third, or are gone from frame 8 on; and its status."""
    made = made_trajectory(0, particles=30)
    status = np.ones((FRAMES, 30), np.int8)
    status[:5, :10], status[8:, 10:20] = 0, 2
    made.header["scene"] = made.header["scene"].replace("walls = {  }", 'walls = { default = "slip", x_max = "open" }')
    made = replace(made, fields=made.fields | {"status": status})
    return write_dataset(tmp_path / "set", [made]), made, status


def tfrecords(path: Path, dimension: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return positions (T, N, d) and types (N,) of each trajectory, as the package tfrecord reads the file."""
    reader = pytest.importorskip("tfrecord.reader")
    described = {"context_description": {"particle_type": "byte"}, "features_description": {"position": "byte"}}
    loader = reader.sequence_loader(str(path), None, **described, compression_type=None)
    found = []
    for context, sequence in loader:
        frames = [np.frombuffer(bytes(frame), np.float32).reshape(-1, dimension) for frame in sequence["position"]]
        found.append((np.stack(frames), np.frombuffer(bytes(context["particle_type"]), np.int64)))
    return found


def refused(path: Path, form: str, target: Path, *options: object) -> str:
    """Return the sentence with which an export is refused, which changes nothing."""
    before = everything(target.parent)
    outcome = run_here("export", path, "--to", form, "-o", target, *options)
    assert outcome.status == 2 and outcome.stdout == "", outcome
    assert everything(target.parent) == before
    assert len(outcome.stderr.splitlines()) == 1 and outcome.stderr.startswith("error: ")
    return outcome.stderr


def everything(directory: Path) -> dict[str, bytes | None]:
    return {str(p.relative_to(directory)): p.read_bytes() if p.is_file() else None for p in directory.rglob("*")}

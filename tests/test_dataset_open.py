"""Datasets are read as they were written: shards, single results, slices, and sentences for what cannot be read."""

import hashlib
import json
import pickle
import re
import shutil
import sqlite3
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import run_here
from made_dataset import COUNTS, made_dataset, made_trajectory, write_dataset
from made_result import made_frame, write_made
from made_sweep import made_workers, make_dataset, small_sweep  # noqa: F401

import mpmcli.dataset
from mpmcli.dataset import folder
from mpmcli.dataset.dataset import open_dataset
from mpmcli.dataset.folder import MANIFEST, Manifest
from mpmcli.dataset.report import verify
from mpmcli.dataset.shard import write_single, write_trajectory
from mpmcli.dataset.sweep_run import SweepSettings, run_sweep
from mpmcli.errors import InputError


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("compress", [False, True])
def test_a_trajectory_reads_back_bit_for_bit(tmp_path, dimension, dtype, compress):
    made = made_trajectory(7, dimension=dimension, dtype=dtype, split="valid", viscosity=0.5)
    dataset = mpmcli.dataset.open(write_dataset(tmp_path / "set", [made], compress=compress))
    read = dataset[7]
    assert (read.number, read.split, read.draws) == (7, "valid", made.draws)
    assert (read.frame_count, read.particle_count, read.header.dimension) == (11, 24, dimension)
    assert read.header.stored == made.header and read.header.bodies[0].material["viscosity"] == 0.5
    assert read.ledger == made.ledger
    for name in ("position", "velocity", "body", "material"):
        same(getattr(read, name), getattr(made, name))
    assert read.field_names == ("pressure", "deformation_gradient")
    for name, array in made.fields.items():
        same(read.field(name), array)
    for name, array in {"times": made.time, "steps": made.step, "frames": made.frame}.items():
        same(getattr(read, name), np.asarray(array))


def same(read: np.ndarray, written: np.ndarray) -> None:
    assert read.dtype == written.dtype
    np.testing.assert_array_equal(read, written)


def test_slices_are_those_of_numpy(tmp_path):
    made = made_trajectory(0)
    read = mpmcli.dataset.open(write_dataset(tmp_path / "set", [made]))[0]
    chosen = np.array([1, 5, 20])
    same(read.read("position", slice(2, None, 3), slice(4, 9)), made.position[2::3, 4:9])
    same(read.read("pressure", slice(0, 2), chosen), made.fields["pressure"][:2, chosen])
    same(read.read("body", particles=chosen), made.body[chosen])


def test_splits_numbers_and_iteration(tmp_path):
    dataset = mpmcli.dataset.open(made_dataset(tmp_path / "set"))
    assert len(dataset) == 4 and dataset.numbers == (0, 1, 2, 3)
    assert dataset.splits == {"train": (0, 1), "valid": (2,), "test": (3,)}
    assert [(each.number, each.particle_count) for each in dataset] == list(enumerate(COUNTS))


def test_datasets_and_trajectories_can_be_sent_to_other_processes(tmp_path):
    for path in (made_dataset(tmp_path / "set"), write_made(tmp_path / "run")):
        dataset = mpmcli.dataset.open(path)
        there = pickle.loads(pickle.dumps((dataset, dataset[0])))
        same(there[0][0].position, dataset[0].position)
        same(there[1].velocity, dataset[0].velocity)


@pytest.mark.parametrize("form", ["packed", "segments"])
def test_a_single_result_is_a_dataset_of_one_trajectory(tmp_path, form):
    dataset = mpmcli.dataset.open(write_made(tmp_path / "run", form, dimension=3))
    assert dataset.splits == {"train": (0,), "valid": (), "test": ()} and dataset[0].header.dimension == 3
    read = dataset[0]
    frames = [made_frame(k, 3) for k in range(6)]
    same(read.position, np.stack([frame.position for frame in frames]))
    same(read.read("velocity", slice(1, None, 2)), np.stack([frame.velocity for frame in frames[1::2]]))
    same(read.body, frames[0].body)
    assert read.steps.tolist() == [frame.step for frame in frames]
    if form == "packed":
        same(mpmcli.dataset.open(tmp_path / "run" / "particles.vtkhdf")[0].position, read.position)


def test_bytes_do_not_depend_on_the_time_or_the_place_of_writing(tmp_path):
    """More than a second apart, since HDF5 counts in whole ones."""
    digests = set()
    for name in ("first", "second/deeper"):
        for compress in (False, True):
            path = write_dataset(tmp_path / name / str(compress), [made_trajectory(3)], compress=compress)
            digests.add((compress, hashlib.sha256((path / "shards/00000.h5").read_bytes()).hexdigest()))
        time.sleep(1.1)
    assert len(digests) == 2


@pytest.mark.parametrize(("fault", "sentence"), [
    ({"split": "training"}, "split"),
    ({"velocity": np.zeros((3, 2, 2))}, "position and velocity"),
    ({"fields": {"time": np.zeros((11, 24))}}, "cannot name a field"),
    ({"fields": {"pressure": np.zeros((11, 2))}}, "pressure must be"),
    ({"body": np.zeros(3)}, "24 entries"),
    ({"time": np.zeros(3)}, "11 entries"),
])  # fmt: skip
def test_a_trajectory_that_contradicts_itself_is_not_written(tmp_path, fault, sentence):
    with h5py.File(tmp_path / "shard.h5", "w") as file:
        with pytest.raises(ValueError, match=sentence):
            write_trajectory(file, replace(made_trajectory(0), **fault))
        assert not list(file)


def test_what_cannot_be_read_is_said_in_a_sentence(tmp_path):
    def refused(path, match):
        with pytest.raises(InputError, match=match):
            mpmcli.dataset.open(path)

    refused(tmp_path / "none", "does not exist")
    refused(tmp_path, "is not a dataset: it has no directory shards")
    (tmp_path / "text").write_text("text")
    refused(tmp_path / "text", "is not an HDF5 file")
    (tmp_path / "empty" / "shards").mkdir(parents=True)
    refused(tmp_path / "empty", "empty dataset")
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "sweep.toml").touch()
    refused(tmp_path / "begun", "empty dataset")

    path = made_dataset(tmp_path / "set")
    dataset = mpmcli.dataset.open(path)
    with pytest.raises(InputError, match=r"has no trajectory 9: it holds 4, from 0 to 3\."):
        dataset[9]
    with pytest.raises(InputError, match='no field "stress": its fields are pressure, deformation_gradient'):
        dataset[0].field("stress")

    shard = path / "shards" / "00001.h5"
    whole = shard.read_bytes()
    shard.write_bytes(whole[: len(whole) // 2])
    refused(path, "00001.h5 is not an HDF5 file, or a damaged one")
    shard.write_bytes((path / "shards" / "00000.h5").read_bytes())
    refused(path, "trajectory 0 lies in .*00000.h5 and in .*00001.h5")
    with h5py.File(shard, "w") as file:
        file.attrs["format"], file.attrs["version"] = "mpmcli-dataset", 3
    refused(path, "has format 3")
    with h5py.File(shard, "w"):
        pass
    refused(path, "not a shard")
    shard.unlink()
    with pytest.raises(InputError, match="is missing"):
        dataset[1]


def test_an_unfinished_shard_and_the_quarantine_are_left_alone(tmp_path):
    path = made_dataset(tmp_path / "set")
    (path / "shards" / "00002.h5.tmp").write_bytes(b"half")
    (path / "quarantine").mkdir()
    (path / "quarantine" / "00009.h5").write_bytes(b"bad")
    assert len(mpmcli.dataset.open(path)) == 4


def computed(directory: Path, number: int) -> folder.Row:
    """Write a trajectory that waits for its shard, and return its row."""
    path = directory / "pending" / f"{number:06d}.h5"
    path.parent.mkdir(exist_ok=True)
    known = write_single(path, made_trajectory(number), compress=False)
    row = folder.Row.failed(number, "train")
    return replace(row, verdict="stable", accepted=1, file=f"pending/{path.name}", checksum=known)


@pytest.mark.usefixtures("made_workers")
def test_what_verify_finds_is_computed_again_on_resume():
    """A changed byte of a shard, of its attributes or in quarantine; a shard that is gone, or is that of another."""
    dataset, rows = make_dataset("d"), Manifest(Path("d")).rows()
    whole = {path.relative_to(dataset): path.read_bytes() for path in dataset.rglob("*.h5")}
    flipped = ("shards/00000.h5", "quarantine/000004.h5", "shards/00001.h5")
    other = whole[Path("shards/00001.h5")]
    for k, (name, content) in enumerate({**dict.fromkeys(flipped), "shards/00002.h5": other}.items()):
        data = bytearray(whole[Path(name)])
        data[len(data) // (k + 2)] ^= 1
        (dataset / name).write_bytes(content or data)
        (dataset / "shards" / "00003.h5").unlink()
        assert verify(dataset).faults
        state = run_sweep(small_sweep(), SweepSettings(dataset, resume=True))
        assert (state.status, state.done) == ("finished", 12)
        assert state.kept == 12 - sum(row.file in (name, "shards/00003.h5") for row in rows)
        assert verify(dataset).faults == ()
        assert {path.relative_to(dataset): path.read_bytes() for path in dataset.rglob("*.h5")} == whole
    # One that waits for its shard.
    asked = iter([False, False, True])
    assert run_sweep(small_sweep(), SweepSettings(Path("e")), stop=lambda: next(asked)).done == 2
    single = Path("e/pending/000001.h5")
    single.write_bytes(single.read_bytes()[:-100])
    assert run_sweep(small_sweep(), SweepSettings(Path("e"), resume=True)).kept == 1
    assert {path.relative_to("e"): path.read_bytes() for path in Path("e").rglob("*.h5")} == whole


@pytest.mark.usefixtures("made_workers")
def test_missing_trajectories_are_named(drawing):
    """Where a dataset is opened, drawn or counted: those whose shard is gone, and those not computed yet."""
    dataset = make_dataset("d")
    assert mpmcli.dataset.open(dataset).missing == ()
    (dataset / "shards" / "00001.h5").unlink()
    said = "d lacks 2 trajectories of its sweep (3, 5): mpmcli sweep --resume computes them."
    with pytest.warns(UserWarning, match=re.escape(said)):
        opened = mpmcli.dataset.open(dataset)
    assert opened.missing == (3, 5) and set(opened.numbers) == set(range(12)) - {3, 4, 5, 9}
    drawn = run_here("render", dataset, "--montage", "2x2", "--json", "--color-by", "speed")
    assert drawn.status == 0 and json.loads(drawn.stdout)["warnings"] == [said], drawn.stderr
    assert json.loads(run_here("dataset", "status", dataset, "--json").stdout)["missing"] == [3, 5]
    with sqlite3.connect(dataset / MANIFEST) as manifest:
        manifest.execute("DELETE FROM trajectories WHERE number > 5")
    shutil.rmtree(dataset / "quarantine")
    for name in ("00002.h5", "00003.h5"):
        (dataset / "shards" / name).unlink()
    assert open_dataset(dataset).missing == (3, 5, *range(6, 12))


def test_a_shard_that_is_sealed_again_asks_for_its_own_size(tmp_path, monkeypatch):
    """A retried trajectory joins those of the shard, which lie there in one file."""
    asked = []
    monkeypatch.setattr(folder, "require_free_space", lambda place, size, *_: asked.append(size))
    place = folder.Folder(tmp_path, 4, 4, (1, 1))
    rows = {n: computed(tmp_path, n) if n < 3 else folder.Row.failed(n, "train") for n in range(4)}
    rows |= {row.number: row for row in place.seal(0, rows)}
    rows[3] = computed(tmp_path, 3)
    sealed = place.seal(0, rows)
    assert [row.file for row in sealed] == ["shards/00000.h5"] * 4
    assert asked[1] < 1.5 * asked[0] and 0.9 * asked[1] < (tmp_path / "shards" / "00000.h5").stat().st_size

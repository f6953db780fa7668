"""`mpmcli export`: what it refuses, replaces, leaves and tells, whatever the format."""

import io
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import tomllib
from collections import namedtuple
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyvista
from command import ROOT, run_here
from exports import FORMS, FRAMES, GnsReader, coming_and_going, everything, exported, metadata_of, refused, tfrecords
from made_dataset import PAUSE, SPLITS, made_dataset, made_trajectory, write_dataset

import mpmcli.dataset
from mpmcli.cli.progress import ProgressBar
from mpmcli.dataset.folder import MANIFEST, Manifest, Row
from mpmcli.dataset.formats import FORMATS, format_named
from mpmcli.dataset.subsample import chosen_particles
from mpmcli.output import open_result


def test_one_time_between_frames_or_none(tmp_path):
    made = [made_trajectory(0), made_trajectory(1, pause=2 * PAUSE)]
    path = write_dataset(tmp_path / "set", made)
    exported(path, "npz", tmp_path / "out")
    assert metadata_of(tmp_path / "out")["dt"] is None
    exported(path, "npz", tmp_path / "out", "--trajectory", 1, "--overwrite")
    assert metadata_of(tmp_path / "out")["dt"] == pytest.approx(2 * PAUSE)


def test_an_unknown_format_is_told_the_nearest_one(tmp_path):
    message = refused(made_dataset(tmp_path / "set"), "parket", tmp_path / "out")
    assert 'there is no "parket"; did you mean "parquet"?' in message


@pytest.mark.parametrize("form", [form for form in FORMATS if format_named(form).package])
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, form):
    known = format_named(form)
    monkeypatch.setitem(sys.modules, known.package, None)
    message = refused(made_dataset(tmp_path / "set"), form, tmp_path / "out")
    assert f'--to {form} needs {known.package}, which pip install "mpmcli[{known.extra}]" installs.' in message
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["optional-dependencies"][known.extra]


@pytest.mark.parametrize("form", FORMS)
def test_fewer_particles_are_the_same_ones_in_every_format_and_frame(tmp_path, form):
    path = made_dataset(tmp_path / "set")
    exported(path, form, tmp_path / "out", "--max-particles", 24)
    source = mpmcli.dataset.open(path)[0]
    # Number 0 has 30 particles, a third of them of the second body.
    chosen = chosen_particles(source.body, 24, 0)
    assert len(set(chosen)) == 24 and np.bincount(source.body[chosen]).tolist() == [16, 8]
    expected = source.read("position", particles=chosen)
    if form == "lagrangebench":
        with h5py.File(tmp_path / "out" / "train.h5") as file:
            found = file["00000/position"][:]
    elif form == "usd":
        stage = pytest.importorskip("pxr.Usd").Stage.Open(str(tmp_path / "out" / "000000.usdc"))
        points = stage.GetPrimAtPath("/World/Particles").GetAttribute("points")
        found = np.stack([np.array(points.Get(k))[:, :2] for k in range(FRAMES)])
    elif form == "neuralmpm":
        with h5py.File(tmp_path / "out" / "train" / "sim_0.h5") as file:
            found = file["particles"][:]
    elif form == "tfrecord":
        found = tfrecords(tmp_path / "out" / "train.tfrecord", 2)[0][0]
    elif form == "gns":
        found = GnsReader(tmp_path / "out" / "train.npz").data[0][0]
    elif form == "npz":
        found = np.load(tmp_path / "out" / "000000.npz")["position"]
    elif form == "parquet":
        table = pytest.importorskip("pyarrow.parquet").read_table(tmp_path / "out" / "train-00000-of-00001.parquet")
        found = np.array(table["position"][0].as_py(), np.float32)
    elif form == "zarr":
        found = pytest.importorskip("zarr").open(tmp_path / "out" / "trajectories.zarr")["000000/position"][:]
    elif form == "webdataset":
        with tarfile.open(tmp_path / "out" / "train-00000-of-00001.tar") as archive:
            found = np.load(io.BytesIO(archive.extractfile("000000.npz").read()))["position"]
    elif form in ("vtk", "ply"):
        files = sorted((tmp_path / "out").glob("000000_*.vtu" if form == "vtk" else "000000_*.ply"))
        found = np.stack([pyvista.read(file).points[:, :2] for file in files])
    else:
        found = np.stack([f.position for f in open_result(tmp_path / "out" / "000000.vtkhdf").frames()])
    np.testing.assert_array_equal(found, expected)
    metadata = metadata_of(tmp_path / "out")
    assert metadata["num_particles_max"] == 24 and metadata["particle_seed"] == 0
    # The largest trajectory had 36 particles: 24 of them are as far apart as on a lattice with 2/3 of its points.
    assert metadata["dx"] == pytest.approx(0.025 * (36 / 24) ** 0.5)


def test_statistics_are_of_active_particles(tmp_path):
    """At --stride 2 too."""
    path, made, status = coming_and_going(tmp_path)
    for stride in (1, 2):
        exported(path, "npz", tmp_path / "out", "--stride", stride, "--overwrite")
        there = np.where(status[::stride, :, None] == 1, made.position[::stride].astype(float), np.nan)
        v = np.diff(there, axis=0)
        found = metadata_of(tmp_path / "out")
        for name, values in {"vel": v, "acc": np.diff(v, axis=0)}.items():
            assert found[f"{name}_mean"] == pytest.approx(np.nanmean(values, axis=(0, 1)), rel=1e-9)
            assert found[f"{name}_std"] == pytest.approx(np.nanstd(values, axis=(0, 1)), rel=1e-9)


def test_every_format_tells_the_same_facts_of_each_trajectory(tmp_path):
    """The effective scene, the draws, and the names to which numbers refer."""
    path, told = made_dataset(tmp_path / "set"), {}
    for form in ("gns", "npz", "vtkhdf"):
        exported(path, form, tmp_path / "out", "--overwrite")
        found = metadata_of(tmp_path / "out")
        told[form] = {key: found[key] for key in ("laws", "bodies", "colliders", "draws", "scene")}
    assert told["gns"] == told["npz"] == told["vtkhdf"]
    source, name = mpmcli.dataset.open(path)[2], "000002"
    assert told["npz"]["draws"][name] == source.draws
    assert told["npz"]["scene"][name] == tomllib.loads(source.header.stored["scene"])
    bodies = told["npz"]["scene"][name]["bodies"]
    assert [one["name"] for one in bodies] == told["npz"]["bodies"][name] == ["pool", "heap"]


@pytest.mark.parametrize("form", FORMS)
def test_the_same_export_has_the_same_bytes(tmp_path, form):
    path = made_dataset(tmp_path / "set")
    files = []
    for name in ("a", "b"):
        assert run_here("export", path, "--to", form, "-o", tmp_path / name, "-q").status == 0
        files.append(everything(tmp_path / name))
    assert files[0] == files[1] and run_here("dataset", "verify", tmp_path / "b").status == 0
    assert run_here("export", path, "--to", form, "-o", tmp_path / "b", "--overwrite").status == 0
    assert everything(tmp_path / "b") == files[0]


def test_an_earlier_export_is_replaced_only_when_asked(tmp_path):
    path, target = made_dataset(tmp_path / "set"), tmp_path / "out"
    exported(path, "npz", target)
    assert "--overwrite" in refused(path, "gns", target)
    assert sorted(exported(path, "gns", target, "--overwrite")["files"]) == [
        "checksums.sha256",
        "metadata.json",
        "test.npz",
        "train.npz",
        "valid.npz",
    ]
    (target / "notes.txt").write_text("mine")
    assert "it holds notes.txt" in refused(path, "gns", target, "--overwrite")


def test_bad_input_is_refused_with_a_sentence(tmp_path, monkeypatch):
    path, target = made_dataset(tmp_path / "set"), tmp_path / "deep" / "out"
    assert "does not exist" in refused(tmp_path / "none", "npz", target)
    assert "has no trajectory 9" in refused(path, "npz", target, "--trajectory", 9)
    assert "take a smaller --stride" in refused(path, "gns", target, "--stride", 9)
    assert "not an earlier export" in refused(path, "gns", path, "--overwrite")
    assert "'--to'" in refused(path, "csv", target)
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.chdir(empty)
    assert "present directory" in refused(path, "gns", Path("."))


def test_a_full_disk_is_found_before_anything_is_written(tmp_path, monkeypatch):
    path = made_dataset(tmp_path / "set")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: namedtuple("Usage", "free")(1000))
    outcome = run_here("export", path, "--to", "npz", "-o", tmp_path / "out")
    assert outcome.status == 1 and "nothing was written" in outcome.stderr
    assert os.listdir(tmp_path) == ["set"]


def test_an_export_that_breaks_off_leaves_nothing(tmp_path):
    """A damaged shard is found when its turn comes; the earlier export stays."""
    path, target = made_dataset(tmp_path / "set"), tmp_path / "new" / "out"
    with h5py.File(path / "shards" / "00001.h5", "a") as file:
        del file["000003/velocity"]
    outcome = run_here("export", path, "--to", "npz", "-o", target)
    assert outcome.status == 2 and "00001.h5 is damaged" in outcome.stderr
    assert os.listdir(tmp_path) == ["set"]


@pytest.mark.parametrize("earlier", [False, True])
def test_an_interrupted_export_leaves_what_was_there(tmp_path, monkeypatch, earlier):
    path, target = made_dataset(tmp_path / "set"), tmp_path / "new" / "out"
    if earlier:
        assert run_here("export", path, "--to", "gns", "-o", target).status == 0
    before = everything(tmp_path)
    monkeypatch.setattr("mpmcli.cli.dataset.interrupt_came", lambda: True)
    assert run_here("export", path, "--to", "npz", "-o", target, "--overwrite").status == 130
    assert everything(tmp_path) == before


@pytest.mark.parametrize("form", FORMS)
def test_a_signal_between_two_trajectories_leaves_nothing(tmp_path, monkeypatch, form):
    """SIGTERM, which arrives when the first of two in a file is written."""
    path = made_dataset(tmp_path / "set")
    monkeypatch.setattr(ProgressBar, "show", lambda *_: signal.raise_signal(signal.SIGTERM))
    assert run_here("export", path, "--to", form, "-o", tmp_path / "new" / "out").status == 143
    assert os.listdir(tmp_path) == ["set"]


@pytest.mark.parametrize("form", [form for form in FORMS if form.values[0] in ("parquet", "zarr", "webdataset")])
def test_a_killed_export_has_no_directory_under_its_name(tmp_path, form):
    """And the next one is as if there had been none."""
    path, target = made_dataset(tmp_path / "set"), tmp_path / "out"
    code = (
        "import os, signal, sys; from mpmcli.cli import program; from mpmcli.cli.progress import ProgressBar\n"
        "ProgressBar.show = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
        "program.run(sys.argv[1:])"
    )
    words = [sys.executable, "-c", code, "export", path, "--to", form, "-o", target]
    killed = subprocess.run([*map(str, words)], env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False)
    assert killed.returncode == -signal.SIGKILL and not target.exists()
    for name in ("out", "other"):
        assert run_here("export", path, "--to", form, "-o", tmp_path / name).status == 0
    assert everything(target) == everything(tmp_path / "other")


@pytest.mark.parametrize("replaced", [False, True])
def test_an_export_that_a_killed_one_has_set_aside_comes_back(tmp_path, replaced):
    """Killed between its two renames, or after them: the next call finds one export under the name."""
    path, target = made_dataset(tmp_path / "set"), tmp_path / "out"
    assert run_here("export", path, "--to", "gns", "-o", target).status == 0
    before = everything(target)
    target.rename(tmp_path / "out.4711.old.tmp")
    if replaced:
        assert run_here("export", path, "--to", "npz", "-o", tmp_path / "new").status == 0
        (tmp_path / "new").rename(target)
        before = everything(target)
    refusal = run_here("export", path, "--to", "npz", "-o", target)
    assert refusal.status == 2 and "not empty" in refusal.stderr
    assert everything(target) == before and sorted(os.listdir(tmp_path)) == ["out", "set"]


def test_the_answer_is_a_line_on_stdout(tmp_path):
    outcome = run_here("export", made_dataset(tmp_path / "set"), "--to", "npz", "-o", tmp_path / "out")
    assert outcome.stdout.startswith(
        f"{tmp_path / 'out'}: 4 trajectories (train 2, valid 1, test 1) of up to 11 frames"
    )
    assert run_here("export", tmp_path / "set", "--to", "npz", "-o", tmp_path / "q", "-q").stdout == ""


def test_an_export_says_what_the_dataset_lacks(tmp_path):
    """In a note, and in metadata.json; a dataset that has all but what its verdicts exclude has no such note."""
    path = made_dataset(tmp_path / "set")
    known = {"key": "", "per_shard": 2, "version": "0.1"}
    rows = [
        replace(Row.failed(n, split), verdict="stable", accepted=1, file=f"shards/{n % 2:05d}.h5")
        for n, split in enumerate(SPLITS)
    ]
    rows.append(replace(Row.failed(4, "train"), verdict="unstable"))
    for count, part, lost, lack in (
        (5, [1, 1], [], ""),
        (8, [1, 1], [Row.failed(5, "test")], "4 of 8 trajectories included, 2 not computed, 1 failed"),
        (10, [1, 2], [], "4 of 6 trajectories included, 1 not computed, this is part 1 of 2 of the sweep"),
    ):
        (path / MANIFEST).unlink(missing_ok=True)
        manifest = Manifest(path)
        manifest.create(known | {"count": count, "part": part})
        manifest.put(rows + lost)
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        notes = exported(path, "npz", tmp_path / "out")["notes"]
        assert [note for note in notes if "complete" in note] == [f"The dataset is not complete: {lack}."] * bool(lack)
        told = metadata_of(tmp_path / "out")["dataset"]
        assert (told["part"], told["accepted"], told["done"]) == (part, 4, 5 + len(lost))
    manifest.put([replace(rows[0], number=6)])
    refused = run_here("export", path, "--to", "npz", "-o", tmp_path / "other")
    assert refused.status == 2 and "lacks 1 trajectory of its manifest, 000006 among them" in refused.stderr
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("most", [1, 10, 30, 990])
def test_small_bodies_do_not_come_before_a_large_one(most: int) -> None:
    """Each body, and all small ones together, have their share to less than one."""
    sizes = np.array([1] * 20 + [5] * 6 + [150, 800])
    body = np.random.default_rng(0).permutation(np.repeat(np.arange(len(sizes)), sizes))
    chosen = chosen_particles(body, most, 0)
    assert len(set(chosen)) == most and (np.diff(chosen) > 0).all()
    found = np.bincount(body[chosen], minlength=len(sizes))
    share = most * sizes / sizes.sum()
    assert np.abs(found - share).max() < 1
    assert abs(found[:20].sum() - share[:20].sum()) < 1

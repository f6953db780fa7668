"""The audit of exports: sound ones have no finding, and each of two dozen planted faults is found by its rule."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from command import ROOT, run_here
from made_dataset import made_trajectory, write_dataset

from mpmcli.dataset.audit import audit
from mpmcli.dataset.formats.npz import write_npz

# A block at rest on the floor, and one that flies; frames are DT apart, particles DX, cells twice as far.
DT, DX, GRAVITY, FRAMES = 0.004, 0.025, np.array([0.0, -9.81]), 11
SPLITS = ("train",) * 4 + ("valid", "test")
LATTICE = DX * (np.indices((4, 4)).reshape(2, -1).T + 0.5)
EXPORTS = {
    "gns": ["--to", "gns", "--walls", "all"],
    "lagrangebench": ["--to", "lagrangebench", "--walls", "all"],
    "neuralmpm": ["--to", "neuralmpm", "--walls", "all"],
    "npz": ["--to", "npz", "--walls", "all"],
    "webdataset": ["--to", "webdataset"],
}
RULES = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/datasets.md").read_text().partition("## Auditing")[2], re.MULTILINE)


def flight(number: int) -> Any:
    """Return a trajectory of the two blocks."""
    made = made_trajectory(number, particles=32, split=SPLITS[number], pause=DT)
    rng, t = np.random.default_rng(number), DT * np.arange(FRAMES)[:, None, None]
    start, speed = rng.uniform([0.3, 0.6], [0.4, 0.7]), rng.uniform([2.0, -0.5], [2.5, 0.5])
    flying = start + LATTICE + speed * t + GRAVITY * t**2 / 2
    rest = np.broadcast_to(LATTICE + np.array([0.4, 0.0]), flying.shape)
    velocity = np.broadcast_to(speed + GRAVITY * t, flying.shape)
    made.header["scene"] = made.header["scene"].replace("gravity = [-1.0, -1.0]", "gravity = [0.0, -9.81]")
    return replace(
        made,
        position=np.concatenate([rest, flying], axis=1).astype(np.float32),
        velocity=np.concatenate([0 * velocity, velocity], axis=1).astype(np.float32),
        body=np.repeat([0, 1], 16).astype(np.int32),
        material=np.repeat([0, 1], 16).astype(np.int32),
    )


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory of sound exports, and of one of somebody else, without the facts that mpmcli adds."""
    place = tmp_path_factory.mktemp("audit")
    dataset = write_dataset(place / "set", [flight(k) for k in range(len(SPLITS))])
    for name, options in EXPORTS.items():
        outcome = run_here("export", dataset, *options, "-o", place / name)
        assert outcome.status == 0, outcome.stderr
    exported_by_others(place / "gns", place / "stranger")
    return place


def exported_by_others(source: Path, target: Path) -> None:
    """Write a GNS export as its authors do: one type, a flat list of facts."""
    target.mkdir()
    for split in ("train", "valid", "test"):
        change_gns(source / f"{split}.npz", lambda x, kind, k: (x[:, 16:32], 6), target / f"{split}.npz")
    facts = json.loads((source / "metadata.json").read_text())
    kept = {key: facts[key] for key in ("bounds", "dim", "dt", "default_connectivity_radius")}
    (target / "metadata.json").write_text(json.dumps(kept | {"sequence_length": FRAMES, "gravity": GRAVITY.tolist()}))


Entry = tuple[np.ndarray, Any]


def change_gns(path: Path, change: Callable[[np.ndarray, Any, int], Entry], target: Path | None = None) -> None:
    """Change positions and types of each trajectory, with its place in the file."""
    with np.load(path, allow_pickle=True) as file:
        found = {name: change(entry[0], entry[1], k) for k, (name, entry) in enumerate(file.items())}
    entries = {name: np.empty(2, object) for name in found}
    for name, entry in found.items():
        entries[name][:] = entry
    write_npz(target or path, entries.items())


def gns(change: Callable[[np.ndarray, int], np.ndarray]) -> Callable[[Path], None]:
    """Return a plant in the positions of the training split."""
    return lambda path: change_gns(path / "train.npz", lambda x, kind, k: (change(x.copy(), k), kind))


def facts(**changes: Callable[[Any], Any]) -> Callable[[Path], None]:
    """Return a plant in entries of metadata.json."""

    def plant(path: Path) -> None:
        found = json.loads((path / "metadata.json").read_text())
        found |= {key: change(found[key]) for key, change in changes.items()}
        (path / "metadata.json").write_text(json.dumps(found))

    return plant


def first_of(split: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Return a plant: the first trajectory of a split becomes the second of the training split, changed."""

    def plant(path: Path) -> None:
        taken: list[np.ndarray] = []
        change_gns(path / f"{split}.npz", lambda x, kind, k: (taken.append(x), (x, kind))[1])
        change_gns(path / "train.npz", lambda x, kind, k: (change(taken[0].copy()) if k == 1 else x, kind))

    return plant


def set_at(index: tuple, value: Any) -> Callable[[np.ndarray, int], np.ndarray]:
    """Return a change of the second trajectory: `value` at an index, or added to what is there if it is callable."""

    def change(x: np.ndarray, k: int) -> np.ndarray:
        if k == 1:
            x[index] = value(x[index]) if callable(value) else value
        return x

    return change


def another_gravity(x: np.ndarray, k: int) -> np.ndarray:
    """Fall with 95 % of gravity in three trajectories."""
    if k < 3:
        x[:, 16:32] -= (0.05 * GRAVITY * (DT * np.arange(FRAMES)[:, None, None]) ** 2 / 2).astype(np.float32)
    return x


def centimetres(x: np.ndarray, k: int) -> np.ndarray:
    return 100 * x


def mirrored(x: np.ndarray) -> np.ndarray:
    x[..., 0] = 1 - x[..., 0]
    return x


def with_noise(x: np.ndarray) -> np.ndarray:
    return x + np.random.default_rng(0).normal(0, 1e-5, x.shape).astype(np.float32)


def change_npz(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Return a plant in an array of a file of NumPy."""

    def plant(path: Path) -> None:
        with np.load(path / "000001.npz") as file:
            arrays = dict(file)
        np.savez(path / "000001.npz", **arrays | {name: change(arrays[name])})

    return plant


def change_h5(file: str, name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Return a plant in an array of a file of HDF5."""

    def plant(path: Path) -> None:
        with h5py.File(path / file, "r+") as opened:
            array = change(opened[name][:])
            del opened[name]
            opened[name] = array

    return plant


def kicked(x: np.ndarray) -> np.ndarray:
    """Move what flies by 1 % of a spacing more per frame from frame 5 on, as an impulse would."""
    x[5:, -16:] += (0.01 * DX * np.arange(1, FRAMES - 4)[:, None, None]).astype(np.float32)
    return x


def other_stride(path: Path) -> None:
    """State the statistics of every second frame."""
    facts(**{k: lambda v: [2 * each for each in v] for k in ("vel_mean", "vel_std")})(path)


ALL = slice(None)
PLANTS: dict[str, tuple[str, str, Callable[[Path], None]]] = {
    "dt of 2 % more, beside velocities": ("npz", "dt", facts(dt=lambda v: 1.02 * v, t_end=lambda v: 1.02 * v)),
    "dt of 2 % more, without": ("stranger", "gravity", facts(dt=lambda v: 1.02 * v)),
    "dt and t_end differ": ("lagrangebench", "dt", facts(dt=lambda v: 0.98 * v)),
    "another gravity in three trajectories": ("gns", "gravity", gns(another_gravity)),
    "axes swapped": ("stranger", "gravity", gns(lambda x, k: x[..., ::-1])),
    "a frame repeated": ("gns", "frames", gns(lambda x, k: x[[0, 1, 2, 3, 3, 5, 6, 7, 8, 9, 10]])),
    "float16": ("lagrangebench", "precision", change_h5("train.h5", "00000/position", lambda x: np.float16(x) + 0.0)),
    "four decimals": ("stranger", "precision", gns(lambda x, k: np.round(x, 4))),
    "a test trajectory in train": ("gns", "leakage", first_of("test", lambda x: x)),
    "a mirrored duplicate in test": ("stranger", "leakage", first_of("test", mirrored)),
    "a mirrored duplicate in train": ("gns", "duplicates", first_of("train", mirrored)),
    "a duplicate with noise, in another order": (
        "stranger",
        "duplicates",
        first_of("train", lambda x: with_noise(x)[:, ::-1]),
    ),
    "statistics of another stride": ("lagrangebench", "statistics", other_stride),
    "statistics in m/s": ("neuralmpm", "statistics", facts(acc_std=lambda v: [each / DT for each in v])),
    "types shifted by one": ("lagrangebench", "types", change_h5("train.h5", "00000/particle_type", lambda k: k + 1)),
    "numbers of laws from 1 on": ("npz", "types", change_npz("material", lambda k: k + 1)),
    "types of fewer particles": (
        "stranger",
        "types",
        lambda path: change_gns(path / "train.npz", lambda x, k, _: (x, np.full(15, 6))),
    ),
    "walls off by a cell": (
        "neuralmpm",
        "walls",
        change_h5("train/sim_0.h5", "boundary", lambda x: x + np.float32(2 * DX)),
    ),
    "walls off by a cell, npz": ("npz", "walls", change_npz("wall_position", lambda x: x * np.float32(0.95))),
    "bounds off by two cells": ("stranger", "bounds", facts(bounds=lambda v: [[0.4, 1.4], v[1]])),
    "centimetres": ("stranger", "units", gns(centimetres)),
    "centimetres, beyond bounds": ("gns", "bounds", gns(centimetres)),
    "millimetres": ("neuralmpm", "units", facts(dx=lambda v: 1000 * v)),
    "no number": ("gns", "finite", gns(set_at((4, 20), np.nan))),
    "a teleport": ("gns", "jumps", gns(set_at((slice(6, None), 20), lambda x: x + 0.2))),
    "a frame of one particle": (
        "lagrangebench",
        "jumps",
        change_h5("valid.h5", "00000/position", lambda x: set_at((5, 3), 0.3)(x, 1)),
    ),
    "frames left out": ("gns", "counts", gns(lambda x, k: x[:8] if k == 1 else x)),
    "a kick": ("stranger", "momentum", gns(lambda x, k: kicked(x) if k == 2 else x)),
    "a kick, npz": ("npz", "momentum", change_npz("position", kicked)),
    "velocities of other frames": ("npz", "dt", change_npz("velocity", lambda u: u[1:])),
    "a trajectory lost": ("npz", "splits", lambda path: (path / "000001.npz").unlink()),
}


@pytest.mark.parametrize("name", [*EXPORTS, "stranger"])
def test_a_sound_export_has_no_finding(sound: Path, name: str) -> None:
    outcome = run_here("dataset", "audit", sound / name, "--json")
    answer = json.loads(outcome.stdout)
    assert outcome.status == 0 and answer["ok"] and answer["trajectories"] == len(SPLITS), outcome.stdout
    verdicts = {rule: entry["verdict"] for rule, entry in answer["rules"].items()}
    assert list(verdicts) == RULES and {*verdicts.values()} <= {"ok", "skipped"}
    assert verdicts["gravity"] == "ok"
    if name == "npz":
        assert "skipped" not in verdicts.values()
    for entry in answer["rules"].values():
        assert (entry["verdict"] == "skipped") == (entry["applied"] == 0) <= bool(entry["skipped"])


@pytest.mark.parametrize("name", PLANTS)
def test_a_planted_fault_is_found_by_its_rule(sound: Path, tmp_path: Path, name: str) -> None:
    form, rule, plant = PLANTS[name]
    shutil.copytree(sound / form, tmp_path / "export")
    plant(tmp_path / "export")
    outcome = run_here("dataset", "audit", tmp_path / "export", "--json")
    answer = json.loads(outcome.stdout)
    assert outcome.status == 1 and answer["rules"][rule]["verdict"] == "finding", outcome.stdout
    for finding in answer["rules"][rule]["findings"]:
        assert finding["sentence"].endswith(".")


def test_a_text_names_trajectory_and_frame(sound: Path, tmp_path: Path) -> None:
    shutil.copytree(sound / "gns", tmp_path / "export")
    PLANTS["no number"][2](tmp_path / "export")
    outcome = run_here("dataset", "audit", tmp_path / "export")
    assert outcome.status == 1
    assert "  train.npz/trajectory_000001, frame 4: 1 positions are not finite, at most 1 here.\n" in outcome.stdout


def test_what_is_no_export_is_refused_in_a_sentence(sound: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    shutil.copytree(sound / "stranger", tmp_path / "code")
    np.savez(tmp_path / "code" / "train.npz", data=np.array([Path("/")], object), allow_pickle=True)
    (tmp_path / "bare").mkdir()
    (tmp_path / "bare" / "metadata.json").write_text("{}")
    for name, why in (
        ("empty", "cannot be read"),
        ("nowhere", "cannot be read"),
        ("bare", "holds no"),
        ("code", "no array"),
    ):
        outcome = run_here("dataset", "audit", tmp_path / name)
        assert outcome.status == 2 and outcome.stdout == "" and why in outcome.stderr
        assert len(outcome.stderr.splitlines()) == 1


@pytest.mark.parametrize("tuples", [False, True])
def test_the_other_layout_of_gns_is_read(sound: Path, tmp_path: Path, tuples: bool) -> None:
    shutil.copytree(sound / "stranger", tmp_path / "export")
    with np.load(tmp_path / "export" / "train.npz", allow_pickle=True) as file:
        rows = [tuple(entry) if tuples else entry for entry in file.values()]
    entries = np.empty(len(rows), object)
    for k, row in enumerate(rows):
        entries[k] = row
    np.savez(tmp_path / "export" / "train.npz", gns_data=entries)
    found = audit(tmp_path / "export")
    assert found.findings == 0 and len(found.seen) == len(SPLITS)


OTHERS = {"zarr": "zarr", "tfrecord": "tfrecord", "parquet": "pyarrow", "usd": "pxr"} | dict.fromkeys(
    ("vtkhdf", "vtk", "ply"), "meshio"
)


@pytest.mark.parametrize("form", OTHERS)
def test_all_other_formats_are_read(sound: Path, tmp_path: Path, form: str) -> None:
    pytest.importorskip(OTHERS[form])
    assert run_here("export", sound / "set", "--to", form, "-o", tmp_path / form).status == 0
    found = audit(tmp_path / form)
    assert found.findings == 0 and len(found.seen) == len(SPLITS)
    assert found.rules["gravity"]["applied"] == found.rules["dt"]["applied"] == len(SPLITS)
    assert found.rules["types"]["verdict"] == "ok"


@pytest.mark.parametrize("form", ["vtkhdf", "vtk", "ply"])
def test_a_damaged_file_has_a_sentence(sound: Path, tmp_path: Path, form: str) -> None:
    """The first 200 bytes of each frame, or of each trajectory."""
    assert run_here("export", sound / "set", "--to", form, "-o", tmp_path / form).status == 0
    for path in tmp_path.glob(f"{form}/*.*"):
        if path.suffix in (".vtkhdf", ".vtu", ".ply"):
            path.write_bytes(path.read_bytes()[:200])
    outcome = run_here("dataset", "audit", tmp_path / form)
    assert outcome.status == 2 and outcome.stdout == "" and "cannot be read" in outcome.stderr
    assert len(outcome.stderr.splitlines()) == 1

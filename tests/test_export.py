"""Exports are read by readers written from the descriptions of the formats, which know nothing of mpmcli."""

import io
import json
import os
import pickletools
import re
import shutil
import sys
import tarfile
import tomllib
import zipfile
from collections import namedtuple
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
import pyvista
import trimesh
from command import ROOT, run_here
from made_dataset import COUNTS, PAUSE, SPLITS, made_dataset, made_header, made_trajectory, write_dataset
from made_result import write_made
from test_dataset_statistics import agree, plain

import mpmcli.dataset
from mpmcli.dataset.folder import MANIFEST, Manifest, Row
from mpmcli.dataset.formats import FORMATS, format_named
from mpmcli.dataset.shard import TrajectoryData
from mpmcli.dataset.subsample import chosen_particles, joined_row
from mpmcli.materials.registry import laws as registered
from mpmcli.materials.registry import parameter_models
from mpmcli.output import open_result
from mpmcli.output.header import RunHeader
from mpmcli.scene import parse_scene, scene_to_toml

FORMS = [
    pytest.param(form, marks=pytest.mark.skipif(find_spec(package or "numpy") is None, reason=f"{package} is absent"))
    for form, package in ((form, format_named(form).package) for form in FORMATS)
]
FRAMES, INPUTS = 11, 6


class LagrangeBenchReader:
    """What LagrangeBench's H5Dataset does: windows of inputs and one target to train, whole chunks to validate."""

    def __init__(self, directory: Path, split: str, extra: int = 0) -> None:
        self.metadata = json.loads((directory / "metadata.json").read_text())
        self.split, self.path = split, directory / f"{split}.h5"
        with h5py.File(self.path) as file:
            self.keys = list(file)
            self.length = file["00000/position"].shape[0]
        self.window = INPUTS + extra + (1 if split == "train" else 0)
        self.per_trajectory = self.length - self.window + 1 if split == "train" else self.length // self.window

    def __len__(self) -> int:
        return self.per_trajectory * len(self.keys)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        k, place = divmod(index, self.per_trajectory)
        first = place if self.split == "train" else place * self.window
        with h5py.File(self.path) as file:
            group = file[self.keys[k]]
            position = group["position"][first : first + self.window].transpose(1, 0, 2)
            kind = group["particle_type"][:]
        padding = self.metadata["num_particles_max"] - len(position)
        position = np.pad(position, ((0, padding), (0, 0), (0, 0)))
        return position, np.pad(kind, (0, padding), constant_values=-1)


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


@pytest.mark.parametrize("dimension", [2, 3])
def test_lagrangebench_reads_windows_and_chunks(tmp_path, dimension):
    path = made_dataset(tmp_path / "set", dimension=dimension)
    exported(path, "lagrangebench", tmp_path / "out")
    reader = LagrangeBenchReader(tmp_path / "out", "train")
    assert reader.keys == ["00000", "00001"] and len(reader) == 2 * (FRAMES - INPUTS)
    sample, kind = reader[6]
    assert sample.shape == (max(COUNTS), INPUTS + 1, dimension) and sample.dtype == np.float32
    written = positions(path, "train")[1]
    np.testing.assert_array_equal(sample[: COUNTS[1]], written[1 : 1 + INPUTS + 1].transpose(1, 0, 2))
    # Fluid is 0; the other law has a type that NodeType leaves free.
    body = mpmcli.dataset.open(path)[1].body
    np.testing.assert_array_equal(kind[: COUNTS[1]], np.where(body == 0, 0, 4))
    assert (kind[COUNTS[1] :] == -1).all()
    for split in ("valid", "test"):
        chunk, _ = LagrangeBenchReader(tmp_path / "out", split, extra=2)[0]
        assert chunk.shape == (max(COUNTS), INPUTS + 2, dimension)


def cells_of(positions: np.ndarray, box: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """The cell of each particle as jax_md's cell_list finds it, in float32, and the cells along each axis."""
    per_side = np.floor(box / radius)
    return (positions / (box / per_side).astype(np.float32)).astype(int), per_side.astype(int)


def neighbours_of(positions: np.ndarray, metadata: dict) -> set[tuple[int, int]]:
    """Pairs as LagrangeBench finds them: within a radius, in adjacent cells, across faces on all axes or on none."""
    box = np.diff(metadata["bounds"])[:, 0]
    radius = metadata["default_connectivity_radius"]
    cells, per_side = cells_of(positions, box, radius)
    apart = positions[:, None].astype(float) - positions[None]
    if any(metadata["periodic_boundary_conditions"]):
        apart = (apart + box / 2) % box - box / 2
    steps = (cells[:, None] - cells[None] + 1) % per_side
    found = (np.linalg.norm(apart, axis=-1) < radius) & (steps <= 2).all(axis=-1)
    inside = ((cells >= 0) & (cells < per_side)).all(axis=-1)
    return {(i, j) for i, j in np.argwhere(found) if inside[i] and inside[j]}


def true_neighbours(positions: np.ndarray, radius: float, periodic: str) -> set[tuple[int, int]]:
    apart = positions[:, None].astype(float) - positions[None]
    for axis in map("xyz".index, periodic):
        apart[..., axis] -= np.round(apart[..., axis])
    return {(i, j) for i, j in np.argwhere(np.linalg.norm(apart, axis=-1) < radius)}


@pytest.mark.parametrize("periodic", ["", "x", "y", "xy"])
def test_lagrangebench_finds_the_neighbours_wherever_the_domain_lies(tmp_path, periodic):
    made = made_trajectory(0, particles=400, origin=-3.7, periodic=periodic, dtype=np.float64)
    rng = np.random.default_rng(3)
    # All over the domain, on its corners and faces too.
    places = rng.choice([0.0, 1.0, *rng.random(9)], (400, 2)) + rng.uniform(-0.02, 0.02, (400, 2))
    made.position[:] = np.clip(places, 0.0, 1.0) - 3.7
    exported(write_dataset(tmp_path / "set", [made]), "lagrangebench", tmp_path / "out")
    metadata = metadata_of(tmp_path / "out")
    assert metadata["origin"] == [-3.7, -3.7]
    with h5py.File(tmp_path / "out" / "train.h5") as file:
        written = file["00000/position"][0]
    away = written - 3.7 - made.position[0]
    away -= np.round(away) * ["x" in periodic, "y" in periodic]
    assert np.abs(away).max() < 3e-6
    radius = metadata["default_connectivity_radius"]
    expected = true_neighbours(made.position[0], radius, periodic)
    fewest = true_neighbours(made.position[0], radius - 1e-5, periodic)
    assert len(expected) > 2000 and fewest == expected, "an example in which no rounding decides"
    assert neighbours_of(written, metadata) == expected


def test_lagrangebench_bounds_hold_what_reaches_out(tmp_path):
    box = made_trajectory(0, origin=2.0)
    exported(write_dataset(tmp_path / "set", [box]), "lagrangebench", tmp_path / "out", "--walls", "all")
    metadata = metadata_of(tmp_path / "out")
    assert metadata["bounds"] == [[0.0, 1.0], [0.0, 1.0]]
    with h5py.File(tmp_path / "out" / "train.h5") as file:
        written = file["00000/position"][:]
    cells, per_side = cells_of(written, np.ones(2), metadata["default_connectivity_radius"])
    assert written.max() > 1 - 2e-6 and (cells < per_side).all() and (cells >= 0).all()


def test_fast_particles_of_periodic_domains(tmp_path):
    """At 12 m/s and 10 ms a particle goes 0.12 of the domain: four frames are 0.48, five are more than a half."""
    made = [made_trajectory(0, speed=12.0, periodic="x", frames=31)]
    path = write_dataset(tmp_path / "set", made)
    # Drawn drifts are at most 0.5 m/s, pulls at most 0.5 m/s^2.
    for stride, speed in ((1, 12.0), (3, 36.0)):
        exported(path, "lagrangebench", tmp_path / "out", "--stride", stride, "--overwrite")
        assert metadata_of(tmp_path / "out")["vel_mean"][0] == pytest.approx(speed * PAUSE, rel=0.05)
    message = refused(path, "lagrangebench", tmp_path / "other", "--stride", "5")
    assert "half of the periodic domain" in message and "--stride" in message
    answer = exported(path, "npz", tmp_path / "out", "--stride", "5", "--overwrite")
    assert any("no statistics" in note for note in answer["notes"])
    assert "vel_mean" not in metadata_of(tmp_path / "out")
    # Whole periods between stored frames: positions alone look as if nothing moved.
    blur = write_dataset(tmp_path / "blur", [made_trajectory(0, speed=100.0, periodic="x")])
    outcome = run_here("export", blur, "--to", "lagrangebench", "-o", tmp_path / "more")
    assert outcome.status == 2 and "half of the periodic domain" in outcome.stderr


def test_gns_takes_no_periodic_domain(tmp_path):
    path = write_dataset(tmp_path / "set", [made_trajectory(0, periodic="y")])
    assert "periodic faces, which GNS does not support" in refused(path, "gns", tmp_path / "out")


def test_periodic_domains_that_differ_are_refused(tmp_path):
    made = [made_trajectory(0, periodic="x"), made_trajectory(1)]
    message = refused(write_dataset(tmp_path / "set", made), "lagrangebench", tmp_path / "out")
    assert "differ in their domain or its periodic faces" in message


def test_one_time_between_frames_or_none(tmp_path):
    made = [made_trajectory(0), made_trajectory(1, pause=2 * PAUSE)]
    path = write_dataset(tmp_path / "set", made)
    exported(path, "npz", tmp_path / "out")
    assert metadata_of(tmp_path / "out")["dt"] is None
    exported(path, "npz", tmp_path / "out", "--trajectory", 1, "--overwrite")
    assert metadata_of(tmp_path / "out")["dt"] == pytest.approx(2 * PAUSE)


def test_gns_loads_laws_that_differ(tmp_path):
    """The type tells laws apart: a feature that each law has its own value of is none."""
    path = made_dataset(tmp_path / "set", density=1500.0)
    exported(path, "gns", tmp_path / "out")
    assert metadata_of(tmp_path / "out")["material_feature_names"] == []
    (_, _, n), _ = GnsReader(tmp_path / "out" / "train.npz")[0]
    assert n == COUNTS[0]


@pytest.mark.parametrize("form", ["lagrangebench", "gns"])
@pytest.mark.parametrize("stride", [1, 3])
def test_metadata_of_learners(tmp_path, form, stride):
    path = made_dataset(tmp_path / "set", dimension=2)
    exported(path, form, tmp_path / "out", "--stride", stride)
    metadata = metadata_of(tmp_path / "out")
    frames = len(range(0, FRAMES, stride))
    if form == "gns":
        assert metadata["sequence_length"] == frames
        # 5 velocities, distances to 4 walls, 16 numbers of the type.
        assert (metadata["nnode_in"], metadata["nedge_in"], metadata["material_feature_len"]) == (30, 3, 0)
        assert metadata["particle_types"] == {"fluid": 5, "sand": 6}
    else:
        assert metadata["sequence_length_train"] == metadata["sequence_length_test"] == frames - 1
        assert metadata["periodic_boundary_conditions"] == [False] * 3
        assert metadata["particle_types"] == {"fluid": 0, "sand": 4}
    assert metadata["bounds"] == [[0.0, 1.0], [0.0, 1.0]] and metadata["dim"] == 2
    assert metadata["dt"] * metadata["write_every"] == pytest.approx(PAUSE * stride, rel=1e-12)
    # Four particles in a cell of 0.05 m are 0.025 m apart.
    assert (metadata["cell_size"], metadata["dx"]) == (0.05, 0.025)
    assert metadata["default_connectivity_radius"] == pytest.approx(1.5 * 0.025)
    assert metadata["num_particles_max"] == max(COUNTS) and metadata["num_frames"] == frames
    assert [metadata[f"num_trajs_{split}"] for split in ("train", "valid", "test")] == [2, 1, 1]
    assert metadata["trajectories"] == {"train": [0, 1], "valid": [2], "test": [3]}
    found = {name: np.array(metadata[name]) for name in ("vel_mean", "vel_std", "acc_mean", "acc_std")}
    agree(found, plain(positions(path, "train", stride)))


@pytest.mark.parametrize("dimension", [2, 3])
def test_gns_reads_samples_of_equal_materials(tmp_path, dimension):
    path = made_dataset(tmp_path / "set", dimension=dimension)
    exported(path, "gns", tmp_path / "out")
    reader = GnsReader(tmp_path / "out" / "train.npz")
    assert len(reader) == 2 * (FRAMES - INPUTS) and not reader.with_property
    (sample, kind, n), label = reader[FRAMES - INPUTS + 1]
    written = positions(path, "train")[1]
    assert n == COUNTS[1] and sample.dtype == np.float32 and sample.shape == (n, INPUTS, dimension)
    np.testing.assert_array_equal(sample, written[1 : 1 + INPUTS].transpose(1, 0, 2))
    np.testing.assert_array_equal(label, written[1 + INPUTS])
    np.testing.assert_array_equal(kind, np.where(mpmcli.dataset.open(path)[1].body == 0, 5, 6))


def test_gns_has_one_property_where_one_parameter_differs(tmp_path):
    made = [made_trajectory(k, viscosity=0.5 * k, split=split) for k, split in enumerate(SPLITS)]
    exported(write_dataset(tmp_path / "set", made), "gns", tmp_path / "out")
    metadata = metadata_of(tmp_path / "out")
    assert metadata["material_feature_names"] == ["viscosity"] and metadata["nnode_in"] == 31
    assert (metadata["material_feature_min"], metadata["material_feature_max"]) == ([0.0], [1.5])
    (_, _, properties, n), _ = GnsReader(tmp_path / "out" / "train.npz")[FRAMES - INPUTS]
    assert properties.shape == (n,)
    # Sand has no viscosity.
    np.testing.assert_array_equal(properties, np.where(made[1].body == 0, 0.5, 0.0))


def test_gns_has_several_properties_where_several_parameters_differ(tmp_path):
    made = [made_trajectory(k, viscosity=0.5 * k, density=1500.0 + k) for k in range(2)]
    path = write_dataset(tmp_path / "set", made)
    assert "density and viscosity differ" in refused(path, "gns", tmp_path / "out")
    assert '"cohesion" does not differ' in refused(path, "gns", tmp_path / "out", "--features", "cohesion")
    assert "--features is for --to gns" in refused(path, "npz", tmp_path / "out", "--features", "none")
    answer = exported(path, "gns", tmp_path / "out", "--features", "density,viscosity")
    assert metadata_of(tmp_path / "out")["material_feature_names"] == ["density", "viscosity"]
    assert any("np.full" in note for note in answer["notes"])
    (_, _, properties, _), _ = GnsReader(tmp_path / "out" / "train.npz")[FRAMES - INPUTS]
    expected = np.array([[1000.0, 0.5], [1501.0, 0.0]])
    np.testing.assert_array_equal(properties, expected[made[1].body])
    exported(path, "gns", tmp_path / "out", "--features", "viscosity", "--overwrite")
    (_, _, properties, _), _ = GnsReader(tmp_path / "out" / "train.npz")[FRAMES - INPUTS]
    np.testing.assert_array_equal(properties, expected[made[1].body, 1])
    exported(path, "gns", tmp_path / "out", "--features", "none", "--overwrite")
    assert not GnsReader(tmp_path / "out" / "train.npz").with_property


def test_a_modulus_that_mpmcli_chose_is_no_property(tmp_path):
    """It depends on the scene, here on the speed; one that the scene states is a property."""
    headers = []
    for speed, modulus in ((1.0, "auto"), (2.0, "auto"), (1.0, 2e6), (1.0, 3e6)):
        data = tomllib.loads(
            made_header()["scene"].replace('law = "fluid"', f'law = "fluid", bulk_modulus = "{modulus}"')
        )
        data["bodies"][0] |= {"velocity": [speed, 0.0]}
        data["bodies"][1]["shape"]["box"] = {"min": [0.6, 0.6], "max": [0.8, 0.8]}
        data["bodies"][0]["material"]["bulk_modulus"] = modulus
        scene = parse_scene(data, laws=parameter_models()).scene
        laws = [registered()[name] for name in ("fluid", "sand")]
        headers.append(RunHeader.of(scene, scene_to_toml(scene), laws, made_header()["backend"]).stored)
    for name, some, expected in (
        ("auto", headers[:2], False),
        ("stated", headers[2:], True),
        ("mixed", headers[1:3], False),
    ):
        made = [replace(made_trajectory(k), header=header) for k, header in enumerate(some)]
        (tmp_path / name).mkdir()
        exported(write_dataset(tmp_path / name / "set", made), "gns", tmp_path / name / "out")
        assert GnsReader(tmp_path / name / "out" / "train.npz").with_property == expected
        assert metadata_of(tmp_path / name / "out")["material_feature_names"] == ["bulk_modulus"] * expected


def test_numpy_before_its_core_was_renamed_reads_a_gns_export(tmp_path):
    """Its pickles name nothing but `numpy.ndarray`, `numpy.dtype` and the codec of protocol 3."""
    exported(made_dataset(tmp_path / "set"), "gns", tmp_path / "out")
    with zipfile.ZipFile(tmp_path / "out" / "train.npz") as archive:
        for name in archive.namelist():
            pickled = archive.read(name).split(b"\n", 1)[1]
            found = {arg for code, arg, _ in pickletools.genops(pickled) if code.name == "GLOBAL"}
            assert found == {"numpy ndarray", "numpy dtype"}


@pytest.mark.parametrize("form", ["lagrangebench", "gns"])
def test_an_empty_split_is_left_out_and_said(tmp_path, form):
    path = write_dataset(tmp_path / "set", [made_trajectory(k, split="train") for k in range(2)])
    answer = exported(path, form, tmp_path / "out")
    end = "h5" if form == "lagrangebench" else "npz"
    assert answer["files"] == ["checksums.sha256", "metadata.json", f"train.{end}"]
    assert [note for note in answer["notes"] if f"valid.{end} is left out" in note]
    assert answer["trajectories"] == {"train": 2, "valid": 0, "test": 0}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_npz_holds_all_arrays_as_they_are(tmp_path, dtype):
    path = made_dataset(tmp_path / "set", dtype=dtype)
    exported(path, "npz", tmp_path / "out", "--stride", 2)
    source = mpmcli.dataset.open(path)[2]
    with np.load(tmp_path / "out" / "000002.npz", allow_pickle=False) as file:
        for name in ("position", "velocity", "pressure", "deformation_gradient"):
            np.testing.assert_array_equal(file[name], source.read(name, slice(None, None, 2)))
            assert file[name].dtype == dtype
        np.testing.assert_array_equal(file["body"], source.body)
        np.testing.assert_array_equal(file["material"], source.material)
        np.testing.assert_array_equal(file["time"], source.times[::2])
        np.testing.assert_array_equal(file["step"], source.steps[::2])
        assert file["frame"].tolist() == list(range(0, FRAMES, 2))
    metadata = metadata_of(tmp_path / "out")
    assert metadata["draws"]["000002"] == source.draws and metadata["laws"]["000002"] == ["fluid", "sand"]


@pytest.mark.parametrize("dimension", [2, 3])
def test_vtkhdf_of_a_result_has_the_bytes_that_simulate_packs(tmp_path, dimension):
    path = write_made(tmp_path / "run", dimension=dimension)
    exported(path, "vtkhdf", tmp_path / "out")
    assert (tmp_path / "out" / "000000.vtkhdf").read_bytes() == (path / "particles.vtkhdf").read_bytes()


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_vtu_of_each_frame_is_what_vtk_reads(tmp_path, dimension):
    """Of every second frame of a result: times, positions, velocities, and a field of each particle."""
    path = write_made(tmp_path / "run", dimension=dimension)
    exported(path, "vtk", tmp_path / "out", "--stride", 2)
    reader, result = pyvista.get_reader(tmp_path / "out" / "000000.pvd"), open_result(path)
    frames = list(result.frames())[::2]
    assert reader.time_values == pytest.approx([frame.time for frame in frames])
    for k, frame in enumerate(frames):
        reader.set_active_time_point(k)
        (points,) = reader.read()
        np.testing.assert_array_equal(points.points[:, :dimension], frame.position)
        np.testing.assert_array_equal(points["velocity"][:, :dimension], frame.velocity)
        np.testing.assert_array_equal(points["body"], frame.body)
        assert points["id"].tolist() == list(range(len(frame.position)))


@pytest.mark.parametrize(("dimension", "dtype"), [(2, np.float32), (3, np.float64)])
def test_a_ply_of_each_frame_is_what_others_read(tmp_path, dimension, dtype):
    """Positions by VTK, in single precision, and trimesh; every property, in its type, by meshio."""
    path = made_dataset(tmp_path / "set", dimension=dimension, dtype=dtype)
    exported(path, "ply", tmp_path / "out", "--trajectory", 0, "--stride", 2)
    source = mpmcli.dataset.open(path)[0]
    assert sorted(p.name for p in (tmp_path / "out").glob("*.ply")) == [f"000000_{k:06d}.ply" for k in range(0, 11, 2)]
    for k in range(0, FRAMES, 2):
        file = tmp_path / "out" / f"000000_{k:06d}.ply"
        position = np.zeros((30, 3), dtype)
        position[:, :dimension] = source.position[k]
        np.testing.assert_array_equal(pyvista.read(file).points, position.astype(np.float32))
        np.testing.assert_array_equal(trimesh.load(file).vertices, position)
        read = meshio.read(file)
        np.testing.assert_array_equal(read.points, position)
        known = {"id": np.arange(30), "body": source.body, "material": source.material}
        for name, expected in {**known, "pressure": source.field("pressure")[k]}.items():
            np.testing.assert_array_equal(read.point_data[name], expected)
        for axis, name in enumerate(("vx", "vy", "vz")[:dimension]):
            np.testing.assert_array_equal(read.point_data[name], source.velocity[k, :, axis])
            assert read.point_data[name].dtype == dtype
        gradient = np.stack([read.point_data[f"deformation_gradient_{n}"] for n in range(9)], axis=1).reshape(30, 3, 3)
        np.testing.assert_array_equal(gradient[:, :dimension, :dimension], source.field("deformation_gradient")[k])
        assert f"\ncomment time {float(source.times[k])!r} s\n".encode() in file.read_bytes()


@pytest.mark.parametrize("dimension", [2, 3])
def test_vtkhdf_of_a_dataset_opens_as_a_result(tmp_path, dimension):
    path = made_dataset(tmp_path / "set", dimension=dimension)
    answer = exported(path, "vtkhdf", tmp_path / "out", "--trajectory", 2)
    assert answer["files"] == ["000002.vtkhdf", "checksums.sha256", "metadata.json"]
    source, result = mpmcli.dataset.open(path)[2], open_result(tmp_path / "out" / "000002.vtkhdf")
    assert result.ledger == source.ledger and result.header.stored == source.header.stored
    assert result.field_names == source.field_names and result.times.tolist() == source.times.tolist()
    for k, frame in enumerate(result.frames()):
        np.testing.assert_array_equal(frame.position, source.position[k])
        np.testing.assert_array_equal(frame.velocity, source.velocity[k])
        np.testing.assert_array_equal(frame.body, source.body)
        np.testing.assert_array_equal(frame.fields["deformation_gradient"], source.field("deformation_gradient")[k])
        assert (frame.index, frame.step) == (k, source.steps[k])
    # And as a dataset again.
    np.testing.assert_array_equal(mpmcli.dataset.open(result.path)[0].position, source.position)


def test_an_unknown_format_is_told_the_nearest_one(tmp_path):
    message = refused(made_dataset(tmp_path / "set"), "parket", tmp_path / "out")
    assert 'there is no "parket"; did you mean "parquet"?' in message


def test_a_table_of_parquet_is_divided_and_has_arrays_where_shapes_agree(tmp_path, monkeypatch):
    """Files as large as allowed, in order; README.md gives fixed shapes to columns whose trajectories agree."""
    reader = pytest.importorskip("pyarrow.parquet")
    path = made_dataset(tmp_path / "set", dtype=np.float64)
    exported(path, "parquet", tmp_path / "out")
    card = (tmp_path / "out" / "README.md").read_text()
    assert '{"name": "position", "list": {"list": {"list": "float64"}}}' in card
    # The trajectories have 11 frames of 30 and 24 particles with 2 + 2 + 1 + 4 numbers, and 3 with --max-particles.
    monkeypatch.setattr("mpmcli.dataset.formats.arrays.FILE_BYTES", 11 * 3 * 9 * 8 + 1000)
    answer = exported(path, "parquet", tmp_path / "out", "--max-particles", 3, "--overwrite")
    files = [name for name in answer["files"] if name.startswith("train")]
    assert files == ["train-00000-of-00002.parquet", "train-00001-of-00002.parquet"]
    card = (tmp_path / "out" / "README.md").read_text()
    assert '{"name": "position", "dtype": {"array3_d": {"shape": [11, 3, 2], "dtype": "float64"}}}' in card
    source = mpmcli.dataset.open(path)
    for number, file in enumerate(files):
        (row,) = reader.read_table(tmp_path / "out" / file).to_pylist()
        chosen = chosen_particles(source[number].body, 3, number)
        assert row["number"] == number and json.loads(row["draws"]) == source[number].draws
        for name in ("position", "pressure", "deformation_gradient"):
            np.testing.assert_array_equal(row[name], source[number].read(name, particles=chosen))
        assert row["body"] == source[number].body[chosen].tolist() and row["time"] == source[number].times.tolist()


def test_a_column_of_parquet_has_one_type_and_null_where_an_array_is_absent(tmp_path, monkeypatch):
    reader = pytest.importorskip("pyarrow.parquet")
    made = [made_trajectory(0), made_trajectory(1)]
    del made[1].fields["pressure"]
    exported(write_dataset(tmp_path / "set", made), "parquet", tmp_path / "out")
    rows = reader.read_table(tmp_path / "out" / "train-00000-of-00001.parquet").to_pylist()
    assert rows[1]["pressure"] is None
    np.testing.assert_array_equal(rows[0]["pressure"], made[0].fields["pressure"])
    assert '{"name": "pressure", "list": {"list": "float32"}}' in (tmp_path / "out" / "README.md").read_text()
    shutil.rmtree(tmp_path / "out")
    path = write_dataset(tmp_path / "other", [made_trajectory(0), made_trajectory(1, dtype=np.float64)])
    assert "position has different types" in refused(path, "parquet", tmp_path / "out")
    monkeypatch.setattr("mpmcli.dataset.formats.parquet.LARGEST", 24 * FRAMES * 2 - 1)
    message = refused(path, "parquet", tmp_path / "out", "--trajectory", 0)
    assert "position of a trajectory has more than 2^31 numbers" in message and "--stride" in message


@pytest.mark.parametrize("form", [form for form in FORMATS if format_named(form).package])
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, form):
    known = format_named(form)
    monkeypatch.setitem(sys.modules, known.package, None)
    message = refused(made_dataset(tmp_path / "set"), form, tmp_path / "out")
    assert f'--to {form} needs {known.package}, which pip install "mpmcli[{known.extra}]" installs.' in message
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["optional-dependencies"][known.extra]


def test_ledgers_of_left_out_frames_are_joined(tmp_path):
    path = made_dataset(tmp_path / "set")
    exported(path, "vtkhdf", tmp_path / "out", "--stride", 4)
    rows, found = mpmcli.dataset.open(path)[0].ledger, open_result(tmp_path / "out" / "000000.vtkhdf").ledger
    assert len(found) == 3 and found[0] == rows[0]
    assert found[1].steps == sum(row.steps for row in rows[1:5]) and found[1].mass == rows[4].mass
    assert found[1].step_min == min(row.step_min for row in rows[1:5])
    assert found[1].step_max == max(row.step_max for row in rows[1:5])
    assert found[2] == joined_row(rows[5:9], rows[4].time)


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


def coming_and_going(tmp_path: Path) -> tuple[Path, TrajectoryData, np.ndarray]:
    """Return a dataset whose particles wait up to frame 4, a third, or are gone from frame 8 on; and its status."""
    made = made_trajectory(0, particles=30)
    status = np.ones((FRAMES, 30), np.int8)
    status[:5, :10], status[8:, 10:20] = 0, 2
    made.header["scene"] = made.header["scene"].replace("walls = {  }", 'walls = { default = "slip", x_max = "open" }')
    made = replace(made, fields=made.fields | {"status": status})
    return write_dataset(tmp_path / "set", [made]), made, status


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


def test_another_package_reads_tfrecords(tmp_path):
    """Positions and types of each trajectory of a split, and the length that the loader of DeepMind asks for."""
    path = made_dataset(tmp_path / "set", dimension=2)
    exported(path, "tfrecord", tmp_path / "out", "--walls", "all")
    dataset = mpmcli.dataset.open(path)
    assert metadata_of(tmp_path / "out")["sequence_length"] == FRAMES - 1
    for split, numbers in dataset.splits.items():
        # In one order, whatever the process.
        names = re.findall(rb"key|particle_type", (tmp_path / "out" / f"{split}.tfrecord").read_bytes())
        assert names == [b"key", b"particle_type"] * len(numbers)
        found = tfrecords(tmp_path / "out" / f"{split}.tfrecord", 2)
        assert len(found) == len(numbers)
        for (position, kinds), number in zip(found, numbers, strict=True):
            source, n = dataset[number], dataset[number].particle_count
            np.testing.assert_array_equal(position[:, :n], source.position.astype(np.float32))
            assert kinds[:n].tolist() == np.array([5, 6])[source.material].tolist() and (kinds[n:] == 3).all()
            assert len(kinds) == position.shape[1] > n


def parsed_by_neuralmpm(path: Path, dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions with velocities, and types, as NMPMParser of NeuralMPM makes them of a file."""
    with h5py.File(path) as file:
        particles, boundary = (file[name][()][..., :dimension] for name in ("particles", "boundary"))
        types = file["types"][()] if "types" in file and len(np.unique(file["types"])) > 1 else None
    whole = np.concatenate([boundary, particles], axis=1)
    types = np.ones(particles.shape[1]) if types is None else types
    if len(types) != whole.shape[1]:
        types = np.concatenate([np.zeros(boundary.shape[1]), types])
    return np.concatenate([whole[1:], np.diff(whole, axis=0)], axis=-1), types


@pytest.mark.parametrize("walls", ["none", "all"])
def test_neuralmpm_parses_each_trajectory(tmp_path, walls):
    """In the order of the numbers of a split, with the walls as its boundary."""
    path = made_dataset(tmp_path / "set", dimension=2)
    exported(path, "neuralmpm", tmp_path / "out", "--walls", walls)
    dataset, metadata = mpmcli.dataset.open(path), metadata_of(tmp_path / "out")
    assert (metadata["num_types"], metadata["sequence_length"]) == (3, FRAMES)
    for split, numbers in dataset.splits.items():
        for k, number in enumerate(numbers):
            state, types = parsed_by_neuralmpm(tmp_path / "out" / split / f"sim_{k}.h5", 2)
            own = types > 0
            source = dataset[number]
            assert own.sum() == source.particle_count and (not own.all()) == (walls == "all")
            np.testing.assert_array_equal(state[:, own, :2], source.position[1:].astype(np.float32))
            np.testing.assert_array_equal(types[own], 1 + source.material)
            still = state[:, ~own]
            assert not still[..., 2:].any() and np.isin(still[..., :2], (0.0, 1.0)).any(axis=-1).all()


def test_neuralmpm_gets_the_gravity_that_differs(tmp_path):
    made = [made_trajectory(k) for k in range(2)]
    made[1].header["scene"] = made[1].header["scene"].replace("gravity = [-1.0, -1.0]", "gravity = [0.0, -2.0]")
    exported(write_dataset(tmp_path / "set", made), "neuralmpm", tmp_path / "out")
    found = [h5py.File(tmp_path / "out" / "train" / f"sim_{k}.h5")["grav"][()].tolist() for k in range(2)]
    assert found == [[-1.0, -1.0], [0.0, -2.0]]


@pytest.mark.parametrize(("stride", "frames"), [(1, slice(None)), (5, slice(None, None, 5))])
def test_particles_that_are_always_there_go_to_every_learner(tmp_path, stride, frames):
    """GNS and LagrangeBench refuse the others, and name the option."""
    (path, made, status), out = coming_and_going(tmp_path), tmp_path / "out"
    for form in ("gns", "lagrangebench", "neuralmpm"):
        assert "--present always takes those" in refused(path, form, tmp_path / "out")
    there = np.flatnonzero((status[frames] == 1).all(axis=0))
    assert 0 < len(there) < 30
    told = exported(path, "gns", tmp_path / "out", "--present", "always", "--stride", stride)
    assert f"{30 - len(there)} particles that are not there in all frames are left out." in told["notes"]
    entry = np.load(tmp_path / "out" / "train.npz", allow_pickle=True)["trajectory_000000"]
    np.testing.assert_array_equal(entry[0], made.position[frames][:, there].astype(np.float32))
    exported(path, "npz", out, "--present", "always", "--stride", stride, "--max-particles", 6, "--overwrite")
    with np.load(out / "000000.npz") as file:
        assert (file["status"] == 1).all() and file["position"].shape[1] == 6
        assert set(file["position"][0, :, 0]) <= set(made.position[0, there, 0])


def test_points_of_ply_are_those_that_are_there(tmp_path):
    path, made, status = coming_and_going(tmp_path)
    exported(path, "ply", tmp_path / "out")
    for k in (0, 6, 9):
        cloud = pyvista.read(tmp_path / "out" / f"000000_{k:06d}.ply")
        np.testing.assert_array_equal(cloud.points[:, :2], made.position[k, status[k] == 1].astype(np.float32))


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


@pytest.mark.parametrize("form", ["lagrangebench", "gns"])
def test_trajectories_that_differ_are_no_set_for_learners(tmp_path, form):
    different = {
        "frames": write_dataset(tmp_path / "frames", [made_trajectory(0), made_trajectory(1, frames=9)]),
        "time": write_dataset(tmp_path / "time", [made_trajectory(0), made_trajectory(1, pause=0.02)]),
        "dimension": write_dataset(tmp_path / "dim", [made_trajectory(0), made_trajectory(1, dimension=3)]),
    }
    out = tmp_path / "out"
    assert "trajectory 1 has 9 frames and trajectory 0 11" in refused(different["frames"], form, out)
    assert "trajectory 1 has frames that are not 0.01 s apart" in refused(different["time"], form, out)
    assert "trajectory 1 is 3D" in refused(different["dimension"], form, out)
    # Each alone is one.
    assert run_here("export", different["frames"], "--to", form, "-o", out, "--trajectory", 1).status == 0


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


def test_a_law_keeps_its_type_whatever_the_others_are(tmp_path):
    """Nine types hold all laws of mpmcli and one more for GNS, and all but one for LagrangeBench."""
    for form, taken in (("gns", {3}), ("lagrangebench", {1, 2, 3})):
        learner = format_named(form)
        free = set(range(9)) - taken
        assert set(learner.usual.values()) <= free and set(learner.free) <= free
        assert len(set(learner.usual.values())) == len(learner.usual)
    for materials, types in {
        ("neo_hookean", "sand"): {"neo_hookean": 8, "sand": 4},
        ("fixed_corotated", "neo_hookean"): {"fixed_corotated": 8, "neo_hookean": 7},
    }.items():
        made = made_trajectory(0)
        header = {**made.header, "materials": list(materials)}
        path = write_dataset(tmp_path / "-".join(materials), [replace(made, header=header)])
        target = tmp_path / "out"
        run_here("export", path, "--to", "lagrangebench", "-o", target, "--overwrite")
        assert metadata_of(target)["particle_types"] == types


def test_too_many_laws_are_refused(tmp_path):
    made = made_trajectory(0)
    names = [f"law_{k}" for k in range(9)]
    header = {**made.header, "materials": names, "laws": [made.header["laws"][0]] * 9}
    path = write_dataset(tmp_path / "set", [replace(made, header=header)])
    assert "GNS has no particle type left for law_6" in refused(path, "gns", tmp_path / "out")
    assert "LagrangeBench has no particle type left for law_5" in refused(path, "lagrangebench", tmp_path / "out")


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

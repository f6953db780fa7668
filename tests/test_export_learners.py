"""Exports for training code are read by readers written from the descriptions of the formats."""

import json
import pickletools
import re
import tomllib
import zipfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import run_here
from exports import FRAMES, INPUTS, GnsReader, coming_and_going, exported, metadata_of, positions, refused, tfrecords
from made_dataset import COUNTS, PAUSE, SPLITS, made_dataset, made_header, made_trajectory, write_dataset
from test_dataset_statistics import agree, plain

import mpmcli.dataset
from mpmcli.dataset.formats import format_named
from mpmcli.materials.registry import laws as registered
from mpmcli.materials.registry import parameter_models
from mpmcli.output.header import RunHeader
from mpmcli.scene import parse_scene, scene_to_toml


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

"""Exports for NumPy, tables and viewers are read by packages that know nothing of mpmcli."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
import pyvista
import trimesh
from command import run_here
from drawn_results import WATER, header, row, write
from drawn_results import frame as drawn
from exports import FORMS, FRAMES, coming_and_going, exported, metadata_of, refused
from made_dataset import made_dataset, made_trajectory, write_dataset
from made_result import write_made

import mpmcli.dataset
from mpmcli.dataset.formats import format_named
from mpmcli.dataset.formats.training import TrainingFormat
from mpmcli.dataset.subsample import chosen_particles, joined_row
from mpmcli.output import SegmentStore, open_result


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


def test_ledgers_of_left_out_frames_are_joined(tmp_path):
    path = made_dataset(tmp_path / "set")
    exported(path, "vtkhdf", tmp_path / "out", "--stride", 4)
    rows, found = mpmcli.dataset.open(path)[0].ledger, open_result(tmp_path / "out" / "000000.vtkhdf").ledger
    assert len(found) == 3 and found[0] == rows[0]
    assert found[1].steps == sum(row.steps for row in rows[1:5]) and found[1].mass == rows[4].mass
    assert found[1].step_min == min(row.step_min for row in rows[1:5])
    assert found[1].step_max == max(row.step_max for row in rows[1:5])
    assert found[2] == joined_row(rows[5:9], rows[4].time)


def test_points_of_ply_are_those_that_are_there(tmp_path):
    path, made, status = coming_and_going(tmp_path)
    exported(path, "ply", tmp_path / "out")
    for k in (0, 6, 9):
        cloud = pyvista.read(tmp_path / "out" / f"000000_{k:06d}.ply")
        np.testing.assert_array_equal(cloud.points[:, :2], made.position[k, status[k] == 1].astype(np.float32))


LAWS = [{"deformation": "J", "coherent": False}]


def jets(directory: Path) -> list[Path]:
    """Return two results of a jet of which none is there at the start and at the end: with all, and those present.

    Particle k is there from frame k + 1 to k + 3. Frames are 0.05 s apart, and their times sums of steps.
    """
    facts, times = header((1.0, 1.0), 0.05, [WATER], laws=LAWS), np.cumsum([0.0, *[0.01] * 50])[::5]
    facts["scene"] = facts["scene"].replace("[domain]", '[domain]\nwalls = { default = "slip", x_max = "open" }')
    dropped = facts | {"scene": facts["scene"] + "[output]\ndrop_retired = true\n"}
    frames = []
    for k, time in enumerate(times.tolist()):
        age = k - 1 - np.arange(6)
        position = np.stack([0.1 * np.clip(age, 0, 2) + 0.1, 0.05 * np.arange(6) + 0.2], axis=1)
        status = np.where(age < 0, 0, np.where(age > 2, 2, 1)).astype(np.int8)
        made = drawn(k, position, velocity=(status == 1)[:, None] * [2.0, 0.0])
        frames.append(replace(made, time=time, fields={"status": status}))
    write(directory / "whole", facts, frames)
    write(directory / "present", dropped, [one.of_present for one in frames])
    return [directory / "whole", directory / "present"]


@pytest.mark.parametrize("form", ["npz", "ply", "vtk"])
def test_a_result_of_those_present_is_exported_as_a_whole_one(tmp_path, form):
    """To the same bytes; frames of which none is there have no vertices in PLY."""
    found = []
    for path in jets(tmp_path):
        outcome = run_here("export", path, "--to", form, "-o", tmp_path / "out" / path.name)
        assert outcome.status == 0, outcome.stderr
        files = (tmp_path / "out" / path.name).glob("000000*")
        found.append({file.name: file.read_bytes() for file in files})
    assert found[0] == found[1]
    if form == "ply":
        counts = [pyvista.read(tmp_path / "out" / "present" / f"000000_{k:06d}.ply").n_points for k in range(11)]
        assert counts == [0, 1, 2, 3, 3, 3, 3, 2, 1, 0, 0]


@pytest.mark.parametrize("stride", [1, 3])
def test_time_codes_of_usd_are_frames(tmp_path, stride):
    """Each has the particles of its frame, also where none is there, although times are no whole multiples of one."""
    usd, geom = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
    for path in jets(tmp_path):
        run_here("export", path, "--to", "usd", "-o", tmp_path / "out", "--stride", stride, "--overwrite")
        stage, result = usd.Stage.Open(str(tmp_path / "out" / "000000.usdc")), open_result(path)
        assert stage.GetTimeCodesPerSecond() == pytest.approx(1 / 0.05)
        points = geom.Points.Get(stage, "/World/Particles")
        assert points.GetPointsAttr().GetTimeSamples() == list(range(0, 11, stride))
        for k in range(0, 11, stride):
            there = result.present_frame(k)
            found = np.array(points.GetPointsAttr().Get(k)).reshape(-1, 3)
            np.testing.assert_array_equal(found[:, :2], there.position)
            assert np.array_equal(points.GetIdsAttr().Get(k), there.id)
        # A stage that is still open would be read again in place of the next file.
        stage.Unload()
        del points, stage


@pytest.mark.parametrize(("gravity", "up"), [
    ([0.0, 0.0, -9.81], "Z"), ([0.0, -9.81, 0.0], "Y"), ([0.0, "-g * min(t / 0.05, 1)", 0.0], "Y"),
    ([0.0, "5 * sin(20 * t)", "-g"], "Z"), ([0.0, "-5 * sin(t)", 0.0], "Y"), ([0.0, 0.0, 0.0], "Z"),
])  # fmt: skip
def test_up_in_usd_is_against_gravity(tmp_path, gravity, up):
    """Also where it is an expression."""
    usd, geom = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
    facts = header((1.0, 1.0, 1.0), 0.05, [WATER], laws=LAWS)
    facts["scene"] = "constants = { g = 9.81 }\n" + facts["scene"].replace("-9.81", "0.0")
    facts["scene"] = facts["scene"].replace("gravity = [\n    0.0,\n    0.0,\n    0.0,\n]", f"gravity = {gravity}")
    write(tmp_path / "run", facts, [drawn(0, np.full((2, 3), 0.5))])
    assert run_here("export", tmp_path / "run", "--to", "usd", "-o", tmp_path / "out").status == 0
    assert geom.GetStageUpAxis(usd.Stage.Open(str(tmp_path / "out" / "000000.usdc"))) == up


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("form", FORMS)
def test_rigid_bodies_alone_are_exported_where_they_can_be(tmp_path, form, dimension):
    """A ball that falls: its surface in PLY and USD, its poses in arrays; training code needs particles."""
    ball = {"name": "ball", "density": 500.0, "shape": {"ball": {"center": [0.5] * dimension, "radius": 0.1}}}
    facts = header((1.0,) * dimension, 0.05, [], [ball], laws=[])
    store, turn = SegmentStore(tmp_path / "run", facts), (0.0,) if dimension == 2 else (1.0, 0.0, 0.0, 0.0)
    for k in range(4):
        pose = ((*[0.5] * (dimension - 1), 0.5 - 0.1 * k, *turn),)
        motion = ((0.0,) * (3 * dimension - 3),)
        store.write(
            drawn(k, np.empty((0, dimension))), replace(row(0.01 * k, dimension), rigid_pose=pose, rigid_motion=motion)
        )
    store.finish()
    outcome = run_here("export", tmp_path / "run", "--to", form, "-o", tmp_path / "out")
    if issubclass(format_named(form), TrainingFormat):
        assert outcome.status == 2 and "has no particles, which" in outcome.stderr
        return
    assert outcome.status == 0, outcome.stderr
    if form == "ply":
        for k in range(4):
            name = f"000000_colliders_{k:06d}.ply"
            for points in (
                trimesh.load(tmp_path / "out" / name).vertices,
                pyvista.read(tmp_path / "out" / name).points,
            ):
                away = np.asarray(points)[:, :dimension] - [*[0.5] * (dimension - 1), 0.5 - 0.1 * k]
                assert np.linalg.norm(away, axis=1) == pytest.approx(0.1, abs=1e-6)
            assert pyvista.read(tmp_path / "out" / f"000000_{k:06d}.ply").n_points == 0
        if dimension == 3:
            assert trimesh.load(tmp_path / "out" / name).volume == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=0.01)
    if form == "npz":
        with np.load(tmp_path / "out" / "000000.npz") as file:
            assert file["position"].shape == (4, 0, dimension)
            assert file["rigid_pose"][:, 0, dimension - 1] == pytest.approx([0.5, 0.4, 0.3, 0.2])
    if form == "usd":
        usd, geom = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
        stage = usd.Stage.Open(str(tmp_path / "out" / "000000.usdc"))
        place = geom.Xformable(stage.GetPrimAtPath("/World/ball")).ComputeLocalToWorldTransform(3).ExtractTranslation()
        assert place[dimension - 1] == pytest.approx(-0.3, abs=1e-6)
    assert open_result(tmp_path / "run").to_pyvista(0).n_points == 0

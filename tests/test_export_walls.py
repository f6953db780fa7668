"""Particles on walls in exports: where they are, how they move, what type they have, and what they leave as it is."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from command import run_here
from drawn_results import WATER, frame, header, lattice, row, write
from scipy.spatial.transform import Rotation

from mpmcli.dataset import subsample
from mpmcli.dataset.subsample import SubsampledTrajectory, joined_row
from mpmcli.scene.colliders import Collider

H = 0.05
POST = {"name": "post", "shape": {"ball": {"center": [0.7, 0.5], "radius": 0.1}}}
ROD = {"name": "rod", "shape": {"box": {"min": [0.2, 0.6], "max": [0.4, 0.65]}}, "angular_velocity": 50.0}
CELL = H / 2
WATER_AT = lattice((0.3, 0.1), (0.6, 0.3), CELL)


def run(directory: Path, colliders: list[dict[str, Any]]) -> Path:
    """A result of four frames, in which water moves to the right."""
    facts = header((1.0, 1.0), H, [WATER], colliders, laws=[{"deformation": "J", "coherent": False}])
    write(directory, facts, [frame(k, WATER_AT + np.array([0.01 * k**2, 0.0])) for k in range(4)])
    return directory


def export(path: Path, form: str, target: Path, *options: object) -> dict[str, Any]:
    """Export, and return metadata.json."""
    outcome = run_here("export", path, "--to", form, "-o", target, *options)
    assert outcome.status == 0, outcome.stderr
    return json.loads((target / "metadata.json").read_text())


def split(positions: np.ndarray, types: np.ndarray, moving: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions of particles on the post, (T, n, 2), and on the rod."""
    n = len(WATER_AT)
    walls, kinds = positions[:, n:], types[n:]
    near = np.linalg.norm(walls[0] - [0.7, 0.5], axis=1) < 0.11
    assert (kinds[~near] == moving).all()
    return walls[:, near], walls[:, ~near]


def assert_on_walls(post: np.ndarray, rod: np.ndarray) -> None:
    """The post rests, and the rod turns, both with particles as far apart as the water's."""
    assert np.array_equal(post, np.broadcast_to(post[0], post.shape))
    assert np.linalg.norm(post[0] - [0.7, 0.5], axis=1) == pytest.approx(0.1, rel=2e-3)
    assert post.shape[1] == pytest.approx(2 * np.pi * 0.1 / CELL, abs=1)
    assert rod.shape[1] == pytest.approx(0.5 / CELL, abs=4)
    for k in range(4):
        c, s = np.cos(0.5 * k), np.sin(0.5 * k)
        back = (rod[k] - [0.3, 0.625]) @ np.array([[c, -s], [s, c]])
        assert np.allclose(np.maximum(np.abs(back[:, 0]) - 0.1, np.abs(back[:, 1]) - 0.025), 0.0, atol=1e-6)


def test_lagrangebench_has_walls_that_rest_and_that_move(tmp_path: Path) -> None:
    path = run(tmp_path / "run", [POST, ROD])
    bare = export(path, "lagrangebench", tmp_path / "bare")
    facts = export(path, "lagrangebench", tmp_path / "out", "--walls", "colliders")
    with h5py.File(tmp_path / "out" / "train.h5") as file:
        positions, types = file["00000/position"][:], file["00000/particle_type"][:]
    post, rod = split(positions, types, moving=2)
    assert_on_walls(post, rod)
    assert set(types.tolist()) == {0, 1, 2}
    assert facts["particle_types"] == {"fluid": 0, "wall": 1, "moving_wall": 2}
    assert facts["num_particles_max"] == positions.shape[1] == bare["num_particles_max"] + post.shape[1] + rod.shape[1]
    # As those of LagrangeBench are, of the fluid alone.
    for name in ("vel_mean", "vel_std", "acc_mean", "acc_std", "dx", "default_connectivity_radius"):
        assert facts[name] == bare[name]
    assert facts["wall_spacing"] == pytest.approx(CELL)


def test_gns_has_particles_whose_motion_is_given(tmp_path: Path) -> None:
    path = run(tmp_path / "run", [POST, ROD])
    facts = export(path, "gns", tmp_path / "out", "--walls", "colliders", "--max-particles", 40)
    with np.load(tmp_path / "out" / "train.npz", allow_pickle=True) as file:
        positions, types = next(iter(file.values()))
    assert (types[:40] == 5).all() and (types[40:] == 3).all()
    assert facts["particle_types"] == {"fluid": 5, "wall": 3}
    assert positions.shape == (4, len(types), 2) and facts["num_particles_max"] == len(types)


def test_npz_has_arrays_of_their_own_and_the_walls_of_the_domain(tmp_path: Path) -> None:
    path = run(tmp_path / "run", [POST, ROD])
    export(path, "npz", tmp_path / "out", "--walls", "all", "--wall-spacing", 0.1)
    with np.load(tmp_path / "out" / "000000.npz") as file:
        assert file["position"].shape == (4, len(WATER_AT), 2)
        walls, numbers = file["wall_position"], file["wall_collider"]
    assert walls.shape == (4, len(numbers), 2) and numbers.dtype == np.int32
    counts = {number: int((numbers == number).sum()) for number in (-1, 0, 1)}
    assert counts == {-1: 40, 0: 6, 1: 6}
    edge = walls[:, numbers == -1]
    assert np.minimum(edge, 1 - edge).min(axis=2) == pytest.approx(0.0, abs=1e-7)


def test_properties_of_walls_are_zero(tmp_path: Path) -> None:
    facts = header((1.0, 1.0), H, [WATER, {**WATER, "viscosity": 0.5}], [POST])
    body = (np.arange(len(WATER_AT)) % 2).astype(np.int32)
    write(tmp_path / "run", facts, [frame(k, WATER_AT, body) for k in range(3)])
    export(tmp_path / "run", "gns", tmp_path / "out", "--walls", "colliders")
    with np.load(tmp_path / "out" / "train.npz", allow_pickle=True) as file:
        positions, types, properties = next(iter(file.values()))
    assert len(properties) == len(types) == positions.shape[1]
    assert set(properties[types == 3].tolist()) == {0.0} and set(properties[types == 5].tolist()) == {0.001, 0.5}


def test_walls_that_cannot_be_had_are_refused(tmp_path: Path) -> None:
    path = run(tmp_path / "run", [{**POST, "shape": {"unheard_of": {}}}])
    outcome = run_here("export", path, "--to", "npz", "-o", tmp_path / "out", "--walls", "colliders")
    assert outcome.status == 2 and 'the collider "post" of trajectory 0 cannot be read' in outcome.stderr
    outcome = run_here("export", path, "--to", "vtkhdf", "-o", tmp_path / "out", "--walls", "colliders")
    assert outcome.status == 2 and "--walls is for training code and NumPy" in outcome.stderr
    assert not (tmp_path / "out").exists()


def test_usd_has_particles_and_colliders_where_they_are(tmp_path: Path) -> None:
    """The rod's corners at each frame, in metres with Y up; the stage has no fault that USD's own checker finds."""
    usd, geom, checks = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom", "UsdValidation"))
    path = run(tmp_path / "run", [POST, ROD])
    export(path, "usd", tmp_path / "out")
    stage = usd.Stage.Open(str(tmp_path / "out" / "000000.usdc"))
    assert (geom.GetStageUpAxis(stage), geom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    faults = checks.ValidationContext(checks.ValidationRegistry().GetOrLoadAllValidators()).Validate(stage)
    assert not [one.GetMessage() for one in faults if one.GetType() == checks.ValidationErrorType.Error]
    points = geom.Points.Get(stage, "/World/Particles")
    rod = geom.BasisCurves.Get(stage, "/World/rod")
    for k in range(4):
        code = stage.GetStartTimeCode() + k
        found = np.array(points.GetPointsAttr().Get(code))
        assert found[:, :2] == pytest.approx(WATER_AT + np.array([0.01 * k**2, 0.0]), abs=1e-6)
        assert np.array_equal(points.GetIdsAttr().Get(code), np.arange(len(WATER_AT)))
        pose = np.array(rod.ComputeLocalToWorldTransform(code))
        placed = np.array(rod.GetPointsAttr().Get()) @ pose[:3, :3] + pose[3, :3]
        c, s = np.cos(0.5 * k), np.sin(0.5 * k)
        back = (placed[:, :2] - [0.3, 0.625]) @ np.array([[c, -s], [s, c]])
        assert np.abs(back) == pytest.approx(np.tile([0.1, 0.025], (len(back), 1)), abs=1e-6)


def test_an_npz_has_the_poses_of_moving_colliders(tmp_path: Path) -> None:
    """The rod turns by 0.5 rad a frame about its centre; the post rests. A quaternion turns as the motion does."""
    export(run(tmp_path / "run", [POST, ROD]), "npz", tmp_path / "out")
    with np.load(tmp_path / "out" / "000000.npz") as file:
        assert file["collider_number"].tolist() == [1]
        expected = [[[0.3, 0.625, 0.5 * k]] for k in range(4)]
        assert file["collider_pose"] == pytest.approx(np.array(expected), abs=1e-9)
    blade = {"name": "b", "shape": {"ball": {"center": [0.5, 0.4, 0.3], "radius": 0.1}}, "axis": [1.0, 2.0, 2.0]}
    blade |= {"angular_velocity": 3.0, "velocity": [0.1, 0.0, -0.2]}
    motion = Collider.model_validate(blade, context={"dimension": 3}).motion
    points = np.random.default_rng(0).uniform(0.0, 1.0, (5, 3))
    for time, (*place, w, x, y, z) in zip((0.0, 0.4), motion.poses([0.0, 0.4]), strict=True):
        turned = Rotation.from_quat([x, y, z, w]).apply(points - [0.5, 0.4, 0.3])
        assert turned + place == pytest.approx(motion.placed(points, time), abs=1e-12)


def test_forces_of_joined_frames_are_means_over_their_time(tmp_path: Path) -> None:
    """So their integral is that of all frames."""
    rows = [
        replace(
            row(time, 2),
            collider_force=((force, 1.0), (0.0, force)),
            collider_torque=((force,), (2.0,)),
            contact_torque=((force,),),
            contact_overlap=0.1 * force % 0.4,
            contact_work=force,
        )
        for time, force in ((0.1, 1.0), (0.4, 3.0), (0.5, 5.0))
    ]
    joined = joined_row(rows, 0.0)
    mean = (0.1 * 1 + 0.3 * 3 + 0.1 * 5) / 0.5
    assert np.allclose(joined.collider_force, ((mean, 1.0), (0.0, mean)), rtol=1e-15)
    assert np.allclose(joined.collider_torque, ((mean,), (2.0,)), rtol=1e-15)
    assert np.allclose(joined.contact_torque, ((mean,),), rtol=1e-15)
    assert joined.contact_overlap == pytest.approx(0.3) and joined.contact_work == 9.0


def test_walls_inside_of_others_have_no_particles(tmp_path: Path) -> None:
    """A round tank leaves nothing of the corners of the domain, and a slope nothing of the tank below it."""
    tank = {"name": "tank", "side": "inside", "shape": {"ball": {"center": [0.5, 0.5], "radius": 0.6}}}
    slope = {"name": "slope", "shape": {"plane": {"point": [0.5, 0.3], "normal": [0.0, 1.0]}}}
    export(run(tmp_path / "run", [tank, slope]), "npz", tmp_path / "out", "--walls", "all", "--wall-spacing", 0.01)
    with np.load(tmp_path / "out" / "000000.npz") as file:
        walls, numbers = file["wall_position"][0], file["wall_collider"]
    assert walls[:, 1].min() >= 0.3 - 1e-4 and np.linalg.norm(walls - 0.5, axis=1).max() <= 0.6 + 1e-4
    half = np.sqrt(0.6**2 - 0.5**2)
    lengths = {-1: 2 * half + 2 * (half + 0.2), 0: 0.6 * 2 * (np.pi / 2 - 2 * np.arcsin(half / 0.6)), 1: 1.0}
    for number, length in lengths.items():
        assert (numbers == number).sum() == pytest.approx(length / 0.01, abs=6), number


def test_walls_move_on_from_block_to_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame is a block."""
    monkeypatch.setattr(subsample, "BLOCK_BYTES", 1)
    path = run(tmp_path / "run", [POST, ROD])
    export(path, "lagrangebench", tmp_path / "out", "--walls", "colliders")
    with h5py.File(tmp_path / "out" / "train.h5") as file:
        positions, types = file["00000/position"][:], file["00000/particle_type"][:]
    assert_on_walls(*split(positions, types, moving=2))


@pytest.mark.parametrize("stride", [1, 2, 3, 4])
def test_the_impulse_of_left_out_frames_is_kept(stride: int) -> None:
    """Forces are means since the frame before: their sum over all times is that of all frames up to there."""
    forces = np.array([0.0, 1.0, 3.0, 5.0, -2.0, 7.0, 4.0, 0.5, 6.0])
    times = np.cumsum([0.0, 0.1, 0.3, 0.1, 0.2, 0.1, 0.4, 0.2, 0.1])
    rows = [
        replace(row(time, 2), collider_force=((force, 0.0),), collider_torque=((2 * force,),))
        for time, force in zip(times, forces, strict=True)
    ]
    found = SubsampledTrajectory.ledger(SimpleNamespace(source=SimpleNamespace(ledger=rows), stride=stride))
    assert [one.time for one in found] == times[::stride].tolist()
    impulse = np.cumsum(forces * np.diff(times, prepend=0.0))[::stride]
    spans = np.diff(times[::stride], prepend=0.0)
    assert np.cumsum([one.collider_force[0][0] for one in found] * spans) == pytest.approx(impulse, rel=1e-12)
    assert np.cumsum([one.collider_torque[0][0] for one in found] * spans) == pytest.approx(2 * impulse, rel=1e-12)

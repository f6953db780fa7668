"""Colliders beside the particles, as VTK's own readers give them back."""

from functools import partial
from pathlib import Path
from time import sleep
from typing import Any

import numpy as np
import pytest
from drawn_results import WATER, frame, header, row

from mpmcli.output import SegmentStore, open_result
from mpmcli.output.collider_files import MOVING, RESTING, RESTING_PIECE, SERIES
from mpmcli.output.directory import take_directory
from mpmcli.output.series import write_series
from mpmcli.scene import surface as scene_surface
from mpmcli.scene.colliders import Collider

BALL = {"name": "ball", "shape": {"ball": {"center": [0.3, 0.5, 0.5], "radius": 0.1}}, "velocity": [2.0, 0.0, 0.0]}
GROUND = {"name": "ground", "shape": {"plane": {"point": [0.5, 0.5, 0.1], "normal": [0.0, 0.0, 1.0]}}}
PADDLE = {"name": "paddle", "shape": {"box": {"min": [0.2, 0.2], "max": [0.4, 0.3]}}, "angular_velocity": 100.0}
POST = {"name": "post", "shape": {"ball": {"center": [0.7, 0.5], "radius": 0.1}}}


def stored(directory: Path, kind: type, d: int, colliders: list[dict[str, Any]], frames: int = 3) -> None:
    """Write a run of one particle."""
    store = kind(directory, header((1.0,) * d, 0.1, [WATER], colliders))
    for k in range(frames):
        entry = frame(k, np.full((1, d), 0.5))
        store.write(entry, row(entry.time, d))
    store.finish()


def steps(path: Path) -> list[tuple[float, Any]]:
    """The time and the surface of every step, by VTK's reader of temporal files."""
    import pyvista as pv
    import vtk

    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtk.vtkStreamingDemandDrivenPipeline.TIME_STEPS())
    found = []
    for time in times:
        reader.UpdateTimeStep(time)
        found.append((time, pv.wrap(reader.GetOutput()).copy()))
    return found


def test_vtk_reads_what_rests_and_what_moves_at_the_times_of_the_frames(tmp_path: Path) -> None:
    stored(tmp_path, SegmentStore, 3, [BALL, GROUND])
    resting, moving = steps(tmp_path / RESTING), steps(tmp_path / MOVING)
    assert [time for time, _ in resting] == [time for time, _ in moving] == pytest.approx([0.0, 0.01, 0.02])
    for time, ground in resting:
        assert ground.area == pytest.approx(1.0, rel=1e-6)
        assert set(ground.cell_data["collider"].tolist()) == {1}
        assert np.allclose(ground.points[:, 2], 0.1), time
    for time, ball in moving:
        assert ball.is_manifold and set(ball.cell_data["collider"].tolist()) == {0}
        away = np.linalg.norm(ball.points - [0.3 + 2.0 * time, 0.5, 0.5], axis=1)
        assert np.allclose(away, 0.1)
    # What rests is there once.
    assert (tmp_path / RESTING).stat().st_size < 20_000


def test_lines_of_a_2d_scene_turn(tmp_path: Path) -> None:
    stored(tmp_path, SegmentStore, 2, [PADDLE, POST])
    for time, paddle in steps(tmp_path / MOVING):
        turned = 100.0 * time
        away = paddle.points[:, :2] - [0.3, 0.25]
        assert np.allclose(np.sort(np.hypot(*away.T)), np.hypot(0.1, 0.05))
        edges = paddle.points[paddle.lines.reshape(-1, 3)[:, 1:]]
        lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
        assert lengths.sum() == pytest.approx(0.6)
        along = (edges[:, 1] - edges[:, 0])[np.argmax(lengths)]
        assert abs(np.cos(turned) * along[1] - np.sin(turned) * along[0]) < 1e-12
    assert steps(tmp_path / RESTING)[2][1].n_cells == 64


def test_a_series_lists_both_and_overwrite_takes_all_away(tmp_path: Path) -> None:
    import pyvista as pv

    stored(tmp_path, SegmentStore, 2, [PADDLE, POST])
    write_series(tmp_path, open_result(tmp_path).colliders)
    reader = pv.PVDReader(str(tmp_path / SERIES))
    assert reader.time_values == pytest.approx([0.0, 0.01, 0.02])
    reader.set_active_time_value(0.02)
    post, paddle = reader.read()
    assert (post.n_cells, paddle.n_cells) == (64, 4)
    assert set(paddle.cell_data["collider"].tolist()) == {0}
    assert (tmp_path / RESTING_PIECE).exists()
    # The record that a run leaves makes the directory one of results.
    with take_directory(tmp_path, overwrite=True) as taken:
        taken.clear()
    assert not list(tmp_path.glob("colliders*"))


def test_a_run_without_colliders_has_no_such_files(tmp_path: Path) -> None:
    stored(tmp_path, SegmentStore, 2, [])
    assert [path.name for path in tmp_path.iterdir()] == ["particles.vtkhdf"]


def test_what_was_read_from_a_file_is_drawn_without_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The surface lies beside the frames, where the shape stands, and moves as the scene says."""
    import pyvista as pv

    # Half as many cells along the shell take an eighth of the time.
    monkeypatch.setattr(scene_surface, "level_surface", partial(scene_surface.level_surface, cells=48))
    pv.Sphere(radius=0.1, center=(0.3, 0.5, 0.5), theta_resolution=60, phi_resolution=60).save(tmp_path / "ball.stl")
    ring = {"mesh": {"file": "ball.stl"}, "subtract": [{"ball": {"center": [0.3, 0.5, 0.5], "radius": 0.06}}]}
    tables = [GROUND, {**BALL, "shape": {"mesh": {"file": "ball.stl"}}}, {**GROUND, "name": "shell", "shape": ring}]
    context = {"dimension": 3, "constants": {}, "directory": tmp_path}
    colliders = [Collider.model_validate(table, context=context) for table in tables]
    run = tmp_path / "run"
    store = SegmentStore(run, header((1.0,) * 3, 0.1, [WATER], tables), colliders=colliders)
    for k in range(3):
        entry = frame(k, np.full((1, 3), 0.5))
        store.write(entry, row(entry.time, 3))
    assert [collider.name for collider in open_result(run).colliders] == ["ground"]
    store.finish()
    (tmp_path / "ball.stl").unlink()
    result = open_result(run)
    assert [collider.name for collider in result.colliders] == ["ground", "ball", "shell"]
    assert result.header.collider_names == ("ground", "ball", "shell") and len(result.header.colliders) == 1
    places = np.random.default_rng(0).uniform(0.15, 0.45, (200, 3)) + np.array([0.0, 0.2, 0.2])
    for own, found in zip(colliders, result.colliders, strict=True):
        tolerance = 1e-6 if own.name != "shell" else 2e-3
        assert np.allclose(own.signed_distance(places, 0.02), found.signed_distance(places, 0.02), atol=tolerance)
    (_, first), *_, (_, last) = steps(run / MOVING)
    assert np.allclose(last.points - first.points, [0.04, 0.0, 0.0], atol=1e-7)
    # The shell has an inner surface.
    shell = steps(run / RESTING)[0][1].extract_cells(steps(run / RESTING)[0][1].cell_data["collider"] == 2)
    expected = 4 * np.pi * (0.1**2 + 0.06**2)
    assert shell.area == pytest.approx(expected, rel=0.01)


def test_bytes_do_not_depend_on_the_time_of_writing(tmp_path: Path) -> None:
    """More than a second apart, since HDF5 counts in whole ones."""
    for name in ("first", "second"):
        stored(tmp_path / name, SegmentStore, 2, [PADDLE, POST])
        sleep(1.1)
    for name in (RESTING, MOVING):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()

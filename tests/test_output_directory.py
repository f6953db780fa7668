"""The output directory and run.json: refused, made, cleared; written in one step."""

import json
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from test_output_frames import make_frame, make_row

from mpmcli.errors import InputError
from mpmcli.output import RunRecord, SegmentStore, open_result, read_record
from mpmcli.output.directory import close_abandoned, take_directory
from mpmcli.output.durable import sealed, write_text
from mpmcli.output.series import write_series


def taken(directory: Path, overwrite: bool) -> Path:
    """Take a directory, clear it, leave it to others at once, and return it."""
    with take_directory(directory, overwrite) as taken:
        taken.clear()
    return taken.path


def write_result(directory: Path, *, finish: bool) -> None:
    (directory / "scene.toml").write_text("title = 'x'\n")
    record = RunRecord(directory)
    record.write()
    store = SegmentStore(directory, {})
    for k in range(2):
        store.write(make_frame(k, 10, 2), make_row(k, 2))
    if finish:
        store.finish()


def test_a_new_directory_is_made_with_its_parents(tmp_path):
    assert taken(tmp_path / "a/b", overwrite=False) == tmp_path / "a/b"
    assert (tmp_path / "a/b").is_dir() and not os.listdir(tmp_path / "a/b")
    assert taken(tmp_path / "a/b", overwrite=False)


def test_a_directory_with_something_in_it_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"not empty.*--overwrite"):
        taken(tmp_path, overwrite=False)
    with pytest.raises(InputError, match="is a file"):
        taken(tmp_path / "file", overwrite=True)
    with pytest.raises(InputError, match="cannot be made"):
        taken(tmp_path / "file/a/b", overwrite=False)
    assert os.listdir(tmp_path) == ["file"]


def test_nothing_is_made_on_error(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="cannot be made"):
        taken(tmp_path / "a" / ("b" * 300), overwrite=False)
    assert os.listdir(tmp_path) == []

    # Permission bits do not bind the administrator, who may run the tests: the answer is imitated.
    def refuse(dir):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    for place in (tmp_path, tmp_path / "a/b"):
        with pytest.raises(InputError, match=r"cannot be written \(Permission denied\)"):
            taken(place, overwrite=False)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("series", [False, True])
@pytest.mark.parametrize("finish", [False, True])
def test_overwrite_removes_a_result_and_nothing_else(tmp_path, series, finish):
    write_result(tmp_path, finish=finish)
    if series and finish:
        write_series(tmp_path, [])
    foreign = ["movie.mp4", "particles_000001.vtu.bak", "frame_000001.vtkhdf", "particles_1.vtu"]
    for name in foreign:
        (tmp_path / name).write_text("mine")
    (tmp_path / "particles.vtkhdf.tmp").touch()
    with pytest.raises(InputError, match="not empty"):
        taken(tmp_path, overwrite=False)
    assert open_result(tmp_path).frame_count == 2
    taken(tmp_path, overwrite=True)
    assert sorted(os.listdir(tmp_path)) == sorted(foreign)
    write_result(tmp_path, finish=finish)
    assert open_result(tmp_path).frame_count == 2


def test_overwrite_spares_a_scene_of_the_user(tmp_path):
    """`mpmcli simulate scene.toml -o . --overwrite` must not remove its own input."""
    (tmp_path / "scene.toml").write_text("title = 'mine'\n")
    with pytest.raises(InputError, match=r"scene\.toml was not written by mpmcli"):
        taken(tmp_path, overwrite=True)
    assert (tmp_path / "scene.toml").read_text() == "title = 'mine'\n"


def test_an_earlier_result_stays_until_it_is_cleared(tmp_path):
    """Without the files that the new run reads; one that it would replace later is refused at once."""
    write_result(tmp_path, finish=True)
    scene, packed = tmp_path / "scene.toml", tmp_path / "particles.vtkhdf"
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(KeyboardInterrupt), take_directory(tmp_path, overwrite=True) as directory:
        raise KeyboardInterrupt
    assert directory.replaces
    # Ended by force, in place of process 1.
    close_abandoned(tmp_path, [], [], 1, "SIGINT")
    assert sorted(os.listdir(tmp_path)) == before
    with pytest.raises(InputError, match=r"particles\.vtkhdf is read by the scene"):
        take_directory(tmp_path, overwrite=True, inputs=[packed])
    assert sorted(os.listdir(tmp_path)) == before
    with pytest.raises(KeyboardInterrupt), take_directory(tmp_path, overwrite=True, inputs=[scene]) as directory:
        directory.clear()
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == ["scene.toml"]


def test_overwrite_does_not_remove_directories(tmp_path):
    (tmp_path / "particles.vtkhdf").mkdir()
    (tmp_path / "run.json").write_text('{"program": "mpmcli"}')
    with pytest.raises(InputError, match="is a directory where mpmcli writes a file"):
        taken(tmp_path, overwrite=True)
    assert len(os.listdir(tmp_path)) == 2


def test_a_sealed_file_is_whole_or_untouched(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "first")
    with pytest.raises(KeyboardInterrupt), sealed(path) as temporary:
        temporary.write_text("half of the sec")
        assert path.read_text() == "first"
        raise KeyboardInterrupt
    assert path.read_text() == "first" and os.listdir(tmp_path) == ["a.txt"]


def test_the_record_of_a_run(tmp_path):
    record = RunRecord(
        tmp_path,
        command=["/somewhere/bin/mpmcli", "simulate", "scene.toml"],
        backend={"arch": "cpu", "threads": 2, "precision": "f32"},
        seeds={"column": 3},
        frames_expected=4,
        particles=np.int64(10),
        notes=["The bulk modulus was set to 1e5 Pa."],
    )
    record.write()
    begun = read_record(tmp_path)
    assert begun["status"] == "running" and begun["ended"] is None
    for k in range(3):
        record.observe(make_row(k, 2))
        record.write()
    record.timings["wall_s"] = 1.5
    record.close("unstable", "It blew up.", step=21, time=np.float32(0.25), particle=7, speed=float("nan"))
    ended = json.loads((tmp_path / "run.json").read_text(), parse_constant=pytest.fail)
    assert ended["program"] == "mpmcli" and ended["started"].endswith("+00:00") and ended["ended"]
    assert ended["command"] == ["mpmcli", "simulate", "scene.toml"]
    assert (ended["frames_written"], ended["frames_expected"], ended["particles"]) == (3, 4, 10)
    assert ended["steps"] == 21 and ended["timings"] == {"wall_s": 1.5}
    assert ended["limits"] == {make_row(1, 2).limit: 1, make_row(2, 2).limit: 1}
    assert ended["energy"]["first"] == make_row(0, 2).energy
    assert ended["energy"]["last"] == make_row(2, 2).energy
    assert ended["failure"] == {"message": "It blew up.", "step": 21, "time": 0.25, "particle": 7, "speed": None}
    assert set(ended["host"]) == {"python", "taichi", "system", "machine", "cpu_count"}
    assert "directory" not in ended and os.listdir(tmp_path) == ["run.json"]


def test_the_record_comes_with_the_result(tmp_path):
    write_result(tmp_path, finish=True)
    assert open_result(tmp_path).record["status"] == "running"
    assert open_result(tmp_path / "particles.vtkhdf").record["status"] == "running"


def test_a_run_without_frames_is_named(tmp_path):
    RunRecord(tmp_path).close("failed", "No.")
    with pytest.raises(InputError, match='no frame yet: its run is "failed"'):
        open_result(tmp_path)


def test_a_foreign_record_is_none(tmp_path):
    assert read_record(tmp_path) is None
    for text in ("torn {", "[]", '{"program": "other"}'):
        (tmp_path / "run.json").write_text(text)
        assert read_record(tmp_path) is None

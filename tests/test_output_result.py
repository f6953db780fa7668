"""Opening results: what is asked of them, what is none, what is damaged, and what is packed meanwhile."""

import h5py
import numpy as np
import pytest
from changed_result import changed
from made_result import made_header
from test_output_frames import FIELDS, make_frame
from test_output_segments import fill

from mpmcli.errors import InputError
from mpmcli.output import open_result
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import sealed_segments


def test_fields_can_be_left_out(tmp_path):
    fill(tmp_path, [make_frame(0, 20, 3, fields=tuple(FIELDS))])
    result = open_result(tmp_path)
    assert set(result.frame(0, fields=["stress"]).fields) == {"stress"}
    assert result.frame(0, fields=[]).fields == {}
    with pytest.raises(InputError, match='no field "strain": its fields are density, pressure'):
        result.frame(0, fields=["strain"])


def test_what_is_no_result_is_named(tmp_path):
    fill(tmp_path / "good", [make_frame(k, 20, 3) for k in range(3)])
    result = open_result(tmp_path / "good")
    for k in (-1, 3):
        with pytest.raises(InputError, match=f"no frame {k}: it holds frames 0 to 2"):
            result.frame(k)
    with pytest.raises(InputError, match="nowhere does not exist"):
        open_result(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no result of mpmcli"):
        open_result(tmp_path / "empty")
    (tmp_path / "text.vtkhdf").write_text("no")
    with pytest.raises(InputError, match="not an HDF5 file"):
        open_result(tmp_path / "text.vtkhdf")
    with h5py.File(tmp_path / "foreign.h5", "w") as f:
        f["x"] = 1
    with pytest.raises(InputError, match="mpmcli did not write it"):
        open_result(tmp_path / "foreign.h5")
    with h5py.File(tmp_path / "good/particles.vtkhdf", "r+") as f:
        f["mpmcli"].attrs["format"] = 99
    with pytest.raises(InputError, match="has format 99, and this version of mpmcli reads format 2"):
        open_result(tmp_path / "good")


def test_a_file_that_contradicts_itself_is_damaged(tmp_path):
    fill(tmp_path / "run", [make_frame(0, 20, 3)])
    with changed(tmp_path / "run" / "particles.vtkhdf") as f:
        f["mpmcli"].attrs["header"] = "{no JSON"
    with pytest.raises(InputError, match="is damaged: its content cannot be read"):
        open_result(tmp_path / "run")
    with h5py.File(tmp_path / "run" / "particles.vtkhdf", "r+") as f:
        del f["VTKHDF/Steps"]
    with pytest.raises(InputError, match="is damaged"):
        open_result(tmp_path / "run")


def test_a_header_of_another_version_is_read():
    """Keys that no scene has are left out, and missing ones unknown: what was not stored is not today's default."""
    made = made_header(2)
    plain = RunHeader.read(made)
    assert (plain.faces, plain.sticking, plain.shifts, plain.keeps_spin, plain.drops) == ((), None, False, True, False)
    more = 'domain = { older = 1, walls = {y_min = "stick"}, friction = {x_max = 0.5} }\nsolver.transfer = "older"\n'
    other = RunHeader.read({**made, "older": 2, "scene": made["scene"].replace("domain = {", more + "older = {")})
    assert other.faces == (("separate", "separate"), ("stick", "separate")) and other.sticking == (True, True)
    assert (other.keeps_spin, other.gravity, other.friction.x_max) == (False, None, 0.5)
    timed = made["scene"].replace("-9.81", '"-9.81 * t"')
    header = RunHeader.read({**made, "scene": timed})
    assert header.driven and header.gravity is None and header.mean_gravity == pytest.approx([0, -9.81 * 0.1 / 2])
    with pytest.raises(ValueError, match=r"number|expression"):
        RunHeader.read({**made, "scene": made["scene"].replace("-9.81", "true")})


def test_frames_packed_under_a_reader_are_read_on(tmp_path):
    frames = [make_frame(k, 20, 3) for k in range(3)]
    store = fill(tmp_path, frames, finish=False)
    result = open_result(tmp_path)
    store.finish()
    assert result.kind == "segments" and not (tmp_path / "segments").exists()
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(result.frame(k).position, frame.position)


def test_a_run_that_ends_while_it_is_opened_is_opened_as_packed(tmp_path, monkeypatch):
    store = fill(tmp_path, [make_frame(0, 20, 3)], finish=False)
    listed = sealed_segments(tmp_path)
    store.finish()
    monkeypatch.setattr("mpmcli.output.result.sealed_segments", lambda directory: listed)
    packed = tmp_path / "particles.vtkhdf"
    there = iter([False])
    exists = type(packed).exists
    # The packed file appears after the first look for it.
    monkeypatch.setattr(type(packed), "exists", lambda path: next(there, True) if path == packed else exists(path))
    assert open_result(tmp_path).kind == "packed"

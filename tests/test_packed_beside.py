"""The packed file that is written beside the segments: the bytes of one that is packed at the end, or none at all."""

import errno
from pathlib import Path

import h5py
import numpy as np
import pytest
from test_output_frames import assert_same_frame, make_frame, make_row

from mpmcli.errors import NoRoomError, RunError
from mpmcli.output import SegmentStore, open_result
from mpmcli.output import durable as durable_module
from mpmcli.output import pack as pack_module
from mpmcli.output import store as store_module
from mpmcli.output.segments import PACKED
from mpmcli.output.vtkhdf import VtkhdfWriter

HEADER = {"dimension": 3, "bodies": ["column"], "precision": "f32", "scene": "title = 1\n"}
TEMPORARY = f"{PACKED}.tmp"
FRAMES = [make_frame(k, 300, 3) for k in range(5)]


@pytest.fixture(autouse=True)
def small_runs_too(monkeypatch) -> None:
    monkeypatch.setattr(store_module, "MOST_WAITING", 0)
    monkeypatch.setattr(store_module, "ASIDE", 0)


def begin(directory: Path, count: int, *, expected: int | None = len(FRAMES), **options) -> SegmentStore:
    store = SegmentStore(directory, HEADER, frames_expected=expected, **options)
    for frame in FRAMES[:count]:
        store.write(frame, make_row(frame.index, 3))
    return store


def packed_at_the_end(directory: Path, count: int) -> bytes:
    return begin(directory, count, expected=None).finish().read_bytes()


def refuse_to_copy(monkeypatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("segments were copied")

    monkeypatch.setattr(pack_module, "_copy", refuse)


@pytest.mark.parametrize("hold", [0.0, 1000.0])
def test_it_has_the_bytes_of_one_that_is_packed_at_the_end(tmp_path, monkeypatch, hold):
    expected = packed_at_the_end(tmp_path / "at_the_end", 5)
    monkeypatch.setattr("mpmcli.output.store.MOST_WAITING", 2 * 300 * 40)
    refuse_to_copy(monkeypatch)
    store = begin(tmp_path / "beside", 5, hold=hold)
    assert (tmp_path / "beside" / TEMPORARY).exists()
    assert store.finish().read_bytes() == expected
    assert [path.name for path in (tmp_path / "beside").iterdir()] == [PACKED]


def test_frames_that_do_not_come_are_not_missed(tmp_path):
    expected = packed_at_the_end(tmp_path / "at_the_end", 3)
    store = begin(tmp_path / "beside", 3)
    assert store.finish().read_bytes() == expected
    assert [path.name for path in (tmp_path / "beside").iterdir()] == [PACKED]


def test_a_packed_file_that_cannot_be_written_is_given_up(tmp_path, monkeypatch):
    expected = packed_at_the_end(tmp_path / "at_the_end", 5)
    store = begin(tmp_path / "beside", 2)

    def fail(*_: object) -> None:
        raise OSError("no")

    monkeypatch.setattr(store._beside.writer, "append", fail)
    for frame in FRAMES[2:]:
        store.write(frame, make_row(frame.index, 3))
    assert not (tmp_path / "beside" / TEMPORARY).exists()
    assert store.finish().read_bytes() == expected


@pytest.mark.parametrize("fails", [2, 4])
def test_frames_that_could_not_be_sealed_are_not_packed(tmp_path, monkeypatch, fails):
    expected = packed_at_the_end(tmp_path / "at_the_end", fails)
    store, sync = begin(tmp_path / "beside", fails), durable_module.sync_file

    def fail(path: Path, **options: bool) -> None:
        if path.name == f"frame_{fails:06d}.vtkhdf.tmp":
            raise OSError("the disk is gone")
        sync(path, **options)

    monkeypatch.setattr(durable_module, "sync_file", fail)
    with pytest.raises(RunError, match=f"frame {fails} could not be written"):
        store.write(FRAMES[fails], make_row(fails, 3))
        store.seal()
    assert store.finish().read_bytes() == expected


@pytest.mark.parametrize("k", [1, 4])
def test_an_interrupt_in_a_write_loses_no_frame(tmp_path, monkeypatch, k):
    expected = packed_at_the_end(tmp_path / "at_the_end", 5)
    store = begin(tmp_path / "beside", k)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(VtkhdfWriter, "finish", interrupt)
        with pytest.raises(KeyboardInterrupt):
            store.write(FRAMES[k], make_row(k, 3))
    store.seal()
    for frame in FRAMES[k + 1 :]:
        store.write(frame, make_row(frame.index, 3))
    assert store.finish().read_bytes() == expected


def test_a_segment_finds_the_room_that_the_packed_file_took(tmp_path, monkeypatch):
    expected = packed_at_the_end(tmp_path / "at_the_end", 5)
    store, ask = begin(tmp_path / "beside", 3), durable_module.ask_for

    def full(path: Path, size: int) -> None:
        if (tmp_path / "beside" / TEMPORARY).exists():
            raise OSError(errno.EDQUOT, "quota exceeded")
        ask(path, size)

    monkeypatch.setattr(durable_module, "ask_for", full)
    for frame in FRAMES[3:]:
        store.write(frame, make_row(frame.index, 3))
    assert store.finish().read_bytes() == expected


@pytest.mark.parametrize("count", [200, 400])
def test_another_number_of_particles_ends_it(tmp_path, count):
    store = begin(tmp_path, 2)
    for k in (2, 3, 4):
        store.write(make_frame(k, count, 3), make_row(k, 3))
    assert not (tmp_path / TEMPORARY).exists()
    store.finish()
    assert_same_frame(open_result(tmp_path).frame(4), make_frame(4, count, 3))


def test_more_frames_than_expected_end_it(tmp_path):
    store = begin(tmp_path, 5, expected=3)
    store.finish()
    assert open_result(tmp_path).frame_count == 5


def test_nothing_of_it_stays_where_a_run_ends_otherwise(tmp_path):
    begin(tmp_path, 3).give_up()
    assert [path.name for path in tmp_path.iterdir()] == ["segments"]


def test_without_room_for_both_it_is_not_begun(tmp_path, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise NoRoomError("full")

    monkeypatch.setattr("mpmcli.output.packed_beside.require_free_space", refuse)
    store = begin(tmp_path, 5)
    assert not (tmp_path / TEMPORARY).exists()
    store.finish()
    assert_same_frame(open_result(tmp_path).frame(4), FRAMES[4])


def test_room_is_counted_once(tmp_path, monkeypatch):
    """What it has of a frame takes no more room at the end."""
    asked = []
    monkeypatch.setattr("mpmcli.output.store.require_free_space", lambda *_, joined, **__: asked.append(joined))
    begin(tmp_path / "beside", 5)
    assert asked == asked[:1] * 5
    asked.clear()
    begin(tmp_path / "at_the_end", 5, expected=None)
    assert asked == sorted(set(asked))


def test_compressed_frames_are_packed_at_the_end(tmp_path):
    store = begin(tmp_path, 5, compress=True)
    assert not (tmp_path / TEMPORARY).exists()
    with h5py.File(store.finish()) as file:
        assert file["VTKHDF/Points"].compression == "gzip"


def test_what_a_killed_process_left_is_removed(tmp_path):
    store = begin(tmp_path, 3)
    store._beside.writer.close()
    index = open_result(tmp_path).index
    store = SegmentStore(tmp_path, HEADER, frames_expected=5)
    store.go_on_after(index)
    assert not (tmp_path / TEMPORARY).exists()
    for frame in FRAMES:
        store.write(frame, make_row(frame.index, 3))
    assert store.finish().read_bytes() == packed_at_the_end(tmp_path / "at_the_end", 5)


@pytest.mark.parametrize("name", ["VTKHDF/Points", "VTKHDF/PointData/id"])
def test_what_does_not_read_back_is_no_result(tmp_path, monkeypatch, name):
    store = begin(tmp_path, 5)

    def corrupt(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            data = file[name][:]
            data.reshape(-1).view(np.uint8)[-4] ^= 1
            file[name][...] = data

    monkeypatch.setattr(pack_module, "sync_file", corrupt)
    with pytest.raises(
        RunError, match=r"does not read back as it was written .* of frame 4 has changed\); the 5 frames"
    ):
        store.finish()
    assert [path.name for path in tmp_path.iterdir()] == ["segments"]
    monkeypatch.undo()
    assert store.finish() == tmp_path / PACKED


def test_a_segment_that_was_changed_meanwhile_is_noticed(tmp_path):
    store = begin(tmp_path, 5)
    other = SegmentStore(tmp_path / "other", HEADER)
    for frame in FRAMES[:5]:
        changed = make_frame(frame.index, 300, 3)
        changed.position[7] += 1
        other.write(changed, make_row(frame.index, 3))
    segment = tmp_path / "segments/frame_000002.vtkhdf"
    segment.write_bytes((tmp_path / "other/segments/frame_000002.vtkhdf").read_bytes())
    with pytest.raises(RunError, match="Points of frame 2"):
        store.finish()
    assert not (tmp_path / TEMPORARY).exists() and segment.exists()

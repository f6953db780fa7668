"""The VTKHDF store: what it writes is read back bit for bit, and survives crashes and full disks."""

import errno
import math
import os
import shutil
import signal
import subprocess
import sys
from collections import namedtuple
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_output_frames import FIELDS, assert_same_frame, make_frame, make_row
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
from vtkmodules.vtkIOHDF import vtkHDFReader

from mpmcli.errors import InputError, RunError
from mpmcli.output import SegmentStore, open_result
from mpmcli.output import durable as durable_module
from mpmcli.output import store as store_module
from mpmcli.output.directory import take_directory
from mpmcli.output.layout import FrameLayout, sealed_segments

HEADER = {"dimension": 2, "bodies": ["column"], "precision": "f32", "scene": 'title = "é"\n'}
Usage = namedtuple("Usage", "total used free")


def fill(directory: Path, frames, *, finish: bool = True, compress: bool = False) -> SegmentStore:
    store = SegmentStore(directory, HEADER, compress=compress)
    for frame in frames:
        store.write(frame, make_row(frame.index, frame.position.shape[1]))
    if finish:
        store.finish()
    return store


def read_with_vtk(path: Path) -> list[dict[str, np.ndarray]]:
    """Every frame as VTK, and so ParaView, sees it: Points, point data, and the cells."""
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    # A file with one frame has no time for VTK: UpdateTimeStep then reads what there is.
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) or [None]
    frames = []
    for time in times:
        reader.UpdateTimeStep(0.0 if time is None else time)
        data = reader.GetOutput()
        frame = {"time": time, "cells": data.GetNumberOfVerts(), "all_cells": data.GetNumberOfCells()}
        if data.GetNumberOfPoints():
            frame["Points"] = vtk_to_numpy(data.GetPoints().GetData()).copy()
            frame["connectivity"] = vtk_to_numpy(data.GetVerts().GetConnectivityArray()).copy()
            for i in range(data.GetPointData().GetNumberOfArrays()):
                array = data.GetPointData().GetArray(i)
                frame[array.GetName()] = vtk_to_numpy(array).copy()
        frames.append(frame)
    return frames


def assert_vtk_sees(path: Path, written) -> None:
    read = read_with_vtk(path)
    if len(written) > 1:
        assert [frame["time"] for frame in read] == [frame.time for frame in written]
    for seen, frame in zip(read, written, strict=True):
        n = len(frame.position)
        assert seen["cells"] == seen["all_cells"] == (1 if n else 0)
        for name, stored in FrameLayout.of(frame).stored(frame) if n else ():
            assert seen[name].dtype == stored.dtype and seen[name].tobytes() == stored.tobytes(), name
        if n:
            assert seen["connectivity"].tolist() == list(range(n))


@settings(deadline=None, max_examples=20)
@given(
    counts=st.lists(st.integers(0, 40), min_size=1, max_size=4),
    d=st.sampled_from([2, 3]),
    dtype=st.sampled_from(["float32", "float64"]),
    fields=st.sets(st.sampled_from(sorted(FIELDS))),
    compress=st.booleans(),
)
def test_round_trip(counts, d, dtype, fields, compress):
    """Random counts, dimensions, types and fields; sealed, packed, and through VTK's own reader."""
    frames = [make_frame(k, n, d, dtype, sorted(fields)) for k, n in enumerate(counts)]
    with TemporaryDirectory() as place:
        directory = Path(place)
        store = fill(directory, frames, finish=False)
        for kind in ("segments", "packed"):
            result = open_result(directory)
            assert (result.kind, result.frame_count, result.dimension) == (kind, len(counts), d)
            assert result.times.dtype == np.float64
            assert result.times.tolist() == [frame.time for frame in frames]
            assert result.particle_counts.tolist() == counts
            assert result.ledger == [make_row(k, d) for k in range(len(counts))]
            assert result.header.stored == HEADER and set(result.field_names) == fields
            for read, frame in zip(result.frames(), frames, strict=True):
                assert_same_frame(read, frame)
            if kind == "segments":
                store._compress = compress
                store.finish()
        if sum(counts):
            assert_vtk_sees(directory / "particles.vtkhdf", frames)


def datasets(path: Path) -> dict[str, tuple]:
    """Return type, shape and bytes of every data set of a file."""
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item}) if isinstance(item, h5py.Dataset) else None)
        return {name: (str(item.dtype), item.shape, item[()].tobytes()) for name, item in found.items()}


@settings(deadline=None, max_examples=10)
@given(
    frames=st.lists(st.tuples(st.integers(0, 40), st.booleans()), min_size=1, max_size=6),
    d=st.sampled_from([2, 3]),
    compress=st.booleans(),
)
def test_frames_that_are_sealed_together_are_those_that_are_sealed_alone(frames, d, compress):
    """Wherever the seals fall: sealed frames can be read, waiting ones do not count, the packed file is equal."""
    made = [make_frame(k, n, d) for k, (n, _) in enumerate(frames)]
    with TemporaryDirectory() as place:
        alone, together = Path(place) / "alone", Path(place) / "together"
        for directory in (alone, together):
            directory.mkdir()
        fill(alone, made, compress=compress)
        store = SegmentStore(together, HEADER, compress=compress, hold=math.inf)
        written = 0
        for frame, (_, seal) in zip(made, frames, strict=True):
            store.write(frame, make_row(frame.index, d))
            if seal:
                store.seal()
                written = frame.index + 1
            assert store.frames_written == written
            if written:
                result = open_result(together)
                assert (result.kind, result.frame_count) == ("segments", written)
                for read, expected in zip(result.frames(), made, strict=False):
                    assert_same_frame(read, expected)
        store.finish()
        assert store.frames_written == len(frames) and os.listdir(together) == ["particles.vtkhdf"]
        assert datasets(together / "particles.vtkhdf") == datasets(alone / "particles.vtkhdf")


def test_frames_wait_for_the_time_or_the_size_that_seals_them(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(store_module.time, "monotonic", lambda: now[0])
    store = SegmentStore(tmp_path, HEADER, hold=1.0)
    counts = []
    for k, at in enumerate((0.0, 0.5, 0.9, 1.0, 1.2, 5.0)):
        now[0] = at
        store.write(make_frame(k, 10, 2), make_row(k, 2))
        counts.append(store.frames_written)
    # The first waits until 1.0, and the fifth, which comes at 1.2, until 5.0.
    assert counts == [0, 0, 0, 4, 4, 6]
    store.write(make_frame(6, 10, 2), make_row(6, 2))
    now[0] = 5.9
    store.seal_due()
    assert store.frames_written == 6
    now[0] = 6.0
    store.seal_due()
    assert store.frames_written == 7
    monkeypatch.setattr(store_module, "MOST_WAITING", 200_000)
    store.write(make_frame(7, 10, 2), make_row(7, 2))
    assert store.frames_written == 7
    store.write(make_frame(8, 10_000, 2), make_row(8, 2))
    assert store.frames_written == 9
    names = [path.name for path in sealed_segments(tmp_path)]
    assert names == [f"frame_{k:06d}.vtkhdf" for k in (0, 4, 6, 7)]


@pytest.fixture
def slow_disk(monkeypatch) -> Event:
    """Let threads seal every frame, and a file be synced only when the event is set, or fail at a third one then."""
    monkeypatch.setattr(store_module, "ASIDE", 0)
    ready, synced, sync = Event(), [], durable_module.sync_file

    def slow(path: Path) -> None:
        assert ready.wait(60)
        synced.append(path)
        if len(synced) == 3:
            raise OSError(errno.EIO, "the disk is gone")
        sync(path)

    monkeypatch.setattr(durable_module, "sync_file", slow)
    return ready


def test_a_frame_that_a_thread_seals_counts_when_it_is_durable(tmp_path, slow_disk):
    store = SegmentStore(tmp_path, HEADER)
    store.write(make_frame(0, 10, 2), make_row(0, 2))
    store.seal_due()
    assert (store.frames_written, sealed_segments(tmp_path)) == (0, [])
    slow_disk.set()
    store.seal()
    assert (store.frames_written, len(sealed_segments(tmp_path))) == (1, 1)
    store.write(make_frame(1, 10, 2), make_row(1, 2))
    # The next write waits for the one before.
    store.write(make_frame(2, 10, 2), make_row(2, 2))
    assert store.frames_written == 2


def test_a_failure_of_the_thread_is_told_at_the_next_frame_which_is_not_written(tmp_path, slow_disk):
    store = SegmentStore(tmp_path, HEADER)
    slow_disk.set()
    for k in range(3):
        store.write(make_frame(k, 10, 2), make_row(k, 2))
    with pytest.raises(RunError, match=r"^frame 2 could not be written .*disk is gone.*2 frames before it are kept"):
        store.write(make_frame(3, 10, 2), make_row(3, 2))
    store.seal()
    assert (store.frames_written, len(sealed_segments(tmp_path))) == (2, 2)


def test_a_disk_that_is_full_at_a_seal_loses_the_waiting_frames_and_says_so(tmp_path, monkeypatch):
    store = SegmentStore(tmp_path, HEADER, hold=math.inf)
    for k in range(2):
        store.write(make_frame(k, 100, 2), make_row(k, 2))
    store.seal()
    for k in (2, 3):
        store.write(make_frame(k, 100, 2), make_row(k, 2))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9 - 10**6, 10**6))
    with pytest.raises(RunError, match=r"frame 2 needs .* the 2 frames before it are kept"):
        store.seal()
    monkeypatch.undo()
    store.finish()
    assert open_result(tmp_path).frame_count == store.frames_written == 2


@pytest.mark.parametrize("compress", [False, True])
def test_vtk_reads_every_frame_of_a_packed_file(tmp_path, compress):
    frames = [make_frame(k, n, 3, fields=tuple(FIELDS)) for k, n in enumerate((30_000, 31_274, 1, 29_137))]
    fill(tmp_path, frames, compress=compress)
    assert [path.name for path in tmp_path.iterdir()] == ["particles.vtkhdf"]
    assert_vtk_sees(tmp_path / "particles.vtkhdf", frames)


def test_vtk_reads_a_sealed_segment_while_the_run_goes_on(tmp_path):
    frames = [make_frame(k, 50, 2) for k in range(2)]
    fill(tmp_path, frames, finish=False)
    for path, frame in zip(sealed_segments(tmp_path), frames, strict=True):
        assert_vtk_sees(path, [frame])
        single = open_result(path)
        assert_same_frame(single.frame(0), frame)


def test_h5py_needs_three_lines(tmp_path):
    frames = [make_frame(k, n, 3) for k, n in enumerate((10, 20, 5))]
    fill(tmp_path, frames)
    with h5py.File(tmp_path / "particles.vtkhdf") as f:
        start, n = f["VTKHDF/Steps/PointOffsets"][1], f["VTKHDF/NumberOfPoints"][1]
        position = f["VTKHDF/Points"][start : start + n]
    assert position.tobytes() == frames[1].position.tobytes()


def test_a_file_that_a_notebook_holds_open_can_be_read(tmp_path):
    fill(tmp_path, [make_frame(0, 10, 2)])
    with h5py.File(tmp_path / "particles.vtkhdf"):
        assert open_result(tmp_path).frame(0).index == 0


def test_the_file_says_what_it_is(tmp_path):
    fill(tmp_path, [make_frame(0, 10, 2)])
    with h5py.File(tmp_path / "particles.vtkhdf") as f:
        assert f["VTKHDF"].attrs["Type"] == b"PolyData"
        assert f["mpmcli"].attrs["scene"] == HEADER["scene"]
        assert f["ledger/limit"].shape == (1,) and f["ledger/linear_momentum"].shape == (1, 2)
        # The vertex list is stored once and no dataset wastes room on padding.
        assert f["VTKHDF/Points"].chunks is None
        assert f["VTKHDF/Vertices/Connectivity"].shape == (10,)


def test_a_long_scene_fits(tmp_path):
    """HDF5 attributes were once limited to 64 KiB."""
    store = SegmentStore(tmp_path, {"scene": "#" * 300_000})
    store.write(make_frame(0, 3, 2), make_row(0, 2))
    store.finish()
    assert open_result(tmp_path).header.stored == {"scene": "#" * 300_000}


def test_compression_saves_what_is_constant(tmp_path):
    sizes = []
    for compress in (False, True):
        directory = tmp_path / str(compress)
        frames = [make_frame(k, 20_000, 3) for k in range(3)]
        for frame in frames:
            frame.fields["density"][:] = 1000
            frame.fields["pressure"][:] = 0
        fill(directory, frames, compress=compress)
        sizes.append((directory / "particles.vtkhdf").stat().st_size)
        assert_same_frame(open_result(directory).frame(2), frames[2])
    # 24 of the 44 bytes per particle are random; ids, and random numbers below 3, compress well.
    assert sizes[1] < 0.65 * sizes[0]
    assert sizes[0] < 3 * 20_000 * 44 + 20_000 * 8 + 30_000


def test_nothing_written_makes_no_file(tmp_path):
    assert SegmentStore(tmp_path, HEADER).finish() is None
    assert list(tmp_path.iterdir()) == []


def test_frames_come_in_order(tmp_path):
    store = SegmentStore(tmp_path, HEADER)
    with pytest.raises(ValueError, match="frame 1 was given where frame 0"):
        store.write(make_frame(1, 3, 2), make_row(1, 2))


def test_an_earlier_result_is_not_mixed_with_a_new_one(tmp_path):
    fill(tmp_path, [make_frame(0, 3, 2)])
    with pytest.raises(InputError, match="earlier result"):
        fill(tmp_path, [make_frame(0, 3, 2)])


@pytest.mark.parametrize("hold", [0.0, 0.1])
def test_a_killed_run_keeps_every_sealed_frame(tmp_path, hold):
    """SIGKILL in the middle of a frame: what was reported as written is there, the rest is ignored."""
    program = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from test_output_frames import make_frame, make_row
from mpmcli.output import SegmentStore, durable
durable.largest_file = lambda: None
store = SegmentStore(Path({str(tmp_path)!r}), {{}}, hold={hold})
k = 0
while True:
    store.write(make_frame(k, 2000, 2), make_row(k, 2))
    k += 1
    print(store.frames_written, flush=True)
"""
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    reported = 0
    while reported < 5:
        reported = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    rest = process.stdout.read().split()
    process.wait()
    reported = int(rest[-1]) if rest else reported
    (tmp_path / "segments/frame_999999.vtkhdf.tmp").write_bytes(b"torn")
    result = open_result(tmp_path)
    # One more seal than was reported, of one frame or of those of 0.1 s.
    assert reported <= result.frame_count and (hold or result.frame_count <= reported + 1)
    for k, frame in enumerate(result.frames()):
        assert_same_frame(frame, make_frame(k, 2000, 2))


def test_a_full_disk_is_seen_before_it_is_met(tmp_path, monkeypatch):
    frames = [make_frame(k, 100, 2) for k in range(3)]
    store = fill(tmp_path, frames[:2], finish=False)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9 - 10**6, 10**6))
    with pytest.raises(RunError, match=r"1\.0 MB left, but frame 2 needs .* the 2 frames before it are kept"):
        store.write(frames[2], make_row(2, 2))
    with pytest.raises(RunError, match=r"packing the frames into particles.vtkhdf needs .* 2 frames .* kept"):
        store.finish()
    assert store.frames_written == 2
    result = open_result(tmp_path)
    assert result.kind == "segments" and result.frame_count == 2
    for read, frame in zip(result.frames(), frames[:2], strict=True):
        assert_same_frame(read, frame)


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="needs POSIX file size limits")
def test_a_disk_that_refuses_ends_in_one_sentence(tmp_path):
    """The write itself fails, as on a disk that fills between the question and the write."""
    program = f"""
import resource, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from test_output_frames import make_frame, make_row
from mpmcli.errors import RunError
from mpmcli.output import SegmentStore, durable
durable.largest_file = lambda: None
store = SegmentStore(Path({str(tmp_path)!r}), {{}})
store.write(make_frame(0, 100, 2), make_row(0, 2))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    store.write(make_frame(1, 50_000, 2), make_row(1, 2))
except RunError as error:
    print(error)
"""
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    assert "frame 1 could not be written" in process.stdout and "the frame before it is kept" in process.stdout
    assert [path.name for path in (tmp_path / "segments").iterdir()] == ["frame_000000.vtkhdf"]
    assert_same_frame(open_result(tmp_path).frame(0), make_frame(0, 100, 2))


@pytest.mark.parametrize("name", ["VTKHDF/Points", "VTKHDF/PointData/id", "VTKHDF/Steps/CellOffsets", "ledger/mass"])
def test_verification_catches_a_corrupted_pack(tmp_path, monkeypatch, name):
    frames = [make_frame(k, 20, 3) for k in range(3)]
    store = fill(tmp_path, frames, finish=False)

    def corrupt(path: Path) -> None:
        if path.name.startswith("particles"):
            with h5py.File(path, "r+") as f:
                data = f[name][:]
                data.reshape(-1).view(np.uint8)[-4] ^= 1
                f[name][...] = data

    monkeypatch.setattr(store_module, "sync_file", corrupt)
    with pytest.raises(RunError, match=r"does not read back as it was written.*3 frames written are kept"):
        store.finish()
    assert [path.name for path in tmp_path.iterdir()] == ["segments"]
    assert_same_frame(open_result(tmp_path).frame(2), frames[2])
    monkeypatch.undo()
    store.finish()
    assert open_result(tmp_path).kind == "packed"


def test_a_segment_that_was_changed_meanwhile_is_not_packed(tmp_path):
    store = fill(tmp_path, [make_frame(k, 20, 3) for k in range(3)], finish=False)
    with h5py.File(sealed_segments(tmp_path)[1], "r+") as f:
        f["VTKHDF/Points"][7] += 1
    with pytest.raises(RunError, match="Points of frame 1"):
        store.finish()
    assert [path.name for path in tmp_path.iterdir()] == ["segments"] and len(sealed_segments(tmp_path)) == 3


def test_an_unfinished_packed_file_goes_when_a_run_goes_on(tmp_path):
    fill(tmp_path, [make_frame(k, 20, 3) for k in range(3)], finish=False)
    unfinished = tmp_path / "particles.vtkhdf.tmp"
    unfinished.write_bytes(b"0")
    SegmentStore(tmp_path, HEADER).go_on_after(open_result(tmp_path).index)
    assert not unfinished.exists() and len(sealed_segments(tmp_path)) == 3


def test_a_damaged_or_foreign_segment_is_not_packed(tmp_path):
    store = fill(tmp_path, [make_frame(k, 20, 3) for k in range(2)], finish=False)
    last = sealed_segments(tmp_path)[-1]
    content = last.read_bytes()
    last.write_bytes(content[:100])
    with pytest.raises(RunError, match="left unpacked"):
        store.finish()
    last.unlink()
    with pytest.raises(RunError, match=r"lacks frame_000001.vtkhdf, one of the 2 files written"):
        store.finish()
    other = SegmentStore(tmp_path / "other", {"scene": "title = 1"})
    for k in range(2):
        other.write(make_frame(k, 20, 3), make_row(k, 3))
    shutil.copy(sealed_segments(tmp_path / "other")[1], last)
    with pytest.raises(RunError, match="another run"):
        store.finish()
    last.write_bytes(content)
    assert store.finish() == tmp_path / "particles.vtkhdf"


def test_an_interrupt_while_packing_leaves_the_segments(tmp_path, monkeypatch):
    store = fill(tmp_path, [make_frame(k, 20, 3) for k in range(2)], finish=False)

    def interrupt(path: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(store_module, "sync_file", interrupt)
    with pytest.raises(KeyboardInterrupt):
        store.finish()
    assert os.listdir(tmp_path) == ["segments"]
    assert open_result(tmp_path).frame_count == 2


def test_a_frame_sealed_but_not_counted_is_packed(tmp_path):
    store = fill(tmp_path, [make_frame(k, 20, 3) for k in range(2)], finish=False)
    store._count = 1
    store.finish()
    assert open_result(tmp_path).frame_count == 2
    assert os.listdir(tmp_path) == ["particles.vtkhdf"]


def test_what_others_put_beside_the_segments_stays(tmp_path):
    store = fill(tmp_path, [make_frame(0, 20, 3)], finish=False)
    (tmp_path / "segments/notes.txt").write_text("mine")
    store.finish()
    assert (tmp_path / "segments/notes.txt").read_text() == "mine"
    assert open_result(tmp_path / "segments").kind == "packed"


def test_the_stores_work_in_a_prepared_directory(tmp_path):
    take_directory(directory := tmp_path / "a/b", overwrite=False).release()
    fill(directory, [make_frame(0, 20, 3)])
    assert open_result(directory).frame_count == 1

"""The VTK series: .vtu frames by meshio, read back by meshio, VTK and open_result."""

import shutil
import subprocess
import sys
from collections import namedtuple
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_output_frames import FIELDS, assert_same_frame, make_frame, make_row
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

from mpmcli.errors import InputError, RunError
from mpmcli.output import VtkSeriesStore, open_result
from mpmcli.output.layout import FrameLayout

HEADER = {"dimension": 2, "bodies": ["column"], "scene": 'title = "é"\n'}
Usage = namedtuple("Usage", "total used free")


def fill(directory: Path, frames, *, compress: bool = False) -> VtkSeriesStore:
    store = VtkSeriesStore(directory, HEADER, compress=compress)
    for frame in frames:
        store.write(frame, make_row(frame.index, frame.position.shape[1]))
    return store


@settings(deadline=None, max_examples=10)
@given(
    counts=st.lists(st.integers(0, 40), min_size=1, max_size=3),
    d=st.sampled_from([2, 3]),
    dtype=st.sampled_from(["float32", "float64"]),
    fields=st.sets(st.sampled_from(sorted(FIELDS))),
    compress=st.booleans(),
)
def test_round_trip(counts, d, dtype, fields, compress):
    frames = [make_frame(k, n, d, dtype, sorted(fields)) for k, n in enumerate(counts)]
    with TemporaryDirectory() as place:
        store = fill(Path(place), frames, compress=compress)
        assert store.finish() == Path(place) / "particles.pvd"
        for path in (place, store.finish()):
            result = open_result(path)
            assert (result.kind, result.dimension, result.header.stored) == ("series", d, HEADER)
            assert result.times.tolist() == [frame.time for frame in frames]
            assert result.particle_counts.tolist() == counts
            assert result.ledger == [make_row(k, d) for k in range(len(counts))]
        for read, frame in zip(result.frames(), frames, strict=True):
            assert_same_frame(read, frame)


@pytest.mark.parametrize("compress", [False, True])
def test_vtk_and_meshio_read_a_frame(tmp_path, compress, capfd):
    frame = make_frame(0, 20_000, 2, fields=tuple(FIELDS))
    fill(tmp_path, [frame], compress=compress)
    path = tmp_path / "particles_000000.vtu"
    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    grid, mesh = reader.GetOutput(), meshio.read(path)
    assert grid.GetNumberOfCells() == 20_000
    assert [(block.type, len(block.data)) for block in mesh.cells] == [("vertex", 20_000)]
    for name, stored in FrameLayout.of(frame).stored(frame):
        if name == "Points":
            by_vtk, by_meshio = vtk_to_numpy(grid.GetPoints().GetData()), mesh.points
        else:
            by_vtk, by_meshio = vtk_to_numpy(grid.GetPointData().GetArray(name)), mesh.point_data[name]
        assert by_vtk.tobytes() == by_meshio.tobytes() == stored.tobytes(), name
    assert capfd.readouterr() == ("", "")


def test_the_pvd_is_whole_after_every_frame(tmp_path):
    store = VtkSeriesStore(tmp_path, HEADER)
    for k in range(3):
        store.write(make_frame(k, 10, 3), make_row(k, 3))
        assert store.frames_written == k + 1
        entries = ElementTree.parse(tmp_path / "particles.pvd").getroot().findall("Collection/DataSet")
        assert [float(entry.get("timestep")) for entry in entries] == [0.1 * j for j in range(k + 1)]
        assert all((tmp_path / entry.get("file")).exists() for entry in entries)
        assert open_result(tmp_path).frame_count == k + 1
    assert not list(tmp_path.glob("*.tmp"))
    table = np.genfromtxt(tmp_path / "ledger.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert table["time"].tolist() == [make_row(k, 3).time for k in range(3)]
    assert table["linear_momentum_2"].tolist() == [make_row(k, 3).linear_momentum[2] for k in range(3)]


def test_a_full_disk_keeps_the_frames_before(tmp_path, monkeypatch):
    store = fill(tmp_path, [make_frame(0, 10, 2)])
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10, 9, 1))
    with pytest.raises(RunError, match=r"frame 1 needs .* the frame before it is kept"):
        store.write(make_frame(1, 10, 2), make_row(1, 2))
    assert open_result(tmp_path).frame_count == 1


def test_frames_that_are_not_listed_are_not_read(tmp_path):
    fill(tmp_path, [make_frame(k, 10, 2) for k in range(2)])
    shutil.copy(tmp_path / "particles_000001.vtu", tmp_path / "particles_000002.vtu")
    assert open_result(tmp_path).frame_count == 2


def test_nothing_written_makes_no_file(tmp_path):
    assert VtkSeriesStore(tmp_path, HEADER).finish() is None
    assert list(tmp_path.iterdir()) == []


def test_misuse_and_foreign_files_are_named(tmp_path):
    store = fill(tmp_path, [make_frame(0, 10, 2)])
    with pytest.raises(ValueError, match="frame 2 was given where frame 1"):
        store.write(make_frame(2, 10, 2), make_row(2, 2))
    with pytest.raises(InputError, match="earlier result"):
        fill(tmp_path, [make_frame(0, 10, 2)])
    with pytest.raises(InputError, match=r"one frame of a series: give .*particles\.pvd"):
        open_result(tmp_path / "particles_000000.vtu")
    result = open_result(tmp_path)
    with pytest.raises(InputError, match="no frame 1: it holds frames 0 to 0"):
        result.frame(1)
    (tmp_path / "particles_000000.vtu").write_text("<torn")
    with pytest.raises(InputError, match="missing or damaged"):
        result.frame(0)
    (tmp_path / "particles.json").unlink()
    with pytest.raises(InputError, match="not a series of mpmcli"):
        open_result(tmp_path)


def test_the_package_imports_neither_vtk_nor_meshio():
    heavy = ("vtk", "vtkmodules", "meshio", "taichi", "pyvista")
    program = f"import sys, mpmcli.output; print([m for m in {heavy} if m in sys.modules])"
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"

"""The series of VTK files: read by meshio, VTK and numpy, and there as a whole or not at all."""

import shutil
import subprocess
import sys
from collections import namedtuple
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
from command import run_here
from test_checksums import flip
from test_output_frames import FIELDS, make_frame, make_row
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

from mpmcli.errors import RunError
from mpmcli.output import SegmentStore, open_result
from mpmcli.output.layout import FrameLayout
from mpmcli.output.series import write_series

HEADER = {"dimension": 2, "bodies": ["column"], "scene": 'title = "é"\n'}
Usage = namedtuple("Usage", "total used free")


def fill(directory: Path, frames) -> Path:
    """Write a packed result, and return its directory."""
    store = SegmentStore(directory, HEADER)
    for frame in frames:
        store.write(frame, make_row(frame.index, frame.position.shape[1]))
    store.finish()
    return directory


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize(("d", "dtype"), [(2, "float32"), (3, "float64")])
def test_vtk_and_meshio_read_a_frame(tmp_path, d, dtype, compress, capfd):
    frames = [make_frame(k, n, d, dtype, tuple(FIELDS)) for k, n in enumerate((2000, 1))]
    write_series(fill(tmp_path, frames), [], compress=compress)
    for frame in frames:
        path, n = tmp_path / f"particles_{frame.index:06d}.vtu", len(frame.position)
        reader = vtkXMLUnstructuredGridReader()
        reader.SetFileName(str(path))
        reader.Update()
        grid, mesh = reader.GetOutput(), meshio.read(path)
        assert grid.GetNumberOfCells() == n
        assert [(block.type, len(block.data)) for block in mesh.cells] == [("vertex", n)]
        for name, stored in FrameLayout.of(frame).stored(frame):
            if name == "Points":
                by_vtk, by_meshio = vtk_to_numpy(grid.GetPoints().GetData()), mesh.points
            else:
                by_vtk, by_meshio = vtk_to_numpy(grid.GetPointData().GetArray(name)), mesh.point_data[name]
            assert by_vtk.tobytes() == by_meshio.tobytes() == stored.tobytes(), name
    assert capfd.readouterr() == ("", "")


def test_the_pvd_and_the_ledger_list_all_frames(tmp_path):
    """The number of particles may change from frame to frame, to none."""
    counts = [10, 0, 7]
    fill(tmp_path, [make_frame(k, n, 3) for k, n in enumerate(counts)])
    assert write_series(tmp_path, []) == tmp_path / "particles.pvd"
    entries = ElementTree.parse(tmp_path / "particles.pvd").getroot().findall("Collection/DataSet")
    assert [float(entry.get("timestep")) for entry in entries] == [0.1 * k for k in range(3)]
    assert all((tmp_path / entry.get("file")).exists() for entry in entries)
    table = np.genfromtxt(tmp_path / "ledger.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert table["frame"].tolist() == [0, 1, 2] and table["particles"].tolist() == counts
    assert table["time"].tolist() == [make_row(k, 3).time for k in range(3)]
    assert table["linear_momentum_2"].tolist() == [make_row(k, 3).linear_momentum[2] for k in range(3)]


def test_a_file_of_a_series_that_changed_is_named(tmp_path):
    write_series(fill(tmp_path, [make_frame(k, 10, 2) for k in range(3)]), [])
    outcome = run_here("info", tmp_path, "--verify")
    assert outcome.status == 0 and "6 files, 3 frames: ok" in outcome.stdout
    flip(tmp_path / "particles_000001.vtu", 700)
    outcome = run_here("info", tmp_path, "--verify")
    assert outcome.status == 1 and "particles_000001.vtu has changed" in outcome.stdout
    assert open_result(tmp_path / "particles.pvd").frame_count == 3


@pytest.mark.parametrize("fault", ["room", "disk", "stop"])
def test_what_ends_a_series_leaves_none(tmp_path, monkeypatch, fault):
    fill(tmp_path, [make_frame(k, 10, 2) for k in range(3)])
    before = sorted(tmp_path.iterdir())
    if fault == "room":
        monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10, 9, 1))
    if fault == "disk":

        def refuse(*_: object) -> None:
            raise OSError(5, "Input/output error")

        monkeypatch.setattr("mpmcli.output.series.ledger_csv", refuse)
    asked = iter([False, True])
    stop = (lambda: next(asked)) if fault == "stop" else lambda: False
    error, sentence = (KeyboardInterrupt, None) if fault == "stop" else (RunError, "are kept")
    with pytest.raises(error, match=sentence):
        write_series(tmp_path, [], stop=stop)
    assert sorted(tmp_path.iterdir()) == before


def test_the_package_imports_neither_vtk_nor_meshio():
    heavy = ("vtk", "vtkmodules", "meshio", "taichi", "pyvista")
    program = f"import sys, mpmcli.output; print([m for m in {heavy} if m in sys.modules])"
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"

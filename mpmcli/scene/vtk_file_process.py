"""A process that reads one file with VTK, PyVista or meshio, and writes its points and triangles to another one.

python -m mpmcli.scene.vtk_file_process FILE OUT.npz
"""

import os
import sys
import warnings
from contextlib import suppress

import numpy as np

from mpmcli.processes.questions import answering

# Beyond what the libraries have taken: bytes, and for each byte of the file; s, and for each byte.
_BYTES, _BYTES_EACH = 3 * 2**28, 64
_SECONDS, _SECONDS_EACH = 15, 2e-6


def main() -> None:
    """Read the file, and answer with the names of its arrays; whatever it raises or crashes by, it answers nothing."""
    path, out = sys.argv[1:]
    with answering() as answer:
        import pyvista as pv
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkFiltersCore import vtkTriangleFilter
        from vtkmodules.vtkFiltersGeometry import vtkDataSetSurfaceFilter

        _limit(os.path.getsize(path))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = pv.read(path)
            found = found.combine() if isinstance(found, pv.MultiBlock) else found
            points, data = np.array(found.points, np.float64), found.point_data
            arrays = {str(name): np.asarray(data[name]) for name in data.keys()}  # noqa: SIM118
            arrays = {name: array for name, array in arrays.items() if array.dtype.kind in "iuf"}
            surface, triangles = vtkDataSetSurfaceFilter(), vtkTriangleFilter()
            surface.SetInputData(found)
            triangles.SetInputConnection(surface.GetOutputPort())
            triangles.PassVertsOff()
            triangles.PassLinesOff()
            triangles.Update()
            result = triangles.GetOutput()
        vertices, corners = points[:0], np.empty((0, 3), np.int64)
        if result.GetNumberOfPolys():
            vertices = vtk_to_numpy(result.GetPoints().GetData()).astype(np.float64)
            corners = vtk_to_numpy(result.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
            if corners.min() < 0 or corners.max() >= len(vertices):
                raise ValueError("a corner is no vertex")
        columns = {f"array_{k}": array for k, array in enumerate(arrays.values())}
        np.savez(out, points=points, vertices=vertices, triangles=corners, **columns)
        answer(arrays=list(arrays))


def _limit(size: int) -> None:
    """Bound memory and time by the size of the file, where the system can."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        with open("/proc/self/statm", encoding="ascii") as statm:
            taken = int(statm.read().split()[0]) * resource.getpagesize()
        most = taken + _BYTES + _BYTES_EACH * size
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))
        seconds = int(sum(os.times()[:2]) + _SECONDS + _SECONDS_EACH * size)
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.getrlimit(resource.RLIMIT_CPU)[1]))


if __name__ == "__main__":
    main()

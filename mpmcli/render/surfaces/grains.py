"""Loose grains: a small ball for every particle, each a little lighter or darker than the next."""

from typing import Any

import numpy as np

from mpmcli.render.shading.lighting import Lights
from mpmcli.render.view import View

# Radius of a ball, in distances between particles: a little more than half, so that a heap has no holes.
RADIUS = 0.6
# By how much grains differ in brightness, as a share.
VARIETY = 0.26
# By how much a grain is moved, in distances between particles: heaps are no lattices.
JITTER = 0.3


def new_grains(view: View, lights: Lights, distance: float) -> Any:
    """Return an actor without grains, whose balls are lit from the side of the lamp."""
    import vtk

    mapper = vtk.vtkPointGaussianMapper()
    mapper.SetInputData(vtk.vtkPolyData())
    mapper.EmissiveOff()
    mapper.SetScaleFactor(RADIUS * distance)
    right, up, back = (float(lights.lamp @ axis) for axis in view.axes)
    mapper.SetSplatShaderCode(
        f"""//VTK::Color::Impl
        vec2 off = offsetVCVSOutput.xy;
        float far = dot(off, off);
        if (far > 1.0) {{ discard; }}
        float lit = dot(vec3(off, sqrt(1.0 - far)), vec3({right:.6f}, {up:.6f}, {back:.6f}));
        float shade = 0.50 + 0.56 * max(0.5 * lit + 0.5, 0.0);
        opacity = 1.0;
        diffuseColor = vertexColorVSOutput.rgb * shade;
        ambientColor = vec3(0.0);
        """
    )
    actor = vtk.vtkActor()
    actor.SetMapper(mapper)
    return actor


def pose_grains(actor: Any, position: np.ndarray, colors: np.ndarray) -> None:
    """Put the grains at (n, 3), with colours (n, 3) from 0 to 1 as the display shows them."""
    import pyvista as pv

    cloud = pv.PolyData(position.astype(np.float32)) if len(position) else pv.PolyData()
    cloud.point_data["colors"] = (255.0 * np.clip(colors, 0.0, 1.0) + 0.5).astype(np.uint8)
    mapper = actor.GetMapper()
    mapper.SetInputData(cloud)
    mapper.SetScalarModeToUsePointFieldData()
    mapper.SelectColorArray("colors")
    mapper.SetColorModeToDirectScalars()


def grain_colors(color: np.ndarray, hashes: np.ndarray, lamp: np.ndarray, sky: np.ndarray) -> np.ndarray:
    """Return colours (n, 3), as the display shows them, of grains that this much light reaches.

    Args:
        color: (3,) or (n, 3), of the heap.
        hashes: (n, 3) from -1 to 1, by which each differs.
        lamp, sky: (n,) shares of the light.
    """
    light = 0.42 + 0.34 * lamp + 0.30 * sky
    own = 1.0 + VARIETY * hashes[:, 0] * np.abs(hashes[:, 0]) + 0.08 * hashes[:, 1]
    return np.broadcast_to(color, (len(lamp), 3)) * (light * own)[:, None]

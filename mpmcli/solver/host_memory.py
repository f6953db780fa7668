"""Memory of the host that the particles of a run need beside the device."""

from collections.abc import Sequence

import numpy as np

from mpmcli.materials.law import Law
from mpmcli.scene import Scene
from mpmcli.scene.initial import has_expressions
from mpmcli.solver.frame_arrays import FrameColumns


def host_bytes_of(scene: Scene, members: Sequence[Law], particles: int, real: int, *, on_cpu: bool) -> int:
    """Return the bytes that particles take on the host at most: at the start, or while a frame is built and written.

    Python, Taichi and its compiler take about 200 MB more, whatever the scene.

    Args:
        members: the laws; real: bytes of a real number on the device.
    """
    d = scene.dimension
    # Double precision: places, and where they vary velocities, their gradients and deformations.
    start = 8 * (d + any(map(has_expressions, scene.bodies)) * (d + 2 * d * d))
    internal = max(len(law.internal) for law in members)
    columns = FrameColumns(d, internal, scene.output.fields, comes_and_goes=scene.comes_and_goes)
    widths = {"velocity": 0, "initial_position": d, "affine": d * d, "deformation_gradient": d * d, "stress": 9}
    fields = sum(widths.get(name, 1) for name in scene.output.fields)
    # Of the frame: positions, velocities and fields.
    frame = real * (2 * d + fields) + scene.comes_and_goes
    # The array that is being written: the number of each particle, or in 2D what has the components of 3D.
    frame += 4 if d == 3 else real * (3 if {"affine", "deformation_gradient"}.isdisjoint(scene.output.fields) else 9)
    if len(scene.sources) > 1:
        frame += 2 * np.dtype(np.int32).itemsize
    if "initial_position" in scene.output.fields:
        frame += real * d
    if not on_cpu:
        # The state as it was copied, and what numpy makes of it.
        return particles * (start + frame + 2 * 8 * (2 * d + d * d))
    return particles * max(start, real * columns.count + frame)

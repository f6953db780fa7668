"""Points as PLY, a file per frame, for Blender, Houdini, trimesh and VTK.

The writer of meshio notes the time of writing in each file, and leaves out vectors.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from mpmcli.dataset.formats.format import Written
from mpmcli.dataset.formats.vtk import Vtkhdf, stored_frames
from mpmcli.dataset.shard import group_name
from mpmcli.frames.frame import ACTIVE, STATUS
from mpmcli.output.layout import POSITION

TYPES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
TYPES |= {"f4": "float", "f8": "double"}
COMPONENTS = {POSITION: ("x", "y", "z"), "velocity": ("vx", "vy", "vz")}


class Ply(Vtkhdf):
    """Binary files, little-endian, of vertices with x, y, z (0 in 2D), id, vx, vy, vz, body, material and fields.

    Particles that wait or have gone are left out. Components of other vectors and tensors are numbered, rows first:
    deformation_gradient_0 to _8. Whole numbers of 64 bits, which PLY lacks, become doubles.
    """

    files = r"\d{6,}_\d{6,}\.ply"

    def size(self) -> int:
        return sum(e.particle_count * e.layout.bytes_per_particle * e.frame_count for e in self.trajectories)

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        for each in self.trajectories:
            for time, frame, arrays in stored_frames(each):
                if STATUS in arrays:
                    present = arrays[STATUS] == ACTIVE
                    arrays = {name: array[present] for name, array in arrays.items()}
                path = directory / f"{group_name(each.source.number)}_{frame:06d}.ply"
                path.write_bytes(ply_bytes(arrays, f"time {time!r} s"))
            tick()
        return {}, []


def ply_bytes(arrays: Mapping[str, np.ndarray], comment: str) -> bytes:
    """Return the file of arrays with n rows; source: paulbourke.net/dataformats/ply."""
    columns: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        parts = array.reshape(len(array), -1).T
        numbered = [name] if array.ndim == 1 else [f"{name}_{k}" for k in range(len(parts))]
        columns |= dict(zip(COMPONENTS.get(name, numbered), parts, strict=True))
    kinds = {name: column.dtype.str[1:] if column.dtype.str[1:] in TYPES else "f8" for name, column in columns.items()}
    rows = np.empty(len(arrays[POSITION]), [(name, f"<{kind}") for name, kind in kinds.items()])
    for name, column in columns.items():
        rows[name] = column
    head = ["ply", "format binary_little_endian 1.0", f"comment {comment}", f"element vertex {len(rows)}"]
    head += [f"property {TYPES[kind]} {name}" for name, kind in kinds.items()]
    return "\n".join([*head, "end_header\n"]).encode("ascii", "replace") + rows.tobytes()

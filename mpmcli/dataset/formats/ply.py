"""Points, and surfaces of colliders, as PLY, a file of each per frame, for Blender, Houdini, trimesh and VTK.

The writer of meshio notes the time of writing in each file, and leaves out vectors.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from mpmcli.dataset.formats.format import Written
from mpmcli.dataset.formats.vtk import Vtkhdf, stored_frames
from mpmcli.dataset.shard import group_name
from mpmcli.frames.frame import ACTIVE, STATUS
from mpmcli.output.collider_files import ColliderGroup, collider_groups
from mpmcli.output.layout import POSITION

TYPES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
TYPES |= {"f4": "float", "f8": "double"}
COMPONENTS = {POSITION: ("x", "y", "z"), "velocity": ("vx", "vy", "vz")}


class Ply(Vtkhdf):
    """Binary files, little-endian, of vertices with x, y, z (0 in 2D), id, vx, vy, vz, body, material and fields.

    Particles that wait or have gone are left out. Components of other vectors and tensors are numbered, rows first:
    deformation_gradient_0 to _8. Whole numbers of 64 bits, which PLY lacks, become doubles. Colliders are in files
    of their own, those at rest in one: triangles, in 2D edges, of vertices with the number of their `collider`.
    """

    files = r"\d{6,}(_colliders)?(_\d{6,})?\.ply"

    def size(self) -> int:
        return sum(e.particle_count * e.layout.bytes_per_particle * e.frame_count for e in self.trajectories)

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        """Write a file per frame with the particles present, and files of colliders: per frame for those that move."""
        for each in self.trajectories:
            name = group_name(each.source.number)
            groups = list(collider_groups(each.source.header.stored, each.source.colliders))
            for time, frame, arrays in stored_frames(each):
                if STATUS in arrays:
                    present = arrays[STATUS] == ACTIVE
                    arrays = {key: array[present] for key, array in arrays.items()}
                comment = f"time {time!r} s"
                (directory / f"{name}_{frame:06d}.ply").write_bytes(ply_bytes(comment, vertex=_columns(arrays)))
                for group in groups:
                    path = directory / (f"{name}_colliders_{frame:06d}.ply" if group.moves else f"{name}_colliders.ply")
                    if group.moves or frame == each.frames[0]:
                        path.write_bytes(ply_bytes(comment, **_surface(group, time)))
            tick()
        return {}, []


def _columns(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns of arrays, (n,) or (n, k), by name."""
    columns: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        parts = np.atleast_2d(array.T)
        numbered = [name] if array.ndim == 1 else [f"{name}_{k}" for k in range(len(parts))]
        columns |= dict(zip(COMPONENTS.get(name, numbered), parts, strict=True))
    return columns


def _surface(group: ColliderGroup, time: float) -> dict[str, dict[str, np.ndarray]]:
    """Return the vertices of colliders, with the number of the collider of each, and their edges (2D) or faces."""
    numbers = np.repeat(np.array(group.numbers, np.int32), [len(surface.points) for surface in group.surfaces])
    vertices, cells = _columns({POSITION: group.points(time), "collider": numbers}), group.whole.cells.astype(np.int32)
    if cells.shape[1] == 2:
        return {"vertex": vertices, "edge": {"vertex1": cells[:, 0], "vertex2": cells[:, 1]}}
    return {"vertex": vertices, "face": {"vertex_indices": cells}}


def ply_bytes(comment: str, **elements: Mapping[str, np.ndarray]) -> bytes:
    """Return the file of elements of columns, (n,), or (n, k) for lists; source: paulbourke.net/dataformats/ply."""
    head, body = ["ply", "format binary_little_endian 1.0", f"comment {comment}"], b""
    for element, columns in elements.items():
        count = len(next(iter(columns.values())))
        head.append(f"element {element} {count}")
        kinds = []
        for name, column in columns.items():
            kind = column.dtype.str[1:] if column.dtype.str[1:] in TYPES else "f8"
            head.append(f"property {'list uchar ' * (column.ndim - 1)}{TYPES[kind]} {name}")
            kinds += [(f"length of {name}", "u1")] * (column.ndim - 1) + [(name, f"<{kind}", column.shape[1:])]
        rows = np.empty(count, kinds)
        for name, column in columns.items():
            rows[name] = column
            if column.ndim > 1:
                rows[f"length of {name}"] = column.shape[1]
        body += rows.tobytes()
    return "\n".join([*head, "end_header\n"]).encode("ascii", "replace") + body

"""Writes surfaces of colliders for ParaView: colliders at rest once, moving ones at every frame.

The files are VTKHDF PolyData, as for particles (see `vtkhdf`), with triangles in 3D and lines in 2D. All frames share
one list of cells; colliders at rest also share one set of points.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np

from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.checksums import append_checksum, load_checksums, store_checksums, table_checksum
from mpmcli.output.durable import require_free_space, sealed, write_text, writing
from mpmcli.output.vtkhdf import FORMAT, LIBVER, open_vtkhdf
from mpmcli.scene.colliders import Collider
from mpmcli.scene.mesh import ClosedSurface
from mpmcli.scene.surface import Surface, collider_surface, form_surface, joined

RESTING, MOVING = "colliders.vtkhdf", "colliders_moving.vtkhdf"
SERIES = "colliders.pvd"
RESTING_PIECE, MOVING_PIECE = "colliders.vtu", "colliders_{:06d}.vtu"
MOVING_FRAME = re.compile(r"colliders_\d{6,}\.vtu")
# Groups of cells in the order of VTK; those for 2D and 3D.
CELLS = ("Vertices", "Lines", "Polygons", "Strips")


@dataclass(frozen=True, eq=False)
class ColliderGroup:
    """The moving colliders of a run, or those at rest: their surfaces at the shape, and their numbers."""

    colliders: tuple[Collider, ...]
    surfaces: tuple[Surface, ...]
    numbers: tuple[int, ...]
    moves: bool

    @property
    def name(self) -> str:
        """Name of the VTKHDF file."""
        return MOVING if self.moves else RESTING

    @property
    def whole(self) -> Surface:
        """All surfaces as one."""
        return joined(list(self.surfaces), self.surfaces[0].points.shape[1])

    @cached_property
    def meshes(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Vertices and triangles of colliders from files, by number; the files may be gone later."""
        pairs = zip(self.numbers, self.colliders, strict=True)
        forms = {number: form_surface(collider.form) for number, collider in pairs if collider.shape.files}
        return {number: (surface.points, surface.cells) for number, surface in forms.items()}

    @property
    def labels(self) -> np.ndarray:
        """The number of the collider of each cell, (m,) int32."""
        return np.repeat(np.array(self.numbers, np.int32), [len(surface.cells) for surface in self.surfaces])

    def points(self, time: float) -> np.ndarray:
        """Return the points (n, 3) at a time, s; z = 0 in 2D."""
        pairs = zip(self.colliders, self.surfaces, strict=True)
        moved = np.concatenate([collider.motion.placed(surface.points, time) for collider, surface in pairs])
        return np.pad(moved, ((0, 0), (0, 3 - moved.shape[1])))


class Recorded(Protocol):
    """A run with frames at times, s, and a row of the ledger for each."""

    times: np.ndarray

    @property
    def ledger(self) -> Sequence[LedgerRow]: ...


def as_they_moved(colliders: Sequence[Collider | None], run: Recorded) -> tuple[Collider | None, ...]:
    """Return the colliders of a run; free ones have the motion in its ledger."""
    found, free = list(colliders), [k for k, collider in enumerate(colliders) if collider is not None and collider.free]
    ledger = run.ledger if free else ()
    if ledger and len(ledger[0].rigid_pose) == len(free):
        poses = np.array([row.rigid_pose for row in ledger])
        for j, k in enumerate(free):
            found[k] = found[k].along(np.asarray(run.times, float), poses[:, j])
    return tuple(found)


def write_collider_files(
    directory: Path, header: Mapping[str, Any], times: Sequence[float], colliders: Sequence[Collider]
) -> None:
    """Write the colliders of a run, if it has any, at the times of its frames, s; RunError: a write failed."""
    for group in collider_groups(header, colliders):
        frames = len(times) if group.moves else 1
        size = 24 * sum(len(s.points) for s in group.surfaces) * frames + 32 * len(group.labels) + 2**16
        size += 200 * len(times) + sum(vertices.nbytes + cells.nbytes for vertices, cells in group.meshes.values())
        with _written(directory, group.name, size) as path:
            _write_vtkhdf(path, group, times)


def write_collider_series(
    directory: Path, header: Mapping[str, Any], times: Sequence[float], colliders: Sequence[Collider]
) -> list[str]:
    """Write the colliders of a run as .vtu files and a .pvd, and return their names; RunError: a write failed."""
    entries: list[tuple[float, int, str]] = []
    for group in collider_groups(header, colliders):
        size = 64 * (3 * sum(len(s.points) for s in group.surfaces) + 3 * len(group.labels)) + 2**12
        for k, time in enumerate(times):
            name = MOVING_PIECE.format(k) if group.moves else RESTING_PIECE
            entries.append((time, int(group.moves), name))
            if group.moves or k == 0:
                with _written(directory, name, size) as path:
                    _write_vtu(path, group, time)
    if entries:
        write_text(directory / SERIES, pvd_text(sorted(entries)))
    return sorted({name for _, _, name in entries} | ({SERIES} if entries else set()))


def pvd_text(entries: Sequence[tuple[float, int, str]]) -> str:
    """Return the text of a .pvd file, which lists files by time, s, and part."""
    lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "<Collection>"]
    lines += [f'<DataSet timestep="{t!r}" group="" part="{p}" file="{name}"/>' for t, p, name in entries]
    return "\n".join([*lines, "</Collection>", "</VTKFile>", ""])


def expected_files(header: Mapping[str, Any], colliders: Sequence[Collider]) -> list[str]:
    """Return the names of the files that `write_collider_files` makes."""
    return [group.name for group in collider_groups(header, colliders)]


def read_stored_surfaces(directory: Path) -> dict[int, ClosedSurface]:
    """Return the surfaces of colliders read from files, by number; InputError: one has changed."""
    found = {}
    for path in (directory / RESTING, directory / MOVING):
        if not path.exists():
            continue
        with open_vtkhdf(path) as file:
            checksums = load_checksums(file, "mpmcli")
            for number in file.get("mpmcli/surfaces", ()):
                names = [f"mpmcli/surfaces/{number}/{part}" for part in ("vertices", "triangles")]
                arrays = [file[name][...] for name in names]
                for name, array in zip(names, arrays, strict=True):
                    checksums.require(name, table_checksum(array))
                found[int(number)] = ClosedSurface(*arrays)
    return found


def collider_groups(header: Mapping[str, Any], colliders: Sequence[Collider]) -> Iterator[ColliderGroup]:
    """Yield the colliders at rest, then those that move; a group without any is left out."""
    for moving in (False, True):
        members = []
        for number, collider in enumerate(colliders):
            if collider.motion.moves == moving:
                lower = np.array(header["origin"], float)
                surface = collider_surface(collider, lower, lower + np.array(header["size"], float))
                if len(surface.cells):
                    members.append((collider, surface, number))
        if members:
            yield ColliderGroup(*zip(*members, strict=True), moves=moving)


@contextmanager
def _written(directory: Path, name: str, size: int) -> Iterator[Path]:
    """Yield a temporary path for a file of `size` bytes; RunError: the disk is full or a write failed."""
    path, kept = directory / name, "the frames of the run are kept"
    with writing(path, kept, faults=(RuntimeError,)):
        require_free_space(directory, size, f"writing {name}", kept)
        with sealed(path, size) as temporary:
            yield temporary


def _write_vtkhdf(path: Path, group: ColliderGroup, times: Sequence[float]) -> None:
    """Write the surfaces of a group, at all times if it moves, with meshes as they were given, and a checksum."""
    whole, labels = group.whole, group.labels
    count, cells, corners = len(whole.points), len(whole.cells), whole.cells.shape[1]
    with h5py.File(path, "w", libver=LIBVER, locking="best-effort") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = [2, 0]
        root.attrs["Type"] = np.bytes_("PolyData")
        sets = len(times) if group.moves else 1
        points = root.create_dataset("Points", (sets * count, 3), "f8")
        for k in range(sets):
            points[k * count : (k + 1) * count] = group.points(times[k])
        root["NumberOfPoints"] = np.array([count])
        for kind in CELLS:
            ours = kind == ("Lines" if corners == 2 else "Polygons")
            cell_group = root.create_group(kind)
            cell_group["NumberOfCells"] = np.array([cells * ours])
            cell_group["NumberOfConnectivityIds"] = np.array([cells * corners * ours])
            cell_group["Connectivity"] = whole.cells.ravel() if ours else np.empty(0, np.int64)
            cell_group["Offsets"] = np.arange(0, cells * corners * ours + 1, corners)
        # Groups that HDF5 makes for a path hold the time.
        root.create_group("CellData")["collider"] = labels
        steps, zeros = root.create_group("Steps"), np.zeros(len(times), np.int64)
        steps["PartOffsets"] = zeros
        steps["NumberOfParts"] = zeros + 1
        steps["PointOffsets"] = count * np.arange(len(times)) if group.moves else zeros
        steps["CellOffsets"] = steps["ConnectivityIdOffsets"] = np.zeros((len(times), 4), np.int64)
        steps.create_group("CellDataOffsets")["collider"] = zeros
        steps["Values"] = np.asarray(times, float)
        steps.attrs["NSteps"] = len(times)
        names = {number: c.name for number, c in zip(group.numbers, group.colliders, strict=True)}
        facts = file.create_group("mpmcli")
        facts.attrs["colliders"], facts.attrs["format"] = json.dumps(names), FORMAT
        for number, (vertices, triangles) in group.meshes.items():
            mesh = file.create_group(f"mpmcli/surfaces/{number}")
            mesh["vertices"], mesh["triangles"] = vertices, triangles
        store_checksums(file, "mpmcli", [], np.empty((0, 0), np.uint32))
    append_checksum(path)


def _write_vtu(path: Path, group: ColliderGroup, time: float) -> None:
    from meshio import Mesh, vtu

    whole = group.whole
    kind = "line" if whole.cells.shape[1] == 2 else "triangle"
    mesh = Mesh(group.points(time), [(kind, whole.cells)], cell_data={"collider": [group.labels]})
    vtu.write(path, mesh, compression=None, header_type="UInt64")

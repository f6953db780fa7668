"""A body in the form of points from a file (CSV, NPY, PLY, VTU), each of which is a particle."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, model_validator

from mpmcli.scene.geometry_file import GeometryFileError, absence, file_version, read_geometry, scene_file
from mpmcli.scene.primitives import Solid
from mpmcli.scene.problem import hint_at, listed, quoted
from mpmcli.scene.quantity import AXES, Positive, Table, Vector, flaw, scene_dimension

TABLES = (".csv", ".npy")


class PointFileError(Exception):
    """A file holds no usable points; the text says why, in words that follow the name of the file."""


def read_points(path: Path, d: int, velocity: str | Sequence[str] | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the points in a file, (n, d), and the velocities it is asked for, (n, d), or None; or a PointFileError.

    It is a CSV whose first line names the columns, x, y (and z) among them; an NPY of named columns, or of d or 2 d
    unnamed ones, x, y, z, vx, vy, vz; or what `read_geometry` reads. `velocity` names the d columns of a table, or an
    array of a file that PyVista reads.
    """
    if fault := absence(path):
        raise PointFileError(fault)
    table = path.suffix.lower() in TABLES
    fits = velocity is None or (
        len(velocity) == d and not isinstance(velocity, str) if table else isinstance(velocity, str)
    )
    if not fits:
        right = (
            f"{d} columns, such as [{', '.join(quoted(_names(d)[d:]))}]" if table else 'an array, such as "velocity"'
        )
        raise PointFileError(f"velocity must name {right}")
    if table:
        columns = _csv(path) if path.suffix.lower() == ".csv" else _npy(path, d)
        found = _chosen(columns, AXES[:d]), None if velocity is None else _chosen(columns, velocity)
    else:
        found = _data_set(path, d, velocity)
    for values in found:
        if values is not None and not np.isfinite(values).all():
            raise PointFileError(f"point {int(np.argmin(np.isfinite(values).all(axis=1))) + 1} is not finite")
    if not len(found[0]):
        raise PointFileError("it holds no point")
    return found


def _names(d: int) -> list[str]:
    return [*AXES[:d], *(f"v{axis}" for axis in AXES[:d])]


def _chosen(columns: dict[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    for name in names:
        if name not in columns:
            hint = hint_at(name, list(columns), f"its columns are {listed(quoted(list(columns)), 'and')}")
            raise PointFileError(f'it has no column "{name}"; {hint}')
    return np.stack([columns[name] for name in names], axis=1)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _csv(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.reader(file)
            names = [name.strip() for name in next(rows, [])]
            lines = [(rows.line_num, row) for row in rows if row]
    except (UnicodeDecodeError, csv.Error, OSError):
        raise PointFileError("it is no text with comma-separated values") from None
    if not names or any(_is_number(name) for name in names):
        raise PointFileError("its first line must name the columns, such as x,y,z")
    for line, row in lines:
        if len(row) != len(names) or not all(map(_is_number, row)):
            raise PointFileError(f"line {line} must hold {len(names)} numbers, one for each column")
    values = np.array([row for _, row in lines], dtype=np.float64).reshape(-1, len(names))
    return dict(zip(names, values.T, strict=True))


def _npy(path: Path, d: int) -> dict[str, np.ndarray]:
    try:
        # Mapped, so that a header cannot claim more than the file holds.
        found = np.load(path, mmap_mode="r", allow_pickle=False)
    # Of a damaged header, Python's own tokenizer and parser raise almost anything.
    except Exception:
        raise PointFileError("it is no array of numpy") from None
    if found.dtype.names:
        return {name: found[name].reshape(-1).astype(np.float64) for name in found.dtype.names}
    if found.ndim != 2 or found.shape[1] not in (d, 2 * d) or found.dtype.kind not in "fiu":
        raise PointFileError(f"it must be of numbers, (n, {d}), or (n, {2 * d}) with velocities; it is {found.shape}")
    return dict(zip(_names(d), found.astype(np.float64).T, strict=False))


def _data_set(path: Path, d: int, velocity: str | None) -> tuple[np.ndarray, np.ndarray | None]:
    try:
        found = read_geometry(path)
    except GeometryFileError:
        raise PointFileError("it is no file of points that can be read (CSV, NPY, PLY and VTU are)") from None
    if not len(found.points):
        raise PointFileError("it holds no point")
    position = _in_plane(found.points, d, "points")
    if velocity is None:
        return position, None
    if velocity not in found.arrays:
        known = listed(quoted(list(found.arrays)), "and") if found.arrays else "none"
        raise PointFileError(f'its points have no array "{velocity}"; they have {known}')
    values = np.array(found.arrays[velocity], dtype=np.float64)
    if values.ndim != 2 or values.shape[1] not in (d, 3):
        raise PointFileError(f'its array "{velocity}" must have {d} numbers for each point')
    return position, _in_plane(values, d, "velocities")


def _in_plane(values: np.ndarray, d: int, what: str) -> np.ndarray:
    """Return vectors (n, 3) of a 2D scene without their z, which has to be the same for all."""
    if d < values.shape[1] and np.ptp(values[:, d]) > 0:
        raise PointFileError(f"its {what} lie in space, and the scene is 2D; give points of one z")
    return values[:, :d]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points, (n, d), m, and their velocities, (n, d), m/s, or None."""

    position: np.ndarray
    velocity: np.ndarray | None

    @cached_property
    def tree(self) -> Any:
        from scipy.spatial import KDTree

        return KDTree(self.position)


class Points(Table, Solid):
    """Points from a file: the particles of the body as they are."""

    file: str = Field(description="The file, relative to the scene: CSV, NPY, PLY, VTU, ...")
    spacing: Positive | None = Field(
        None, description="Distance between neighbours, m: a particle has its square or cube as volume."
    )
    total_volume: Positive | None = Field(
        None, description="Volume of the whole body, m^3 (m^2 in 2D), in place of spacing."
    )
    velocity: str | tuple[str, ...] | None = Field(
        None,
        description='Velocities in the file, added to that of the body: names of columns, such as ["vx", "vy"], of '
        "CSV and NPY, or the name of an array of VTU, VTP and VTK. Default: none.",
    )
    scale: Positive = Field(1.0, description="Metres per unit of the file; velocities are taken as they are.")
    translate: Vector = Field(None, validate_default=True, description="What is added to all points after scaling, m.")
    _cloud: Cloud = PrivateAttr()

    @model_validator(mode="after")
    def _read(self, info: ValidationInfo) -> "Points":
        path, d = scene_file(self.file, info), scene_dimension(info) or len(self.translate)
        try:
            self._cloud = _cloud_of(path.absolute(), file_version(path), d, self.velocity, self.scale, self.translate)
        except PointFileError as error:
            raise flaw(f"{path}: {error}", "file") from None
        if (self.spacing is None) == (self.total_volume is None):
            usual = self._usual_spacing()
            hint = f"; its points are some {usual:.3g} m apart" if usual else ""
            raise flaw(f"needs either spacing or total_volume, which the mass of the body follows from{hint}")
        return self

    def _usual_spacing(self) -> float:
        """Return the median distance of a point to the nearest other one, m; 0 where there is none."""
        if len(self._cloud.position) < 2:
            return 0.0
        return float(np.median(self._cloud.tree.query(self._cloud.position[:10_000], k=2)[0][:, 1]))

    @property
    def position(self) -> np.ndarray:
        """The points, (n, d), m."""
        return self._cloud.position

    @property
    def file_velocity(self) -> np.ndarray | None:
        """The velocities in the file, (n, d), m/s."""
        return self._cloud.velocity

    @property
    def volume(self) -> float:
        n, d = self.position.shape
        return n * self.spacing**d if self.total_volume is None else self.total_volume

    @property
    def edge(self) -> float:
        """Edge of the square or cube that a particle stands for, m."""
        n, d = self.position.shape
        return (self.volume / n) ** (1 / d)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.position.min(axis=0), self.position.max(axis=0)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, d) from the particles, balls whose diameter is an edge, (n,), m."""
        return self._cloud.tree.query(points)[0] - self.edge / 2


@lru_cache(maxsize=32)
def _cloud_of(path: Path, version: tuple[int, int], d: int, velocity: Any, scale: float, translate: Any) -> Cloud:
    """Return the points in a file; `version` tells versions of the file apart."""
    position, velocities = read_points(path, d, velocity)
    return Cloud(position * scale + np.array(translate), velocities)

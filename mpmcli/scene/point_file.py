"""Points from a file, with the velocities that stand beside them: CSV, NPY, PLY, VTU."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mpmcli.scene.geometry_file import GeometryFileError, absence, read_geometry
from mpmcli.scene.quantity import AXES
from mpmcli.scene.sentences import listed, nearest, quoted

TABLES = (".csv", ".npy")


class PointFileError(Exception):
    """A file holds no usable points; the text says why, in words that follow the name of the file."""


def read_points(path: Path, d: int, velocity: str | Sequence[str] | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the points in a file, (n, d), and their velocities, (n, d), None where none are asked for.

    Args:
        path: a CSV whose first line names the columns, x, y (and z) among them; an NPY of named columns, or of d or 2 d
            unnamed ones, taken as x, y, z, vx, vy, vz; or what PyVista reads.
        d: number of axes.
        velocity: names of the d columns of a table, or the name of an array of another file.

    Raises:
        PointFileError: there is no such file, it cannot be read, or it lacks what is asked for.
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
            guess = nearest(name, list(columns))
            hint = f'did you mean "{guess}"?' if guess else f"its columns are {listed(quoted(list(columns)), 'and')}"
            raise PointFileError(f'it has no column "{name}"; {hint}')
    return np.stack([columns[name] for name in names], axis=1)


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


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


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
    chosen = [_in_plane(found.points, d, "points")]
    if velocity is None:
        return chosen[0], None
    if velocity not in found.arrays:
        known = listed(quoted(list(found.arrays)), "and") if found.arrays else "none"
        raise PointFileError(f'its points have no array "{velocity}"; they have {known}')
    values = np.array(found.arrays[velocity], dtype=np.float64)
    if values.ndim != 2 or values.shape[1] not in (d, 3):
        raise PointFileError(f'its array "{velocity}" must have {d} numbers for each point')
    return chosen[0], _in_plane(values, d, "velocities")


def _in_plane(values: np.ndarray, d: int, what: str) -> np.ndarray:
    """Return vectors (n, 3) of a 2D scene without their z, which has to be the same for all."""
    if d < values.shape[1] and np.ptp(values[:, d]) > 0:
        raise PointFileError(f"its {what} lie in space, and the scene is 2D; give points of one z")
    return values[:, :d]

"""Points and triangles from a file, by its ending: PLY, STL and OBJ are read here, all others by VTK.

VTK's readers trust what a file says of itself, and a damaged one may end the interpreter. They run in a process of
their own.
"""

import os
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path

import numpy as np
from pydantic import ValidationInfo

from mpmcli.processes.questions import Question, ask, module_command


# Wavefront Technologies, Advanced Visualizer, appendix B1, Object Files (.obj): its lines v and f.
def read_obj(data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the points (n, 3) float64, and the corners of each polygon; ValueError for a damaged file."""
    points: list[list[float]] = []
    polygons = []
    for line in data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        words = line.split()
        if words[:1] == [b"v"]:
            if len(words) < 4:
                raise ValueError("a vertex lacks a coordinate")
            points.append([float(word) for word in words[1:4]])
        elif words[:1] == [b"f"]:
            numbers = np.array([int(word.partition(b"/")[0]) for word in words[1:]], np.int64)
            # Counted from 1, or backwards from the latest vertex.
            if not numbers.all():
                raise ValueError("vertices count from 1")
            polygons.append(np.where(numbers > 0, numbers - 1, len(points) + numbers))
    return np.array(points, np.float64).reshape(-1, 3), polygons


# 3D Systems, StereoLithography Interface Specification, 1989.
_HEAD, _FACET = 84, 50
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_stl(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (3 m, 3) float64, and the triangles (m, 3), which share none; ValueError for a damaged file."""
    count = int.from_bytes(data[80:_HEAD], "little")
    size = _HEAD + _FACET * count
    if len(data) >= _HEAD and (len(data) == size or (len(data) > size and not data.lstrip().startswith(b"solid"))):
        facets = np.frombuffer(data, np.dtype([("numbers", "<f4", (4, 3)), ("flags", "<u2")]), count, _HEAD)
        points = facets["numbers"][:, 1:].reshape(-1, 3).astype(np.float64)
    elif data.lstrip().startswith(b"solid"):
        points = np.array([[float(word) for word in words] for words in _VERTEX.findall(data)]).reshape(-1, 3)
    else:
        raise ValueError("it is no STL file, or cut off")
    if len(points) % 3:
        raise ValueError("a triangle lacks a vertex")
    return points, np.arange(len(points)).reshape(-1, 3)


# G. Turk, The PLY Polygon File Format, 1994. VTK's reader writes beyond its memory where a header and the data behind
# it disagree, and ends the interpreter.
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class _Property:
    """A property of an element: its type, and that of the length of a list, "" of a single number."""

    name: str
    type: str
    length: str = ""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


def read_ply(data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the points (n, 3) float64, and the corners of each polygon; ValueError, LookupError for a damaged file."""
    order, elements, start = _header(data)
    source = _Elements(data[start:] if order else _as_bytes(data[start:].split()), order)
    points, polygons = np.empty((0, 3)), []
    for element in elements:
        columns = source.read(element)
        if element.name == "vertex":
            points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
        elif element.name == "face":
            polygons = columns.get(_CORNERS[0], columns.get(_CORNERS[1], []))
    return points, polygons


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Return the order of bytes, the elements, and where the data begin."""
    ending = data.index(b"end_header")
    start = data.index(b"\n", ending) + 1
    lines = [line.split() for line in data[:ending].decode("ascii").splitlines()]
    if lines[0] != ["ply"]:
        raise ValueError("it does not begin with ply")
    order, elements = None, []
    for words in lines[1:]:
        match words:
            case ["format", form, _]:
                order = _ORDERS[form]
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name]:
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name]:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
    if order is None or any(element.count < 0 for element in elements):
        raise ValueError("its header is not complete")
    if not order:
        for element in elements:
            element.properties[:] = [_Property(p.name, "f8", "f8" if p.length else "") for p in element.properties]
    return order, elements, start


class _Elements:
    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order, self.at = data, order, 0

    def read(self, element: _Element) -> dict[str, np.ndarray | list]:
        """Return numbers by the names of properties; lists as one array where all are as long, else one by one."""
        n, properties, start = element.count, element.properties, self.at
        if not n or not properties:
            return {p.name: [] if p.length else np.empty(0) for p in properties}
        lengths = [len(numbers) for numbers in self._row(properties)]
        kinds = []
        for k, (p, length) in enumerate(zip(properties, lengths, strict=True)):
            head = [(f"length {k}", self.order + p.length)] if p.length else []
            kinds += [*head, (f"{k}", self.order + p.type, (length,) if p.length else ())]
        row = np.dtype(kinds)
        if start + n * row.itemsize <= len(self.data):
            table = np.frombuffer(self.data, row, n, start)
            listed = [k for k, p in enumerate(properties) if p.length]
            if all((table[f"length {k}"] == lengths[k]).all() for k in listed):
                self.at = start + n * row.itemsize
                return {p.name: table[f"{k}"] for k, p in enumerate(properties)}
        if n > len(self.data):
            raise ValueError("it ends too early")
        self.at = start
        columns = list(zip(*(self._row(properties) for _ in range(n)), strict=True))
        return {
            p.name: list(column) if p.length else np.concatenate(column)
            for p, column in zip(properties, columns, strict=True)
        }

    def _row(self, properties: list[_Property]) -> list[np.ndarray]:
        found = []
        for p in properties:
            length = self._take(p.length, 1)[0] if p.length else 1
            if length != int(length):
                raise ValueError("a length is no whole number")
            found.append(self._take(p.type, int(length)))
        return found

    def _take(self, kind: str, count: int) -> np.ndarray:
        dtype = np.dtype(self.order + kind)
        data = self.data[self.at : self.at + count * dtype.itemsize]
        if count < 0 or len(data) < count * dtype.itemsize:
            raise ValueError("it ends too early")
        self.at += len(data)
        return np.frombuffer(data, dtype)


def _as_bytes(words: list[bytes]) -> bytes:
    """Return numbers in text, up to the first word that is none, as float64."""
    try:
        return np.array(words, np.float64).tobytes()
    except ValueError:
        return np.array([float(word) for word in takewhile(is_number, words)]).tobytes()


def is_number(word: str | bytes) -> bool:
    """Say whether a word is a number to Python."""
    try:
        float(word)
    except ValueError:
        return False
    return True


_READERS: dict[str, Callable[[bytes], tuple[np.ndarray, list[np.ndarray] | np.ndarray]]] = {
    ".ply": read_ply,
    ".stl": read_stl,
    ".obj": read_obj,
}
# Wall time for VTK to start and read, s; the process limits its own work as well.
_TIMEOUT = 600.0


@dataclass(frozen=True, eq=False)
class Geometry:
    """Points (n, 3) float64 and their arrays by name; vertices (k, 3) and triangles (m, 3) int64 of the surface."""

    points: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


class GeometryFileError(Exception):
    """There is no such file, or it cannot be read; the text is empty in the latter case."""


def scene_file(name: str, info: ValidationInfo) -> Path:
    """Return the path of a file that a scene names, which is relative to the directory of the scene."""
    directory = info.context.get("directory") if isinstance(info.context, dict) else None
    return Path(directory or ".") / name


def file_version(path: Path) -> tuple[int, int]:
    """Return what tells versions of a file apart: when it was changed, ns, and its bytes; zeros where there is none."""
    try:
        stat = path.stat()
    # Of a name with a null character, ValueError.
    except (OSError, ValueError):
        return 0, 0
    return stat.st_mtime_ns, stat.st_size


def absence(path: Path) -> str:
    """Say why there is no file at a path, "" where there is one."""
    try:
        return "" if path.is_file() else "it is no file" if path.exists() else "there is no such file"
    # A name that is too long, or a directory that may not be read.
    except (OSError, ValueError):
        return "there is no such file"


def read_geometry(path: Path) -> Geometry:
    """Return the points and the triangles in a file, or raise a GeometryFileError."""
    if fault := absence(path):
        raise GeometryFileError(fault)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        return _by_vtk(path)
    try:
        points, polygons = reader(path.read_bytes())
        return Geometry(points, points, _triangles(polygons, len(points)))
    except (OSError, ValueError, LookupError, OverflowError, MemoryError):
        raise GeometryFileError from None


def _triangles(polygons: list[np.ndarray] | np.ndarray, count: int) -> np.ndarray:
    """Return the triangles of polygons, a fan of each; ValueError for a corner that is none of `count` points."""
    if isinstance(polygons, np.ndarray):
        # All of one length.
        fans = [polygons[:, [0, k, k + 1]] for k in range(1, polygons.shape[1] - 1)]
        found = np.stack(fans, axis=1).reshape(-1, 3).astype(np.int64) if fans else np.empty((0, 3), np.int64)
    else:
        fans = [np.stack([np.full(len(p) - 2, p[0]), p[1:-1], p[2:]], axis=1) for p in polygons if len(p) > 2]
        found = np.concatenate([np.empty((0, 3), np.int64), *fans]).astype(np.int64)
    if found.size and not 0 <= found.min() <= found.max() < count:
        raise ValueError("a corner is no vertex")
    return found


def _by_vtk(path: Path) -> Geometry:
    with tempfile.TemporaryDirectory() as place:
        out = os.path.join(place, "geometry.npz")
        command = module_command("mpmcli.scene.vtk_file_process", str(path.absolute()), out)
        reply = ask(Question(command, _TIMEOUT, {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}))
        names = reply.answer.get("arrays")
        if reply.fault or not isinstance(names, list):
            raise GeometryFileError
        with np.load(out, allow_pickle=False) as found:
            arrays = {name: found[f"array_{k}"] for k, name in enumerate(names)}
            return Geometry(found["points"], found["vertices"], found["triangles"], arrays)

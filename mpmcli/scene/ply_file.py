"""Points and polygons from a PLY file (G. Turk, The PLY Polygon File Format, 1994).

meshio refuses faces with colours or texture coordinates in binary files, and elements but vertices and faces. VTK ends
the interpreter where a file is cut off.
"""

from dataclasses import dataclass
from itertools import takewhile

import numpy as np

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

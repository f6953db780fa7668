"""Points and polygons from a PLY file, text or binary.

VTK's reader writes beyond its memory where a header and the data behind it disagree, and ends the interpreter.

Source: G. Turk, The PLY Polygon File Format, 1994.
"""

from dataclasses import dataclass

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
    """Return the points (n, 3) float64, and of each polygon the numbers of its corners.

    Raises:
        ValueError, KeyError, IndexError: it is no PLY file, or a damaged one.
    """
    order, elements, start = _header(data)
    source = _Words(data[start:].split()) if order == "" else _Bytes(data[start:], order)
    points, polygons = np.empty((0, 3)), []
    for element in elements:
        columns = source.element(element)
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
    return order, elements, start


class _Words:
    """Numbers as text."""

    def __init__(self, words: list[bytes]) -> None:
        self.words, self.at = words, 0

    def element(self, element: _Element) -> dict[str, list]:
        columns: dict[str, list] = {p.name: [] for p in element.properties}
        if element.count > len(self.words):
            raise ValueError("it ends too early")
        if (found := self._uniform(element)) is not None:
            return found
        for _ in range(element.count if columns else 0):
            for p in element.properties:
                count = int(self._next(1)[0]) if p.length else 1
                numbers = np.array([float(word) for word in self._next(count)])
                columns[p.name].append(numbers if p.length else numbers[0])
        return columns if any(p.length for p in element.properties) else {n: np.array(c) for n, c in columns.items()}

    def _uniform(self, element: _Element) -> dict[str, np.ndarray] | None:
        """Return an element of single numbers, or of one list that is as long in each, None for any other."""
        one, n = element.properties[:1], element.count
        listed = [p for p in element.properties if p.length]
        if not one or not n or (listed and len(element.properties) > 1) or self.at >= len(self.words):
            return None
        width = 1 + int(self.words[self.at]) if listed else len(element.properties)
        words = self.words[self.at : self.at + n * width]
        if width < 1 or len(words) < n * width:
            return None
        table = np.array(words, np.float64).reshape(n, width)
        if listed and (table[:, 0] != width - 1).any():
            return None
        self.at += n * width
        return (
            {one[0].name: table[:, 1:]} if listed else {p.name: table[:, k] for k, p in enumerate(element.properties)}
        )

    def _next(self, count: int) -> list[bytes]:
        found = self.words[self.at : self.at + count]
        if count < 0 or len(found) < count:
            raise ValueError("it ends too early")
        self.at += count
        return found


class _Bytes:
    """Numbers as bytes."""

    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order, self.at = data, order, 0

    def element(self, element: _Element) -> dict[str, np.ndarray | list]:
        if not any(p.length for p in element.properties):
            return self._table(element.count, element.properties)
        if element.count > len(self.data):
            raise ValueError("it ends too early")
        if (found := self._uniform(element)) is not None:
            return found
        columns: dict[str, list] = {p.name: [] for p in element.properties}
        for _ in range(element.count):
            for p in element.properties:
                count = int(self._numbers(p.length, 1)[0]) if p.length else 1
                numbers = self._numbers(p.type, count)
                columns[p.name].append(numbers if p.length else numbers[0])
        return columns

    def _uniform(self, element: _Element) -> dict[str, np.ndarray] | None:
        """Return an element of one list that is as long in each, None for any other."""
        if len(element.properties) > 1 or not element.count:
            return None
        p, n = element.properties[0], element.count
        head = np.dtype(self.order + p.length)
        length = int(np.frombuffer(self.data, head, 1, self.at)[0])
        size = head.itemsize + length * np.dtype(p.type).itemsize
        if length < 1 or self.at + n * size > len(self.data):
            return None
        row = np.dtype([("length", head), ("numbers", self.order + p.type, (length,))])
        found = np.frombuffer(self.data, row, n, self.at)
        if (found["length"] != length).any():
            return None
        self.at += n * size
        return {p.name: found["numbers"]}

    def _table(self, count: int, properties: list[_Property]) -> dict[str, np.ndarray]:
        row = np.dtype([(p.name, self.order + p.type) for p in properties])
        if not row.itemsize:
            return {}
        found = np.frombuffer(self._take(count * row.itemsize), row)
        return {p.name: found[p.name] for p in properties}

    def _numbers(self, kind: str, count: int) -> np.ndarray:
        dtype = np.dtype(self.order + kind)
        return np.frombuffer(self._take(count * dtype.itemsize), dtype)

    def _take(self, size: int) -> bytes:
        found = self.data[self.at : self.at + size]
        if size < 0 or len(found) < size:
            raise ValueError("it ends too early")
        self.at += size
        return found

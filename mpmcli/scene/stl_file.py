"""Triangles from an STL file, text or binary.

Source: 3D Systems, StereoLithography Interface Specification, 1989.
"""

import re

import numpy as np

_HEAD, _FACET = 84, 50
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_stl(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (3 m, 3) float64, and the triangles (m, 3), which share none.

    Raises:
        ValueError: it is no STL file, or one that is cut off.
    """
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

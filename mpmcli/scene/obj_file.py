"""Points and polygons from a Wavefront OBJ file: its lines v and f.

Source: Wavefront Technologies, Advanced Visualizer, appendix B1, Object Files (.obj).
"""

import numpy as np


def read_obj(data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the points (n, 3) float64, and of each polygon the numbers of its corners.

    Raises:
        ValueError: a line is not what it should be.
    """
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

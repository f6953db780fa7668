"""Tables of a temporal VTKHDF file that follow from the numbers of particles alone."""

import numpy as np

CONNECTIVITY = "Vertices/Connectivity"
UNUSED_CELLS = ("Lines", "Polygons", "Strips")


def part_tables(counts: np.ndarray) -> dict[str, np.ndarray]:
    """Everything under /VTKHDF that follows from the (T,) particle counts alone, by path.

    Each frame is one part with one poly-vertex cell, or none where it has no particles.
    """
    number = len(counts)
    cells = (counts > 0).astype(np.int64)
    zeros, cell_offsets = np.zeros(number, np.int64), np.zeros((number, 4), np.int64)
    cell_offsets[:, 0] = np.cumsum(cells) - cells
    tables = {
        "NumberOfPoints": counts,
        "Vertices/NumberOfCells": cells,
        "Vertices/NumberOfConnectivityIds": counts,
        "Vertices/Offsets": np.concatenate([[0, n] if n else [0] for n in counts]).astype(np.int64),
        CONNECTIVITY: np.arange(counts.max(), dtype=np.int64),
        "Steps/PartOffsets": np.arange(number, dtype=np.int64),
        "Steps/NumberOfParts": np.ones(number, np.int64),
        "Steps/PointOffsets": np.cumsum(counts) - counts,
        "Steps/CellOffsets": cell_offsets,
        # Point numbers count from the frame's first particle, so every frame uses the same list.
        "Steps/ConnectivityIdOffsets": np.zeros((number, 4), np.int64),
    }
    for name in UNUSED_CELLS:
        # The reader opens all four kinds of cells, used or not.
        tables[f"{name}/NumberOfCells"] = tables[f"{name}/NumberOfConnectivityIds"] = zeros
        tables[f"{name}/Connectivity"], tables[f"{name}/Offsets"] = zeros[:0], zeros
    return tables

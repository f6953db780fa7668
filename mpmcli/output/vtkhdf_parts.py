"""Parts of a temporal VTKHDF file: size, paths, and tables that follow from the numbers of particles alone."""

from collections.abc import Sequence

import numpy as np

from mpmcli.output.layout import POSITION, FrameLayout

# Size without the particles: headers, tables of the steps, ledger. Used to reserve disk space.
OVERHEAD_BYTES = 64 * 1024
OVERHEAD_BYTES_PER_FRAME = 1024
# What is copied at once stays in a cache of the processor.
BLOCK_BYTES = 2**20
# The numbers of the particles of the largest frame, from 0 on.
CONNECTIVITY = "Vertices/Connectivity"
UNUSED_CELLS = ("Lines", "Polygons", "Strips")


def array_path(name: str) -> str:
    """Return the path of an array of frames under /VTKHDF."""
    return name if name == POSITION else f"PointData/{name}"


def file_size(layout: FrameLayout, counts: Sequence[int]) -> int:
    """Bytes of an uncompressed file with frames of `counts` particles, rounded up."""
    particles = sum(counts) * layout.bytes_per_particle + 8 * max(counts, default=0)
    return particles + OVERHEAD_BYTES + OVERHEAD_BYTES_PER_FRAME * len(counts)


def part_tables(counts: np.ndarray) -> dict[str, np.ndarray]:
    """Everything under /VTKHDF that follows from the (T,) particle counts alone, by path, but CONNECTIVITY.

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

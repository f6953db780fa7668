"""Writing .npz files one array at a time, with bytes that depend on the arrays alone."""

import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np


def write_npz(path: Path, arrays: Iterable[tuple[str, np.ndarray]]) -> None:
    """Write a compressed .npz as numpy does, but with one array in memory at a time; object arrays are pickled."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays:
            # Entries that are opened by name have the date 1980-01-01.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=array.dtype == object)

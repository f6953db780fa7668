"""Damaged files of a result with the checksums of what they hold, as if mpmcli had written them so."""

from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
from changed_result import accept_changes, changed

from fuzzing.seeds import Files
from mpmcli.output.checksums import SUMS

# Values of one array: an HDF5 file states any number of them, at no cost to it.
MOST_VALUES = 10**6


def with_new_checksums(files: Files, name: str) -> Files:
    """Return the files of a result, that of some name with the checksums that it would have; as it is if none fit."""
    data, folder = files[name], str(Path(name).parent)
    with TemporaryDirectory() as place, suppress(Exception):
        if name.endswith(".vtkhdf"):
            path = Path(place) / "file.vtkhdf"
            path.write_bytes(data)
            with h5py.File(path) as file:
                sizes = [np.prod(one.shape, dtype=float) for one in _arrays(file)]
            if max(sizes) < MOST_VALUES:
                with changed(path):
                    pass
                return files | {name: path.read_bytes()}
        elif f"{folder}/{SUMS}" in files and not name.endswith(SUMS):
            for own in (own for own in files if str(Path(own).parent) == folder):
                (Path(place) / Path(own).name).write_bytes(files[own])
            accept_changes(Path(place))
            return files | {f"{folder}/{SUMS}": (Path(place) / SUMS).read_bytes()}
    return files


def _arrays(file: h5py.File) -> list[h5py.Dataset]:
    found: list[h5py.Dataset] = []
    file.visititems(lambda _, one: found.append(one) if isinstance(one, h5py.Dataset) else None)
    return found

"""Reading data sets of HDF5 files that anybody may have changed: no more memory than the bytes in the file can fill."""

import h5py
import numpy as np

from mpmcli.output.hdf5_items import held


def read_whole(group: h5py.Group, name: str, kinds: str = "iuf") -> np.ndarray:
    """Return all of a data set.

    Args:
        group: that holds it.
        name: of the data set.
        kinds: the kinds of numpy types that it may have.

    Raises:
        KeyError: there is none.
        ValueError: it is no data set, or has another type.
        InputError: it lies in another file, or claims more than the file holds.
    """
    return require_stored(group, name, kinds)[...]


def read_rows(group: h5py.Group, name: str, first: int, count: int, kinds: str = "iuf") -> np.ndarray:
    """Return rows of a data set, fewer where it ends.

    Raises:
        KeyError, ValueError, InputError: as `read_whole`.
    """
    found = require_stored(group, name, kinds)
    if first < 0 or count < 0 or not found.shape:
        raise ValueError(f"{name} has no rows {first} to {first + count}")
    return found[first : first + count]


def require_stored(group: h5py.Group, name: str, kinds: str = "iuf") -> h5py.Dataset:
    """Return a data set all of whose values may be read.

    Raises:
        KeyError, ValueError, InputError: as `read_whole`.
    """
    found = held(group, name)
    if not isinstance(found, h5py.Dataset) or found.dtype.kind not in kinds or found.shape is None:
        raise ValueError(f"{name} is no array of numbers")
    return found

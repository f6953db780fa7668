"""Reading data sets of HDF5 files that anybody may have changed: no more memory than the bytes in the file can fill."""

import math

import h5py
import numpy as np

from mpmcli.output.hdf5_items import held

# The most that deflate makes of a byte, and bytes that do not matter.
_DEFLATE, _SMALL = 1032, 2**20


def read_whole(group: h5py.Group, name: str, kinds: str = "iuf") -> np.ndarray:
    """Return all of a data set.

    Args:
        group: that holds it.
        name: of the data set.
        kinds: the kinds of numpy types that it may have.

    Raises:
        KeyError: there is none.
        ValueError: it is no data set, has another type, or claims more than the file holds.
        InputError: see `held`.
    """
    return require_stored(group, name, kinds)[...]


def read_rows(group: h5py.Group, name: str, first: int, count: int, kinds: str = "iuf") -> np.ndarray:
    """Return rows of a data set, fewer where it ends.

    Raises:
        KeyError, ValueError: as `read_whole`.
    """
    found = require_stored(group, name, kinds)
    if first < 0 or count < 0 or not found.shape:
        raise ValueError(f"{name} has no rows {first} to {first + count}")
    return found[first : first + count]


def require_stored(group: h5py.Group, name: str, kinds: str = "iuf") -> h5py.Dataset:
    """Return a data set all of whose values may be read.

    Raises:
        KeyError, ValueError: as `read_whole`.
    """
    found = held(group, name)
    if not isinstance(found, h5py.Dataset) or found.dtype.kind not in kinds or found.shape is None:
        raise ValueError(f"{name} is no array of numbers")
    stored = found.id.get_storage_size()
    chunk = math.prod(found.chunks) * found.dtype.itemsize if found.chunks else 0
    if max(found.size * found.dtype.itemsize, chunk) > _SMALL + _DEFLATE * stored:
        raise ValueError(f"{name} claims {found.shape} values, and the file holds {stored} bytes of it")
    return found

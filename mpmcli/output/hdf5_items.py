"""What an HDF5 file itself holds: no link or storage that leads to another file is followed."""

import math
from collections.abc import Iterator

import h5py

from mpmcli.errors import InputError
from mpmcli.plain_text import one_line

# What deflate makes of one byte at most, and what small tables may claim beyond that.
MOST_INFLATED, SMALL = 1100, 2**20


class DamageError(InputError):
    """A file that was written by mpmcli, and has changed since."""


def held(group: h5py.Group, path: str) -> h5py.Group | h5py.Dataset:
    """Return an item at a path below a group.

    Raises:
        KeyError: there is none.
        InputError: the path leads through a link to another place, or the data lie in another file, or claim to be more
            than the file holds.
    """
    item = group
    for name in path.split("/"):
        link = item.get(name, getlink=True) if isinstance(item, h5py.Group) else None
        if link is None:
            raise KeyError(f"{path} is missing")
        if not isinstance(link, h5py.HardLink):
            raise InputError(
                f"{group.file.filename} holds a link to another place, {one_line(path)}; mpmcli writes none and "
                "follows none."
            )
        item = item[name]
    if isinstance(item, h5py.Dataset):
        _require_own_data(item, path)
    return item


def items(group: h5py.Group, path: str = "") -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """Yield all that lies below a group, itself first, as `held` returns it, in the order of the names.

    Raises:
        InputError: as `held`.
    """
    yield path, group
    for name in sorted(group):
        below, item = f"{path}/{name}" if path else name, held(group, name)
        if isinstance(item, h5py.Group):
            # Of ours no group lies in itself.
            if below.count("/") < 8:
                yield from items(item, below)
        else:
            yield below, item


def _require_own_data(data: h5py.Dataset, path: str) -> None:
    file = data.file.filename
    if data.is_virtual or data.external:
        raise InputError(f"{file} takes {path} from another file; mpmcli writes and follows no such link.")
    chunk = math.prod(data.chunks) * data.dtype.itemsize if data.chunks else 0
    if max(data.nbytes, chunk) > MOST_INFLATED * data.id.get_storage_size() + SMALL:
        raise DamageError(f"{file} is damaged: its data set {path} claims to be more than the file holds.")

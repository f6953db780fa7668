"""The parts of a trajectory in a shard, each compared with its checksum when it is read."""

import json
from typing import Any

import h5py
import numpy as np

from mpmcli.dataset.shard import LEDGER, TABLES, group_name
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.checksums import NAME, Checksums, attribute_checksum, item_checksums, load_checksums, table_checksum
from mpmcli.output.guarded_read import read_whole, require_stored
from mpmcli.output.hdf5_items import held
from mpmcli.output.ledger_table import read_ledger


class StoredGroup:
    """The group of a trajectory in an open shard.

    Raises:
        KeyError: the shard has no such trajectory.
        InputError: its checksums are damaged.
    """

    def __init__(self, file: h5py.File, number: int) -> None:
        self._number = number
        self.group: h5py.Group = held(file, group_name(number))
        # Version 1 has none.
        self._checksums: Checksums | None = load_checksums(self.group, "") if file.attrs["version"] > 1 else None

    def attribute(self, name: str) -> Any:
        """Read an attribute.

        Raises:
            InputError: it has changed since it was written.
        """
        found = self.group.attrs[name]
        if self._checksums is not None:
            self._checksums.require(f"@{name}", attribute_checksum(found))
        return json.loads(found) if name in ("draws", "header") else found

    def table(self, path: str, kinds: str = "iuf") -> np.ndarray:
        """Read all of an array without frames, which has one of these kinds of numpy types.

        Raises:
            InputError: as `attribute`.
        """
        found = read_whole(self.group, path, kinds)
        if self._checksums is not None:
            self._checksums.require(path, table_checksum(found))
        return found

    def frames(self, name: str, chosen: slice) -> np.ndarray:
        """Read some frames of an array.

        Raises:
            InputError: as `attribute`.
        """
        data = require_stored(self.group, name)
        found = data[chosen]
        if self._checksums is not None:
            for t, rows in zip(range(len(data))[chosen], found, strict=True):
                self._checksums.require_frame(t, name, rows, t)
        return found

    def tables(self) -> tuple[np.ndarray, ...]:
        """Read the times, steps and numbers of the frames."""
        return tuple(self.table(name) for name in TABLES)

    def require_all(self) -> None:
        """Compare the checksums of all that the group holds.

        Raises:
            InputError: something has changed since it was written.
        """
        if self._checksums is None:
            return
        for name in self._checksums.arrays:
            self.frames(name, slice(None))
        self._checksums.require_items(item_checksums(self.group, self._checksums.arrays, NAME))

    def ledger(self) -> list[LedgerRow]:
        """Read the ledger."""
        return read_ledger(held(self.group, LEDGER), lambda name, kinds: self.table(f"{LEDGER}/{name}", kinds))

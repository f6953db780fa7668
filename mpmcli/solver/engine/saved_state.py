"""Saves and loads the state of a run: everything that its next step depends on."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from mpmcli.errors import InputError
from mpmcli.quick_taichi import ti
from mpmcli.solver.engine.batch import Batch

# Bytes of a number on the device.
SIZES = {ti.f32: 4, ti.f64: 8, ti.i32: 4}


@dataclass(frozen=True)
class SavedState:
    """A state on the host that can be stored in a file.

    Attributes:
        numbers: plain numbers, and lists and dictionaries of them, by name; values may be infinite.
        arrays: arrays by name: particles in the order of the device, the tables of the sort, and the box of the grid.
    """

    numbers: dict[str, object]
    arrays: Mapping[str, np.ndarray]

    def copied(self) -> "SavedState":
        """Return the state with all arrays copied from the device, so that it stays valid after the next step."""
        return SavedState(self.numbers, dict(self.arrays))


class ArraysOnDevice(Mapping[str, np.ndarray]):
    """Arrays of a state, copied from the device one by one when accessed; valid until the next step.

    Attributes:
        nbytes: number of bytes of all arrays.
    """

    def __init__(self, fields: Mapping[str, ti.Field], others: Mapping[str, np.ndarray] = MappingProxyType({})) -> None:
        """Store the named fields, and other named arrays on the host."""
        self._fields, self._others = fields, others
        entries = sum(math.prod(shape_of(field)) * SIZES[field.dtype] for field in fields.values())
        self.nbytes = entries + sum(array.nbytes for array in others.values())

    def __getitem__(self, name: str) -> np.ndarray:
        return self._others[name].copy() if name in self._others else self._fields[name].to_numpy()

    def __iter__(self) -> Iterator[str]:
        yield from self._fields
        yield from self._others

    def __len__(self) -> int:
        return len(self._fields) + len(self._others)


def shape_of(field: ti.Field) -> tuple[int, ...]:
    """Return the shape of a field as a NumPy array."""
    if isinstance(field, ti.lang.matrix.MatrixField):
        return (*field.shape, field.n) if field.m == 1 else (*field.shape, field.n, field.m)
    return tuple(field.shape)


# Names of the arrays of a sparse grid: its numbered tiles, and the table of the sort for these tiles.
BLOCKS, START = "grid.blocks", "{}.block_start"


def read_batch(batch: Batch) -> ArraysOnDevice:
    """Return the device arrays and kernel numbers of a batch of one run, by name, valid until the next launch."""
    return ArraysOnDevice(_fields(batch), {"numbers": batch.numbers[0], "counts": batch.counts[0]} | _blocks(batch))


def write_batch(batch: Batch, arrays: Mapping[str, np.ndarray]) -> None:
    """Replace the arrays of a batch of one run by those of a run of the same scene or one with an earlier end."""
    if batch.device.grid.sparse:
        _make_room(batch, arrays)
    fields = _fields(batch)
    expected = {name: shape_of(field) for name, field in fields.items()}
    expected |= {"numbers": batch.numbers[0].shape, "counts": batch.counts[0].shape}
    found = {name: array.shape for name, array in arrays.items()}
    if batch.device.grid.sparse:
        expected |= _block_shapes(batch, arrays)
    if expected != found:
        raise InputError("the saved state belongs to another scene or to another kind of backend.")
    for name, field in fields.items():
        field.from_numpy(arrays[name])
    if batch.device.grid.sparse:
        _write_blocks(batch, arrays)
    for name, (row,) in (("numbers", batch.numbers), ("counts", batch.counts)):
        # A continued run with a later end has its own end and its own bound by colliders.
        columns = batch.layout.of_scene(name)
        own = row[columns]
        row[:] = arrays[name]
        row[columns] = own
    if batch.backend.on_cpu:
        batch.cpu.share_work(batch.counts)


def _fields(batch: Batch) -> dict[str, ti.Field]:
    """Return all fields of the device that persist between steps, by name."""
    device = batch.device
    found: dict[str, ti.Field] = {}
    if batch.backend.on_cpu:
        found = {"grid.box": device.grid.box, "stencils": device.stencils}
        if not device.grid.sparse:
            pairs = zip(device.groups, device.orders, strict=True)
            found |= {f"{group.law.name}.tile_start": order.start for group, order in pairs}
    for group in device.groups:
        found |= {f"{group.law.name}.{name}": field for name, field in group.fields().items()}
    for feature in device.features:
        found |= feature.saved()
    return found


def _blocks(batch: Batch) -> dict[str, np.ndarray]:
    """Return the numbered tiles of a sparse grid and the tables of its sorts, by name; empty for a dense grid."""
    device, grid = batch.device, batch.device.grid
    if not grid.sparse:
        return {}
    found = {BLOCKS: grid.occupied()}
    found |= {name: field.to_numpy()[:used] for name, (field, used) in _kept(batch, len(found[BLOCKS])).items()}
    for group, order in zip(device.groups, device.orders, strict=True):
        start = order.start.to_numpy()
        # All tiles after the blocks in use are empty.
        found[START.format(group.law.name)] = np.concatenate([start[: len(found[BLOCKS]) + 2], start[order.tiles :]])
    return found


def _block_shapes(batch: Batch, arrays: Mapping[str, np.ndarray]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of `_blocks` for the number of blocks in `arrays`."""
    count, order = len(arrays[BLOCKS]), batch.device.orders[0]
    starts = {START.format(group.law.name): (count + 3 + order.bins - order.tiles,) for group in batch.device.groups}
    kept = {name: (used, *shape_of(field)[1:]) for name, (field, used) in _kept(batch, count).items()}
    return {BLOCKS: (count,)} | starts | kept


def _kept(batch: Batch, count: int) -> dict[str, tuple[ti.Field, int]]:
    """Return the fields of the nodes of a sparse grid that persist, and their entries for a number of blocks."""
    points, grid = batch.device.features.points, batch.device.grid
    fields = {} if points is None else points.kept_fields
    return {
        name: (field, (count + 1) * grid.block * (field.shape[0] // grid.node_count)) for name, field in fields.items()
    }


def _make_room(batch: Batch, arrays: Mapping[str, np.ndarray]) -> None:
    """Enlarge a sparse grid if it has too few blocks for a saved state."""
    tiles, grid = arrays.get(BLOCKS, np.empty((0, 0))), batch.device.grid
    sound = tiles.ndim == 1 and (np.diff(tiles) > 0).all() and (tiles >= 0).all() and (tiles < grid.all_tiles).all()
    if not sound:
        raise InputError("the saved state belongs to another scene or to another kind of backend.")
    if len(tiles) >= grid.tile_count:
        batch.grow(len(tiles) + 1)


def _write_blocks(batch: Batch, arrays: Mapping[str, np.ndarray]) -> None:
    """Restore the arrays of `_blocks`."""
    batch.device.grid.occupy(arrays[BLOCKS])
    for name, (field, _) in _kept(batch, len(arrays[BLOCKS])).items():
        whole = np.zeros(shape_of(field), arrays[name].dtype)
        whole[: len(arrays[name])] = arrays[name]
        field.from_numpy(whole)
    used = len(arrays[BLOCKS]) + 1
    for group, order in zip(batch.device.groups, batch.device.orders, strict=True):
        saved = arrays[START.format(group.law.name)]
        start = np.full(order.bins + 1, saved[used], np.int32)
        start[: used + 1], start[order.tiles :] = saved[: used + 1], saved[used + 1 :]
        order.start.from_numpy(start)

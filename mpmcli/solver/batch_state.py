"""The complete state of the only run of a batch on the CPU, saved and loaded as one; see `state.State`."""

import math
from collections.abc import Mapping

import numpy as np
import taichi as ti

from mpmcli.errors import InputError
from mpmcli.solver.batch import Batch
from mpmcli.solver.batch_layout import Row
from mpmcli.solver.state import ArraysOnDevice, shape_of

# The tiles of a sparse grid that have numbers; of the table of a sort what concerns these.
BLOCKS, START = "grid.blocks", "{}.block_start"
# Columns that the scene sets, and that one which goes on for longer sets otherwise.
OF_SCENE = ("end", "until"), ("frames", "sheets")


def read_batch(batch: Batch) -> ArraysOnDevice:
    """Return what a batch of one run has on the device and tells its kernel, by name, until the next launch."""
    return ArraysOnDevice(_fields(batch), {"numbers": batch.numbers[0], "counts": batch.counts[0]} | _blocks(batch))


def write_batch(batch: Batch, arrays: Mapping[str, np.ndarray]) -> None:
    """Replace what a batch of one run has by what was read of one of the same scene, or of one that ended earlier.

    Raises:
        InputError: the arrays are of another scene.
    """
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
    for row, name, layout, kept in (
        (batch.numbers[0], "numbers", batch.layout.real, OF_SCENE[0]),
        (batch.counts[0], "counts", batch.layout.count, OF_SCENE[1]),
    ):
        columns = np.hstack([getattr(layout, column) for column in kept]).astype(int)
        own = row[columns].copy()
        row[:] = arrays[name]
        row[columns] = own
    batch.share_work(batch.counts)


def aim_on(row: Row) -> None:
    """Let a run that has reached its last frame go on to the next one, as the kernel does after every other frame."""
    frames = row.count("frames")
    if row.count("arrived") == 1 and row.count("frame") < frames:
        row.set_counts(frame=row.count("frame") + 1, limit=0, arrived=0)
        row.set(smallest=math.inf, largest=0.0, largest_courant=0.0)
    row.set(target=row.number("end") * row.count("frame") / frames)


def _fields(batch: Batch) -> dict[str, ti.Field]:
    """Return every field of the device that outlives a step, by name."""
    device = batch.device
    found = {"grid.box": device.grid.box, "stencils": device.stencils}
    for group, order in zip(device.groups, device.orders, strict=True):
        found |= {f"{group.law.name}.{name}": field for name, field in group.fields().items()}
        if not device.grid.sparse:
            found[f"{group.law.name}.tile_start"] = order.start
    if device.colliders is not None:
        found["colliders.taken"] = device.colliders.taken
    if device.motion is not None:
        found["colliders.pose"] = device.motion.pose
    return found | ({} if device.particles.contact is None else device.particles.contact.fields())


def _blocks(batch: Batch) -> dict[str, np.ndarray]:
    """Return what a sparse grid numbers, and the tables of its sorts, by name; nothing of a dense one."""
    device, grid = batch.device, batch.device.grid
    if not grid.sparse:
        return {}
    found = {BLOCKS: grid.occupied()}
    for group, order in zip(device.groups, device.orders, strict=True):
        start = order.start.to_numpy()
        # Behind the blocks in use all tiles are empty.
        found[START.format(group.law.name)] = np.concatenate([start[: len(found[BLOCKS]) + 2], start[order.tiles :]])
    return found


def _block_shapes(batch: Batch, arrays: Mapping[str, np.ndarray]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of `_blocks`, as many as there are in `arrays`."""
    count, order = len(arrays[BLOCKS]), batch.device.orders[0]
    starts = {START.format(group.law.name): (count + 3 + order.bins - order.tiles,) for group in batch.device.groups}
    return {BLOCKS: (count,)} | starts


def _make_room(batch: Batch, arrays: Mapping[str, np.ndarray]) -> None:
    """Let a sparse grid have room for saved blocks.

    Raises:
        InputError: they are not tiles of its domain.
    """
    tiles, grid = arrays.get(BLOCKS, np.empty((0, 0))), batch.device.grid
    sound = tiles.ndim == 1 and (np.diff(tiles) > 0).all() and (tiles >= 0).all() and (tiles < grid.all_tiles).all()
    if not sound:
        raise InputError("the saved state belongs to another scene or to another kind of backend.")
    if len(tiles) >= grid.tile_count:
        batch.grow(len(tiles) + 1)


def _write_blocks(batch: Batch, arrays: Mapping[str, np.ndarray]) -> None:
    """Replace what `_blocks` returns."""
    batch.device.grid.occupy(arrays[BLOCKS])
    used = len(arrays[BLOCKS]) + 1
    for group, order in zip(batch.device.groups, batch.device.orders, strict=True):
        saved = arrays[START.format(group.law.name)]
        start = np.full(order.bins + 1, saved[used], np.int32)
        start[: used + 1], start[order.tiles :] = saved[: used + 1], saved[used + 1 :]
        order.start.from_numpy(start)

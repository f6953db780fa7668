"""The complete state of the only run of a batch on the CPU, saved and loaded as one; see `state.State`."""

import math
from collections.abc import Mapping

import numpy as np
import taichi as ti

from mpmcli.errors import InputError
from mpmcli.solver.batch import Batch
from mpmcli.solver.batch_layout import Row
from mpmcli.solver.state import ArraysOnDevice, shape_of

# Columns that the scene sets, and that one which goes on for longer sets otherwise.
OF_SCENE = ("end", "until"), ("frames", "sheets")


def read_batch(batch: Batch) -> ArraysOnDevice:
    """Return what a batch of one run has on the device and tells its kernel, by name, until the next launch."""
    return ArraysOnDevice(_fields(batch), {"numbers": batch.numbers[0], "counts": batch.counts[0]})


def write_batch(batch: Batch, arrays: Mapping[str, np.ndarray]) -> None:
    """Replace what a batch of one run has by what was read of one of the same scene, or of one that ended earlier.

    Raises:
        InputError: the arrays are of another scene.
    """
    fields = _fields(batch)
    expected = {name: shape_of(field) for name, field in fields.items()}
    expected |= {"numbers": batch.numbers[0].shape, "counts": batch.counts[0].shape}
    if expected != {name: array.shape for name, array in arrays.items()}:
        raise InputError("the saved state belongs to another scene or to another kind of backend.")
    for name, field in fields.items():
        field.from_numpy(arrays[name])
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
        found[f"{group.law.name}.tile_start"] = order.start
    if device.colliders is not None:
        found["colliders.taken"] = device.colliders.taken
    if device.motion is not None:
        found["colliders.pose"] = device.motion.pose
    return found | ({} if device.particles.contact is None else device.particles.contact.fields())

"""A store of Zarr 3: a group per trajectory."""

import math
import warnings
from collections.abc import Callable
from pathlib import Path

from mpmcli.dataset.formats.arrays import ArraysFormat, ExportedArray, arrays_of
from mpmcli.dataset.metadata import common_facts, facts_of
from mpmcli.dataset.shard import group_name
from mpmcli.plain_json import finite_json

# Bytes of a chunk, which holds at least one frame.
CHUNK_BYTES = 4 * 2**20


class Zarr(ArraysFormat):
    """The store trajectories.zarr, with consolidated metadata, and the facts of metadata.json as attributes.

    The group of a trajectory has its arrays, in chunks of consecutive frames with all particles, uncompressed.
    """

    files = r"trajectories\.zarr"
    package = extra = "zarr"

    def write_arrays(self, directory: Path, tick: Callable[[], None]) -> None:
        """Write a Zarr 3 store with a group per trajectory, whose attributes are its facts."""
        import zarr

        root = zarr.open_group(directory / "trajectories.zarr", mode="w", zarr_format=3)
        common = common_facts(self.trajectories, self.trajectories[0].stride)
        own = facts_of(self.trajectories[0])
        root.attrs.update(finite_json({key: value for key, value in common.items() if key not in own}))
        for each in self.trajectories:
            facts = {"number": each.source.number, "split": each.source.split, **facts_of(each)}
            group = root.create_group(group_name(each.source.number), attributes=facts)
            for name, array in arrays_of(each).items():
                options = {"shape": array.shape, "dtype": array.dtype, "chunks": _chunk(array)}
                stored, first = group.create_array(name, compressors=None, **options), 0
                for block in array.blocks():
                    stored[first : first + len(block)] = block
                    first += len(block)
            tick()
        with warnings.catch_warnings():
            # Other readers of Zarr 3 may not know consolidated metadata, and need none.
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(root.store)


def _chunk(array: ExportedArray) -> tuple[int, ...]:
    """Return the shape of chunks of nearly equal numbers of frames: Zarr pads the last one."""
    # Chunks have no length of 0.
    frames, *rest = (max(length, 1) for length in array.shape)
    most = max(1, CHUNK_BYTES // (array.dtype.itemsize * math.prod(rest)))
    return (math.ceil(frames / math.ceil(frames / most)), *rest)

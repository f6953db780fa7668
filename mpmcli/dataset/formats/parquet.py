"""Tables of Parquet as `load_dataset` of Hugging Face reads them: a row per trajectory."""

import json
import math
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.dataset.formats.arrays import ArraysFormat, ExportedArray, arrays_of
from mpmcli.dataset.formats.croissant import croissant
from mpmcli.dataset.shard import SPLITS
from mpmcli.errors import InputError
from mpmcli.output.checksums import path_digest
from mpmcli.plain_text import one_line

# Arrays of datasets have up to five axes, and lists as many numbers as 31 bits count.
MOST_AXES, LARGEST = 5, 2**31 - 1
_ABOUT = "Trajectories of particles computed with mpmcli, one in each row; lengths in m, times in s."
_CARD = """\
---
configs:
- config_name: default
  data_files:
{files}
dataset_info:
  features:
{features}
---

# {title}

{about} `metadata.json` has spacings,
the names of laws and bodies, and statistics of motion.

```python
from datasets import load_dataset
dataset = load_dataset(".").with_format("numpy")
position = dataset["{split}"][0]["position"]    # (T, N, {dimension})
```
"""


class Parquet(ArraysFormat):
    """A table per split, in files of at most 500 MB, and README.md and croissant.json with splits and types of columns.

    Columns are the number and the draws (JSON) of a trajectory, and its arrays as nested lists. The column of an array
    whose axes have the same length in all trajectories, but for the first, is an Array2D to Array5D of datasets: these
    become arrays of NumPy a hundred times faster than lists. A trajectory without an array has null.
    """

    files = r"(train|valid|test)-\d{5}-of-\d{5}\.parquet|README\.md|croissant\.json"
    package, extra = "pyarrow", "huggingface"

    def check(self) -> None:
        """Refuse arrays whose type differs between trajectories, or that are too large for a row of a table."""
        for name, found in self._columns.items():
            if len({(array.dtype, len(array.shape)) for array in found}) > 1:
                raise InputError(
                    f"{name} has different types in the trajectories: a table has one type in each column; --to npz "
                    "takes trajectories that differ."
                )
            if any(math.prod(array.shape) > LARGEST for array in found):
                raise InputError(
                    f"{name} of a trajectory has more than 2^31 numbers, too many for a row of a table: take a larger "
                    "--stride, or --max-particles."
                )

    @cached_property
    def _columns(self) -> dict[str, list[ExportedArray]]:
        """The array of each trajectory that has it, without its content, by name."""
        found: dict[str, list[ExportedArray]] = {}
        for each in self.trajectories:
            for name, array in arrays_of(each).items():
                found.setdefault(name, []).append(ExportedArray(array.dtype, array.shape, tuple))
        return found

    def _lengths(self, name: str) -> list[int | None]:
        """Return the lengths of the axes of a column, None where trajectories differ."""
        axes = zip(*(array.shape for array in self._columns[name]), strict=True)
        return [lengths[0] if len({*lengths}) == 1 else None for lengths in axes]

    def _feature(self, name: str) -> dict[str, Any]:
        """Return the type of a column for datasets."""
        found, shape = self._columns[name], self._lengths(name)
        dtype, axes = found[0].dtype.name, len(shape)
        alike = not {None, 0} & {*shape[1:]} and len(found) == len(self.trajectories)
        if alike and 1 < axes <= MOST_AXES:
            return {"name": name, "dtype": {f"array{axes}_d": {"shape": shape, "dtype": dtype}}}
        kind: Any = dtype
        for _ in range(axes):
            kind = {"list": kind}
        return {"name": name, **kind}

    def write_arrays(self, directory: Path, tick: Callable[[], None]) -> None:
        """Write tables with a row per trajectory, and a card and a Croissant description beside them."""
        import pyarrow as pa
        from pyarrow.parquet import ParquetWriter

        types = {"number": pa.int64(), "draws": pa.string()}
        for name, found in self._columns.items():
            types[name] = pa.from_numpy_dtype(found[0].dtype)
            for _ in found[0].shape:
                types[name] = pa.list_(types[name])
        for file, chosen in self.parts():
            path = directory / f"{file}.parquet"
            with ParquetWriter(path, pa.schema(types), compression="none", use_dictionary=False) as writer:
                for each in chosen:
                    row = {"number": [each.source.number], "draws": [json.dumps(each.source.draws)]}
                    row |= {name: _nested(array.read()) for name, array in arrays_of(each).items()}
                    columns = [pa.array(row.get(name, [None]), kind) for name, kind in types.items()]
                    writer.write_batch(pa.record_batch(columns, schema=pa.schema(types)))
                    tick()
        (directory / "README.md").write_text(self._card(), encoding="utf-8", newline="\n")
        files = {path.name: (path.stat().st_size, path_digest(path)) for path in sorted(directory.glob("*.parquet"))}
        columns = {"number": (np.dtype("int64"), ()), "draws": (None, ())}
        for name, found in self._columns.items():
            columns[name] = found[0].dtype, [-1 if one is None else one for one in self._lengths(name)]
        text = json.dumps(croissant(files, self._splits, columns, name=self._title, description=_ABOUT), indent=2)
        (directory / "croissant.json").write_text(text + "\n", encoding="utf-8", newline="\n")

    @property
    def _title(self) -> str:
        return one_line(self.trajectories[0].source.header.title or "Trajectories of particles")

    @property
    def _splits(self) -> list[str]:
        there = {each.source.split for each in self.trajectories}
        return [split for split in SPLITS if split in there]

    def _card(self) -> str:
        features = [{"name": "number", "dtype": "int64"}, {"name": "draws", "dtype": "string"}]
        features += map(self._feature, self._columns)
        return _CARD.format(
            files="\n".join(f"  - split: {split}\n    path: {split}-*.parquet" for split in self._splits),
            features="\n".join(f"  - {json.dumps(feature)}" for feature in features),
            title=self._title,
            about=_ABOUT,
            split=self._splits[0],
            dimension=self.trajectories[0].layout.dimension,
        )


def _nested(array: np.ndarray) -> Any:
    """Return an array of pyarrow of one row, a nested list."""
    import pyarrow as pa

    found = pa.array(array.reshape(-1))
    for axis in reversed(range(array.ndim)):
        offsets = np.arange(math.prod(array.shape[:axis]) + 1) * array.shape[axis]
        found = pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), found)
    return found

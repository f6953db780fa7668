"""Shards of WebDataset: archives of a .npz and a .json per trajectory."""

import io
import json
import tarfile
from collections.abc import Callable
from pathlib import Path

from mpmcli.dataset.formats.arrays import ArraysFormat, arrays_of
from mpmcli.dataset.formats.npz import write_npz
from mpmcli.dataset.metadata import facts_of
from mpmcli.dataset.shard import group_name


class Webdataset(ArraysFormat):
    """Archives of at most 500 MB per split; the arrays of the sample 000007 are 000007.npz, its facts 000007.json."""

    files = r"(train|valid|test)-\d{5}-of-\d{5}\.tar"

    def write_arrays(self, directory: Path, tick: Callable[[], None]) -> None:
        """Write tar files with an NPZ and a JSON file per trajectory; their bytes depend on these alone."""
        for file, chosen in self.parts():
            with tarfile.open(directory / f"{file}.tar", "w") as archive:
                for each in chosen:
                    name, arrays = group_name(each.source.number), io.BytesIO()
                    write_npz(arrays, ((key, array.read()) for key, array in arrays_of(each).items()))
                    facts = {"number": each.source.number, "split": each.source.split, **facts_of(each)}
                    for suffix, content in (("npz", arrays.getbuffer()), ("json", json.dumps(facts).encode())):
                        # Of no owner and date.
                        info = tarfile.TarInfo(f"{name}.{suffix}")
                        info.size = len(content)
                        archive.addfile(info, io.BytesIO(content))
                    tick()

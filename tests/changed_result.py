"""Changes to a result that its checksums do not tell of, as if mpmcli had written it so."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from mpmcli.output.checksums import NAME, append_checksum, checksum, gaps_of, store_checksums


@contextmanager
def changed(path: Path) -> Iterator[h5py.File]:
    """Open a file for changes, and give it the checksums of what it holds then."""
    with h5py.File(path, "r+") as file:
        yield file
        arrays = json.loads(file["mpmcli"][NAME].attrs["list"])["arrays"]
        del file["mpmcli"][NAME]
        present = [name for name in arrays if name in file]
        places = zip(file["VTKHDF/Steps/PointOffsets"][:], file["VTKHDF/NumberOfPoints"][:], strict=False)
        table = [[checksum(file[name][offset : offset + count]) for name in present] for offset, count in places]
        store_checksums(file, "mpmcli", present, np.array(table, np.uint32).reshape(-1, len(present)))
        gaps = gaps_of([file[name] for name in present])
    append_checksum(path, gaps)

"""The format for ParaView before 5.12: a .vtu file for each frame, a .pvd that lists them, and the ledger as CSV."""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from mpmcli.errors import DiskFullError, RunError
from mpmcli.output.checksums import SUMS, path_digest, sums_text
from mpmcli.output.collider_files import MOVING_FRAME, RESTING_PIECE, as_they_moved, pvd_text, write_collider_series
from mpmcli.output.collider_files import SERIES as COLLIDERS
from mpmcli.output.durable import is_full, require_free_space, sealed, write_text
from mpmcli.output.layout import PACKED, POSITION, FrameLayout, ledger_csv
from mpmcli.output.result import open_result
from mpmcli.scene.colliders import Collider

SERIES, SERIES_LEDGER = "particles.pvd", "ledger.csv"
SERIES_FILES = (SERIES, SERIES_LEDGER, SUMS, COLLIDERS, RESTING_PIECE)
SERIES_FRAME = re.compile(r"particles_\d{6,}\.vtu")
# Each particle is one cell: number, offset and type.
_CELL_BYTES, _FILE_BYTES = 24, 64 * 1024


def is_series_file(name: str) -> bool:
    """Return whether a name is that of a file of a series."""
    return name in SERIES_FILES or bool(SERIES_FRAME.fullmatch(name) or MOVING_FRAME.fullmatch(name))


def series_size(layout: FrameLayout, counts: Sequence[int]) -> int:
    """Return a bound on the bytes of the files of frames with `counts` particles, not compressed."""
    # Base64 makes 4 bytes of 3.
    return sum(counts) * ((layout.bytes_per_particle + _CELL_BYTES) * 4 // 3) + _FILE_BYTES * len(counts)


def write_series(
    directory: Path,
    colliders: Sequence[Collider],
    *,
    compress: bool = False,
    stop: Callable[[], bool] = lambda: False,
) -> Path:
    """Write the frames of the packed result to a series in the same directory, with checksums, and return the .pvd.

    The series appears as a whole or not at all. `compress` uses zlib. RunError: the disk is full or a write failed;
    KeyboardInterrupt: `stop` returned True.
    """
    result = open_result(directory / PACKED)
    index = result.index
    counts, kept = index.counts.tolist(), f"the frames are kept in {PACKED}"
    try:
        require_free_space(directory, series_size(index.layout, counts), "the series of VTK files", kept, several=True)
        names = [f"particles_{number:06d}.vtu" for number in index.frames.tolist()]
        for k, name in enumerate(names):
            if stop():
                raise KeyboardInterrupt
            with sealed(directory / name) as temporary:
                write_vtu(temporary, result.stored(k), compress=compress)
        columns = zip(*(table.tolist() for table in (index.frames, index.steps, index.counts)), strict=True)
        write_text(directory / SERIES_LEDGER, ledger_csv(index.ledger, list(columns)))
        times, moved = index.times.tolist(), as_they_moved(colliders, index)
        names += write_collider_series(directory, index.header, times, moved)
        listed = [(time, 0, name) for time, name in zip(times, names, strict=False)]
        write_text(directory / SERIES, pvd_text(listed))
        names += [SERIES, SERIES_LEDGER]
        write_text(directory / SUMS, sums_text({name: path_digest(directory / name) for name in names}))
    except BaseException as error:
        with suppress(OSError):
            remove_series(directory)
        if not isinstance(error, OSError):
            raise
        fault = DiskFullError if is_full(error) else RunError
        raise fault(f"{directory / SERIES} could not be written ({error.strerror or error}); {kept}.") from error
    return directory / SERIES


def remove_series(directory: Path) -> None:
    """Remove the files of a series and no others."""
    for path in directory.iterdir():
        if is_series_file(path.name):
            path.unlink(missing_ok=True)


def write_vtu(path: Path, arrays: dict[str, np.ndarray], *, compress: bool = False) -> None:
    """Write the arrays of a frame, in the form in the file, as points."""
    from meshio import Mesh, vtu

    points = arrays.pop(POSITION)
    mesh = Mesh(points, [("vertex", np.arange(len(points)).reshape(-1, 1))], point_data=arrays)
    # The writer is named because meshio.write would choose one by the suffix of the temporary name.
    vtu.write(path, mesh, compression="zlib" if compress else None, header_type="UInt64")

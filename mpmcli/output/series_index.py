"""The list of the frames of a .vtu series, from the files beside them."""

import json
import time
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from mpmcli.errors import InputError
from mpmcli.output.damage import DAMAGE
from mpmcli.output.frame_index import FrameIndex
from mpmcli.output.hdf5_items import DamageError
from mpmcli.output.layout import FrameLayout
from mpmcli.output.ledger_table import FRAME_COLUMNS, parse_ledger_csv
from mpmcli.output.series import SERIES_FRAME, SERIES_HEADER, SERIES_LEDGER
from mpmcli.output.sums_file import read_sums, text_digest
from mpmcli.output.vtkhdf import FORMAT
from mpmcli.plain_text import one_line

# While a run goes on, its files may be replaced between two reads.
TRIES, PAUSE = 4, 0.1
Digests = dict[str, list[str]]


def read_series(path: Path) -> tuple[FrameIndex, list[Path], Digests | None]:
    """Read the .pvd of a series, its ledger and its header.

    Returns:
        The index; the file of each frame; the SHA-256 that each file may have, None of a series without checksums.

    Raises:
        InputError: a file is missing or has changed since it was written, a newer mpmcli wrote it, or it names a file
            that is no frame of it.
    """
    for _ in range(TRIES - 1):
        try:
            return _read(path)
        except DamageError:
            time.sleep(PAUSE)
    return _read(path)


def _read(path: Path) -> tuple[FrameIndex, list[Path], Digests | None]:
    directory = path.parent
    try:
        # The .pvd is read first: the ledger is replaced before it, so it holds at least as many rows.
        places = [path, directory / SERIES_HEADER, directory / SERIES_LEDGER]
        listed, header, table = (place.read_bytes().decode("utf-8") for place in places)
        facts = dict(json.loads(header))
        if not isinstance(facts["format"], int):
            raise ValueError("the format is no number")
        if facts["format"] > FORMAT:
            raise InputError(f"{path} is of a newer version of mpmcli; update mpmcli to read it.")
        sums = read_sums(directory) if facts["format"] > 1 else None
        for place, text in zip(places, (listed, header, table), strict=True):
            if sums is not None and text_digest(text) not in sums.get(place.name, ()):
                raise DamageError(f"{place} has changed since it was written: its checksum differs.")
        entries = list(ElementTree.fromstring(listed).iter("DataSet"))
        times = np.array([float(entry.attrib["timestep"]) for entry in entries])
        names = [entry.attrib["file"] for entry in entries]
        if foreign := [name for name in names if not SERIES_FRAME.fullmatch(name)]:
            raise InputError(f'{path} names "{one_line(foreign[0])}", and reads no file but the frames beside it.')
        layout = FrameLayout.from_dict(facts["layout"])
        rows, columns = parse_ledger_csv(table)
        frames, steps, counts = (np.array(columns[name][: len(times)]) for name in FRAME_COLUMNS)
        tables = times, frames, steps, 0 * counts, counts
        index = FrameIndex(layout, facts["header"], *tables, rows[: len(times)]).checked()
    except (*DAMAGE, ElementTree.ParseError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path} is not a series of mpmcli: it needs {SERIES_HEADER}, {SERIES_LEDGER} and its frames "
            "beside it, as mpmcli wrote them."
        ) from error
    return index, [directory / name for name in names], sums

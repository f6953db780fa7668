"""The older form of output: one .vtu file per frame, written by meshio, and a .pvd that lists them.

Every ParaView and VTK reads it, at the price of more and larger files; VTKHDF is the default for that reason.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from time import sleep
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mpmcli import __version__
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.checksums import path_digest, read_sums, text_digest, write_sums
from mpmcli.output.collider_files import pvd_text, write_collider_series
from mpmcli.output.durable import sealed, write_text
from mpmcli.output.guarded_read import DAMAGE, DamageError
from mpmcli.output.layout import POSITION, FrameIndex, FrameLayout
from mpmcli.output.ledger_table import FRAME_COLUMNS, ledger_csv, parse_ledger_csv
from mpmcli.output.store import Store
from mpmcli.output.vtkhdf import FORMAT, OVERHEAD_BYTES
from mpmcli.plain_text import one_line

SERIES = "particles.pvd"
SERIES_HEADER = "particles.json"
SERIES_LEDGER = "ledger.csv"
SERIES_FRAME = re.compile(r"particles_\d{6,}\.vtu")
# While a run goes on, its files may be replaced between two reads.
TRIES, PAUSE = 4, 0.1
Digests = dict[str, list[str]]


def series_frame_name(index: int) -> str:
    """File name of the frame with this number."""
    return f"particles_{index:06d}.vtu"


class VtkSeriesStore(Store):
    """The store of `--format vtk`.

    After each frame `directory` holds its .vtu file, ledger.csv and particles.pvd, each replaced in one step, so that
    ParaView can open the series while the run goes on. particles.json holds the header. `compress` is zlib in the .vtu.
    """

    several = True

    def __init__(self, directory: Path, header: dict[str, Any], **options: Any) -> None:
        super().__init__(directory, header, **options)
        self._times: list[float] = []
        self._frames: dict[str, list[int]] = {name: [] for name in FRAME_COLUMNS}
        self._rows: list[LedgerRow] = []
        self._sums: dict[str, list[str]] = {}

    def go_on_after(self, index: FrameIndex) -> None:
        super().go_on_after(index)
        self._times, self._rows = index.times.tolist(), list(index.ledger)
        for name, column in zip(FRAME_COLUMNS, (index.frames, index.steps, index.counts), strict=True):
            self._frames[name] = column.tolist()
        self._sums = read_sums(self._directory)
        # The scene may end later than it did.
        self._replace({SERIES_HEADER: self._header_text(index.layout)})

    def finish(self, stop: Callable[[], bool] = lambda: False) -> Path | None:
        """Write the colliders, and return the .pvd, complete after every frame; None where no frame was written."""
        if self.frames_written:
            names = write_collider_series(self._directory, self._header, self._times, self._colliders)
            self._sums |= {name: [path_digest(self._directory / name)] for name in names}
            self._sums |= {name: digests[-1:] for name, digests in self._sums.items()}
            write_sums(self._directory, self._sums)
        return self._directory / SERIES if self.frames_written else None

    def _holds_result(self) -> bool:
        return (self._directory / SERIES).exists()

    def _start(self) -> None:
        self._directory.mkdir(parents=True, exist_ok=True)

    def _size(self, layout: FrameLayout, counts: Sequence[int]) -> int:
        # Base64 makes 4 bytes of 3; each particle is a cell of its own: number, offset and type.
        return sum(counts) * (layout.bytes_per_particle + 24) * 4 // 3 + OVERHEAD_BYTES * len(counts)

    def _write(
        self, layout: FrameLayout, frames: Sequence[Frame], rows: Sequence[LedgerRow], size: int
    ) -> Callable[[], None]:
        return partial(self._write_all, layout, frames, rows)

    def _write_all(self, layout: FrameLayout, frames: Sequence[Frame], rows: Sequence[LedgerRow]) -> None:
        for frame in frames:
            with sealed(self._directory / series_frame_name(frame.index)) as temporary:
                _write_vtu(temporary, dict(layout.stored(frame)), compress=self._compress)
                self._sums[series_frame_name(frame.index)] = [path_digest(temporary)]
        if frames[0].index == 0:
            text = self._header_text(layout)
            self._sums[SERIES_HEADER] = [text_digest(text)]
            write_text(self._directory / SERIES_HEADER, text)
        self._rows += rows
        for frame in frames:
            self._times.append(float(frame.time))
            for name, value in zip(FRAME_COLUMNS, (frame.index, frame.step, len(frame.position)), strict=True):
                self._frames[name].append(int(value))
        entries = [(time, 0, series_frame_name(k)) for k, time in enumerate(self._times)]
        # The .pvd comes last: what it lists is there.
        self._replace({SERIES_LEDGER: ledger_csv(self._rows, self._frames), SERIES: pvd_text(entries)})

    def _replace(self, texts: Mapping[str, str]) -> None:
        """Replace files; a reader may find the former one or the new one, whenever the run ends."""
        for name, text in texts.items():
            self._sums[name] = [*self._sums.get(name, [])[-1:], text_digest(text)]
        write_sums(self._directory, self._sums)
        for name, text in texts.items():
            write_text(self._directory / name, text)

    def _header_text(self, layout: FrameLayout) -> str:
        facts = {"format": FORMAT, "version": __version__, "header": self._header, "layout": layout.to_dict()}
        return json.dumps(facts, indent=1) + "\n"


def read_vtu(path: Path, digests: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """Read the arrays of one frame, in the form of the file; `digests` are the SHA-256 that it may have, None all."""
    from meshio import vtu

    try:
        if digests is not None and path_digest(path) not in digests:
            raise ValueError("its checksum differs")
        mesh = vtu.read(path)
    # A damaged file makes meshio and the XML parser raise almost anything.
    except Exception as error:
        raise InputError(f"{path} is missing or damaged: this frame of the series cannot be read.") from error
    return {POSITION: mesh.points, **mesh.point_data}


def _write_vtu(path: Path, arrays: dict[str, np.ndarray], *, compress: bool) -> None:
    from meshio import Mesh, vtu

    points = arrays.pop(POSITION)
    mesh = Mesh(points, [("vertex", np.arange(len(points)).reshape(-1, 1))], point_data=arrays)
    # The writer is named, because meshio.write would choose one by the end of the temporary name.
    vtu.write(path, mesh, compression="zlib" if compress else None, header_type="UInt64")


def read_series(path: Path) -> tuple[FrameIndex, list[Path], Digests | None]:
    """Read the .pvd of a series: its index, the file of each frame, and the SHA-256 that each may have, or None.

    InputError: a file is missing, has changed, is of a newer mpmcli, or is no frame.
    """
    for _ in range(TRIES - 1):
        try:
            return _read(path)
        except DamageError:
            sleep(PAUSE)
    return _read(path)


def read_sound_series(path: Path) -> FrameIndex | None:
    """Return the index of the frames of a series up to the first whose file is missing or damaged, None for none.

    InputError: as of `read_series`.
    """
    index, files, digests = read_series(path)
    count = 0
    for file in files:
        try:
            if digests is None:
                read_vtu(file)
            elif path_digest(file) not in digests.get(file.name, ()):
                break
        except (InputError, OSError):
            break
        count += 1
    return index.first(count) if count else None


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

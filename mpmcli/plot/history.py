"""What a figure of a result shows over time: the columns of its ledger, and how far the particles reach."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader
from mpmcli.output.ledger_table import TEXT
from mpmcli.output.result import Result
from mpmcli.plain_text import one_line
from mpmcli.render.frame_choice import evenly_spaced

FRAMES_MAX = 200  # frames whose positions are read; more would not be seen in the figure
BODIES_MAX = 6  # more bodies than this are shown as one
NAMED = 5  # frames that a note names


@dataclass(frozen=True)
class Reach:
    """How far the particles reach, in some of the frames."""

    times: np.ndarray  # (F,) s
    names: tuple[str, ...]  # of B bodies, or one name for all of them
    lowest: np.ndarray  # (F, B, d) m, NaN where a body has no particle; `highest` alike
    highest: np.ndarray


@dataclass(frozen=True)
class History:
    """One run over time."""

    title: str  # of the scene
    header: RunHeader
    particles: int  # in the last frame
    status: str  # of the result
    columns: dict[str, np.ndarray]  # of the ledger, (T,) float64, momenta (T, components); NaN where it is not finite
    limits: tuple[str, ...]  # T names of the bound on the step, "" at the initial state
    reach: Reach
    notes: tuple[str, ...]  # sentences about what the figure does not show

    @property
    def times(self) -> np.ndarray:
        """(T,) s."""
        return self.columns["time"]


def read_history(result: Result) -> History:
    """Read what a figure of a result shows; InputError where a frame or the ledger is damaged."""
    rows = result.ledger
    if len(rows) != result.frame_count:
        raise InputError(f"{result.path} is damaged: it has {result.frame_count} frames and {len(rows)} ledger rows.")
    columns, broken = {}, []
    for name in (entry.name for entry in fields(LedgerRow) if entry.name != TEXT):
        if rows and getattr(rows[0], name) is None:
            # Of scenes in which particles come and go.
            continue
        values = np.array([getattr(row, name) for row in rows], dtype=np.float64)
        columns[name] = np.where(np.isfinite(values), values, np.nan)
        broken.append(~np.isfinite(values).reshape(len(rows), -1).all(1))
    notes = _gaps(np.flatnonzero(np.any(broken, 0)), result.numbers)
    chosen = evenly_spaced(range(result.frame_count), FRAMES_MAX)
    if len(chosen) < result.frame_count:
        notes.append(f"The reach of the particles is read from {len(chosen)} of {result.frame_count} frames.")
    return History(
        title=one_line(result.header.title) or result.path.stem,
        header=result.header,
        particles=int(result.particle_counts[-1]),
        status="" if result.record is None else result.status,
        columns=columns,
        limits=tuple(row.limit for row in rows),
        reach=_reach(result, chosen),
        notes=tuple(notes),
    )


def _gaps(rows: np.ndarray, numbers: np.ndarray) -> list[str]:
    if len(rows) == 0:
        return []
    named = ", ".join(str(numbers[k]) for k in rows[:NAMED])
    more = f" and {len(rows) - NAMED} more" if len(rows) > NAMED else ""
    frames = "frame" if len(rows) == 1 else "frames"
    return [f"The ledger holds numbers that are not finite in {frames} {named}{more}; they are gaps in the figure."]


def _reach(result: Result, chosen: Sequence[int]) -> Reach:
    bodies = result.header.body_names
    apart = 1 < len(bodies) <= BODIES_MAX
    labels = range(len(bodies)) if apart else [None]
    extents = [[_extent(frame, label) for label in labels] for frame in (result.present_frame(k, ()) for k in chosen)]
    both = np.array(extents).reshape(len(chosen), len(labels), 2, result.dimension)
    names = bodies if apart else (bodies[0] if len(bodies) == 1 else "all bodies",)
    names = tuple(one_line(name) for name in names)
    return Reach(result.times[chosen], names, both[:, :, 0], both[:, :, 1])


def _extent(frame: Frame, label: int | None) -> np.ndarray:
    """Return the lowest and the highest coordinates of a body, or of all, that are finite: (2, d)."""
    position = frame.position.astype(np.float64)
    kept = np.isfinite(position).all(1)
    if label is not None:
        kept &= frame.body == label
    if not kept.any():
        return np.full((2, position.shape[1]), np.nan)
    return np.array([position[kept].min(0), position[kept].max(0)])

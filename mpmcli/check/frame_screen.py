"""Looks at many frames of a run in memory at once, for those that the checks of single frames need not look at.

The checks of a frame of a thousand particles take longer than its steps do.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mpmcli.check.result_entries import KeptEntry
from mpmcli.check.result_motion import outlier_threshold, reach
from mpmcli.check.result_state import BLOWN_UP, CRUSHED
from mpmcli.output.header import RunHeader

# Numbers of an array that are looked at at once.
AT_ONCE = 2**18
# Room for the rounding of what single frames compute otherwise.
ROUNDING = 1e-4
# Fields with checks of their own.
CHECKED = ("affine", "mass", "volume_ratio")


class Screened(NamedTuple):
    """What was seen of T frames.

    Attributes:
        quiet: (T,) bool, whether no check of the values of a frame, or of the motion up to it, finds anything.
        ratio: (T,), the largest displacement over the largest that the ledger allows; 0 where a frame is not quiet.
        lowest, highest: (T, d), corners of the particles, m.
    """

    quiet: np.ndarray
    ratio: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray


def screen(header: RunHeader, entries: Sequence[KeptEntry]) -> Screened | None:
    """Look at all frames of a run; None where they are not alike, particles come and go, or a field is of CHECKED."""
    frames = [entry.frame for entry in entries]
    counts = {len(frame.position) for frame in frames}
    bounded = header.origin is not None and header.spacing is not None and not any(header.open_axes)
    known = bounded and not header.comes_and_goes and not header.drops
    if not known or len(counts) != 1 or 0 in counts or not set(CHECKED).isdisjoint(frames[0].fields):
        return None
    d = header.dimension
    found = Screened(
        np.zeros(len(frames), bool), np.zeros(len(frames)), np.empty((len(frames), d)), np.empty((len(frames), d))
    )
    with np.errstate(invalid="ignore", over="ignore"):
        for part in _parts(len(frames), counts.pop() * d):
            _screen(header, entries[max(0, part.start - 1) : part.stop], part, found)
    return found


def _parts(count: int, size: int) -> Iterator[slice]:
    step = max(1, AT_ONCE // size)
    for first in range(0, count, step):
        yield slice(first, min(first + step, count))


def _screen(header: RunHeader, entries: Sequence[KeptEntry], part: slice, found: Screened) -> None:
    """Look at some frames; the first of `entries` is the one before them, unless they begin with frame 0."""
    frames, rows = [entry.frame for entry in entries], [entry.row for entry in entries]
    own = slice(1 if part.start else 0, None)
    x, v = (np.stack([getattr(frame, name) for frame in frames]) for name in ("position", "velocity"))
    columns = np.ascontiguousarray(x[own].transpose(0, 2, 1))
    found.lowest[part], found.highest[part] = columns.min(axis=2), columns.max(axis=2)
    # Written so that a NaN is not quiet.
    quiet = (found.lowest[part] > header.origin).all(axis=1) & (found.highest[part] < header.upper).all(axis=1)
    quiet &= np.isfinite(v[own]).all(axis=(1, 2))
    for name in frames[0].fields:
        values = np.stack([frame.fields[name] for frame in frames[own]])
        if values.dtype.kind == "f":
            quiet &= np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    J = np.array([(row.volume_ratio_min, row.volume_ratio_max) for row in rows[own]])
    quiet &= (J[:, 0] > CRUSHED * (1 + ROUNDING)) & (J[:, 1] < BLOWN_UP * (1 - ROUNDING))
    follows = np.array([b.number == a.number + 1 for a, b in pairwise(entries)], bool)
    allowed = np.array([reach(header, row, x.dtype) or 0.0 for row in rows[1:]])
    moved = header.way(x[:-1], x[1:])
    farthest = np.sqrt(np.einsum("tij,tij->ti", moved, moved).max(axis=1, initial=0.0))
    times = np.array([row.time for row in rows])
    moved -= (0.5 * np.diff(times)).astype(x.dtype)[:, None, None] * (v[:-1] + v[1:])
    stray = np.sqrt(np.einsum("tij,tij->ti", moved, moved).max(axis=1, initial=0.0))
    follows &= (farthest > 0) & (farthest < allowed * (1 - ROUNDING))
    follows &= stray < outlier_threshold(header.spacing, allowed) * (1 - ROUNDING)
    ratio = np.divide(farthest, allowed, out=np.zeros(len(allowed)), where=follows)
    if not part.start:
        # Nothing is before the first frame.
        follows, ratio = np.append(False, follows), np.append(0.0, ratio)
    found.quiet[part] = quiet & follows
    found.ratio[part] = np.where(found.quiet[part], ratio, 0.0)

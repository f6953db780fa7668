"""Colours of a surface by a field of its particles."""

from collections.abc import Mapping

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.coloring import Coloring
from mpmcli.render.shading.material_groups import Group
from mpmcli.render.theme import rgb

# Colours in a table of a colour map.
STEPS = 1024


def tints_of(group: Group, colors: Coloring, frame: Frame) -> dict[str, np.ndarray]:
    """Return what is carried over from particles to a surface: their values, and which of them are numbers."""
    values = np.asarray(colors.values(frame), dtype=np.float64)[group.rows]
    known = np.isfinite(values)
    return {"value": np.where(known, values, 0.0), "known": known.astype(np.float32)}


def shades(values: np.ndarray, colors: Coloring) -> np.ndarray:
    """Return the colours (n, 3) float32, as the display shows them, of values (n,)."""
    from matplotlib import colormaps

    low, high = colors.limits
    table = colormaps[colors.cmap](np.linspace(0.0, 1.0, STEPS))[:, :3].astype(np.float32)
    known = np.isfinite(values)
    place = (np.where(known, values, low) - low) / max(high - low, 1e-300)
    found = table[np.clip(place * STEPS, 0, STEPS - 1).astype(int)]
    found[~known] = rgb(colors.missing)
    return found


def painted(attributes: Mapping[str, np.ndarray], colors: Coloring) -> np.ndarray:
    """Return linear colours (v, 3) of vertices to which the values of `tints_of` have been carried over."""
    value, known = attributes["value"].astype(np.float64), attributes["known"].astype(np.float64)
    # The mean over those particles that have a number, where they are the most.
    values = np.divide(value, known, out=np.full_like(value, np.nan), where=known > 0.5)
    return shades(values, colors) ** np.float32(2.2)

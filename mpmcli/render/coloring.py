"""Colourings of particles: by a value with its unit and limits, or by category."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.theme import rgb, rgb_bytes

# Steps of a colour map under light, which makes more of the differences between neighbouring colours.
SHADES = 1024


@dataclass(frozen=True)
class Coloring:
    """Colours by value.

    Attributes:
        name, unit: of the value, for people; the unit is "" where there is none.
        fields: to be read of each frame.
        value: gives (n,) float64 for a frame; NaN where there is none.
        cmap: name of a colour map of matplotlib.
        limits: the values at its two ends, the same for all frames.
        missing: "#rrggbb" of what is not a number.
    """

    name: str
    unit: str
    fields: tuple[str, ...]
    value: Callable[[Frame], np.ndarray]
    cmap: str
    limits: tuple[float, float]
    missing: str

    def values(self, frame: Frame) -> np.ndarray:
        """Return (n,) float64."""
        # A quotient by zero is drawn as a missing value.
        with np.errstate(all="ignore"):
            return self.value(frame)

    def particle_rgb(self, frame: Frame) -> np.ndarray:
        """Return (n, 3) uint8."""
        return self.rgb(self.values(frame))

    def rgb(self, values: np.ndarray) -> np.ndarray:
        """Return the colours (..., 3) uint8 of values (...)."""
        low, high = self.limits
        known = np.isfinite(values)
        with np.errstate(all="ignore"):
            share = np.where(known, (values - low) / (high - low), 0.0)
        colors = self._table[np.clip(share * 255.0 + 0.5, 0, 255).astype(np.intp)]
        colors[~known] = rgb_bytes(self.missing)
        return colors

    def shades(self, values: np.ndarray) -> np.ndarray:
        """Return the colours (..., 3) float32 from 0 to 1 of values (...), in finer steps than `rgb`."""
        import matplotlib as mpl

        low, high = self.limits
        table = mpl.colormaps[self.cmap](np.linspace(0.0, 1.0, SHADES))[:, :3].astype(np.float32)
        known = np.isfinite(values)
        place = (np.where(known, values, low) - low) / max(high - low, 1e-300)
        found = table[np.clip(place * SHADES, 0, SHADES - 1).astype(int)]
        found[~known] = rgb(self.missing)
        return found

    @cached_property
    def _table(self) -> np.ndarray:
        import matplotlib as mpl

        return (mpl.colormaps[self.cmap](np.linspace(0.0, 1.0, 256))[:, :3] * 255.0 + 0.5).astype(np.uint8)


@dataclass(frozen=True)
class Categories:
    """Colours by category: the body or the material of a particle.

    Attributes:
        name: of the property, such as "material".
        names, inks: of each category; inks are "#rrggbb".
        kind_of: (b,) category of each body.
    """

    name: str
    names: tuple[str, ...]
    inks: tuple[str, ...]
    kind_of: tuple[int, ...]
    fields: tuple[str, ...] = ()

    def particle_rgb(self, frame: Frame) -> np.ndarray:
        """Return (n, 3) uint8."""
        table = np.array([rgb_bytes(ink) for ink in self.inks], np.uint8)
        return table[np.array(self.kind_of)[np.clip(frame.body, 0, len(self.kind_of) - 1)]]

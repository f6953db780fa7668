"""The style of figures: colours that colour-blind people can distinguish, on light and on dark."""

import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mpmcli.render.theme import ThemeName

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Pixels per inch of a figure of AREA pixels; others are the same figure, larger or smaller.
DPI, AREA = 100.0, 1200 * 900
# Settings of matplotlib that all figures share.
SHARED: dict[str, Any] = {
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.7,
    "legend.frameon": False,
}


@dataclass(frozen=True)
class Theme:
    """Colours of a figure; the names follow what they are used for.

    Attributes:
        series: seven colours in the order of their use, after Okabe and Ito (2008).
    """

    ground: str
    panel: str
    ink: str
    faint: str
    grid: str
    series: tuple[str, ...]


LIGHT = Theme(
    ground="#ffffff",
    panel="#ffffff",
    ink="#1a1a1a",
    faint="#7a7a7a",
    grid="#e4e4e4",
    series=("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#777777"),
)
DARK = Theme(
    ground="#14171c",
    panel="#1b1f26",
    ink="#eceff3",
    faint="#98a1ad",
    grid="#313842",
    series=("#56b4e9", "#f0824a", "#2fc09a", "#dd9cc1", "#f2c14e", "#4d8fd6", "#a9a9a9"),
)
THEMES: dict[ThemeName, Theme] = {"light": LIGHT, "dark": DARK}


@contextmanager
def empty_figure(
    inches: tuple[float, float], settings: dict[str, Any], pads: tuple[float, float], dpi: float = DPI
) -> "Iterator[Figure]":
    """Provide an empty figure to draw on, independent of the user's settings of matplotlib.

    Args:
        inches: width and height.
        settings: of matplotlib, in addition to `SHARED`.
        pads: around panels, across and up, inches.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(SHARED | settings)
        figure = Figure(figsize=inches, dpi=dpi, layout="constrained")
        figure.get_layout_engine().set(w_pad=pads[0], h_pad=pads[1])  # type: ignore[union-attr]
        FigureCanvasAgg(figure)
        yield figure


def drawing(size: tuple[int, int], theme: Theme) -> "AbstractContextManager[Figure]":
    """Return an empty figure of a size in pixels, (width, height), as a context.

    Text grows with the picture, so that all sizes of one shape look alike.
    """
    dpi = DPI * (size[0] * size[1] / AREA) ** 0.5
    # A hundredth of a pixel more, since the canvas rounds down.
    inches = (size[0] + 0.01) / dpi, (size[1] + 0.01) / dpi
    return empty_figure(inches, _settings(theme), (0.09, 0.07), dpi)


def pixels(figure: "Figure") -> np.ndarray:
    """Return a figure as an image, (h, w, 3) uint8, within the context of `drawing`."""
    with warnings.catch_warnings():
        # A character that the font lacks is drawn as a box, which is warning enough.
        warnings.filterwarnings("ignore", "Glyph", UserWarning)
        figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[:, :, :3].copy()  # type: ignore[attr-defined]


def _settings(theme: Theme) -> dict[str, object]:
    return {
        "font.family": "DejaVu Sans",
        "font.size": 8.0,
        # A title may hold a $.
        "text.parse_math": False,
        "axes.titlesize": 9.0,
        "axes.titlepad": 16.0,
        "axes.labelsize": 8.0,
        "axes.labelcolor": theme.faint,
        "axes.titlecolor": theme.ink,
        "axes.edgecolor": theme.faint,
        "axes.facecolor": theme.panel,
        "axes.linewidth": 0.7,
        "grid.color": theme.grid,
        "xtick.color": theme.faint,
        "ytick.color": theme.faint,
        "xtick.labelsize": 7.5,
        "ytick.labelsize": 7.5,
        "xtick.major.width": 0.7,
        "ytick.major.width": 0.7,
        "xtick.minor.width": 0.5,
        "ytick.minor.width": 0.5,
        "figure.facecolor": theme.ground,
        "text.color": theme.ink,
        "lines.linewidth": 1.4,
        "lines.solid_capstyle": "round",
        "legend.fontsize": 7.5,
        "legend.handlelength": 1.1,
        "legend.handletextpad": 0.4,
        "legend.columnspacing": 0.9,
        "legend.borderpad": 0.0,
        "legend.borderaxespad": 0.3,
    }

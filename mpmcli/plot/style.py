"""How figures look: colours that are told apart by colour-blind people too, on light and on dark."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ThemeName = Literal["light", "dark"]
# Pixels per inch of a figure of AREA pixels; others are the same figure, larger or smaller.
DPI, AREA = 100.0, 1200 * 900


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
def drawing(size: tuple[int, int], theme: Theme) -> "Iterator[Figure]":
    """Give an empty figure of a size in pixels, (width, height), to draw on, without the user's settings of matplotlib.

    Text grows with the picture, so that all sizes of one shape look alike.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    dpi = DPI * (size[0] * size[1] / AREA) ** 0.5
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_settings(theme))
        # A hundredth of a pixel more, since the canvas rounds down.
        figure = Figure(figsize=((size[0] + 0.01) / dpi, (size[1] + 0.01) / dpi), dpi=dpi, layout="constrained")
        figure.get_layout_engine().set(w_pad=0.09, h_pad=0.07)  # type: ignore[union-attr]
        FigureCanvasAgg(figure)
        yield figure


def pixels(figure: "Figure") -> np.ndarray:
    """Return a figure as an image, (h, w, 3) uint8; to be called within `drawing`."""
    with warnings.catch_warnings():
        # A letter that the font has not is a box in the picture, which says enough.
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
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.titlepad": 16.0,
        "axes.labelsize": 8.0,
        "axes.labelcolor": theme.faint,
        "axes.titlecolor": theme.ink,
        "axes.edgecolor": theme.faint,
        "axes.facecolor": theme.panel,
        "axes.linewidth": 0.7,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": theme.grid,
        "grid.linewidth": 0.7,
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
        "legend.frameon": False,
        "legend.fontsize": 7.5,
        "legend.handlelength": 1.1,
        "legend.handletextpad": 0.4,
        "legend.columnspacing": 0.9,
        "legend.borderpad": 0.0,
        "legend.borderaxespad": 0.3,
    }

"""The style of figures: colours for colour-blind readers, on light and on dark ground."""

import io
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mpmcli.render.settings import ThemeName

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Pixels per inch of a figure of AREA pixels; figures of other sizes are scaled.
DPI, AREA = 100.0, 1200 * 900
# Matplotlib style sheets of all figures and of figures of ledgers.
SHARED, LEDGER = (Path(__file__).with_name(f"{name}.mplstyle") for name in ("shared", "ledger"))


@dataclass(frozen=True)
class Theme:
    """Colours of a figure, named by their use."""

    ground: str
    panel: str
    ink: str
    faint: str
    grid: str
    series: tuple[str, ...]  # seven colours in the order of their use, after Okabe and Ito (2008)


LIGHT_SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#777777")
DARK_SERIES = ("#56b4e9", "#f0824a", "#2fc09a", "#dd9cc1", "#f2c14e", "#4d8fd6", "#a9a9a9")
THEMES: dict[ThemeName, Theme] = {
    "light": Theme("#ffffff", "#ffffff", "#1a1a1a", "#7a7a7a", "#e4e4e4", LIGHT_SERIES),
    "dark": Theme("#14171c", "#1b1f26", "#eceff3", "#98a1ad", "#313842", DARK_SERIES),
}


@contextmanager
def empty_figure(
    inches: tuple[float, float], sheet: Path, settings: dict[str, Any], pads: tuple[float, float], dpi: float = DPI
) -> "Iterator[Figure]":
    """Yield an empty figure, independent of the user's matplotlib settings.

    `SHARED`, the style sheet `sheet` and `settings` are applied in this order. `pads` are the horizontal and vertical
    padding of panels, inches.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        for style in (SHARED, sheet):
            matplotlib.rcParams.update(matplotlib.rc_params_from_file(style, use_default_template=False))
        matplotlib.rcParams.update(settings)
        figure = Figure(figsize=inches, dpi=dpi, layout="constrained")
        figure.get_layout_engine().set(w_pad=pads[0], h_pad=pads[1])  # type: ignore[union-attr]
        FigureCanvasAgg(figure)
        yield figure


def drawing(size: tuple[int, int], theme: Theme) -> "AbstractContextManager[Figure]":
    """Return a context with an empty figure of a size in pixels, (width, height); its text scales with the size."""
    dpi = DPI * (size[0] * size[1] / AREA) ** 0.5
    # A hundredth of a pixel is added, because the canvas rounds down.
    inches = (size[0] + 0.01) / dpi, (size[1] + 0.01) / dpi
    settings = {
        **dict.fromkeys(("axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), theme.faint),
        **dict.fromkeys(("axes.titlecolor", "text.color"), theme.ink),
        "axes.facecolor": theme.panel,
        "grid.color": theme.grid,
        "figure.facecolor": theme.ground,
    }
    return empty_figure(inches, LEDGER, settings, (0.09, 0.07), dpi)


def svg(figure: "Figure", title: str = "") -> bytes:
    """Return a figure as SVG, the same bytes each time."""
    content = io.BytesIO()
    figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None, "Title": title})
    return content.getvalue()


def pixels(figure: "Figure") -> np.ndarray:
    """Return a figure as an image, (h, w, 3) uint8, within the context of `drawing`."""
    with warnings.catch_warnings():
        # A character that the font lacks is drawn as a box, which is warning enough.
        warnings.filterwarnings("ignore", "Glyph", UserWarning)
        figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[:, :, :3].copy()  # type: ignore[attr-defined]

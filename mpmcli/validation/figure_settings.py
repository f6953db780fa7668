"""The figure of all settings: ratios of error and time in every case, and their means."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpmcli.validation.comparison import Compared, Ratios
from mpmcli.validation.figure_axes import logarithmic_x
from mpmcli.validation.figure_style import style_of
from mpmcli.validation.figures import Format, drawing, saved

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Height of a row and of the margins, inches.
ROW, AROUND = 0.36, 1.5


def draw_settings(compared: Sequence[Compared], form: Format = "svg") -> bytes:
    """Return the figure: a row per setting, a dot per case, the geometric mean as the marker of the setting."""
    with drawing((10.0, AROUND + ROW * len(compared))) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        panels = {
            left: ("Error at equal resolution", [entry.error for entry in compared]),
            right: ("Seconds to an equal error", [entry.to_equal for entry in compared]),
        }
        for axes, (title, ratios) in panels.items():
            axes.set_title(title)
            axes.set_xlabel("times that of the default setting")
            values = [value for ratio in ratios if ratio for value in ratio.of_case.values()]
            logarithmic_x(axes, [1.0, *values])
            axes.axvline(1.0, color="#000000", linewidth=1.2, zorder=1)
            for row, (entry, ratio) in enumerate(zip(compared, ratios, strict=True)):
                _draw_row(axes, row, entry, ratio)
        for row, entry in enumerate(compared):
            _mark_failed(right, row, entry)
        left.set_yticks(range(len(compared)), [entry.label for entry in compared])
        left.set_ylim(len(compared) - 0.5, -0.5)
        left.text(0.015, 0.02, "← better", transform=left.transAxes, fontsize=9, color="#666666")
        right.text(0.015, 0.02, "← faster", transform=right.transAxes, fontsize=9, color="#666666")
        return saved(figure, form)


def _draw_row(axes: "Axes", row: int, entry: Compared, ratio: Ratios | None) -> None:
    if ratio is None:
        return
    style = style_of(entry.setting)
    axes.plot([ratio.low, ratio.high], [row, row], color="#bbbbbb", linewidth=1.2, zorder=2)
    places = list(ratio.of_case.values())
    axes.plot(places, [row] * len(places), ".", color="#777777", markersize=5, zorder=3)
    size = max(style.size, 6.0) + 2
    face = style.color if style.filled else "white"
    keywords = {"color": style.color, "markerfacecolor": face, "markeredgewidth": 1.6, "markersize": size, "zorder": 5}
    axes.plot([ratio.mean], [row], style.marker, **keywords)


def _mark_failed(axes: "Axes", row: int, entry: Compared) -> None:
    """Write the number of failed runs to the right of a row."""
    if entry.failed:
        place, color = axes.get_yaxis_transform(), style_of(entry.setting).color
        cross = {"color": color, "markersize": 7, "markeredgewidth": 2, "clip_on": False}
        axes.plot([1.02], [row], "x", transform=place, **cross)
        axes.text(1.05, row, f"{entry.failed} of {entry.runs} runs failed", transform=place, va="center", fontsize=8.5)

"""One panel of a figure over time: lines, bands, and what holds from frame to frame."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.plot.style import Theme

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Fewer points than this are marked, since a single one makes no line.
MARKED = 8
# Fewer decades than this have numbers at 2 and 5 times their powers, too.
FEW_DECADES = 2.5
# Characters of a name in a legend.
NAME_MAX = 16


class Panel:
    """Axes with the time along x; colours go by number, None is that of the text.

    Args:
        times: (T,) s, of the values that are drawn.
    """

    def __init__(self, axes: "Axes", times: np.ndarray, theme: Theme) -> None:
        self.axes = axes
        self._times = times
        self._theme = theme

    def title(self, title: str, label: str) -> None:
        """Say what is shown, and in which unit."""
        self.axes.set_title(title)
        self.axes.set_ylabel(label)

    def line(self, values: np.ndarray, name: str, color: int | None, linewidth: float = 1.4) -> None:
        """Draw values (T,) of the frames; NaN is a gap."""
        keywords = {"color": self._color(color), "linewidth": linewidth, "label": self._name(name)}
        self.axes.plot(self._times, values, marker=self._marker(values), markersize=3.5, **keywords)

    def steps(self, values: np.ndarray, color: int | None, name: str = "") -> None:
        """Draw values (T,) that hold from the frame before to each frame."""
        keywords = {"color": self._color(color), "linewidth": 1.4, "label": self._name(name)}
        self.axes.step(self._times[1:], values[1:], where="pre", **keywords)

    def band(self, low: np.ndarray, high: np.ndarray, name: str, color: int, times: np.ndarray | None = None) -> None:
        """Fill between two series, at the times of the frames or at others."""
        times = self._times if times is None else times
        shown = self._color(color)
        self.axes.fill_between(times, low, high, color=shown, alpha=0.28, linewidth=0)
        for k, values in enumerate((low, high)):
            keywords = {"color": shown, "linewidth": 1.2, "label": self._name(name if k == 0 else "")}
            self.axes.plot(times, values, marker=self._marker(values), markersize=3.5, **keywords)

    def between_frames(
        self, low: np.ndarray, high: np.ndarray, chosen: np.ndarray, name: str, color: int | None
    ) -> None:
        """Fill from low to high in the time before each chosen frame, (T,) bool."""
        from matplotlib.collections import PolyCollection

        ends = np.flatnonzero(chosen & np.isfinite(low) & np.isfinite(high))
        ends = ends[ends > 0]
        left, right, bottom, top = self._times[ends - 1], self._times[ends], low[ends], high[ends]
        corners = [np.stack(corner, -1) for corner in ((left, bottom), (right, bottom), (right, top), (left, top))]
        shown = self._color(color)
        # The edge is seen where the band has no height.
        boxes = PolyCollection(np.stack(corners, 1), facecolor=shown, edgecolor=shown, linewidth=1.6, label=name)
        boxes.set_capstyle("butt")
        self.axes.add_collection(boxes)
        self.axes.update_datalim(np.concatenate(corners))

    def level(self, value: float, name: str = "", color: int | None = None) -> None:
        """Draw a dashed line at a value that means something, faint where it has no colour."""
        shown = self._theme.faint if color is None else self._color(color)
        keywords = {"linestyle": (0, (4, 2.5)), "linewidth": 1.0, "zorder": 1.5}
        self.axes.axhline(value, color=shown, label=self._name(name), **keywords)

    def say(self, text: str) -> None:
        """Write in the middle what there is to say where nothing is drawn."""
        place = {"transform": self.axes.transAxes, "ha": "center", "va": "center"}
        self.axes.text(0.5, 0.5, text, color=self._theme.faint, **place)

    def from_zero(self) -> None:
        """Let the values begin at 0."""
        self.axes.set_ylim(bottom=0.0)

    def logarithmic(self, values: Sequence[np.ndarray]) -> None:
        """Scale positive values logarithmically, over three quarters of a decade at least."""
        from matplotlib.ticker import LogLocator

        positive = np.concatenate([series[series > 0] for series in values])
        if len(positive) == 0:
            return
        low, high = np.log10(positive.min()), np.log10(positive.max())
        room = max(0.08 * (high - low), 0.375 - (high - low) / 2)
        self.axes.set_yscale("log")
        self.axes.set_ylim(10 ** (low - room), 10 ** (high + room))
        if high - low + 2 * room < FEW_DECADES:
            self.axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))

    def finish(self) -> None:
        """Give it its times, its numbers and its legend."""
        from matplotlib.ticker import FuncFormatter, NullFormatter

        axes = self.axes
        first, last = float(self._times[0]), float(self._times[-1])
        if last > first:
            axes.set_xlim(first, last)
        axes.set_xlabel("t, s", labelpad=1.0)
        plain = FuncFormatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_major_formatter(plain)
        axes.yaxis.set_major_formatter(plain)
        if axes.get_yscale() == "log":
            axes.yaxis.set_minor_formatter(NullFormatter())
        handles, names = axes.get_legend_handles_labels()
        if handles:
            axes.legend(handles, names, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(handles))

    def _marker(self, values: np.ndarray) -> str:
        return "o" if np.isfinite(values).sum() < MARKED else ""

    def _color(self, color: int | None) -> str:
        return self._theme.ink if color is None else self._theme.series[color % len(self._theme.series)]

    def _name(self, name: str) -> str:
        # matplotlib leaves out of legends what begins with a line below.
        return (name if len(name) <= NAME_MAX else f"{name[: NAME_MAX - 1]}…").lstrip("_") or "_"

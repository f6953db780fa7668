"""Axes of the figures: logarithmic ticks, labels of points, and crosses for failed runs."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpmcli.validation.case import Measure
from mpmcli.validation.figure_style import style_of
from mpmcli.validation.matrix import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

# Ordinate of a zero error.
LOWEST = 1e-17
# Fraction of the panel width reserved for crosses.
STRIP = 0.08
# Minimum ratio of the limits of a logarithmic axis, so that a flat curve looks flat.
LEAST_SPAN = 16.0
# Largest number of powers of ten with a label.
MOST_TICKS = 7
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def shown(error: float) -> float:
    """Return where an error is drawn on a logarithmic axis."""
    return max(error, LOWEST)


def label_axes(axes: "Axes", measure: Measure, what: str) -> None:
    """Label both axes; the ordinate is the error."""
    axes.set_xlabel(what)
    axes.set_ylabel(measure.name + (f" ({measure.unit})" if measure.unit else ""))


def logarithmic_x(axes: "Axes", values: Sequence[float]) -> None:
    """Make the x axis logarithmic, with margins for labels on the left and crosses on the right."""
    axes.set_xscale("log")
    low, high = _limits(values)
    axes.set_xlim(low / (high / low) ** 0.08, high * (high / low) ** STRIP)
    _ticks(axes.xaxis, *axes.get_xlim())


def logarithmic_y(axes: "Axes", errors: Sequence[float]) -> None:
    """Make the y axis logarithmic, with margins around the errors."""
    axes.set_yscale("log")
    axes.set_ylim(*_limits([shown(error) for error in errors]))
    _ticks(axes.yaxis, *axes.get_ylim())


def _limits(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values, default=1.0), max(values, default=1.0)
    widen = max(math.sqrt(LEAST_SPAN / (high / low)), 1.0) * (high / low) ** 0.08
    return low / widen, high * widen


def _ticks(axis: "Axis", low: float, high: float) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    powers = range(math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9) + 1)
    places = [10.0**k for k in powers[:: math.ceil(len(powers) / MOST_TICKS)]]
    if len(places) < 2:
        decade = range(math.floor(math.log10(low)), math.ceil(math.log10(high)))
        places = [m * 10.0**k for k in decade for m in (1, 2, 5) if low <= m * 10.0**k <= high]
    axis.set_major_locator(FixedLocator(places))
    axis.set_major_formatter(FuncFormatter(lambda value, _: number_text(value)))
    axis.set_minor_locator(NullLocator())


def number_text(value: float) -> str:
    """Return a round number as text, as a decimal or a power of ten."""
    if 0.999e-3 <= value < 1e4:
        return f"{value:.3g}"
    power = math.floor(math.log10(value) + 1e-9)
    digit = round(value / 10.0**power)
    return ("" if digit == 1 else f"{digit}·") + "10" + str(power).translate(SUPERSCRIPTS)


def number_ticks(axes: "Axes", places: Sequence[float], *, logarithmic: bool) -> None:
    """Set ticks of the x axis at the given places, labelled with plain numbers."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    low, high = min(places), max(places)
    if logarithmic:
        axes.set_xscale("log")
        widen = (high / low) ** 0.12 if high > low else 2.0
        axes.set_xlim(low / widen, high * widen)
    else:
        room = 0.08 * (high - low)
        axes.set_xlim(low - room, high + room)
    axes.xaxis.set_major_locator(FixedLocator(sorted(set(places))))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def name_points(axes: "Axes", points: Sequence[tuple[float, float, int]]) -> None:
    """Label points (x, y, n) with their resolution n."""
    for x, y, n in points:
        text = f"n = {n}" if n == points[0][2] else f"{n}"
        axes.annotate(text, (x, y), xytext=(-5, -13), textcoords="offset points", ha="right", fontsize=8.5, zorder=6)


def mark_target(axes: "Axes", target: float) -> None:
    """Draw a horizontal line at an error, if it is within the limits of the axis."""
    low, high = axes.get_ylim()
    if low < target < high:
        axes.axhline(target, color="#999999", linewidth=1.0, linestyle=(0, (1, 2)), zorder=1)
        place = {"xycoords": ("axes fraction", "data"), "xytext": (3, 2), "textcoords": "offset points"}
        axes.annotate(f"{100 * target:g} %", (0.0, target), fontsize=8.5, color="#666666", **place)


def mark_failures(axes: "Axes", failed: Sequence[Run]) -> None:
    """Draw a cross at the right edge for every failed run."""
    from matplotlib.patches import Rectangle

    failed = list(dict.fromkeys(failed))
    if not failed:
        return
    axes.add_patch(Rectangle((1 - STRIP, 0), STRIP, 1, color="#f0f0f0", zorder=0, transform=axes.transAxes))
    spacing = min(0.06, 0.85 / len(failed))
    text = {"transform": axes.transAxes, "va": "center", "fontsize": 7.5}
    for k, run in enumerate(failed):
        y = 0.96 - k * spacing
        _cross(axes, 1 - 0.3 * STRIP, y, run, axes.transAxes)
        axes.text(1 - 0.55 * STRIP, y, f"{run.n}", ha="right", **text)
    axes.text(1 - 0.5 * STRIP, 0.96 - len(failed) * spacing, "failed", ha="center", **text)


def crosses_on_top(axes: "Axes", failed: Sequence[tuple[float, Run]]) -> None:
    """Draw a cross at the top for every failed run (x, run), stacked at equal x."""
    heights: dict[float, int] = {}
    # Extend the axis to make room for the crosses.
    most = max((sum(x == other for other, _ in failed) for x, _ in failed), default=0)
    low, high = axes.get_ylim()
    axes.set_ylim(low, low * (high / low) ** (1 / (1 - min(0.055 * most, 0.5))))
    for x, run in failed:
        heights[x] = heights.get(x, -1) + 1
        _cross(axes, x, 0.97 - 0.055 * heights[x], run, axes.get_xaxis_transform())


def _cross(axes: "Axes", x: float, y: float, run: Run, transform: object) -> None:
    color = style_of(run.setting).color
    axes.plot([x], [y], "x", color=color, markersize=7, markeredgewidth=2, transform=transform, clip_on=False, zorder=7)

"""The figures of a report, as reproducible SVG: a case's error against its cost, and all settings against the default.

Colours and markers of a setting are the same in every figure.
"""

import io
import math
import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpmcli.plot.style import empty_figure
from mpmcli.validation.case import Measure, Setting
from mpmcli.validation.comparison import TARGET, Compared, Point, Ratios, points_of, series_of
from mpmcli.validation.report import CaseReport
from mpmcli.validation.runs import Run, RunResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

SIZE = (10.0, 8.4)
# Offset of the line of the expected slope, as a factor of the finest error.
SLOPE_BELOW = 0.5

Series = Sequence[tuple[Run, RunResult]]
# Settings with a line of their own, and the sweep of the Courant fraction.
Parts = tuple[dict[Setting, Series], Series]
# Ordinate of a zero error.
LOWEST = 1e-17
# Fraction of the panel width reserved for crosses.
STRIP = 0.08
# Minimum ratio of the limits of a logarithmic axis, so that a flat curve looks flat.
LEAST_SPAN = 16.0
# Largest number of powers of ten with a label.
MOST_TICKS = 7
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# Height of a row and of the margins, inches.
ROW, AROUND = 0.36, 1.5


@dataclass(frozen=True)
class Style:
    """Line and marker style of a setting. The colours suit colour-blind readers."""

    color: str
    marker: str
    size: float = 6.0
    width: float = 1.3
    dashes: tuple[float, ...] = ()
    filled: bool = True
    above: int = 3

    def keywords(self) -> dict[str, Any]:
        """Return keyword arguments for matplotlib's `plot`."""
        return {
            "color": self.color,
            "marker": self.marker,
            "markersize": self.size,
            "linewidth": self.width,
            "linestyle": (0, self.dashes) if self.dashes else "-",
            "markerfacecolor": self.color if self.filled else "white",
            "markeredgecolor": self.color,
            "markeredgewidth": 1.3,
            "zorder": self.above,
        }


DEFAULT = Style("#000000", "o", size=6.5, width=2.2, above=5)
# Single precision usually coincides with double, so it is dashed with open markers.
STYLES: dict[tuple[str, object], Style] = {
    ("precision", "f32"): Style("#0072b2", "s", size=9.5, dashes=(3.0, 2.0), filled=False, above=4),
    ("kernel", "quadratic"): Style("#117733", "<"),
    ("kernel", "cubic"): Style("#009e73", "^", size=7.0),
    ("transfer", "apic"): Style("#882255", ">"),
    ("transfer", "pic"): Style("#d55e00", "v", size=7.0),
    ("transfer", "aflip"): Style("#e69f00", "D", size=5.5),
    ("walls", "folded"): Style("#999933", "h"),
    ("walls", "zeroed"): Style("#cc79a7", "p", size=7.5),
    ("per_axis", 1): Style("#56b4e9", "<", size=7.0),
    ("per_axis", 2): Style("#332288", "8"),
    ("per_axis", 3): Style("#5e3c99", ">", size=7.0),
}
# Style of the series over the Courant fraction.
SWEEP = Style("#777777", "d", size=5.5, width=1.0, dashes=(1.0, 1.5), above=2)
OTHER = Style("#aaaaaa", ".")


def style_of(setting: Setting) -> Style:
    """Return the style of a setting."""
    changed = setting.changed_from(Setting())
    if not changed:
        return DEFAULT
    if set(changed) == {"safety"}:
        return SWEEP
    return STYLES.get(next(iter(changed.items())), OTHER) if len(changed) == 1 else OTHER


def draw_case(report: CaseReport) -> bytes:
    """Return the figure of a case, an SVG."""
    with drawing(SIZE) as figure:
        panels = figure.subplots(2, 2)
        lines, sweep = _split(report)
        _cost_panel(panels[0, 0], report, (lines, sweep), "seconds of stepping, one thread", lambda p: p.seconds)
        _cost_panel(panels[0, 1], report, (lines, sweep), "particle-steps", lambda p: p.particle_steps)
        guides = _order_panel(panels[1, 0], report, lines)
        handles = [*_handles(lines, sweep), *guides]
        if len(sweep) > 1:
            _courant_panel(panels[1, 1], report, sweep)
            figure.legend(handles=handles, loc="outside lower center", ncols=4, handlelength=2.6)
        else:
            panels[1, 1].set_axis_off()
            panels[1, 1].legend(handles=handles, loc="center", handlelength=2.6)
        return saved(figure)


def drawing(size: tuple[float, float]) -> "AbstractContextManager[Figure]":
    """Return an empty figure in the common style, (width, height) in inches, as a context."""
    return empty_figure(size, Path(__file__).parent / "page" / "figures.mplstyle", {}, (0.1, 0.12))


def saved(figure: "Figure") -> bytes:
    """Return a figure as the bytes of an SVG. Equal figures give equal bytes.

    It has no comments, indentation and names of groups, and coordinates are rounded to 0.01.
    """
    content = io.BytesIO()
    figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None}, dpi=90)
    svg = content.getvalue().decode()
    svg = re.sub(r"<!-- .*? -->\n?", "", svg)
    svg = re.sub(r' id="[A-Za-z0-9.]+_\d+"', "", svg)
    svg = re.sub(r' transform="rotate\(-0 [^)]*\)"', "", svg)
    # A common font is stated once.
    fonts = set(re.findall(r"font-family: [^;\"]*", svg))
    if len(fonts) == 1:
        svg = re.sub(r" *font-family: [^;\"]*;?", "", svg).replace("</style>", f"text{{{fonts.pop()}}}</style>", 1)
    svg = re.sub(r"<[^>]*>", lambda tag: re.sub(r"\d+\.\d{4,}", lambda x: f"{float(x[0]):.2f}", tag[0]), svg)
    svg = re.sub(r"\s*\n\s*", "\n", svg)
    return re.sub(r"\n(?=[LMQCz] ?[^<\n]*\n)", " ", svg).encode()


def _split(report: CaseReport) -> Parts:
    """Return the settings that have a line of their own, and the sweep of the Courant fraction with the default."""
    lines: dict[Setting, Series] = {}
    sweep: list[tuple[Run, RunResult]] = []
    for setting, runs in series_of(report.case, report.results).items():
        if set(setting.changed_from(Setting())) == {"safety"}:
            sweep += runs
        else:
            lines[setting] = runs
    at = {run.n for run, _ in sweep}
    sweep += [(run, result) for run, result in lines.get(Setting(), []) if run.n in at]
    return lines, sorted(sweep, key=lambda entry: entry[0].setting.safety)


def _cost_panel(axes: "Axes", report: CaseReport, parts: Parts, what: str, cost: Callable[[Point], float]) -> None:
    """Draw error against cost: each line is a setting, from its coarsest run to its finest."""
    lines, sweep = parts
    axes.set_title(f"Error against {what.partition(',')[0]}")
    label_axes(axes, report.case.measures[0], what)
    for setting, runs in [*lines.items(), (None, sweep)]:
        points = [point for point in points_of(report.case, runs) if cost(point) > 0]
        style = SWEEP if setting is None else style_of(setting)
        axes.plot([cost(p) for p in points], [shown(p.error) for p in points], **style.keywords())
        if setting == Setting():
            offset = {"xytext": (-5, -13), "textcoords": "offset points", "ha": "right", "fontsize": 8.5, "zorder": 6}
            for p in points:
                text = f"n = {p.n}" if p.n == points[0].n else f"{p.n}"
                axes.annotate(text, (cost(p), shown(p.error)), **offset)
    every = [point for runs in (*lines.values(), sweep) for point in points_of(report.case, runs)]
    logarithmic_x(axes, [cost(point) for point in every if cost(point) > 0])
    logarithmic_y(axes, [point.error for point in every])
    low, high = axes.get_ylim()
    if not report.case.measures[0].unit and low < TARGET < high:
        axes.axhline(TARGET, color="#999999", linewidth=1.0, linestyle=(0, (1, 2)), zorder=1)
        place = {"xycoords": ("axes fraction", "data"), "xytext": (3, 2), "textcoords": "offset points"}
        axes.annotate(f"{100 * TARGET:g} %", (0.0, TARGET), fontsize=8.5, color="#666666", **place)
    axes.text(0.015, 0.02, "↙ better", transform=axes.transAxes, fontsize=9, color="#666666")
    mark_failures(axes, [run for runs in (*lines.values(), sweep) for run, result in runs if not result.finished])


def _order_panel(axes: "Axes", report: CaseReport, lines: dict[Setting, Series]) -> list[Any]:
    """Draw error against resolution, with the slope that theory expects and the bounds of the case; return these."""
    case, measure = report.case, report.case.measures[0]
    label_axes(axes, measure, f"n, {case.resolution}")
    observed = "" if report.order is None else f": order {report.order:.2f}"
    expected = "" if measure.expected is None else f"{',' if observed else ':'} {measure.expected:g} expected"
    axes.set_title(f"Error against resolution{observed}{expected}")
    everywhere = sorted({run.n for runs in lines.values() for run, _ in runs})
    errors = []
    for setting, runs in lines.items():
        points = points_of(case, runs)
        errors += [point.error for point in points]
        axes.plot([p.n for p in points], [shown(p.error) for p in points], **style_of(setting).keywords())
    bounds = [(n, measure.bound(n)) for n in everywhere if 0 < measure.bound(n) < float("inf")]
    if bounds:
        label = "bound of the default setting"
        axes.plot(*zip(*bounds, strict=True), "_", color="#444444", markersize=16, markeredgewidth=1.6, label=label)
    slope = []
    if measure.expected is not None and report.finest is not None and len(everywhere) > 1:
        n, error = report.finest
        slope = [(m, SLOPE_BELOW * shown(error) * (n / m) ** measure.expected) for m in everywhere]
        dashes, label = (0, (6, 3)), f"slope of order {measure.expected:g}"
        axes.plot(*zip(*slope, strict=True), color="#999999", linestyle=dashes, zorder=4, label=label)
    number_ticks(axes, everywhere, logarithmic=True)
    logarithmic_y(axes, [*errors, *(y for _, y in [*bounds, *slope])])
    crosses_on_top(axes, [(run.n, run) for runs in lines.values() for run, result in runs if not result.finished])
    return axes.get_legend_handles_labels()[0]


def _courant_panel(axes: "Axes", report: CaseReport, sweep: Series) -> None:
    """Draw error against the Courant fraction at one resolution."""
    measure = report.case.measures[0]
    label_axes(axes, measure, "Courant fraction: step over the largest stable one")
    axes.set_title(f"Error against Courant fraction, n = {sweep[0][0].n}")
    points = {run.setting: shown(result.error(measure.name)) for run, result in sweep if result.finished}
    axes.plot([setting.safety for setting in points], [*points.values()], **SWEEP.keywords())
    if Setting() in points:
        axes.plot([Setting().safety], [points[Setting()]], **style_of(Setting()).keywords())
    number_ticks(axes, [run.setting.safety for run, _ in sweep], logarithmic=False)
    logarithmic_y(axes, [*points.values()])
    crosses_on_top(axes, [(run.setting.safety, run) for run, result in sweep if not result.finished])


def _handles(lines: dict[Setting, Series], sweep: Series) -> list[Any]:
    """Return the entries of the legend of the whole figure."""
    from matplotlib.lines import Line2D

    entries = {setting.label: style_of(setting) for setting in lines}
    if sweep:
        values = [run.setting.safety for run, _ in sweep]
        entries[f"Courant fraction {min(values):g} to {max(values):g}, n = {sweep[0][0].n}"] = SWEEP
    handles = [Line2D([], [], label=label, **style.keywords()) for label, style in entries.items()]
    if any(not result.finished for runs in (*lines.values(), sweep) for _, result in runs):
        cross = {"marker": "x", "linestyle": "", "markersize": 7, "markeredgewidth": 2}
        handles.append(Line2D([], [], color="#555555", label="failed", **cross))
    return handles


def draw_settings(compared: Sequence[Compared]) -> bytes:
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
            if entry.failed:
                edge, cross = right.get_yaxis_transform(), {"markersize": 7, "markeredgewidth": 2, "clip_on": False}
                right.plot([1.02], [row], "x", color=style_of(entry.setting).color, transform=edge, **cross)
                text = f"{entry.failed} of {entry.runs} runs failed"
                right.text(1.05, row, text, transform=edge, va="center", fontsize=8.5)
        left.set_yticks(range(len(compared)), [entry.setting.label for entry in compared])
        left.set_ylim(len(compared) - 0.5, -0.5)
        left.text(0.015, 0.02, "← better", transform=left.transAxes, fontsize=9, color="#666666")
        right.text(0.015, 0.02, "← faster", transform=right.transAxes, fontsize=9, color="#666666")
        return saved(figure)


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


def shown(error: float) -> float:
    """Return where an error is drawn on a logarithmic axis."""
    return max(error, LOWEST)


def label_axes(axes: "Axes", measure: Measure, what: str) -> None:
    """Label both axes; the ordinate is the error."""
    axes.set_xlabel(what)
    axes.set_ylabel(f"{measure.name} ({measure.unit})" if measure.unit else measure.name)


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
    powers = range(math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9) + 1)
    places = [10.0**k for k in powers[:: math.ceil(len(powers) / MOST_TICKS)]]
    if len(places) < 2:
        decade = range(math.floor(math.log10(low)), math.ceil(math.log10(high)))
        places = [m * 10.0**k for k in decade for m in (1, 2, 5) if low <= m * 10.0**k <= high]
    _label(axis, places, number_text)


def _label(axis: "Axis", places: Sequence[float], text_of: Callable[[float], str]) -> None:
    """Set the ticks of an axis and their labels."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    axis.set_major_locator(FixedLocator(places))
    axis.set_major_formatter(FuncFormatter(lambda value, _: text_of(value)))
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
    low, high = min(places), max(places)
    if logarithmic:
        axes.set_xscale("log")
        widen = (high / low) ** 0.12 if high > low else 2.0
        axes.set_xlim(low / widen, high * widen)
    else:
        room = 0.08 * (high - low)
        axes.set_xlim(low - room, high + room)
    _label(axes.xaxis, sorted(set(places)), lambda value: f"{value:g}")


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

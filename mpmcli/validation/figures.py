"""The figure of a case: error against cost, resolution and Courant fraction, as a reproducible SVG."""

import io
import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

from mpmcli.plot.style import empty_figure
from mpmcli.validation.comparison import TARGET, points_of, series_of
from mpmcli.validation.convergence import Point
from mpmcli.validation.figure_axes import (
    crosses_on_top,
    label_axes,
    logarithmic_x,
    logarithmic_y,
    mark_failures,
    mark_target,
    name_points,
    number_ticks,
    shown,
)
from mpmcli.validation.figure_style import SWEEP, style_of
from mpmcli.validation.matrix import Run, label_of
from mpmcli.validation.report import CaseReport
from mpmcli.validation.run_result import RunResult
from mpmcli.validation.setting import Setting

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Text is stored as text, which keeps files small and searchable. Ids are derived from the content.
RC = {
    "svg.fonttype": "none",
    "svg.hashsalt": "mpmcli",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial"],
    "font.size": 10.0,
    "axes.titlesize": 10.5,
    "axes.grid.which": "major",
    "grid.color": "#e4e4e4",
}
SIZE = (10.0, 8.4)
# Offset of the line of the expected slope, as a factor of the finest error.
SLOPE_BELOW = 0.5

Series = Sequence[tuple[Run, RunResult]]
# Settings with a line of their own, and the sweep of the Courant fraction.
Parts = tuple[dict[Setting, Series], Series]
Format = str


def draw_case(report: CaseReport, form: Format = "svg") -> bytes:
    """Return the figure of a case.

    Args:
        form: "svg" or "png".
    """
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
        return saved(figure, form)


def drawing(size: tuple[float, float]) -> "AbstractContextManager[Figure]":
    """Return an empty figure in the common style, (width, height) in inches, as a context."""
    return empty_figure(size, RC, (0.1, 0.12))


def saved(figure: "Figure", form: Format) -> bytes:
    """Return a figure as the bytes of a file. Equal figures give equal bytes."""
    content = io.BytesIO()
    unsaid = {"Date": None, "Creator": None} if form == "svg" else {"Software": None}
    figure.savefig(content, format=form, metadata=unsaid, dpi=90)
    return _compact(content.getvalue().decode()).encode() if form == "svg" else content.getvalue()


def _compact(svg: str) -> str:
    """Return an SVG without comments, indentation and names of groups, with coordinates rounded to 0.01."""
    svg = re.sub(r"<!-- .*? -->\n?", "", svg)
    svg = re.sub(r' id="[A-Za-z0-9.]+_\d+"', "", svg)
    svg = re.sub(r' transform="rotate\(-0 [^)]*\)"', "", svg)
    # A common font is stated once.
    fonts = set(re.findall(r"font-family: [^;\"]*", svg))
    if len(fonts) == 1:
        svg = re.sub(r" *font-family: [^;\"]*;?", "", svg).replace("</style>", f"text{{{fonts.pop()}}}</style>", 1)
    svg = re.sub(r"<[^>]*>", lambda tag: re.sub(r"\d+\.\d{4,}", _rounded, tag.group()), svg)
    svg = re.sub(r"\s*\n\s*", "\n", svg)
    return re.sub(r"\n(?=[LMQCz] ?[^<\n]*\n)", " ", svg)


def _rounded(number: re.Match[str]) -> str:
    return f"{float(number.group()):.2f}"


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
            name_points(axes, [(cost(p), shown(p.error), p.n) for p in points])
    every = [point for runs in (*lines.values(), sweep) for point in points_of(report.case, runs)]
    logarithmic_x(axes, [cost(point) for point in every if cost(point) > 0])
    logarithmic_y(axes, [point.error for point in every])
    if not report.case.measures[0].unit:
        mark_target(axes, TARGET)
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
    found = [(run.setting, shown(result.error(measure.name))) for run, result in sweep if result.finished]
    axes.plot([setting.safety for setting, _ in found], [error for _, error in found], **SWEEP.keywords())
    for setting, error in found:
        if setting == Setting():
            axes.plot([setting.safety], [error], **style_of(setting).keywords())
    number_ticks(axes, [run.setting.safety for run, _ in sweep], logarithmic=False)
    logarithmic_y(axes, [error for _, error in found])
    crosses_on_top(axes, [(run.setting.safety, run) for run, result in sweep if not result.finished])


def _handles(lines: dict[Setting, Series], sweep: Series) -> list[Any]:
    """Return the entries of the legend of the whole figure."""
    from matplotlib.lines import Line2D

    entries = {label_of(setting): style_of(setting) for setting in lines}
    if sweep:
        values = [run.setting.safety for run, _ in sweep]
        entries[f"Courant fraction {min(values):g} to {max(values):g}, n = {sweep[0][0].n}"] = SWEEP
    handles = [Line2D([], [], label=label, **style.keywords()) for label, style in entries.items()]
    if any(not result.finished for runs in (*lines.values(), sweep) for _, result in runs):
        cross = {"marker": "x", "linestyle": "", "markersize": 7, "markeredgewidth": 2}
        handles.append(Line2D([], [], color="#555555", label="failed", **cross))
    return handles

"""The figure of a case, as reproducible SVG: error against resolution, and error against processor time."""

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpmcli.plot.style import LIGHT_SERIES, empty_figure
from mpmcli.validation.case import KNOBS, Case, Setting
from mpmcli.validation.runs import Results, variants
from mpmcli.validation.verdict import order_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = (10.0, 4.8)
STYLE = Path(__file__).parent / "page" / "figures.mplstyle"
# Ordinate of a zero error.
LOWEST = 1e-17
COURANT = "Courant fraction"
GREY = {"color": "#777777", "linewidth": 1.0, "linestyle": ":"}
VARIANTS = [variant.label for knob in KNOBS if knob != "safety" for variant in variants(knob)]
# Lines of the settings, the same in every figure; single precision usually coincides with double.
LOOKS: dict[str, dict[str, Any]] = {Setting().label: {"color": "black", "marker": "o", "linewidth": 2.0, "zorder": 3}}
LOOKS |= {
    label: {"color": color, "marker": marker, "linewidth": 1.2}
    for label, color, marker in zip(VARIANTS, LIGHT_SERIES, "s^vDph<", strict=False)
}
LOOKS["f32"] |= {"markersize": 9, "markerfacecolor": "none", "linestyle": "--"}
LOOKS[COURANT] = {**GREY, "marker": "d"}


def draw_case(case: Case, results: Results) -> bytes:
    """Return the figure of a case and its results, an SVG; equal results give equal bytes."""
    measure = case.measures[0]
    with empty_figure(SIZE, STYLE, {}, (0.1, 0.1)) as figure:
        order, cost = figure.subplots(1, 2, sharey=True, subplot_kw={"xscale": "log", "yscale": "log"})
        for label, runs in _lines(results).items():
            finished = {run: result for run, result in runs.items() if result.finished}
            errors = [max(result.error(measure.name), LOWEST) for result in finished.values()]
            failed = len(runs) - len(finished)
            named = f"{label} ({failed} failed)" if failed else label
            cost.plot([result.seconds for result in finished.values()], errors, label=named, **LOOKS[label])
            if label != COURANT:
                order.plot([run.n for run in finished], errors, **LOOKS[label])
        _draw_bounds(order, case, results)
        named = f"{measure.name} ({measure.unit})" if measure.unit else measure.name
        order.set(title="Error against resolution", xlabel=f"n, {case.resolution}", ylabel=named)
        resolutions = sorted({run.n for run in results})
        order.set_xticks(resolutions, [str(n) for n in resolutions])
        order.xaxis.minorticks_off()
        cost.set(title="Error against processor time", xlabel="seconds of stepping, one thread")
        figure.legend(loc="outside lower center", ncols=4)
        content = io.BytesIO()
        figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None})
    return content.getvalue()


def _lines(results: Results) -> dict[str, Results]:
    """Return the results of each line, by its label; Courant fractions share one."""
    lines: dict[str, Results] = {}
    for run, result in results.items():
        label = COURANT if run.setting.label.startswith(COURANT) else run.setting.label
        lines.setdefault(label, {})[run] = result
    return lines


def _draw_bounds(axes: "Axes", case: Case, results: Results) -> None:
    """Draw the bounds of the default setting, and the slope that theory expects below its finest error."""
    measure, observed = case.measures[0], order_of(case.measures[0], results)
    usual = {run.n: result for run, result in results.items() if run.setting == Setting()}
    bounds = [(n, measure.bound(n)) for n in usual if 0 < measure.bound(n) < float("inf")]
    if bounds:
        axes.plot(*zip(*bounds, strict=True), "_", color="#444444", markersize=16, label="bound of the default setting")
    finished = [(n, max(result.error(measure.name), LOWEST)) for n, result in usual.items() if result.finished]
    if measure.expected is not None and len(finished) > 1:
        finest, error = finished[-1]
        slope = [error * (finest / n) ** measure.expected / 2 for n in usual]
        label = f"slope of order {measure.expected:g}" + ("" if observed is None else f", observed {observed:.2f}")
        axes.plot([*usual], slope, label=label, **GREY)

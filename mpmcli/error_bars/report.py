"""What a reader sees of a study: lines, tables, a page with figures, JSON, and the spacing that keeps a target."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.error_bars.bars import BARS, Bars, distance
from mpmcli.error_bars.observables import DENSITY
from mpmcli.error_bars.study import Study
from mpmcli.errors import InputError
from mpmcli.output.durable import sealed, write_text, writing
from mpmcli.plain_json import finite_json
from mpmcli.plain_text import counted, duration_text, markdown_table, plain_number, text_table
from mpmcli.plot.style import LIGHT_SERIES, THEMES, drawing, svg
from mpmcli.scene import Scene
from mpmcli.scene.problem import hint_at, listed, several
from mpmcli.scene.quantity import AXES

PAGE, BANDS, COST = "report.md", "bands.svg", "cost.svg"
HEAD = ("observable", "value", "% of its size", "causes")
RUNS = ("run", "cause", "spacing, m", "particles", "steps", "seconds", "error: mass elsewhere", "error: headline")
# Panels of the figure of bands, and its size and that of the other, pixels.
PANELS, SIZE, SMALL = 6, (1200, 900), (800, 500)
# Finest grid that a target is extrapolated to, as a factor on the spacing, and the coarsest.
FINEST, COARSEST = 16.0, 2.0


def headline(scene: Scene, bars: Bars) -> str:
    """Return the name of what moves most: a front of what flows, or the centre of an elastic or rigid body."""
    gravity = scene.domain.gravity_at(0.0)
    across = [a for a in range(scene.dimension) if not gravity[a]] or list(range(scene.dimension))
    flows = [source.name for source in scene.sources if not source.has_surface]
    others = [f"{source.name}.centre" for source in scene.sources if source.has_surface]
    others += [collider.name for collider in scene.colliders if collider.free]
    names = [f"{name}.{side}.{AXES[a]}" for name in flows for side in ("low", "high") for a in across]
    names += [f"{name}.{axis}" for name in others for axis in AXES]
    # Along periodic axes there is neither.
    found = [name for name in names if name in bars.of] or [name for name in bars.of if name != DENSITY]
    return max(found, key=lambda name: np.nan_to_num(np.ptp(bars.of[name].value[np.isfinite(bars.of[name].value)])))


def unit_of(name: str) -> str:
    """Return the unit of an observable in 3D, with a space before it; "" if it has none or it is not known."""
    units = {"low": "m", "high": "m", "centre": "m", "velocity": "m/s", "energy": "J", "force": "N", "torque": "N m"}
    parts = name.split(".")
    return next((f" {units[part]}" for part in (*parts[-2:-1], parts[0]) if part in units), "")


def last_line(study: Study) -> str:
    """Return the sentence on the headline at the end, such as "front of water at 1 s: 0.83 m ± 0.02"."""
    name, bars = headline(study.scene, study.bars), study.bars
    body, _, what = name.rpartition(".")
    body, _, kind = body.rpartition(".")
    said = f"front of {body}" if kind in ("low", "high") else f"{kind} of {body}, {what}," if body else name
    value, _, bar = bars.of[name].text(-1).partition(" ± ")
    shown = f"{value}{unit_of(name)} ± {bar}"
    return f"{said} at {bars.time[-1]:.4g} s: {shown}"


def rows_of(bars: Bars) -> list[tuple[str, ...]]:
    """Return the rows of the table at the end, the map of the mass first and then by their bar over their size."""
    known = {name: one for name, one in bars.of.items() if np.isfinite(one.value[-1])}
    order = sorted(known, key=lambda name: (name != DENSITY, -known[name].bar[-1] / known[name].size))
    return [
        (
            "mass elsewhere" if name == DENSITY else name,
            f"{known[name].bar[-1]:.2g}" if name == DENSITY else known[name].text(-1),
            f"{100 * known[name].bar[-1] / known[name].size:.2g}",
            known[name].main_cause(-1),
        )
        for name in order
    ]


def text(study: Study) -> str:
    """Return the report at the end of the run as plain text."""
    bars = study.bars
    table = text_table(HEAD, rows_of(bars), {0, 1, 3})
    head = f"at {bars.time[-1]:.4g} s, bars for {bars.confidence} %:"
    return "\n".join([head, table, "", *remarks(study), last_line(study)])


def remarks(study: Study) -> list[str]:
    """Return sentences on the cost, on what was left out, on the time of parting, and on what bars do not contain."""
    found = [f"{counted(len(study.runs), 'sibling')} in {study.cost:.2g} times the time of the run."]
    found += [f"Left out: {one.name}: {one.reason}." for one in study.left_out]
    for choice, names in study.bars.depends.items():
        said = several(["mass elsewhere" if name == DENSITY else name for name in names])
        found.append(
            f"Within their bars, observables depend on a choice that the scene leaves open ({choice}): {said}."
        )
    if study.bars.parted is not None:
        found.append(
            f"From {study.bars.parted:.3g} s rounding alone parts runs: single runs then differ by what is shown as "
            "rounding; compare means over a window of time."
        )
    return [*found, *study.bars.warnings]


def cost_rows(study: Study) -> list[tuple[str, ...]]:
    """Return the rows of all runs, the scene first: what each costs, and its error.

    That of the scene is its bar, that of a sibling the bar and its distance from the scene; means over the frames.
    """
    name, bars = headline(study.scene, study.bars), study.bars
    h, base = study.scene.domain.spacing, study.base
    own = bars.of[DENSITY].bar, bars.of[name].bar
    found = [("the scene", "", base, h, *own)]
    for one, run in study.runs:
        away = own[0] + distance(run, base), own[1] + np.abs(run.values[name] - base.values[name])
        found.append((one.name, one.cause, run, one.ratio * h, *away))
    rows = []
    for label, cause, run, spacing, *off in found:
        means = (plain_number(float(np.nanmean(each))) for each in off)
        rows.append((label, cause, f"{spacing:.4g}", str(run.particles), str(run.steps), f"{run.seconds:.3g}", *means))
    return rows


def as_dict(study: Study) -> dict[str, Any]:
    """Return the study for JSON: bars by observable, and the runs."""
    runs = [dict(zip(RUNS, row, strict=True)) for row in cost_rows(study)]
    left = [vars(one) for one in study.left_out]
    at_end = {name: one.text(-1) for name, one in study.bars.of.items()}
    told = {"headline": last_line(study), "at_end": at_end, "runs": runs, "left_out": left, "cost_in_runs": study.cost}
    return finite_json({**told, **study.bars.as_dict()})


def target_of(text: str) -> tuple[str, float]:
    """Return the name and the share of a target "OBSERVABLE:PERCENT%"; InputError: it cannot be read."""
    name, _, percent = (part.strip() for part in text.partition(":"))
    try:
        share = float(percent.rstrip("% ")) / 100
    except ValueError:
        share = 0.0
    if not (name and 0 < share < math.inf):
        raise InputError(f"--target {text}: give an observable and percent of its size, such as front:2%.")
    return name, share


def target_text(study: Study, name: str, share: float) -> str:
    """Return the spacing that keeps a target, by first order, its time, and the line to paste.

    "front" is the headline. InputError: there is no such observable.
    """
    bars, scene = study.bars, study.scene
    name = headline(scene, bars) if name == "front" else name
    if name not in bars.of:
        hint = hint_at(name, list(bars.of), f"there are front, {listed(list(bars.of), 'and')}.")
        raise InputError(f'--target: there is no observable "{name}"; {hint}')
    wanted, worst = share * bars.of[name].size, float(np.nanmax(bars.of[name].bar))
    finer = worst / wanted
    if finer > FINEST:
        return f"{name} is within {plain_number(worst)} now: {plain_number(wanted)} is out of reach of first order."
    h, size = scene.domain.spacing, scene.domain.size
    # Whole cells along the first axis; a spacing at which the others are whole, too, is taken if it is near.
    least = math.ceil(size[0] / h * max(finer, 1 / COARSEST) * (1 - 1e-3))
    fits = (n for n in range(least, least + least // 8 + 2) if all(_whole(s * n / size[0]) for s in size))
    spacing = size[0] / next(fits, least)
    seconds = study.base.seconds * (h / spacing) ** (scene.dimension + 1)
    return (
        f"{name} within {plain_number(wanted)}{unit_of(name)} needs a spacing of {spacing:.4g} m, "
        f"{h / spacing:.2g} times finer, and about {duration_text(seconds)}:\nspacing = {spacing:.8g}"
    )


def _whole(number: float) -> bool:
    return abs(number - round(number)) < 1e-6


def write(study: Study, directory: Path) -> None:
    """Write the page, its figures and the bars into a directory. Raises RunError on failure."""
    bars = study.bars
    page = [
        f"# Error bars: {study.scene.title or 'scene'}",
        f"**{last_line(study)}** (bars for {bars.confidence} %, end of the run)",
        "\n".join(f"* {line}" for line in remarks(study)),
        f"![Observables and their bars over time]({BANDS})",
        markdown_table(HEAD, rows_of(bars), {0, 1, 3}),
        "## Speed against error",
        "The error of the scene is its bar, that of a sibling the bar plus its distance from the scene; all are means.",
        markdown_table(RUNS, cost_rows(study), {0, 1}),
        f"![Seconds against error]({COST})",
    ]
    with writing("The report", to=directory):
        directory.mkdir(parents=True, exist_ok=True)
        for name, content in ((BANDS, draw_bands(study)), (COST, draw_cost(study))):
            with sealed(directory / name, unique=True) as temporary:
                temporary.write_bytes(content)
        write_text(directory / BARS, json.dumps(as_dict(study)) + "\n", unique=True)
        write_text(directory / PAGE, "\n\n".join(page) + "\n", unique=True)


def draw_bands(study: Study) -> bytes:
    """Return a figure of the headline and of the observables with the widest bars over time, as SVG."""
    bars, first = study.bars, headline(study.scene, study.bars)
    shown = [name for name in bars.of if name not in (DENSITY, first)]
    shown.sort(key=lambda name: -float(np.nanmax(bars.of[name].bar)) / bars.of[name].size)
    with drawing(SIZE, THEMES["light"]) as figure:
        for axes, name in zip(figure.subplots(3, 2).flat, (first, *shown[: PANELS - 1]), strict=False):
            one = bars.of[name]
            axes.fill_between(bars.time, one.value - one.bar, one.value + one.bar, color=LIGHT_SERIES[5], alpha=0.5)
            axes.plot(bars.time, one.value, color=LIGHT_SERIES[0])
            axes.set(title=name, ylabel=unit_of(name).strip(), xlabel="t, s")
        return svg(figure)


def draw_cost(study: Study) -> bytes:
    """Return a figure of seconds against the share of the mass that is elsewhere, as SVG."""
    from matplotlib.ticker import LogLocator

    with drawing(SMALL, THEMES["light"]) as figure:
        axes = figure.subplots(subplot_kw={"xscale": "log", "yscale": "log"})
        bars, base = study.bars, study.base
        own = float(bars.of[DENSITY].bar.mean())
        points = [("the scene", base.seconds, own)]
        points += [(one.name, run.seconds, own + float(distance(run, base).mean())) for one, run in study.runs]
        for k, (name, seconds, off) in enumerate(points):
            color = LIGHT_SERIES[k % len(LIGHT_SERIES)]
            axes.plot([max(seconds, 1e-3)], [max(off, 1e-9)], "os"[k == 0], color=color, label=name)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("")
        axes.set(xlabel="seconds", ylabel="share of the mass that is elsewhere", title="Seconds against error")
        axes.legend()
        return svg(figure)

"""Draws the ledger of a run: energies, momenta, time steps and their limits, volumes, speeds, and extents."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.error_bars.bars import read_bars
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import TEXT
from mpmcli.output.result import Result
from mpmcli.plain_text import one_line
from mpmcli.plot.style import THEMES, Theme, ThemeName, drawing, pixels
from mpmcli.render.frame_choice import evenly_spaced
from mpmcli.scene.problem import listed
from mpmcli.stability.limits import NODE_COURANT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FRAMES_MAX = 200  # frames whose positions are read; more would not be visible in the figure
BODIES_MAX = 6  # more bodies than this are shown as one
NAMED = 5  # largest number of frames named in a note
LABEL_WIDTH = 24  # characters in a line of a label of the vertical axis
MARKED = 8  # fewer points than this have markers, because a single point makes no line
FEW_DECADES = 2.5  # axes of fewer decades than this also have ticks at 2 and 5 times the powers of ten
NAME_MAX = 16  # characters of a name in a legend
TITLE_MAX = 64  # characters of the title of a scene
COLLIDERS_MAX = 6  # more colliders than this are shown as one; largest number of pairs of bodies
AXES = "xyz"
# The order of the colours is that of the legend.
LIMITS = ("wave", "speed", "force", "viscosity", "deformation", "forced", "maximum")


@dataclass(frozen=True)
class History:
    """One run over time."""

    title: str  # of the scene
    header: RunHeader
    particles: int  # in the last frame
    status: str  # of the result
    columns: dict[str, np.ndarray]  # of the ledger, (T,) float64, momenta (T, components); NaN where it is not finite
    limits: tuple[str, ...]  # T names of the bound on the step, "" at the initial state
    # Extents of the particles in some of the frames.
    reach_times: np.ndarray  # (F,) s
    names: tuple[str, ...]  # of B bodies, or one name for all of them
    lowest: np.ndarray  # (F, B, d) m, NaN where a body has no particle; `highest` alike
    highest: np.ndarray
    notes: tuple[str, ...]  # sentences on data that the figure does not show
    bars: Mapping[str, np.ndarray] = field(default_factory=dict)  # (T,) by observable, see `error_bars`

    @property
    def times(self) -> np.ndarray:
        """Times of the frames, (T,), s."""
        return self.columns["time"]


def read_history(result: Result) -> History:
    """Read the history of a result. Raises InputError if a frame or the ledger is damaged."""
    rows = result.ledger
    if len(rows) != result.frame_count:
        raise InputError(f"{result.path} is damaged: it has {result.frame_count} frames and {len(rows)} ledger rows.")
    columns, broken = {}, []
    for name in (entry.name for entry in fields(LedgerRow) if entry.name != TEXT):
        if rows and getattr(rows[0], name) is None:
            # Only ledgers of scenes in which particles enter and leave have this column.
            continue
        values = np.array([getattr(row, name) for row in rows], dtype=np.float64)
        columns[name] = np.where(np.isfinite(values), values, np.nan)
        broken.append(~np.isfinite(values).reshape(len(rows), -1).all(1))
    notes, lost = [], np.flatnonzero(np.any(broken, 0))
    if len(lost):
        named = ", ".join(str(result.numbers[k]) for k in lost[:NAMED])
        named += f" and {len(lost) - NAMED} more" if len(lost) > NAMED else ""
        frames = "frame" if len(lost) == 1 else "frames"
        notes.append(f"The ledger holds numbers that are not finite in {frames} {named}; they are gaps in the figure.")
    chosen = evenly_spaced(range(result.frame_count), FRAMES_MAX)
    if len(chosen) < result.frame_count:
        notes.append(f"The reach of the particles is read from {len(chosen)} of {result.frame_count} frames.")
    bodies = result.header.body_names
    apart = 1 < len(bodies) <= BODIES_MAX
    labels = range(len(bodies)) if apart else [None]
    extents = [[_extent(frame, label) for label in labels] for frame in (result.present_frame(k, ()) for k in chosen)]
    both = np.array(extents).reshape(len(chosen), len(labels), 2, result.dimension)
    names = bodies if apart else (bodies[0] if len(bodies) == 1 else "all bodies",)
    bars = (read_bars(result.directory, result.times) or {}).get("observables", {})
    return History(
        title=one_line(result.header.title) or result.path.stem,
        header=result.header,
        particles=int(result.particle_counts[-1]),
        status="" if result.record is None else result.status,
        columns=columns,
        limits=tuple(row.limit for row in rows),
        reach_times=result.times[chosen],
        names=tuple(one_line(name) for name in names),
        lowest=both[:, :, 0],
        highest=both[:, :, 1],
        notes=tuple(notes),
        bars={name: np.array(one["bar"]) for name, one in bars.items()},
    )


def _extent(frame: Frame, label: int | None) -> np.ndarray:
    """Return the lowest and the highest finite coordinates of a body, or of all bodies, (2, d), m."""
    position = frame.position.astype(np.float64)
    kept = np.isfinite(position).all(1)
    if label is not None:
        kept &= frame.body == label
    if not kept.any():
        return np.full((2, position.shape[1]), np.nan)
    return np.array([position[kept].min(0), position[kept].max(0)])


def ledger_picture(history: History, size: tuple[int, int], theme: ThemeName) -> tuple[np.ndarray, list[str]]:
    """Return the figure of a run, (h, w, 3) uint8 of a size (width, height) in pixels, and the titles of its panels."""
    with drawing(size, THEMES[theme]) as figure:
        titles = draw_ledger(figure, history, theme)
        return pixels(figure), titles


def draw_ledger(figure: "Figure", history: History, theme: ThemeName) -> list[str]:
    """Draw a run into an empty figure and return the titles of its panels, in the order of its axes."""
    d = history.header.dimension
    # Each row has its own grid, because the rows differ in their number of panels.
    colliders, contacts = history.header.collider_names, [" on ".join(pair[::-1]) for pair in history.header.contacts]
    counts = (4, 4, d) + (d,) * bool(colliders) + (d,) * bool(contacts)
    rows = figure.add_gridspec(len(counts), 1)
    places = [cell for row, count in enumerate(counts) for cell in rows[row].subgridspec(1, count)]
    panels = [Panel(figure.add_subplot(place), history.times, THEMES[theme]) for place in places]
    _energy(panels[0], panels[1], history)
    _momenta(panels[2], panels[3], history)
    _steps(panels[4], panels[5], history)
    _extremes(panels[6], panels[7], history)
    for axis in range(d):
        _reach(panels[8 + axis], history, axis)
    for k, panel in enumerate(panels[8 + d :]):
        what, names = ("colliders", colliders) if colliders and k < d else ("bodies", contacts)
        _load(panel, history, k % d, what, names)
    for panel in panels:
        panel.finish()
    status = f", {history.status}" if history.status else ""
    facts = f"{history.particles:,} particles, {len(history.times)} frames{status}"
    figure.suptitle(f"{_shortened(history.title, TITLE_MAX)}: {facts}", x=0.012, ha="left", fontsize=11)
    return [panel.axes.get_title(loc="left") for panel in panels]


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 1]}…"


def _first(values: np.ndarray) -> int:
    """Return the index of the first finite row, the reference of changes."""
    return int(np.isfinite(values).reshape(len(values), -1).all(1).argmax())


class Panel:
    """Axes with the times (T,), s, of the values along x; colours are given by index, None is that of text."""

    def __init__(self, axes: "Axes", times: np.ndarray, theme: Theme) -> None:
        self.axes, self._times, self._theme = axes, times, theme

    def title(self, title: str, label: str) -> None:
        """Set the title and the label of the values, which ends with their unit."""
        self.axes.set_title(title)
        self.axes.set_ylabel(textwrap.fill(label, LABEL_WIDTH))

    def line(
        self,
        values: np.ndarray,
        name: str,
        color: int | None,
        width: float = 1.4,
        times: np.ndarray | None = None,
        bar: np.ndarray | None = None,
    ) -> None:
        """Draw values at the times of the frames, or at others, perhaps with error bars as a band; NaN is a gap."""
        if bar is not None:
            self.axes.fill_between(self._times, values - bar, values + bar, color=self._color(color), alpha=0.2, lw=0)
        marker = "o" if np.isfinite(values).sum() < MARKED else ""
        keywords = {"color": self._color(color), "linewidth": width, "label": self._name(name)}
        self.axes.plot(self._times if times is None else times, values, marker=marker, markersize=3.5, **keywords)

    def steps(self, values: np.ndarray, color: int | None, name: str = "") -> None:
        """Draw values (T,), each constant from the previous frame to its own."""
        keywords = {"color": self._color(color), "linewidth": 1.4, "label": self._name(name)}
        self.axes.step(self._times[1:], values[1:], where="pre", **keywords)

    def band(self, low: np.ndarray, high: np.ndarray, name: str, color: int, times: np.ndarray | None = None) -> None:
        """Fill between two series, at the times of the frames or at others."""
        times = self._times if times is None else times
        self.axes.fill_between(times, low, high, color=self._color(color), alpha=0.28, linewidth=0)
        self.line(low, name, color, 1.2, times)
        self.line(high, "", color, 1.2, times)

    def between_frames(
        self, low: np.ndarray, high: np.ndarray, chosen: np.ndarray, name: str, color: int | None
    ) -> None:
        """Fill from low to high in the interval before each chosen frame, (T,) bool."""
        from matplotlib.collections import PolyCollection

        ends = np.flatnonzero(chosen & np.isfinite(low) & np.isfinite(high))
        ends = ends[ends > 0]
        left, right, bottom, top = self._times[ends - 1], self._times[ends], low[ends], high[ends]
        corners = [np.stack(corner, -1) for corner in ((left, bottom), (right, bottom), (right, top), (left, top))]
        shown = self._color(color)
        # The edge shows bands of zero height.
        boxes = PolyCollection(np.stack(corners, 1), facecolor=shown, edgecolor=shown, linewidth=1.6, label=name)
        boxes.set_capstyle("butt")
        self.axes.add_collection(boxes)
        self.axes.update_datalim(np.concatenate(corners))

    def level(self, value: float, name: str = "", color: int | None = None) -> None:
        """Draw a dashed reference line at a value, faint if `color` is None."""
        shown = self._theme.faint if color is None else self._color(color)
        keywords = {"linestyle": (0, (4, 2.5)), "linewidth": 1.0, "zorder": 1.5}
        self.axes.axhline(value, color=shown, label=self._name(name), **keywords)

    def note(self, text: str) -> None:
        """Write a text in the middle of an empty panel."""
        place = {"transform": self.axes.transAxes, "ha": "center", "va": "center"}
        self.axes.text(0.5, 0.5, text, color=self._theme.faint, **place)

    def logarithmic(self, *values: np.ndarray) -> None:
        """Scale positive values logarithmically, over at least three quarters of a decade."""
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
        """Set the limits of the times, the format of the numbers, and the legend."""
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

    def _color(self, color: int | None) -> str:
        return self._theme.ink if color is None else self._theme.series[color % len(self._theme.series)]

    def _name(self, name: str) -> str:
        # Matplotlib omits labels that begin with an underscore from legends.
        return _shortened(name, NAME_MAX).lstrip("_") or "_"


def _energy(parts: Panel, change: Panel, history: History) -> None:
    """Plot the energies over time, and the change of their total over its largest value."""
    columns, header = history.columns, history.header
    potential = columns["potential"]
    above = potential - np.nanmin(potential) if np.isfinite(potential).any() else potential
    series = {"kinetic": columns["kinetic"], "elastic": columns["elastic"], "potential": above}
    total = columns["kinetic"] + columns["elastic"] + above
    parts.title("Energy", f"{'J/m' if header.dimension == 2 else 'J'}, potential above its lowest")
    parts.line(total, "total", None, width=2.0)
    for k, (name, values) in enumerate(series.items()):
        parts.line(values, name, k, bar=history.bars.get(f"energy.{name}"))
    largest = float(np.nanmax(total)) if np.isfinite(total).any() else 0.0
    work = " and ".join([*["forces"] * header.driven, *["colliders"] * header.moved])
    work = f", while {work} do work" if work else ""
    change.title("Change of total energy", f"(E - E₀) / largest E{work}")
    if largest > 0:
        change.line((total - total[_first(total)]) / largest, "", None)
    change.level(0.0)


def _momenta(linear: Panel, angular: Panel, history: History) -> None:
    """Draw the momentum without that of gravity, 0 until another force acts, and the angular momentum."""
    header, columns = history.header, history.columns
    momentum = columns["linear_momentum"]
    start = _first(momentum)
    values = momentum - momentum[start]
    # In 2D they are per metre of depth.
    unit, angular_unit = ("N s/m", "N s") if header.dimension == 2 else ("N s", "N m s")
    if header.gravity is None:
        linear.title("Momentum (gravity is not constant)", f"P - P₀, {unit}")
    else:
        what = listed(["walls", *["colliders"] * bool(header.collider_names), *["forces"] * header.driven], "and")
        linear.title(f"Impulse of the {what}", f"P - P₀ - M g t, {unit}")
        # Velocities are those at the middle of the last step.
        middle = history.times - (columns["step_min"] + columns["step_max"]) / 4
        values = values - columns["mass"][:, None] * header.gravity * (middle - middle[start])[:, None]
    for axis in range(header.dimension):
        linear.line(values[:, axis], AXES[axis], axis)
    linear.level(0.0)
    moments = columns["angular_momentum"]
    angular.title("Angular momentum", f"about the domain's corner, {angular_unit}")
    # In 2D there is one component, about z.
    for axis, component in zip(range(3)[-moments.shape[1] :], moments.T, strict=True):
        angular.line(component, AXES[axis], axis)
    angular.level(0.0)


def _steps(length: Panel, courant: Panel, history: History) -> None:
    """Plot the range of steps between frames, s, by what limits them, and the Courant number."""
    length.title("Time step, by limit", "smallest to largest, s")
    shortest, longest = history.columns["step_min"], history.columns["step_max"]
    names = [name for name in LIMITS if name in history.limits]
    names += sorted(set(history.limits) - {"", *LIMITS})
    for name in names:
        chosen = np.array([limit == name for limit in history.limits])
        color = LIMITS.index(name) if name in LIMITS else None
        length.between_frames(shortest, longest, chosen, name, color)
    if not names:
        length.note("no step yet")
    length.logarithmic(shortest, longest)
    courant.title("Courant number", "largest displacement in a step, cells")
    courant.steps(history.columns["courant_max"], 0)
    courant.level(NODE_COURANT, f"limit {NODE_COURANT:g}", 1)
    courant.axes.set_ylim(bottom=0.0)


def _extremes(volume: Panel, speed: Panel, history: History) -> None:
    volume.title("Volume ratio J", "smallest to largest")
    volume.band(history.columns["volume_ratio_min"], history.columns["volume_ratio_max"], "", 2)
    volume.level(1.0)
    speed.title("Largest speed", "m/s")
    speed.line(history.columns["speed_max"], "", 0)
    speed.axes.set_ylim(bottom=0.0)


def _reach(panel: Panel, history: History, axis: int) -> None:
    header = history.header
    panel.title(f"Reach along {AXES[axis]}", "lowest to highest particle, m")
    for k, name in enumerate(history.names):
        panel.band(history.lowest[:, k, axis], history.highest[:, k, axis], name, k, times=history.reach_times)
    if header.origin is not None and header.upper is not None:
        panel.level(float(header.origin[axis]), "walls")
        panel.level(float(header.upper[axis]))


def _load(panel: Panel, history: History, axis: int, what: str, names: Sequence[str]) -> None:
    """Draw mean forces between frames: on each collider or all together, or of the pairs of bodies with the largest."""
    unit = "N/m" if history.header.dimension == 2 else "N"
    panel.title(f"Force on {what} along {AXES[axis]}", f"mean since the previous frame, {unit}")
    forces = history.columns["collider_force" if what == "colliders" else "contact_force"]
    if forces.ndim != 3:
        panel.note("not in this ledger")
        return
    if what == "bodies":
        chosen = np.sort(np.abs(forces).sum(axis=(0, 2)).argsort()[-COLLIDERS_MAX:])
        forces, names = forces[:, chosen], [names[k] for k in chosen]
    elif len(names) > COLLIDERS_MAX:
        forces, names = forces.sum(axis=1, keepdims=True), ("all together",)
    for k, name in enumerate(names):
        panel.steps(forces[:, k, axis], k, one_line(name))
    panel.level(0.0)

"""Draws the ledger of a run: energies, momenta, steps and what bounds them, volumes, speeds, and where matter is."""

from typing import TYPE_CHECKING

import numpy as np

from mpmcli.plain_text import one_line
from mpmcli.plot.history import History
from mpmcli.plot.panels import Panel
from mpmcli.plot.style import THEMES, ThemeName, drawing, pixels
from mpmcli.scene.sentences import listed
from mpmcli.stability.limits import COURANT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AXES = "xyz"
# Characters of the title of a scene.
TITLE_MAX = 64
# More colliders than this are shown as one.
COLLIDERS_MAX = 6
# The order of the colours is that of the legend.
LIMITS = ("wave", "speed", "force", "viscosity", "deformation", "forced", "maximum")


def ledger_picture(history: History, size: tuple[int, int], theme: ThemeName) -> tuple[np.ndarray, list[str]]:
    """Return the figure of a run as an image, and the titles of its panels.

    Args:
        size: pixels, wide and high.

    Returns:
        (h, w, 3) uint8, the same for the same history.
    """
    with drawing(size, THEMES[theme]) as figure:
        titles = draw_ledger(figure, history, theme)
        return pixels(figure), titles


def draw_ledger(figure: "Figure", history: History, theme: ThemeName) -> list[str]:
    """Draw a run into an empty figure and return the titles of its panels, in the order of its axes."""
    d = history.header.dimension
    # Each row for itself, as they differ in their number of panels.
    counts = (4, 4, d, d) if history.header.collider_names else (4, 4, d)
    rows = figure.add_gridspec(len(counts), 1)
    places = [cell for row, count in enumerate(counts) for cell in rows[row].subgridspec(1, count)]
    panels = [Panel(figure.add_subplot(place), history.times, THEMES[theme]) for place in places]
    _energy(panels[0], panels[1], history)
    _momentum(panels[2], history)
    _angular_momentum(panels[3], history)
    _step(panels[4], history)
    _courant(panels[5], history)
    _volume(panels[6], history)
    _speed(panels[7], history)
    for axis, panel in enumerate(panels[8 : 8 + d]):
        _reach(panel, history, axis)
    for axis, panel in enumerate(panels[8 + d :]):
        _load(panel, history, axis)
    for panel in panels:
        panel.finish()
    status = f", {history.status}" if history.status else ""
    said = f"{history.particles:,} particles, {len(history.times)} frames{status}"
    title = history.title if len(history.title) <= TITLE_MAX else f"{history.title[: TITLE_MAX - 1]}…"
    figure.suptitle(f"{title}: {said}", x=0.012, ha="left", fontsize=11)
    return [panel.axes.get_title(loc="left") for panel in panels]


def _first(values: np.ndarray) -> int:
    """Return the number of the first row that is known, which changes are counted from."""
    return int(np.isfinite(values).reshape(len(values), -1).all(1).argmax())


def _units(history: History) -> tuple[str, str, str]:
    """Return the units of energy, momentum and angular momentum: in the plane they are per metre of depth."""
    return ("J/m", "N s/m", "N s") if history.header.dimension == 2 else ("J", "N s", "N m s")


def _energy(parts: Panel, change: Panel, history: History) -> None:
    unit, columns = _units(history)[0], history.columns
    potential = columns["potential"]
    above = potential - np.nanmin(potential) if np.isfinite(potential).any() else potential
    total = columns["kinetic"] + columns["elastic"] + above
    parts.title("Energy", f"{unit}, potential above its lowest")
    parts.line(total, "total", None, linewidth=2.0)
    for k, (name, values) in enumerate(
        (("kinetic", columns["kinetic"]), ("elastic", columns["elastic"]), ("potential", above))
    ):
        parts.line(values, name, k)
    largest = float(np.nanmax(total)) if np.isfinite(total).any() else 0.0
    sources = [("forces", history.header.driven), ("colliders", history.header.moved)]
    work = " and ".join(name for name, there in sources if there)
    work = f", while {work} do work" if work else ""
    change.title("Change of total energy", f"(E - E₀) / largest E{work}")
    if largest > 0:
        change.line((total - total[_first(total)]) / largest, "", None)
    change.level(0.0)


def _momentum(panel: Panel, history: History) -> None:
    """Draw what gravity does not explain of the momentum: 0 but for rounding until something else acts."""
    header, columns = history.header, history.columns
    momentum = columns["linear_momentum"]
    start = _first(momentum)
    values = momentum - momentum[start]
    unit = _units(history)[1]
    if header.gravity is None:
        panel.title("Momentum (gravity is not constant)", f"P - P₀, {unit}")
    else:
        what = listed(["walls", *["colliders"] * bool(header.collider_names), *["forces"] * header.driven], "and")
        panel.title(f"Impulse of the {what}", f"P - P₀ - M g t, {unit}")
        # Velocities are those of the middle of the last step.
        middle = history.times - (columns["step_min"] + columns["step_max"]) / 4
        values = values - columns["mass"][:, None] * header.gravity * (middle - middle[start])[:, None]
    for axis in range(header.dimension):
        panel.line(values[:, axis], AXES[axis], axis)
    panel.level(0.0)


def _angular_momentum(panel: Panel, history: History) -> None:
    values, unit = history.columns["angular_momentum"], _units(history)[2]
    panel.title("Angular momentum", f"about the domain's corner, {unit}")
    if values.shape[1] == 1:
        panel.line(values[:, 0], "z", 2)
    else:
        for axis in range(3):
            panel.line(values[:, axis], AXES[axis], axis)
    panel.level(0.0)


def _step(panel: Panel, history: History) -> None:
    panel.title("Time step, by what bounds it", "smallest to largest, s")
    columns = history.columns
    names = [name for name in LIMITS if name in history.limits]
    names += sorted(set(history.limits) - {"", *LIMITS})
    for name in names:
        chosen = np.array([limit == name for limit in history.limits])
        color = LIMITS.index(name) if name in LIMITS else None
        panel.between_frames(columns["step_min"], columns["step_max"], chosen, name, color)
    if not names:
        panel.say("no step yet")
    panel.logarithmic([columns["step_min"], columns["step_max"]])


def _courant(panel: Panel, history: History) -> None:
    panel.title("Courant number", "largest displacement in a step, cells")
    panel.steps(history.columns["courant_max"], 0)
    panel.level(COURANT, f"limit {COURANT:g}", 1)
    panel.from_zero()


def _volume(panel: Panel, history: History) -> None:
    panel.title("Volume ratio J", "smallest to largest")
    panel.band(history.columns["volume_ratio_min"], history.columns["volume_ratio_max"], "", 2)
    panel.level(1.0)


def _speed(panel: Panel, history: History) -> None:
    panel.title("Largest speed", "m/s")
    panel.line(history.columns["speed_max"], "", 0)
    panel.from_zero()


def _reach(panel: Panel, history: History, axis: int) -> None:
    header, reach = history.header, history.reach
    panel.title(f"Reach along {AXES[axis]}", "lowest to highest particle, m")
    for k, name in enumerate(reach.names):
        panel.band(reach.lowest[:, k, axis], reach.highest[:, k, axis], name, k, times=reach.times)
    if header.origin is not None and header.upper is not None:
        panel.level(float(header.origin[axis]), "walls")
        panel.level(float(header.upper[axis]))


def _load(panel: Panel, history: History, axis: int) -> None:
    """Draw the mean force on each collider between frames, or on all of them."""
    unit = "N/m" if history.header.dimension == 2 else "N"
    panel.title(f"Force on colliders along {AXES[axis]}", f"mean since the frame before, {unit}")
    forces, names = history.columns["collider_force"], history.header.collider_names
    if forces.ndim != 3:
        panel.say("not in this ledger")
        return
    if len(names) > COLLIDERS_MAX:
        forces, names = forces.sum(axis=1, keepdims=True), ("all together",)
    for k, name in enumerate(names):
        panel.steps(forces[:, k, axis], k, one_line(name))
    panel.level(0.0)

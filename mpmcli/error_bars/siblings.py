"""The siblings of a scene: the same physics with one numerical choice changed.

Two coarser grids, other choices of the model on the coarsest of them, half a step, a shifted grid, other samples, and
gravity times 1 + 1e-6, which shows from which time on rounding alone parts two runs.
"""

import copy
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from mpmcli.scene import Scene, scene_to_toml
from mpmcli.scene.domain import FEWEST_CELLS, FEWEST_PERIODIC_CELLS, PASSED, PERIODIC
from mpmcli.scene.quantity import AXES

Tables = dict[str, Any]
Cause = Literal["grid", "model", "rounding", "step", "placement", "sample"]
Level = Literal["grids", "step", "all"]
# The causes of each level, and its cost in runs of the scene in 2D.
LEVELS: dict[Level, tuple[Cause, ...]] = {
    "grids": ("grid", "model"),
    "step": ("grid", "model", "rounding", "step"),
    "all": ("grid", "model", "rounding", "step", "placement", "sample"),
}
CAUSES = LEVELS["all"]
# Spacings of the coarser grids over that of the scene; how far a spacing that fits may be from them, how far a wall may
# move, in coarse cells, to fit well, and to fit at all.
RATIOS, OFF_RATIO, OFF_WALL, LOOSE_WALL = (math.sqrt(2), 2.0), 0.12, 0.05, 0.25
# Lattices of the preferred ratios stay symmetric: they are taken for the square root of 2 where they fit.
PREFERRED = (1.4, 1.5)
# A face that no particle comes within so many cells of, at any frame, may move out.
NEAR = 2.5
# Shifts of the grid, cells. Not a half: two particles per axis would meet the nodes in the same way.
SHIFTS = (0.37, 0.71)
# Factor on moduli that the scene leaves to mpmcli: an error by softness, c/K, differs by itself, and the run is cheaper
# than with stiffer ones. The name of the sample of liquids and grains among choices.
SOFTER, SAMPLING = 0.5, "sampling"
# Factor on gravity. It changes numbers by ten times the rounding of f32.
NUDGE = 1 + 1e-6


@dataclass(frozen=True)
class Sibling:
    """A changed scene: its name, its cause, its tables, and its spacing over that of the scene."""

    name: str
    cause: Cause
    tables: Tables
    ratio: float = 1.0


@dataclass(frozen=True)
class LeftOut:
    """A sibling that does not exist or was not finished, and the reason."""

    name: str
    cause: Cause
    reason: str


@dataclass(frozen=True)
class Reach:
    """Bounds of all that moves over all frames, and its middle at the start, (d,) each, m."""

    low: np.ndarray
    high: np.ndarray
    middle: np.ndarray


def tables_of(scene: Scene) -> Tables:
    """Return the complete tables of a scene, in which nothing is "auto" that depends on the spacing."""
    return tomllib.loads(scene_to_toml(scene.model_copy(update={"error_bars": None})))


def siblings_of(
    tables: Tables,
    reach: Reach,
    causes: tuple[Cause, ...],
    choices: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
) -> Iterator[Sibling | LeftOut]:
    """Yield the siblings of a scene for some causes, in the order of LEVELS; `choices`: see `models`."""
    makers: dict[Cause, Callable[[], Iterator[Sibling | LeftOut]]] = {
        "grid": lambda: (coarser(tables, reach, target) for target in RATIOS),
        "model": lambda: models(tables, reach, choices),
        "rounding": lambda: iter([nudged(tables)]),
        "step": lambda: iter([half_step(tables)]),
        "placement": lambda: (shifted(tables, reach, share) for share in SHIFTS),
        "sample": lambda: samples(tables),
    }
    for cause in CAUSES:
        if cause in causes:
            yield from makers[cause]()


def coarser(tables: Tables, reach: Reach, target: float) -> Sibling | LeftOut:
    """Return the scene on a grid about `target` times coarser, with its walls in place."""
    fixed = fixed_faces(tables, reach)
    new = spacing_for(tables, fixed, target)
    if new is None:
        few = f"no spacing near {target:.3g} times that of the scene fits between its walls"
        return LeftOut(f"spacing x {target:.3g}", "grid", f"{few}, with {FEWEST_CELLS} cells or more")
    changed = copy.deepcopy(tables)
    domain = changed["domain"]
    old = domain["spacing"]
    for k, (low, high) in enumerate(fixed):
        origin, size = domain["origin"][k], domain["size"][k]
        cells = round(size / new) if low and high else max(FEWEST_CELLS, math.ceil(size / new - 1e-6))
        if not (low or high):
            # The middle of the material keeps its place within a cell: a symmetric scene stays symmetric.
            middle = float(reach.middle[k])
            place = (middle - origin) / old % 1.0
            below = math.ceil((middle - origin) / new - place - 1e-6) + place
            above = math.ceil((origin + size - middle) / new + place - 1e-6) - place
            domain["origin"][k], cells = middle - below * new, max(FEWEST_CELLS, round(below + above))
        elif high and not low:
            domain["origin"][k] -= cells * new - size
        domain["size"][k] = cells * new
    domain["spacing"] = new
    ratio = new / old
    return Sibling(f"spacing x {ratio:.3g}", "grid", changed, ratio)


def models(tables: Tables, reach: Reach, choices: Mapping[str, tuple[str, ...]]) -> Iterator[Sibling]:
    """Yield the scene on the coarsest grid with other choices than those that it leaves to mpmcli.

    `choices` has the names of moduli, and SAMPLING, by the body or emitter that they are for.
    """
    grids = [one for one in (coarser(tables, reach, target) for target in RATIOS) if isinstance(one, Sibling)]
    for coarsest in grids[-1:]:
        changed = copy.deepcopy(coarsest.tables)
        for source in _sources(changed):
            for name in set(choices.get(source["name"], ())) - {SAMPLING}:
                source["material"][name] *= SOFTER
        if changed != coarsest.tables:
            yield Sibling(f"automatic moduli x {SOFTER:g}", "model", changed, coarsest.ratio)
        changed = copy.deepcopy(coarsest.tables)
        for source in _sampled(changed):
            if SAMPLING in choices.get(source["name"], ()) and source["sampling"] == "lattice":
                turn(source)
        if changed != coarsest.tables:
            yield Sibling("turned sample", "model", changed, coarsest.ratio)


def fixed_faces(tables: Tables, reach: Reach) -> list[tuple[bool, bool]]:
    """Return for each axis whether the lower and the upper face must stay: material comes near, or passes."""
    domain, found = tables["domain"], []
    for k, (origin, size) in enumerate(zip(domain["origin"], domain["size"], strict=True)):
        near = [gap < NEAR * domain["spacing"] for gap in (reach.low[k] - origin, origin + size - reach.high[k])]
        passed = [wall(tables, k, side) in PASSED for side in ("min", "max")]
        found.append((near[0] or passed[0], near[1] or passed[1]))
    return found


def wall(tables: Tables, axis: int, side: str) -> str:
    """Return the condition at a face, "min" or "max"."""
    walls = tables["domain"]["walls"]
    return walls.get(f"{AXES[axis]}_{side}", walls["default"])


def spacing_for(tables: Tables, fixed: list[tuple[bool, bool]], target: float) -> float | None:
    """Return a coarser spacing that fits between all pairs of fixed faces, m, or None.

    Their distances are whole numbers of the new cells up to OFF_WALL of a cell, by which a wall moves out; between
    periodic faces they are exact. Of the spacings that fit, the nearest to the target; if none does, the best one
    within LOOSE_WALL.
    """
    sizes, h = tables["domain"]["size"], tables["domain"]["spacing"]
    tight = [k for k, pair in enumerate(fixed) if all(pair)]
    rings = [k for k in tight if wall(tables, k, "min") == PERIODIC]
    if not tight:
        return (PREFERRED[0] if target < PREFERRED[1] else target) * h
    options = []
    for lead in tight:
        cells = sizes[lead] / h / target
        for n in range(max(1, math.floor(cells / (1 + OFF_RATIO))), math.ceil(cells * (1 + OFF_RATIO)) + 1):
            counts = {k: max(1, round(sizes[k] * n / sizes[lead])) for k in tight}
            new = max(sizes[k] / counts[k] for k in tight)
            off = {k: counts[k] - sizes[k] / new for k in tight}
            few = any(counts[k] < (FEWEST_PERIODIC_CELLS if k in rings else FEWEST_CELLS) for k in tight)
            torn = any(off[k] > 1e-6 for k in rings)
            away = abs(new / h / target - 1)
            if not few and not torn and away <= OFF_RATIO:
                even = target < PREFERRED[1] and any(abs(new / h - one) < 1e-6 for one in PREFERRED)
                options.append((max(off.values()), not even, away, new))
    fits = [one for one in options if one[0] <= OFF_WALL]
    best = min(fits, key=lambda one: one[1:], default=min(options, default=None))
    return best[-1] if best is not None and best[0] <= LOOSE_WALL else None


def nudged(tables: Tables) -> Sibling | LeftOut:
    """Return the scene with gravity times NUDGE."""
    gravity = tables["domain"]["gravity"]
    if not any(gravity):
        return LeftOut("gravity x (1 + 1e-6)", "rounding", "there is no gravity")
    changed = copy.deepcopy(tables)
    changed["domain"]["gravity"] = [f"({g}) * {NUDGE!r}" if isinstance(g, str) else g * NUDGE for g in gravity]
    return Sibling("gravity x (1 + 1e-6)", "rounding", changed)


def half_step(tables: Tables) -> Sibling:
    """Return the scene with steps half as long."""
    time = tables["time"]
    changed = {"safety": time["safety"] / 2} | ({} if time["step"] == "auto" else {"step": time["step"] / 2})
    return Sibling("half step", "step", {**copy.deepcopy(tables), "time": {**time, **changed}})


def shifted(tables: Tables, reach: Reach, share: float) -> Sibling | LeftOut:
    """Return the scene with the grid moved by a share of a cell along the axes without fixed faces."""
    name = f"grid moved by {share} of a cell"
    free = [k for k, pair in enumerate(fixed_faces(tables, reach)) if not any(pair)]
    if not free:
        return LeftOut(name, "placement", "material comes near the walls of every axis")
    changed = copy.deepcopy(tables)
    domain = changed["domain"]
    for k in free:
        domain["origin"][k] -= share * domain["spacing"]
        domain["size"][k] += domain["spacing"]
    return Sibling(name, "placement", changed)


def samples(tables: Tables) -> Iterator[Sibling | LeftOut]:
    """Yield the scene with more particles, and with another sample of like quality."""
    d, more, other = len(tables["domain"]["size"]), copy.deepcopy(tables), copy.deepcopy(tables)
    for source in _sampled(more):
        axis = round(source["particles_per_cell"] ** (1 / d))
        source["particles_per_cell"] = (axis + 1) ** d
    for source in _sampled(other):
        source["seed"] += 1
        if source["sampling"] == "lattice":
            turn(source)
        elif source["sampling"] == "turned":
            source["sampling"] = "jittered"
    if more == tables:
        yield LeftOut("other sample", "sample", "all particles are given as points")
        return
    yield Sibling("more particles", "sample", more)
    yield Sibling("other sample", "sample", other)


def turn(source: Tables) -> None:
    """Replace a lattice by a turned one; random positions would measure their own noise, a hundred times as large."""
    source |= {"sampling": "turned"} | ({"relaxed": True} if "relaxed" in source else {})


def _sources(tables: Tables) -> list[Tables]:
    return [*tables.get("bodies", []), *tables.get("emitters", [])]


def _sampled(tables: Tables) -> list[Tables]:
    """Return the bodies and emitters whose particles mpmcli places."""
    return [source for source in _sources(tables) if "points" not in source["shape"]]

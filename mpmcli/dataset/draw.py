"""One trajectory of a sweep: its values, its bodies and colliders placed at random, and the scene with them."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from pydantic import ValidationError

from mpmcli.dataset.sweep import Sweep, TrajectoryValues, generator
from mpmcli.errors import InputError
from mpmcli.scene import LoadedScene, parse_scene
from mpmcli.scene.colliders import Collider, Plane
from mpmcli.scene.entry import definitions
from mpmcli.scene.expand import Laws
from mpmcli.scene.primitives import box_corners
from mpmcli.scene.problem import Path as KeyPath
from mpmcli.scene.quantity import dimension_of
from mpmcli.scene.shapes import Ball, BodyShape, Form
from mpmcli.scene.toml_file import key_parts, set_value

# Signed distance of points (n, d), (n,), m.
Distance = Callable[[np.ndarray], np.ndarray]
# Candidates drawn for one body before the placement restarts, and number of restarts.
TRIES = 256
STARTS = 20
# Number of times that sizes and radii are drawn before a trajectory is given up.
ROUNDS = 10
# Upper bound of random seeds of bodies, so that every format stores them exactly.
SEEDS = 2**53


@dataclass(frozen=True, eq=False)
class RoundedBox:
    """All points within `radius`, m, of a box of half edge lengths `half`, (d,), m; a ball if `half` is 0."""

    center: np.ndarray
    half: np.ndarray
    radius: float


@dataclass(frozen=True, eq=False)
class Wanted:
    """A body to be placed in its region, from `lower` to `upper`, (d,), m, into which it fits.

    `half` and `radius` are those of a RoundedBox; `volume` in m^3 (m^2 in 2D), as large bodies are placed first;
    `min_distance` to other bodies in m.
    """

    half: np.ndarray
    radius: float
    volume: float
    lower: np.ndarray
    upper: np.ndarray
    min_distance: float
    generator: np.random.Generator


class NoPlace(Exception):  # noqa: N818
    """No arrangement was found; the best one placed `placed` bodies and failed at body `index`."""

    def __init__(self, index: int, placed: int) -> None:
        super().__init__(index, placed)
        self.index, self.placed = index, placed


def room_before(centers: np.ndarray, half: np.ndarray, radius: float, wall: Distance) -> np.ndarray:
    """Return the distance of a rounded box at m centres (m, d) from a wall, (m,), m: exact in a convex container."""
    corners = box_corners(-half, half)
    return np.min([wall(centers + corner) for corner in np.unique(corners, axis=0)], axis=0) - radius


def _box(lower: np.ndarray, upper: np.ndarray) -> RoundedBox:
    return RoundedBox((lower + upper) / 2, (upper - lower) / 2, 0.0)


def rounded_box(form: Form) -> RoundedBox:
    """Return a box or a ball itself, and of any other shape its bounding box."""
    if isinstance(form, Ball):
        center = np.array(form.center)
        return RoundedBox(center, np.zeros(len(center)), form.radius)
    return _box(*form.bounds())


def find_places(
    wanted: Sequence[Wanted], obstacles: Sequence[RoundedBox], walls: Sequence[Distance] = ()
) -> list[np.ndarray]:
    """Return the centre of every body, (d,), m, by rejection sampling, the largest first; NoPlace after STARTS starts.

    Each body takes the first of TRIES candidates, uniform in its region, that keeps its distance from `obstacles`, from
    bodies already placed, and from `walls`, signed distances that are positive in free space.
    """
    order = sorted(range(len(wanted)), key=lambda i: -wanted[i].volume)
    farthest = NoPlace(0, -1)
    for _ in range(STARTS):
        centers: dict[int, np.ndarray] = {}
        for i in order:
            least = wanted[i].min_distance
            others = [*obstacles, *(RoundedBox(c, wanted[k].half, wanted[k].radius) for k, c in centers.items())]
            apart = [least] * len(obstacles) + [max(least, wanted[k].min_distance) for k in centers]
            center = _free_center(wanted[i], others, np.array(apart), walls)
            if center is None:
                if len(centers) > farthest.placed:
                    farthest = NoPlace(i, len(centers))
                break
            centers[i] = center
        else:
            return [centers[i] for i in range(len(wanted))]
    raise farthest


def _free_center(
    body: Wanted, others: Sequence[RoundedBox], apart: np.ndarray, walls: Sequence[Distance]
) -> np.ndarray | None:
    """Return the first free one of TRIES candidates, (d,), or None; `apart` is the distance to each of `others`, m."""
    reach = body.half + body.radius
    slack = np.maximum(0.0, body.upper - body.lower - 2 * reach)
    centers = body.lower + reach + body.generator.random((TRIES, len(body.lower))) * slack
    free = np.ones(TRIES, dtype=bool)
    if others:
        distance = distances(centers, body.half, body.radius, others)
        # Overlapping bodies have the distance 0, too.
        free = np.all((distance >= apart) & (distance > 0), axis=1)
    for wall in walls:
        room = room_before(centers, body.half, body.radius, wall)
        free &= (room >= body.min_distance) & (room > 0)
    return centers[np.argmax(free)] if free.any() else None


def distances(centers: np.ndarray, half: np.ndarray, radius: float, others: Sequence[RoundedBox]) -> np.ndarray:
    """Return the distances of a rounded box at centres (m, d) to n others, (m, n), m; 0 where they overlap."""
    other_centers = np.array([other.center for other in others])
    other_halves = np.array([other.half for other in others])
    other_radii = np.array([other.radius for other in others])
    beyond = np.abs(centers[:, None] - other_centers) - (half + other_halves)
    return np.maximum(0.0, np.linalg.norm(np.maximum(0.0, beyond), axis=2) - (radius + other_radii))


class PlacementError(InputError):
    """The bodies of a placement cannot be placed; `source` is the sweep file, `placement` the index in it."""

    def __init__(self, source: str, placement: int, sentence: str) -> None:
        super().__init__(source, placement, sentence)
        self.source, self.placement, self.sentence = source, placement, sentence

    def __str__(self) -> str:
        return f"{self.source}: {self.sentence}"


def place_bodies(values: TrajectoryValues, data: dict[str, Any]) -> list[list[dict[str, Any]]]:
    """Return for each placement its bodies: name, corners or centre and radius, and velocity if it is drawn.

    If placement fails, all sizes are drawn again, up to ROUNDS times; then PlacementError is raised. `data`
    is the parsed TOML of the scene with its templates.
    """
    placements = values.sweep.placements
    templates = {
        place.key: next(entry for entry in data[place.list] if entry["name"] == place.template) for place in placements
    }
    obstacles, walls = _obstacles(data, {(p.list, p.template) for p in placements}, values.sweep.base.parent)
    farthest: tuple[int, int, list[Wanted]] | None = None
    # Index of the placement and number of each body.
    chosen: list[tuple[int, int]] = []
    for index, place in enumerate(placements):
        key = f"{place.key}.count"
        chosen += [(index, k) for k in range(1, values.value(key, key, place.count) + 1)]
    random = [values.generator(f"{placements[index].key}.{k}.position") for index, k in chosen]
    for round_number in range(ROUNDS):
        wanted = []
        for (index, k), numbers in zip(chosen, random, strict=True):
            place = placements[index]
            shape = templates[place.key]["shape"]
            name = "radius" if "ball" in shape else "size"
            distribution = getattr(place, name)
            # The drawn value, else that of the template.
            extent = template_extent(shape)
            if distribution is not None:
                stream = f"{place.key}.{k}.{name}" + (f".{round_number}" if round_number else "")
                extent = values.value(f"{place.key}.{name}", stream, distribution)
            lower, upper = np.array(place.region.min), np.array(place.region.max)
            d, is_box = len(lower), isinstance(extent, list)
            half, radius = (np.array(extent, float) / 2, 0.0) if is_box else (np.zeros(d), float(extent))
            volume = math.prod((2 * half).tolist()) if is_box else [math.pi, 4 / 3 * math.pi][d - 2] * radius**d
            wanted.append(Wanted(half, radius, volume, lower, upper, place.min_distance, numbers))
        try:
            centers = find_places(wanted, obstacles, walls)
            break
        except NoPlace as found:
            if farthest is None or found.placed > farthest[1]:
                farthest = (chosen[found.index][0], found.placed, wanted)
    else:
        assert farthest is not None
        index, placed, wanted = farthest
        there = [body for body, (of, _) in zip(wanted, chosen, strict=True) if of == index]
        place = placements[index]
        fill = sum(body.volume for body in there) / math.prod((there[0].upper - there[0].lower).tolist())
        measure = "area" if len(place.region.min) == 2 else "volume"
        raise PlacementError(
            str(values.sweep.path),
            index,
            f"trajectory {values.number}: at most {placed} of {len(wanted)} {place.list} found a place in "
            f'{ROUNDS * STARTS} starts of {TRIES} tries each; "{place.template}" takes {100 * fill:.3g} percent of the '
            f"{measure} of its region; place fewer or smaller {place.list}, with a smaller min_distance, or in a "
            "larger region",
        )
    result: list[list[dict[str, Any]]] = [[] for _ in placements]
    for (index, k), want, center in zip(chosen, wanted, centers, strict=True):
        place = placements[index]
        body: dict[str, Any] = {"name": f"{place.template}_{k}"}
        if want.radius:
            body |= {"center": center.tolist(), "radius": want.radius}
        else:
            # Round-off may carry a face out of the region.
            lower, upper = (np.clip(center + side * want.half, want.lower, want.upper) for side in (-1, 1))
            body |= {"min": lower.tolist(), "max": upper.tolist()}
        if place.velocity is not None:
            key = place.key
            body["velocity"] = copy.deepcopy(values.value(f"{key}.velocity", f"{key}.{k}.velocity", place.velocity))
        result[index].append(body)
    return result


def template_extent(shape: dict[str, Any]) -> Any:
    """Return the radius of a ball, or the edge lengths of a box, m, from its table."""
    if "ball" in shape:
        return shape["ball"]["radius"]
    return [high - low for low, high in zip(shape["box"]["min"], shape["box"]["max"], strict=True)]


def _obstacles(
    data: dict[str, Any], templates: set[tuple[str, str]], directory: Path
) -> tuple[list[RoundedBox], list[Distance]]:
    """Return bodies and colliders that stay, and distances of walls; validation of the scene reports faulty ones."""
    dimension = dimension_of(data)
    constants, _ = definitions(data.get("constants"), dimension)
    context = {"dimension": dimension, "constants": constants, "directory": directory}
    boxes: list[RoundedBox] = []
    walls: list[Distance] = []
    for body in data.get("bodies", []):
        if ("bodies", body["name"]) not in templates:
            with suppress(ValidationError, KeyError):
                boxes.append(rounded_box(BodyShape.model_validate(body["shape"], context=context).form))
    for table in data.get("colliders", []):
        if ("colliders", table["name"]) not in templates:
            with suppress(ValidationError):
                collider = Collider.model_validate(table, context=context)
                if isinstance(collider.form, Ball) and collider.side == "outside":
                    center = collider.motion.placed(np.array([collider.form.center]), 0.0)[0]
                    boxes.append(RoundedBox(center, np.zeros(len(center)), collider.form.radius))
                elif collider.side == "inside" or isinstance(collider.form, Plane):
                    walls.append(collider.signed_distance)
                else:
                    # A box with faces along the axes, about the bounding box at time 0.
                    placed = collider.motion.placed(box_corners(*collider.form.bounds()), 0.0)
                    boxes.append(_box(placed.min(axis=0), placed.max(axis=0)))
    return boxes, walls


@dataclass(frozen=True, eq=False)
class Draw:
    """One trajectory of a sweep, of the `split` "train", "valid" or "test" if rules on its particles do not matter.

    `values` are the drawn values as JSON: of each key of [vary], and under `place.NAME` (`place.colliders.NAME`) lists
    of placed `{name, min, max}` or `{name, center, radius}`, with `velocity` if drawn. `data` is the parsed TOML with
    these values; origins are indices of base entries; `source` names the scene in errors.
    """

    number: int
    split: str
    values: dict[str, Any]
    data: dict[str, Any]
    origins: tuple[int, ...]
    collider_origins: tuple[int, ...]
    source: str
    directory: Path

    def scene(self, laws: Laws) -> LoadedScene:
        """Return the complete scene; an InputError has one line per fault."""
        return parse_scene(self.data, laws=laws, source=self.source, directory=self.directory)


def draw(sweep: Sweep, number: int, given: Mapping[str, Any] = MappingProxyType({})) -> Draw:
    """Draw one trajectory, deterministically; PlacementError: bodies cannot be placed; ValueError: no such number.

    Random values depend on the seed, the number and their own key alone; Sobol and Latin values also on the set of
    continuous keys, Latin values on the count. Bodies and emitters with random sampling get their own seeds unless
    [vary] has them. A force on a template acts on each body that replaces it. `given` values replace drawn ones.
    """
    if not 0 <= number < sweep.count:
        raise ValueError(f"The sweep has trajectories 0 to {sweep.count - 1}; there is no trajectory {number}.")
    drawn = TrajectoryValues(sweep, number, given)
    data = copy.deepcopy(sweep.base_data)
    values: dict[str, Any] = {}
    varied: set[KeyPath] = set()
    for key, distribution in sweep.vary.items():
        values[key] = copy.deepcopy(drawn.value(key, key, distribution))
        varied.add(set_value(data, key_parts(key), copy.deepcopy(values[key])))
    origins, collider_origins = (tuple(range(len(data.get(name, [])))) for name in ("bodies", "colliders"))
    if sweep.placements:
        placed = list(zip(sweep.placements, place_bodies(drawn, data), strict=True))
        values |= {place.key: bodies for place, bodies in placed}
        origins, collider_origins = (
            _put_in_place(data, name, {place.template: bodies for place, bodies in placed if place.list == name})
            for name in ("bodies", "colliders")
        )
    for kind, places in (("bodies", origins), ("emitters", range(len(data.get("emitters", []))))):
        for source, origin in zip(data.get(kind, []), places, strict=True):
            if source.get("sampling") in ("jittered", "poisson") and (kind, origin, "seed") not in varied:
                source["seed"] = int(generator(sweep.seed, number, f"{kind}.{source['name']}.seed").integers(SEEDS))
    source, split = f"{sweep.path}: trajectory {number}", sweep.split_of(number)
    return Draw(number, split, values, data, origins, collider_origins, source, sweep.base.parent)


def _put_in_place(data: dict[str, Any], name: str, placed: dict[str, list[dict[str, Any]]]) -> tuple[int, ...]:
    """Replace every template of a list by its placed entries, and return the index of the base entry of each entry."""
    entries, origins = [], []
    for index, entry in enumerate(data.get(name, [])):
        for new in placed.get(entry["name"], [None]):
            made = copy.deepcopy(entry)
            if new is not None:
                keys = copy.deepcopy(new)
                form = {key: keys.pop(key) for key in ("min", "max", "center", "radius") if key in keys}
                made |= {**keys, "shape": {"ball" if "radius" in form else "box": form}}
            entries.append(made)
            origins.append(index)
    if entries or name in data:
        data[name] = entries
    if name == "bodies" and isinstance(data.get("forces"), list):
        data["forces"] = [
            force if new is None else {**force, "body": new["name"]}
            for force in data["forces"]
            for new in next((bodies for name, bodies in placed.items() if force.get("body") == name), [None])
        ]
    return tuple(origins)

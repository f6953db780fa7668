"""The bodies and colliders that a trajectory places: their number, extents and velocities, and then where they lie."""

import copy
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from mpmcli.dataset.placement import STARTS, TRIES, Distance, NoPlace, RoundedBox, Wanted, find_places, rounded_box
from mpmcli.dataset.sweep import Placement
from mpmcli.dataset.trajectory_values import TrajectoryValues
from mpmcli.errors import InputError
from mpmcli.scene.colliders import Collider, Plane
from mpmcli.scene.constants import definitions
from mpmcli.scene.primitives import Ball
from mpmcli.scene.quantity import dimension_of
from mpmcli.scene.shapes import BodyShape

# How often sizes and radii are drawn before a trajectory is given up.
ROUNDS = 10


class PlacementError(InputError):
    """The bodies of a trajectory have no place.

    Attributes:
        source: the sweep file.
        placement: index of the placement in the sweep.
        sentence: trajectory, what is wrong with it, and what to change.
    """

    def __init__(self, source: str, placement: int, sentence: str) -> None:
        super().__init__(source, placement, sentence)
        self.source = source
        self.placement = placement
        self.sentence = sentence

    def __str__(self) -> str:
        return f"{self.source}: {self.sentence}"


def place_bodies(values: TrajectoryValues, data: dict[str, Any]) -> list[list[dict[str, Any]]]:
    """Return for each placement its bodies: name, corners or centre and radius, and velocity where it is drawn.

    Bodies keep their size while they look for places. Where they find none, all sizes and radii are drawn anew, up
    to ROUNDS times: they follow their distributions given that the bodies fit.

    Args:
        values: of the trajectory.
        data: parsed TOML of the scene with its templates, which is not changed.

    Raises:
        PlacementError: the bodies find no place.
    """
    placements = values.sweep.placements
    templates = {place.key: _named(data, place) for place in placements}
    obstacles, walls = _obstacles(
        data, {(place.list, place.template) for place in placements}, values.sweep.base.parent
    )
    farthest: tuple[int, int, list[Wanted]] | None = None
    chosen: list[tuple[int, int]] = []
    for index, place in enumerate(placements):
        key = f"{place.key}.count"
        chosen += [(index, k) for k in range(1, values.value(key, key, place.count) + 1)]
    random = [values.generator(f"{placements[index].key}.{k}.position") for index, k in chosen]
    for round_number in range(ROUNDS):
        wanted = []
        for (index, k), generator in zip(chosen, random, strict=True):
            place = placements[index]
            half, radius = _extent(values, place, k, round_number, templates[place.key]["shape"])
            wanted.append(_wanted(place, half, radius, generator))
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
        sentence = _crowded(placements[index], there, placed, len(wanted))
        raise PlacementError(str(values.sweep.path), index, f"trajectory {values.number}: {sentence}")
    result: list[list[dict[str, Any]]] = [[] for _ in placements]
    for (index, k), want, center in zip(chosen, wanted, centers, strict=True):
        place = placements[index]
        body = {"name": f"{place.template}_{k}", **_shape_values(want, center)}
        if place.velocity is not None:
            key = place.key
            body["velocity"] = copy.deepcopy(values.value(f"{key}.velocity", f"{key}.{k}.velocity", place.velocity))
        result[index].append(body)
    return result


def _extent(
    values: TrajectoryValues, place: Placement, k: int, round_number: int, shape: dict[str, Any]
) -> tuple[np.ndarray, float]:
    """Return half the edge lengths (d,) and the radius of body k, m: what is drawn, else that of the template."""
    name = "radius" if "ball" in shape else "size"
    distribution = getattr(place, name)
    stream = f"{place.key}.{k}.{name}" + (f".{round_number}" if round_number else "")
    if distribution is None:
        drawn = template_extent(shape)
    else:
        drawn = values.value(f"{place.key}.{name}", stream, distribution)
    if name == "radius":
        return np.zeros(len(place.region.min)), float(drawn)
    return np.array(drawn, float) / 2, 0.0


def template_extent(shape: dict[str, Any]) -> Any:
    """Return the radius of a ball, or the edge lengths of a box, m, from its table."""
    if "ball" in shape:
        return shape["ball"]["radius"]
    return [high - low for low, high in zip(shape["box"]["min"], shape["box"]["max"], strict=True)]


def _wanted(place: Placement, half: np.ndarray, radius: float, generator: np.random.Generator) -> Wanted:
    d = len(half)
    volume = [math.pi, 4 / 3 * math.pi][d - 2] * radius**d if radius else math.prod((2 * half).tolist())
    lower, upper = np.array(place.region.min), np.array(place.region.max)
    return Wanted(half, radius, volume, lower, upper, place.min_distance, generator)


def _shape_values(want: Wanted, center: np.ndarray) -> dict[str, Any]:
    if want.radius:
        return {"center": center.tolist(), "radius": want.radius}
    # Round-off may carry a face out of the region.
    lower, upper = (np.clip(center + side * want.half, want.lower, want.upper) for side in (-1, 1))
    return {"min": lower.tolist(), "max": upper.tolist()}


def _named(data: dict[str, Any], place: Placement) -> dict[str, Any]:
    """Return the template of a placement."""
    return next(entry for entry in data[place.list] if entry["name"] == place.template)


def _obstacles(
    data: dict[str, Any], templates: set[tuple[str, str]], directory: Path
) -> tuple[list[RoundedBox], list[Distance]]:
    """Return the bodies and colliders that stay, and the signed distances of planes and containers.

    One that is faulty is left to the validation of the scene.
    """
    dimension = dimension_of(data)
    constants, _ = definitions(data.get("constants"), dimension)
    context = {"dimension": dimension, "constants": constants, "directory": directory}
    boxes: list[RoundedBox] = []
    walls: list[Distance] = []
    for body in data["bodies"]:
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
                    boxes.append(_box_about(collider))
    return boxes, walls


def _box_about(collider: Collider) -> RoundedBox:
    """Return the box with faces along the axes about the bounding box of a collider at time 0."""
    lower, upper = collider.form.bounds()
    d = len(lower)
    corners = np.array([[upper[a] if k >> a & 1 else lower[a] for a in range(d)] for k in range(2**d)])
    placed = collider.motion.placed(corners, 0.0)
    lower, upper = placed.min(axis=0), placed.max(axis=0)
    return RoundedBox((lower + upper) / 2, (upper - lower) / 2, 0.0)


def _crowded(place: Placement, there: list[Wanted], placed: int, total: int) -> str:
    """Say how far the placement came, and how full the region would be."""
    fill = sum(body.volume for body in there) / math.prod((there[0].upper - there[0].lower).tolist())
    measure = "area" if len(place.region.min) == 2 else "volume"
    return (
        f"at most {placed} of {total} {place.list} found a place in {ROUNDS * STARTS} starts of {TRIES} tries each; "
        f'"{place.template}" takes {100 * fill:.3g} percent of the {measure} of its region; '
        f"place fewer or smaller {place.list}, with a smaller min_distance, or in a larger region"
    )

"""One trajectory of a sweep: its values, and the scene with them."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path as File
from types import MappingProxyType
from typing import Any

from mpmcli.dataset.placed_bodies import place_bodies
from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.trajectory_values import TrajectoryValues
from mpmcli.dataset.unit_numbers import generator
from mpmcli.errors import InputError
from mpmcli.scene import LoadedScene, parse_scene
from mpmcli.scene.expand import Laws
from mpmcli.scene.overrides import key_parts, set_value
from mpmcli.scene.problem import Path

# Seeds of bodies that are sampled at random are below this, so that every format holds them exactly.
SEEDS = 2**53
_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Draw:
    """One trajectory of a sweep.

    Attributes:
        number: of the trajectory, from 0.
        split: "train", "valid" or "test".
        values: what was drawn, plain Python that JSON holds: the value of every key of [vary], and under `place.NAME`
            a list of the placed bodies, `{name, min, max}` or `{name, center, radius}`, with `velocity` where drawn;
            under `place.colliders.NAME` one of colliders.
        data: parsed TOML of the scene with all of it.
        origins: for each body of the scene, the index of the body of the base scene that it comes from;
            collider_origins: the same of colliders.
        source: what to call the scene in errors.
        directory: that of the base scene.
    """

    number: int
    split: str
    values: dict[str, Any]
    data: dict[str, Any]
    origins: tuple[int, ...]
    collider_origins: tuple[int, ...]
    source: str
    directory: File

    def scene(self, laws: Laws) -> LoadedScene:
        """Return the complete scene.

        Args:
            laws: parameter models of the constitutive laws that a material may follow.

        Raises:
            InputError: the values make no valid scene; one line per fault.
        """
        loaded = parse_scene(self.data, laws=laws, source=self.source, directory=self.directory)
        if loaded.scene.output.drop_retired:
            raise InputError(
                f"{self.source}: output.drop_retired: a trajectory of a dataset has the same particles in all frames; "
                "leave it out"
            )
        return loaded


def draw(sweep: Sweep, number: int, given: Mapping[str, Any] = _NOTHING) -> Draw:
    """Draw one trajectory; the same sweep and number always give the same.

    Values drawn at random depend on the seed, the number and their own key alone. Continuous ones of a Sobol
    sequence or a Latin hypercube also depend on which keys are continuous, and those of a hypercube on the count.
    Bodies that are sampled at random get a seed of their own, from the seed, the number and their name, unless [vary]
    has it. A force on a body that is replaced acts on each of those in its place.

    Args:
        sweep: from `sweep_file.load_sweep`.
        number: of the trajectory, from 0 to `sweep.count` - 1.
        given: values in place of drawn ones, by the keys of `sweep.distributions`.

    Raises:
        ValueError: there is no such trajectory.
        PlacementError: the bodies have no place in their regions.
    """
    if not 0 <= number < sweep.count:
        raise ValueError(f"The sweep has trajectories 0 to {sweep.count - 1}; there is no trajectory {number}.")
    drawn = TrajectoryValues(sweep, number, given)
    data = copy.deepcopy(sweep.base_data)
    values: dict[str, Any] = {}
    varied: set[Path] = set()
    for key, distribution in sweep.vary.items():
        values[key] = copy.deepcopy(drawn.value(key, key, distribution))
        varied.add(set_value(data, key_parts(key), copy.deepcopy(values[key])))
    origins, collider_origins = (tuple(range(len(data.get(name, [])))) for name in ("bodies", "colliders"))
    if sweep.placements:
        placed = place_bodies(drawn, data)
        values |= {place.key: bodies for place, bodies in zip(sweep.placements, placed, strict=True)}
        new = list(zip(sweep.placements, placed, strict=True))
        origins, collider_origins = (
            _put_in_place(data, name, {p.template: made for p, made in new if p.list == name})
            for name in ("bodies", "colliders")
        )
    for body, origin in zip(data["bodies"], origins, strict=True):
        if body.get("sampling") in ("jittered", "poisson") and ("bodies", origin, "seed") not in varied:
            body["seed"] = int(generator(sweep.seed, number, f"bodies.{body['name']}.seed").integers(SEEDS))
    source = f"{sweep.path}: trajectory {number}"
    directory = sweep.base.parent
    return Draw(number, sweep.split_of(number), values, data, origins, collider_origins, source, directory)


def _put_in_place(data: dict[str, Any], name: str, placed: dict[str, list[dict[str, Any]]]) -> tuple[int, ...]:
    """Replace every template of a list by what is placed, and return the index of the base entry of each entry."""
    entries, origins = [], []
    for index, entry in enumerate(data.get(name, [])):
        for new in placed.get(entry["name"], [None]):
            entries.append(entry if new is None else _entry_from(entry, new))
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


def _entry_from(template: dict[str, Any], placed: dict[str, Any]) -> dict[str, Any]:
    placed = copy.deepcopy(placed)
    form = {key: placed.pop(key) for key in ("min", "max", "center", "radius") if key in placed}
    return {**copy.deepcopy(template), **placed, "shape": {"ball" if "radius" in form else "box": form}}

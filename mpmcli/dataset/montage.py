"""A montage of a dataset: one frame from each of several trajectories, drawn as the frames of one run."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.dataset.dataset import Dataset, Trajectory, open_dataset
from mpmcli.dataset.report import MONTAGE, number_text
from mpmcli.dataset.trajectory_frames import TrajectoryFrames
from mpmcli.errors import InputError
from mpmcli.output.header import BodyHeader
from mpmcli.render.frame_choice import evenly_spaced
from mpmcli.render.render_scene import appearance_of
from mpmcli.render.request import RenderPlan, Request, plan_render
from mpmcli.render.settings import parse_grid


def plan_montage(path: Path, request: Request) -> RenderPlan:
    """Plan a montage of evenly spaced trajectories, each at one frame; InputError: the request is impossible.

    `frames` of the request is N, "first" or "last" for all, None for the middle one of each.
    """
    if request.montage is None or request.movie is not None or request.save_surface is not None:
        raise InputError(
            f"{path} is a dataset, of which --montage 4x4 draws sixteen trajectories in one picture; "
            "`mpmcli export --to vtkhdf --trajectory N` makes a result of one, for pictures and films."
        )
    dataset = open_dataset(path)
    columns, rows = parse_grid(request.montage)
    numbers = evenly_spaced(dataset.numbers, columns * rows)
    cells = TrajectoryCells(dataset, numbers, request.frames)
    # No empty cells, except in the last row.
    columns = min(columns, len(numbers))
    grid, output = f"{columns}x{-(-len(numbers) // columns)}", request.output or path / MONTAGE
    plan = plan_render(cells, replace(request, frames=None, montage=grid, output=output), cells.captions)
    return replace(plan, notes=(dataset.lack,) if dataset.lack else ())


class TrajectoryCells(TrajectoryFrames):
    """One frame from each of several trajectories, as the frames of one run with the bodies of all.

    They share camera, scale and colours. The domain is the box around all.
    """

    def __init__(self, dataset: Dataset, numbers: Sequence[int], frame: str | None) -> None:
        """Choose the frame of each trajectory, and join their headers. Raises InputError if dimensions differ."""
        trajectories = [dataset[number] for number in numbers]
        headers = [each.header for each in trajectories]
        first = headers[0]
        if any(header.dimension != first.dimension or header.origin is None for header in headers):
            raise InputError(f"{dataset.path} has trajectories of 2 and 3 dimensions, or without a domain.")
        super().__init__(dataset.path, [(each, _position(frame, each)) for each in trajectories], numbers)
        self._first_bodies = np.cumsum([0, *(len(header.bodies) for header in headers)])
        self.captions = _captions(trajectories)
        self.collider_frames = tuple(each.number for each in trajectories for _ in each.colliders)
        title = f"{first.title}, t = {number_text(self.times[0])} s" if np.ptp(self.times) == 0 else first.title
        scenes = [header.stored.get("scene", "") for header in headers]
        alike: dict[str, Any] = {}
        bodies: list[BodyHeader] = []
        for header in headers:
            # The particle distance refers to the first grid, whatever the spacing of this one.
            finer = (first.spacing / header.spacing) ** header.dimension
            for body in header.bodies:
                name = appearance_of(body.material.get("law", "material"), dict(body.material)).name
                material = alike.setdefault(name, body.material)
                own = {"particles_per_cell": body.particles_per_cell * finer, "own_density": body.density}
                bodies.append(_Body(body.name, material, body.volume, **own))
        self.header = replace(
            first,
            # A change of this value causes pictures to be drawn again.
            stored={**first.stored, "scene": json.dumps([title, *self.captions, *scenes])},
            title=title,
            origin=np.min([header.origin for header in headers], axis=0),
            upper=np.max([header.upper for header in headers], axis=0),
            bodies=tuple(bodies),
        )

    def _read(self, k: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Return arrays of the frame of trajectory k, in which bodies are numbered through all trajectories."""
        stored = super()._read(k, names)
        if "body" in stored:
            stored["body"] = stored["body"] + self._first_bodies[k].astype(np.int32)
        return stored


@dataclass(frozen=True)
class _Body(BodyHeader):
    """A body with the material of the first one of the same appearance, and its own density, kg/m^3."""

    own_density: float | None = None

    @property
    def density(self) -> float | None:
        return self.own_density


def _position(frame: str | None, trajectory: Trajectory) -> int:
    """Return the index of the frame named by a text in a trajectory."""
    count = trajectory.frame_count
    named = {None: count // 2, "first": 0, "last": count - 1}
    if frame in named:
        return named[frame]
    try:
        number = int(frame)
    except ValueError:
        raise InputError(f'--frame "{frame}" is no frame of every trajectory: give a number, first or last.') from None
    if not -count <= number < count:
        raise InputError(f"--frame {number}: trajectory {trajectory.number} holds frames 0 to {count - 1}.")
    return number % count


def _captions(trajectories: Sequence[Trajectory]) -> tuple[str, ...]:
    """Return the number of each trajectory and those drawn values in which the trajectories differ."""
    # Placed bodies are lists, which are too long.
    draws = [
        {key: value for key, value in each.draws.items() if not isinstance(value, list | dict)} for each in trajectories
    ]
    keys = list(dict.fromkeys(key for values in draws for key in values))
    varying = [key for key in keys if any(values.get(key) != draws[0].get(key) for values in draws)]
    captions = []
    for each, values in zip(trajectories, draws, strict=True):
        texts = [f"{_name(key)} {_text(values[key])}" for key in varying if key in values]
        captions.append(f"{each.number}: {', '.join(texts)}" if texts else str(each.number))
    return tuple(captions)


def _name(key: str) -> str:
    parts = key.split(".")
    return ".".join(parts[-2:] if parts[-1].isdecimal() else parts[-1:]).replace("_", " ")


def _text(value: Any) -> str:
    return number_text(value) if isinstance(value, int | float) and not isinstance(value, bool) else str(value)

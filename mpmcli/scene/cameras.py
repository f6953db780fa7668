"""Cameras of a scene: where they are, what they look at, and how large their images are."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo, model_validator

from mpmcli.scene.entry import Entry, OfTime, value_of
from mpmcli.scene.primitives import unit
from mpmcli.scene.problem import Problem
from mpmcli.scene.quantity import (
    NAME,
    Axis,
    Integer,
    NotNegative,
    Number,
    Positive,
    Table,
    flaw,
    list_of_axes,
    scene_dimension,
)

# Limits of the pixels along a side.
FEWEST_PIXELS, MOST_PIXELS = 16, 8192
# Vertical angle of view by default, degrees.
USUAL_FOV = 40.0
# Angle by which the directions of a dome turn from one to the next, rad (Fibonacci lattice).
GOLDEN = math.pi * (3 - math.sqrt(5))


def _of_pixels(size: tuple[int, ...]) -> tuple[int, ...]:
    if not all(FEWEST_PIXELS <= n <= MOST_PIXELS for n in size):
        raise flaw(f"must be two numbers of pixels from {FEWEST_PIXELS} to {MOST_PIXELS}; found {list(size)}")
    return size


Size = Annotated[tuple[Integer, Integer], AfterValidator(_of_pixels)]
Place = list_of_axes(Number)
MovingPlace = list_of_axes(OfTime)


class CameraKey(Table):
    """Position and target of a camera at a time."""

    time: NotNegative = Field(description="s.")
    position: Place = Field(description="m.")
    target: Place | None = Field(None, description="m. Default: that of the camera.")


class Ring(Table):
    """Cameras at equal angles on a circle about the upward axis."""

    count: Integer = Field(ge=1, le=1000, description="Number of cameras.")
    radius: Positive = Field(description="Radius of the circle, m.")
    height: Number = Field(0.0, description="Height of the circle above the target, m.")


class Dome(Table):
    """Cameras spread evenly over the upper half of a sphere about the target."""

    count: Integer = Field(ge=1, le=1000, description="Number of cameras.")
    radius: Positive = Field(description="Radius of the sphere, m.")


class Camera(Table):
    """A camera, or the cameras of a ring or a dome: pinhole in 3D, orthographic in 2D."""

    name: str = Field("camera", pattern=NAME, description="Name; those of a ring or a dome are numbered.")
    position: MovingPlace | None = Field(
        None, description="Position in 3D, m; numbers, or expressions of the time t. Or give path, ring or dome."
    )
    target: MovingPlace | None = Field(
        None,
        description="Point in the middle of the image, m; numbers, or expressions of t. Default: the middle of the "
        "domain.",
    )
    up: Axis = Field(None, description="Upward direction in 3D. Default: against gravity, or along z.")
    fov: float | None = Field(
        None, strict=True, gt=0, lt=170, description=f"Vertical angle of view in 3D, degrees. Default: {USUAL_FOV:g}."
    )
    focal: Positive | None = Field(None, description="Focal length in 3D, pixels, in place of fov.")
    height: Positive | None = Field(
        None, description="Height of the part of the plane in the image of a 2D scene, m. Default: all of the domain."
    )
    size: Size = Field((256, 256), description="Width and height of the image, pixels.")
    path: tuple[CameraKey, ...] = Field(
        (), description="Positions and targets at some times, in place of a position; linear between them."
    )
    ring: Ring | None = Field(None, description="Cameras on a circle, in place of a position.")
    dome: Dome | None = Field(None, description="Cameras on the upper half of a sphere, in place of a position.")

    @model_validator(mode="after")
    def _one_place(self, info: ValidationInfo) -> "Camera":
        """Refuse keys of the other dimension, and places given in two ways or in none."""
        dimension = scene_dimension(info)
        ways = [key for key in ("position", "path", "ring", "dome") if getattr(self, key)]
        if dimension == 2:
            for key in (*ways, "up", "fov", "focal"):
                if getattr(self, key) not in (None, ()):
                    raise flaw("is for scenes in 3D; the camera of a 2D scene has target and height", key)
            return self
        if self.height is not None:
            raise flaw("is for scenes in 2D; give fov or focal", "height")
        if len(ways) != 1:
            said = (
                f'"{ways[0]}" is given as well; leave one of them out' if ways else "missing key, or path, ring, dome"
            )
            raise flaw(said, ways[1] if ways else "position")
        if None not in (self.fov, self.focal):
            raise flaw('"fov" is given as well; leave one of them out', "focal")
        if any(b.time <= a.time for a, b in pairwise(self.path)):
            raise flaw("must have times that rise from each to the next", "path")
        return self


@dataclass(frozen=True)
class PlacedCamera:
    """One camera; lengths in m, everything in three dimensions, z = 0 in the plane of a 2D scene."""

    name: str
    size: tuple[int, int]  # width and height, pixels
    up: tuple[float, ...]  # (3,)
    focal: float | None  # pixels; None for an orthographic camera
    height: float | None  # of what an orthographic image shows, m
    target: tuple[Entry, ...]  # (3,)
    position: tuple[Entry, ...] | None = None  # (3,); None: `offset` from the target
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    path: tuple[CameraKey, ...] = ()

    def pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and target, (3,) each, m, at a time, s."""
        target = self._at("target", self.target, time)
        if self.position is None:
            return target + self.offset, target
        return self._at("position", self.position, time), target

    def _at(self, key: str, entries: tuple[Entry, ...], time: float) -> np.ndarray:
        keys = [(one.time, value) for one in self.path if (value := getattr(one, key)) is not None]
        if not keys:
            return np.array([float(value_of(entry, t=time)) for entry in entries])
        times, values = zip(*keys, strict=True)
        return np.array([np.interp(time, times, column) for column in zip(*values, strict=True)])


def placed_cameras(
    cameras: Sequence[Camera], lower: Sequence[float], upper: Sequence[float], up: Sequence[float]
) -> list[PlacedCamera]:
    """Return each camera of a domain, corners (3,), m, whose upward direction is `up`, (3,); names are unique."""
    found = [one for camera in cameras for one in _placed(camera, np.array(lower), np.array(upper), np.array(up))]
    names = [one.name for one in found]
    return [one if names.count(one.name) == 1 else replace(one, name=f"{one.name}_{k}") for k, one in enumerate(found)]


def camera_problems(cameras: Sequence[Camera], end: float) -> Iterator[Problem]:
    """Yield the problems of cameras of a run until `end`, s."""
    for k, camera in enumerate(cameras):
        times = [key.time for key in camera.path]
        if times and not (times[0] == 0 and times[-1] >= end):
            said = f"must cover the run, from 0 to {end:g} s; found {times[0]:g} to {times[-1]:g} s"
            yield Problem(("cameras", k, "path"), said)
        if camera.target is not None and camera.position == camera.target:
            yield Problem(("cameras", k, "target"), "must not be the position")


def _placed(camera: Camera, lower: np.ndarray, upper: np.ndarray, up: np.ndarray) -> Iterator[PlacedCamera]:
    """Yield the cameras of a table; see `placed_cameras`."""
    middle = tuple((0.5 * (lower + upper)).tolist())
    width, height = camera.size
    target = middle if camera.target is None else (*camera.target, 0.0)[:3]
    common: dict[str, Any] = {"name": camera.name, "size": camera.size, "target": target}
    if not (camera.position or camera.path or camera.ring or camera.dome):
        extent = upper - lower
        shown = camera.height or float(max(extent[1], extent[0] * height / width))
        above = (*target[:2], float(extent.max()))
        yield PlacedCamera(**common, up=(0.0, 1.0, 0.0), focal=None, height=shown, position=above)
        return
    up = up if camera.up is None else unit(camera.up)
    focal = camera.focal or 0.5 * height / math.tan(math.radians(0.5 * (camera.fov or USUAL_FOV)))
    common |= {"up": tuple(up.tolist()), "focal": focal, "height": None}
    if camera.position or camera.path:
        position = camera.position or camera.path[0].position
        yield PlacedCamera(**common, position=position, path=camera.path)
        return
    # Two directions across the upward one.
    across = unit(np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))]))
    beside = np.cross(up, across)
    several = camera.ring or camera.dome
    for k in range(several.count):
        if camera.ring:
            angle, rise, radius = 2 * math.pi * k / several.count, camera.ring.height, several.radius
        else:
            angle, rise = GOLDEN * k, several.radius * (k + 0.5) / several.count
            radius = math.sqrt(several.radius**2 - rise**2)
        away = radius * (math.cos(angle) * across + math.sin(angle) * beside) + rise * up
        yield PlacedCamera(**{**common, "name": f"{camera.name}_{k}"}, offset=tuple(away.tolist()))

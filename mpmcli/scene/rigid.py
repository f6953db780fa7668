"""Rigid bodies: colliders with a density, whose motion follows from the forces on them."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationInfo, model_validator

from mpmcli.scene.entry import OfTime
from mpmcli.scene.primitives import grid_points, unit
from mpmcli.scene.quantity import AXES, Number, Positive, Table, Vector, direction_as, flaw, scene_dimension
from mpmcli.scene.shapes import Form

# Cells along the longest side of a form over which its moments are summed, in 2D and 3D.
CELLS = {2: 512, 3: 96}


@dataclass(frozen=True)
class Moments:
    """The mass of a rigid body, kg (per metre of depth in 2D), its centre, m, and its inertia about that, kg m^2."""

    mass: float
    center: tuple[float, ...]
    inertia: np.ndarray  # (1, 1) in 2D, (3, 3) in 3D

    def kinetic(self, pose: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """Return the kinetic energy, J, (n,), of poses and rates (n, k) as in `LedgerRow`."""
        d = len(self.center)
        velocity, spin = motion[:, :d], motion[:, d:]
        if d == 3:
            spin = np.einsum("nba,nb->na", turned_by(pose[:, d:]), spin)
        return 0.5 * (self.mass * (velocity**2).sum(axis=1) + np.einsum("na,ab,nb->n", spin, self.inertia, spin))


def moments_of(form: Form, density: float | None, mass: float | None) -> Moments:
    """Return the moments of a form with a density, kg/m^3, or else a mass, kg.

    They are sums over cells; cells at the surface count in part.
    """
    lower, upper = (np.array(corner, float) for corner in form.bounds())
    d = len(lower)
    counts = np.ceil((upper - lower) / (upper - lower).max() * CELLS[d]).astype(int)
    size = (upper - lower) / counts
    axes = [lower[a] + size[a] * (np.arange(counts[a]) + 0.5) for a in range(d)]
    x = grid_points(*axes)
    masses = math.prod(size) * np.clip(0.5 - form.signed_distance(x) / size.min(), 0.0, 1.0)
    masses *= mass / masses.sum() if density is None else density
    mass = float(masses.sum())
    center = masses @ x / mass
    second = (masses[:, None] * (x - center)).T @ (x - center) + np.diag(mass * size**2 / 12)
    inertia = np.array([[np.trace(second)]]) if d == 2 else np.trace(second) * np.eye(3) - second
    return Moments(mass, tuple(center.tolist()), inertia)


def _has_direction(axis: Any, info: ValidationInfo) -> Any:
    if axis is not None and scene_dimension(info) == 2:
        raise flaw("is for 3D scenes and this one is 2D, where colliders turn in their plane; leave it out")
    if isinstance(axis, list | tuple) and not any(axis):
        raise flaw("must have a direction, as [0, 0, 1] has; found zeros")
    return axis


# Axis of rotation; None in 2D.
SpinAxis = Annotated[tuple[Number, Number, Number] | None, BeforeValidator(_has_direction)]
Z = (0.0, 0.0, 1.0)


class _Joint(Table):
    """A joint that leaves a rigid body one degree of freedom, which a motor may drive."""

    motor: OfTime | None = Field(
        None, description="Rate that a motor keeps, rad/s or m/s: a number, or an expression of t. Default: no motor."
    )
    strength: Positive | None = Field(
        None, description="Largest torque of the motor, N m, or its largest force, N. Default: no limit."
    )

    @model_validator(mode="after")
    def _strength_is_that_of_a_motor(self) -> "_Joint":
        if self.strength is not None and self.motor is None:
            raise flaw('is that of a motor; give "motor" as well', "strength")
        return self


class Hinge(_Joint):
    """A hinge: a rigid body rotates about its axis."""

    type: Literal["hinge"]
    point: Vector | None = Field(None, description="Point of the axis, m. Default: the centre of mass.")
    axis: SpinAxis = Field(None, description="Direction of the axis; 3D only. Default: [0, 0, 1].")

    def way(self, arm: np.ndarray) -> np.ndarray:
        """Return velocity and spin, (k,), at a rate of 1, of a body whose centre is at an arm (d,) from the point."""
        axis = unit(self.axis or Z)
        around = np.cross(axis, np.pad(arm, (0, 3 - len(arm))))
        return np.concatenate([around[: len(arm)], axis[2:] if len(arm) == 2 else axis])


class Slider(_Joint):
    """A slider: a rigid body moves along it without rotation."""

    type: Literal["slider"]
    axis: direction_as("[0, 1] has in 2D") = Field(description="Direction to move along, of any length.")

    def way(self, arm: np.ndarray) -> np.ndarray:
        """Return velocity and spin, (k,), at a rate of 1."""
        return np.concatenate([unit(self.axis), np.zeros(2 * len(arm) - 3)])


Joint = Annotated[Hinge | Slider, Field(discriminator="type")]
# Parts of a motion that may be fixed.
Fixed = Literal["x", "y", "z", "rotation"]


def ways_of(dimension: int, fixed: tuple[str, ...]) -> np.ndarray:
    """Return the velocity and spin at unit rate of each degree of freedom that is not fixed, in columns."""
    turns = 2 * dimension - 3
    left = [a for a in range(dimension) if AXES[a] not in fixed]
    left += [] if "rotation" in fixed else range(dimension, dimension + turns)
    return np.eye(dimension + turns)[:, left]


def turned_by(rotation: np.ndarray) -> np.ndarray:
    """Return rotations (n, d, d) from angles (n, 1) or unit quaternions (n, 4), the real part first."""
    if rotation.shape[1] == 1:
        c, s = np.cos(rotation[:, 0]), np.sin(rotation[:, 0])
        return np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
    w, v = rotation[:, :1, None], rotation[:, 1:]
    cross = np.zeros((len(v), 3, 3))
    for a in range(3):
        cross[:, a - 2, a - 1], cross[:, a - 1, a - 2] = -v[:, a], v[:, a]
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


class Posed:
    """A motion with a pivot, (d,), m, and at each time a pose: the position of the pivot, and a rotation."""

    def placed(self, points: np.ndarray, time: float) -> np.ndarray:
        """Return the positions at a time, s, of points (n, d) given at the start, without offset."""
        place, turned = self.pose(time)
        return place + (points - np.array(self.pivot)) @ turned.T

    def taken_back(self, points: np.ndarray, time: float) -> np.ndarray:
        """Inverse of `placed`: return the start of points (n, d)."""
        place, turned = self.pose(time)
        return np.array(self.pivot) + (points - place) @ turned


@dataclass(frozen=True, eq=False)
class Path(Posed):
    """The computed motion of a rigid body, in place of a `Motion`: its pose at the times of some frames.

    Between frames the pose is that of the nearest frame.
    """

    pivot: tuple[float, ...]  # its centre at the start, (d,), m
    times: np.ndarray  # (n,), s
    places: np.ndarray  # of the centre, (n, d), m
    rotations: np.ndarray  # (n, d, d)
    moves = turns = True
    angle = 0.0

    @staticmethod
    def start(pivot: tuple[float, ...]) -> "Path":
        """Return the path of a body before it moves."""
        return Path(pivot, np.zeros(1), np.array([pivot]), np.eye(len(pivot))[None])

    @property
    def offset(self) -> tuple[float, ...]:
        """At the start."""
        return (0.0,) * len(self.pivot)

    def pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return where the centre is, (d,), m, and the rotation, (d, d), at a time, s."""
        k = int(np.abs(self.times - time).argmin())
        return self.places[k], self.rotations[k]

"""Colliders: rigid obstacles, at rest, with prescribed motion, or moving freely."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, PrivateAttr, ValidationInfo, model_validator

from mpmcli.scene.domain import Domain
from mpmcli.scene.entry import Entry, OfTime, TimeVector, tree_of, varies
from mpmcli.scene.expression import Apply, Expression, Name, Tree, apply, derivative, evaluate
from mpmcli.scene.expression import Number as Constant
from mpmcli.scene.primitives import rotation, unit
from mpmcli.scene.problem import written
from mpmcli.scene.quadrature import integral_of, largest_of
from mpmcli.scene.quantity import (
    NAME,
    NotNegative,
    Number,
    Positive,
    Table,
    Vector,
    direction_as,
    flaw,
    list_of_axes,
    scene_dimension,
)
from mpmcli.scene.rigid import Fixed, Hinge, Joint, Moments, Path, Posed, SpinAxis, Z, moments_of, turned_by, ways_of
from mpmcli.scene.shapes import Form, Shape, exactly_one_form

TIME = Name("t")
# Number of parts that are searched for jumps separately, so that two jumps do not cancel.
PIECES = 8
# The functions that jump where their arguments do not; conditions do only in a choice.
JUMPS = {"floor", "ceil", "sign", "step", "if", "%", "/", "**", "pow", "tan", "atan2"}


@dataclass(frozen=True)
class Motion(Posed):
    """The motion of a rigid body about a pivot that moves with it.

    A point that starts at X is at pivot + offset + R(angle) (X - pivot), R the rotation about a fixed axis.
    """

    pivot: tuple[float, ...]  # at the start, before `offset`, (d,), m
    axis: tuple[float, ...]  # of rotation, a unit vector, (3,); z in 2D
    offset: tuple[float, ...]  # at time 0, (d,), m
    angle: float  # at time 0, rad
    velocity: tuple[Tree, ...]  # of the pivot, m/s, one tree of t per axis
    spin: Tree  # rate of the angle, rad/s

    @property
    def rates(self) -> tuple[Tree, ...]:
        """Velocity and spin, d + 1 trees."""
        return (*self.velocity, self.spin)

    @property
    def moves(self) -> bool:
        """Whether anything changes with time."""
        return any(tree != Constant(0.0) for tree in self.rates)

    @property
    def turns(self) -> bool:
        """Whether the angle changes with time."""
        return self.spin != Constant(0.0)

    def at(self, time: float) -> tuple[np.ndarray, float]:
        """Return the offset, (d,), m, and the angle, rad, at a time, s."""
        gone = [integral_of(tree, 0.0, time) for tree in self.rates]
        return np.array(self.offset) + gone[:-1], self.angle + gone[-1]

    def pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return where the pivot is, (d,), m, and the rotation, (d, d), at a time, s."""
        offset, angle = self.at(time)
        d = len(self.pivot)
        return np.array(self.pivot) + offset, rotation(self.axis, angle)[:d, :d]

    def poses(self, times: Sequence[float]) -> np.ndarray:
        """Return place of the pivot, m, and angle, rad, or unit quaternion, real part first, (T, 3) or (T, 7)."""
        found = [(np.array(self.pivot) + offset, angle) for offset, angle in map(self.at, times)]
        if len(self.pivot) == 2:
            return np.array([[*place, angle] for place, angle in found])
        turns = [(math.cos(angle / 2), *(math.sin(angle / 2) * np.array(self.axis))) for _, angle in found]
        return np.array([[*place, *turn] for (place, _), turn in zip(found, turns, strict=True)])

    def fastest(self, reach: float, end: float) -> float:
        """Return a bound on the speed of points within `reach` (m) of the pivot between 0 and `end` (s), m/s."""
        speeds = [largest_of(tree, 0.0, end) for tree in self.rates]
        turning = speeds[-1] * reach if speeds[-1] > 0 else 0.0
        return math.hypot(*speeds[:-1]) + turning


def between_keys(times: Sequence[float], values: Sequence[float]) -> Tree:
    """Return the slope of the linear interpolation of values at rising times, constant before and after; a tree."""
    result: Tree = Constant(0.0)
    for (t0, v0), (t1, v1) in reversed(list(pairwise(zip(times, values, strict=True)))):
        result = apply("if", apply("<", TIME, Constant(t1)), Constant((v1 - v0) / (t1 - t0)), result)
    if times[0] > 0 and len(times) > 1:
        result = apply("if", apply("<", TIME, Constant(times[0])), Constant(0.0), result)
    return result


def has_jump(tree: Tree, slope: Tree, end: float) -> bool:
    """Return whether a tree of t jumps between 0 and `end` (s): whether it differs from the integral of its slope."""
    if not {node.function for node in getattr(tree, "order", ()) if isinstance(node, Apply)} & JUMPS:
        return False
    times = np.linspace(0.0, end, PIECES + 1)
    values = [float(evaluate(tree, {"t": time})) for time in times]
    scale = max(largest_of(tree, 0.0, end), 1e-12)
    return any(
        not abs(v1 - v0 - integral_of(slope, t0, t1)) <= 1e-6 * scale
        for (t0, t1), (v0, v1) in zip(pairwise(times.tolist()), pairwise(values), strict=True)
    )


Normal = direction_as("[0, 1] has in 2D")
# Boundary condition of a surface, as for walls of the domain.
SurfaceWord = Literal["slip", "stick", "separate", "hold"]
ZERO = Constant(0.0)


class Plane(Table):
    """A half space: all points behind a plane."""

    point: Vector = Field(description="A point of the plane, m.")
    normal: Normal = Field(description="Direction out of the collider, into the material, of any length.")

    @property
    def direction(self) -> np.ndarray:
        """The normal as a unit vector, (d,)."""
        return unit(self.normal)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, d) from the plane, (n,), m; negative behind it."""
        return (points - np.array(self.point)) @ self.direction


class ColliderShape(Shape):
    """The shape of a collider: one of the forms of bodies, or a plane."""

    plane: Plane | None = Field(None, description="A half space: all points behind a plane.")

    @model_validator(mode="after")
    def _plane_has_its_normal(self) -> "ColliderShape":
        if self.plane and self.rotation is not None:
            raise flaw("has a normal; leave rotation out", "plane")
        if self.plane and (self.add or self.subtract):
            raise flaw("is a shape alone; leave add and subtract out, or give a box or a polygon", "plane")
        return self


OneColliderShape = Annotated[
    ColliderShape, AfterValidator(exactly_one_form), Field(json_schema_extra={"minProperties": 1})
]


def _of_one_axis(value: Any, info: ValidationInfo) -> Any:
    if not isinstance(value, list | tuple):
        return value
    about = "colliders turn in their plane in this 2D scene"
    if scene_dimension(info) == 3:
        about = "that about the key axis, such as axis = [0, 0, 1]"
    raise flaw(f"must be one number or expression: {about}; found {written(value)}")


# An angle, or a rate of rotation.
Turn = Annotated[OfTime, BeforeValidator(_of_one_axis)]


class Keyframe(Table):
    """Position and angle of a collider at a time."""

    time: NotNegative = Field(description="s.")
    offset: Vector = Field(
        None, validate_default=True, description="Offset from the place of its shape, m. Default: zeros."
    )
    angle: Number = Field(0.0, description="Angle that it is turned by, rad.")


class Collider(Table):
    """A rigid obstacle."""

    name: str = Field(pattern=NAME, description="Name of the collider, for messages and --set.")
    shape: OneColliderShape = Field(description="Shape: a form, as of bodies, or a plane.")
    side: Literal["outside", "inside"] = Field(
        "outside", description="Side of the material: outside the shape, or inside, as in a container."
    )
    wall: SurfaceWord = Field(
        "separate",
        description="Condition at its surface: slip, stick or separate; hold: material inside moves with it.",
    )
    friction: NotNegative = Field(0.0, description="Coefficient of friction, unless it sticks.")
    axes: tuple[Literal["x", "y", "z"], ...] | None = Field(
        None, description='With wall = "hold": the axes along which it holds. Default: all of them.'
    )
    velocity: TimeVector = Field(
        None,
        validate_default=True,
        description="Velocity, m/s; numbers, or expressions of the time t (s). Default: at rest.",
    )
    angular_velocity: Turn = Field(0.0, description="Rate of rotation about its axis, rad/s.")
    offset: list_of_axes(OfTime) | None = Field(
        None, description="Offset from where its shape stands, m, in place of the velocity. Default: none."
    )
    angle: Turn | None = Field(
        None, description="Angle that it is turned by, rad, in place of the rate. Default: none."
    )
    keyframes: tuple[Keyframe, ...] = Field(
        (), description="Offsets and angles at some times, in place of all these; linear between them."
    )
    axis: SpinAxis = Field(None, description="Direction of the axis that it turns about; 3D only. Default: [0, 0, 1].")
    pivot: Vector | None = Field(
        None, description="Point of the axis, m; it moves along. Default: the centre of the shape."
    )
    density: Positive | None = Field(
        None,
        description="Density, kg/m^3, of a free collider, whose velocity and angular_velocity are initial values. "
        "Default: prescribed motion.",
    )
    mass: Positive | None = Field(
        None, description="Mass, kg (2D: per metre of depth), in place of the density. Default: that of the density."
    )
    restitution: float = Field(
        0.0,
        strict=True,
        ge=0,
        le=1,
        description="Coefficient of restitution, 0 to 1, where rigid bodies meet; of two the larger one counts.",
    )
    fixed: tuple[Fixed, ...] = Field(
        (), description='Motions that a free collider cannot make: along "x", "y" or "z", or "rotation". Default: none.'
    )
    joint: Joint | None = Field(None, description="Joint between a free collider and the world: a hinge or a slider.")
    _path: Path | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _one_way_to_move(self) -> "Collider":
        """Refuse a motion given in two ways, and keys that do not apply to the surface or to a free body."""
        for key, other in (("offset", "velocity"), ("angle", "angular_velocity")):
            if getattr(self, key) is not None and self._gives(other):
                raise flaw(f'"{other}" is given as well; leave one of them out', key)
        others = [key for key in ("velocity", "angular_velocity", "offset", "angle") if self._gives(key)]
        if self.keyframes and others:
            raise flaw(f'"{others[0]}" is given as well; leave one of them out', "keyframes")
        times = [key.time for key in self.keyframes]
        if any(b <= a for a, b in pairwise(times)):
            raise flaw("must have times that rise from each to the next", "keyframes")
        if self.wall in ("stick", "hold") and self.friction > 0:
            raise flaw(f'is for a surface that slips or separates, and wall is "{self.wall}"; leave it out', "friction")
        if self.axes is not None and not self.holds:
            raise flaw(f'is for wall = "hold", and wall is "{self.wall}"; leave it out', "axes")
        if self.axes is not None and (not self.axes or (len(self.velocity) == 2 and "z" in self.axes)):
            raise flaw(
                f"must be some of {'x, y' if len(self.velocity) == 2 else 'x, y, z'}; found {list(self.axes)}", "axes"
            )
        if self.holds and (self.free or self.side == "inside"):
            raise flaw('is "hold", which is for the inside of a shape that moves as the scene says', "wall")
        if self.free:
            self._require_free()
        elif self.fixed or self.joint:
            raise flaw("is for one that moves freely; give its density or mass", "fixed" if self.fixed else "joint")
        return self

    def _require_free(self) -> None:
        """Refuse keys that a free rigid body cannot have."""
        given = "mass" if self.density is None else "density"
        if None not in (self.density, self.mass):
            raise flaw('"density" is given as well; leave one of them out', "mass")
        for key in ("offset", "angle", "keyframes", "pivot"):
            if getattr(self, key):
                raise flaw(f"is for a collider that moves as the scene says, and {given} lets it move freely", key)
        if isinstance(self.form, Plane) or self.side == "inside":
            raise flaw("is for a shape with the material outside of it; leave it out", given)
        if varies(*self.velocity, self.angular_velocity):
            key = "velocity" if varies(*self.velocity) else "angular_velocity"
            raise flaw(f"must be a number, that at the start, where {given} lets it move freely", key)
        # An initial motion that the joint or the fixed axes do not allow.
        d, hinged = len(self.velocity), isinstance(self.joint, Hinge)
        if self.fixed and (self.joint or not ways_of(d, self.fixed).size):
            both = '"joint" is given as well; leave one of them out'
            raise flaw(both if self.joint else f"holds all of it; leave its {given} out", "fixed")
        if d == 2 and "z" in self.fixed:
            raise flaw('must be some of "x", "y" and "rotation" in 2D', "fixed")
        if hinged and self._gives("velocity"):
            raise flaw("follows from angular_velocity where a hinge holds it; leave it out", "velocity")
        if hinged and self.axis is not None:
            raise flaw("is that of the hinge; leave it out", "axis")
        if not hinged:
            held = self.rates - self.ways @ np.linalg.pinv(self.ways) @ self.rates
            if np.abs(held).max() > 1e-9:
                key = "velocity" if np.abs(held[:d]).max() > 1e-9 else "angular_velocity"
                raise flaw("must be 0 along what joint or fixed holds", key)

    def _gives(self, key: str) -> bool:
        """Return whether a motion is given and is not zero; defaults are written out as zeros."""
        value = getattr(self, key)
        return bool(any(value) if isinstance(value, tuple) else value)

    @property
    def form(self) -> Form | Plane:
        return self.shape.form

    @property
    def free(self) -> bool:
        """Whether it is a rigid body that moves freely."""
        return (self.density, self.mass) != (None, None)

    @property
    def holds(self) -> bool:
        """Whether the material inside moves with it, as a pinned part; it is then no obstacle."""
        return self.wall == "hold"

    @property
    def driven(self) -> bool:
        """Whether the scene prescribes its motion."""
        return not self.free and self.motion.moves

    @cached_property
    def moments(self) -> Moments:
        """Mass, centre and inertia of a free collider."""
        return moments_of(self.form, self.density, self.mass)

    @property
    def center(self) -> tuple[float, ...]:
        """The pivot: as given, else the centre of mass, the centre of the bounding box, or the point of a plane."""
        if self.free:
            return self.moments.center
        if self.pivot is not None:
            return self.pivot
        if isinstance(self.form, Plane):
            return self.form.point
        return tuple(float(x) for x in np.mean(self.form.bounds(), axis=0))

    @property
    def radius(self) -> float:
        """Largest distance of any of its points from the pivot, m; infinite for a plane."""
        if isinstance(self.form, Plane):
            return math.inf
        return float(np.linalg.norm(np.abs(np.array(self.form.bounds()) - self.center).max(axis=0)))

    @property
    def spin(self) -> np.ndarray:
        """Initial angular velocity of a free collider, (1,) or (3,), rad/s."""
        axis = unit((self.joint.axis if isinstance(self.joint, Hinge) else self.axis) or Z)
        return self.angular_velocity * (axis[2:] if len(self.velocity) == 2 else axis)

    @property
    def arm(self) -> np.ndarray:
        """Initial vector from the hinge point of a free collider to its centre, (d,), m."""
        point = getattr(self.joint, "point", None)
        return np.zeros(len(self.velocity)) if point is None else np.array(self.center) - point

    @property
    def ways(self) -> np.ndarray:
        """Initial velocity and spin of a free collider at unit rate of each of its n degrees of freedom, (k, n)."""
        return self.joint.way(self.arm)[:, None] if self.joint else ways_of(len(self.velocity), self.fixed)

    @property
    def rates(self) -> np.ndarray:
        """Initial velocity and spin of a free collider, (k,), m/s and rad/s."""
        if isinstance(self.joint, Hinge):
            return self.angular_velocity * self.ways[:, 0]
        return np.concatenate([self.velocity, self.spin])

    def along(self, times: np.ndarray, poses: np.ndarray) -> "Collider":
        """Return it with a computed motion: poses (n, k), positions with angles or quaternions, at times, s."""
        d, found = len(self.velocity), self.model_copy()
        found._path = Path(self.center, times, poses[:, :d], turned_by(poses[:, d:]))
        return found

    @property
    def motion(self) -> Motion | Path:
        """Its motion; for a free collider the initial one, or that set by `along`."""
        if self.free:
            return self._path or Path.start(self.center)
        d = len(self.velocity)
        axis = tuple(unit(self.axis or Z).tolist())
        if self.keyframes:
            times = [key.time for key in self.keyframes]
            offsets = [between_keys(times, [key.offset[a] for key in self.keyframes]) for a in range(d)]
            spin = between_keys(times, [key.angle for key in self.keyframes])
            first = self.keyframes[0]
            return Motion(self.center, axis, first.offset, first.angle, tuple(offsets), spin)
        velocity, start = tuple(map(tree_of, self.velocity)), (0.0,) * d
        if self.offset is not None:
            velocity = tuple(slope_of(entry) for entry in self.offset)
            start = tuple(start_of(entry) for entry in self.offset)
        spin, angle = tree_of(self.angular_velocity), 0.0
        if self.angle is not None:
            spin, angle = slope_of(self.angle), start_of(self.angle)
        return Motion(self.center, axis, start, angle, velocity, spin)

    def fastest(self, domain: Domain, end: float) -> float:
        """Return a bound on the speed of its points in a domain between time 0 and `end` (s), m/s.

        For a free collider it covers the initial speed and the largest rate of its motor.
        """
        if self.free:
            motions = [self.rates]
            if self.joint and self.joint.motor is not None:
                motions.append(largest_of(tree_of(self.joint.motor), 0.0, end) * self.ways[:, 0])
            d = len(self.velocity)
            return max(float(np.linalg.norm(u[:d]) + np.linalg.norm(u[d:]) * self.radius) for u in motions)
        motion = self.motion
        # Points outside the domain meet no material; the pivot moves at most this far.
        gone = float(np.linalg.norm(motion.offset)) + end * motion.fastest(0.0, end)
        far = np.linalg.norm(np.abs(np.array([domain.origin, domain.upper]) - self.center).max(axis=0)) + gone
        return motion.fastest(min(self.radius, float(far)), end)

    def signed_distance(self, points: np.ndarray, time: float = 0.0) -> np.ndarray:
        """Return the distance of points (n, d) from its surface at a time, s: (n,), m; positive where material is."""
        found = self.form.signed_distance(self.motion.taken_back(points, time))
        return -found if self.side == "inside" else found


def slope_of(entry: Entry) -> Tree:
    """Return the derivative of an entry by t, a tree."""
    return derivative(entry.tree, "t") if isinstance(entry, Expression) else ZERO


def start_of(entry: Entry) -> float:
    """Return the value of an entry at time 0."""
    return float(evaluate(tree_of(entry), {"t": 0.0}))

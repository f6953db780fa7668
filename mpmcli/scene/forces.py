"""Loads on bodies besides gravity: accelerations, forces, impulses near a place, and contact with other bodies."""

from typing import Literal

from pydantic import Field, model_validator

from mpmcli.scene.entry import Entry, MotionVector
from mpmcli.scene.expression import INITIAL, POSITION, VELOCITY, Expression
from mpmcli.scene.expression_reader import parse
from mpmcli.scene.primitives import Ball, Box
from mpmcli.scene.quantity import NAME, NotNegative, Number, Positive, Table, Vector, flaw

# Factor of a push at a distance r, in radii; 0 beyond 1. The standard deviation of the Gaussian is a third. An impulse
# becomes forces, whose means over a step are exact.
FALLOFF = {"none": "1", "linear": "(1 - sqrt({r2}))", "gaussian": "exp(-4.5 * {r2})"}
# Duration of an impulse without an end, as a fraction of the interval between frames.
INSTANT = 1e-3
# Radii around the centre in which a radial push falls to zero.
CORE = 1e-3


class Impulse(Table):
    """A push on all particles within a radius of a place."""

    name: str | None = Field(None, pattern=NAME, description="Name of the impulse, for --set.")
    body: str | None = Field(None, description="Name of the body or rigid body that it acts on. Default: all of them.")
    start: NotNegative = Field(description="Start, s.")
    end: Positive | None = Field(
        None, description="End, s. Default: a thousandth of the interval between frames after the start."
    )
    center: Vector = Field(description="Place of its largest strength, m.")
    radius: Positive = Field(description="Distance from the centre beyond which nothing is pushed, m.")
    strength: Number = Field(
        description="Total change of velocity at the centre, m/s; negative values pull or push backwards."
    )
    direction: Vector | None = Field(
        None, description="Direction of the push, of any length. Default: away from the centre."
    )
    falloff: Literal["none", "linear", "gaussian"] = Field(
        "linear",
        description="Decay of the push with distance: none, linear to the radius, or Gaussian.",
    )

    @model_validator(mode="after")
    def _lasts_and_points(self) -> "Impulse":
        if self.end is not None and self.end <= self.start:
            raise flaw(f"must be after start, {self.start:g} s; found {self.end:g}", "end")
        if self.direction is not None and not any(self.direction):
            raise flaw("must not be zero; leave it out for a push away from the centre", "direction")
        return self

    def acceleration(self, interval: float) -> tuple[Entry, ...]:
        """Return the acceleration, m/s^2, expressions of t and the position; `interval` is that between frames, s."""
        end = self.start + INSTANT * interval if self.end is None else self.end
        axes = POSITION[: len(self.center)]
        away = [f"({x} - ({c!r}))" for x, c in zip(axes, self.center, strict=True)]
        r2 = "(" + " + ".join(f"({a} / {self.radius!r})**2" for a in away) + ")"
        push = f"({self.strength / (end - self.start)!r} if t >= {self.start!r} and t < {end!r} else 0)"
        near = f"({FALLOFF[self.falloff].format(r2=r2)} if {r2} < 1 else 0)"
        if self.direction is None:
            pointing = [f"({a} / {self.radius!r} / max(sqrt({r2}), {CORE}))" for a in away]
        else:
            length = sum(n**2 for n in self.direction) ** 0.5
            pointing = [repr(n / length) for n in self.direction]
        return tuple(0.0 if one == "0.0" else parse(f"{push} * {near} * ({one})", ("t", *axes), {}) for one in pointing)


class Region(Table):
    """A part of a body: the particles that start in a box or a ball."""

    box: Box | None = Field(None, description="Box with sides along the axes.")
    ball: Ball | None = Field(None, description="Disc (2D) or ball (3D).")

    @model_validator(mode="after")
    def _one(self) -> "Region":
        if (self.box is None) == (self.ball is None):
            raise flaw("must be one of box and ball")
        return self

    @property
    def form(self) -> Box | Ball:
        return self.box or self.ball

    @property
    def condition(self) -> str:
        """Return whether a particle starts in it, as the text of an expression."""
        if self.box is not None:
            sides = zip(INITIAL, self.box.min, self.box.max, strict=False)
            return " and ".join(f"{X} >= {low!r} and {X} <= {high!r}" for X, low, high in sides)
        r2 = " + ".join(f"({X} - ({c!r}))**2" for X, c in zip(INITIAL, self.ball.center, strict=False))
        return f"{r2} <= {self.ball.radius**2!r}"


class Force(Table):
    """An acceleration of one body or of all bodies; or a force that is spread over the mass of one body."""

    name: str | None = Field(None, pattern=NAME, description="Name of the force, for --set.")
    body: str | None = Field(None, description="Name of the body or rigid body that it acts on. Default: all of them.")
    acceleration: MotionVector | None = Field(
        None,
        description="m/s^2, one entry per axis: numbers, or expressions of the time t (s), the position x, y, z, the "
        "initial position X, Y, Z (m) and the velocity vx, vy, vz (m/s) of a particle; speed is that of the velocity.",
    )
    force: MotionVector | None = Field(
        None,
        description="N (2D: per metre of depth), in place of the acceleration: spread evenly over the mass of the "
        "body, or of its part in the region.",
    )
    region: Region | None = Field(
        None, description="Box or ball in which the particles that it acts on start. Default: all particles."
    )

    @model_validator(mode="after")
    def _one_of_two(self) -> "Force":
        if self.acceleration is None and self.force is None:
            raise flaw("missing key: m/s^2, one entry per axis; or give force, N", "acceleration")
        if self.acceleration is not None and self.force is not None:
            raise flaw('"acceleration" is given as well; leave one of them out', "force")
        if self.force is not None and self.body is None:
            raise flaw("missing key: the body that the force is spread over", "body")
        return self

    def spread(self, mass: float) -> "Force":
        """Return it as an acceleration; `mass` is that of the particles that it acts on, kg."""
        given = self.acceleration if self.force is None else self.force
        scale = "" if self.force is None else f" * {1 / mass!r}"
        where = f" if {self.region.condition} else 0" if self.region else ""
        texts = [entry.text if isinstance(entry, Expression) else repr(entry) for entry in given]
        names = ("t", *(name for axes in (POSITION, INITIAL, VELOCITY) for name in axes[: len(given)]))
        entries = tuple(0.0 if text == "0.0" else parse(f"({text}){scale}{where}", names, {}) for text in texts)
        return self.model_copy(update={"acceleration": entries, "force": None, "region": None})


class ContactPair(Table):
    """Contact of two bodies; overrides that of the scene."""

    between: tuple[str, str] = Field(description="Names of the two bodies.")
    friction: NotNegative | Literal["stick"] = Field(
        description='Coefficient of Coulomb friction between them, which can separate; "stick": they cannot.'
    )


class Contact(Table):
    """Contact between bodies."""

    default: Literal["auto", "stick", "separate"] = Field(
        "auto",
        description='"separate": each elastic body, and each of von_mises with a surface_friction, has a velocity '
        "field of its own; they meet each other, all other material, and walls and colliders that separate, where "
        'their surfaces are, slide with friction, and part. All others stick to each other. "stick": bodies share one '
        'velocity field, meet up to two cells before they touch, and do not slide. "auto": "separate" with such a body '
        'that can meet anything, unless settings of the solver exclude it; otherwise "stick".',
    )
    friction: NotNegative | None = Field(
        None,
        description="Coefficient of Coulomb friction, 0 for liquids. Default: `surface_friction` of the body that "
        "separates, of the softer of two.",
    )
    pairs: tuple[ContactPair, ...] = Field((), description="Pairs of bodies with contact of their own.")

"""Impulses: pushes on what is near a place, at a time or over an interval. They are forces, whose means are exact."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mpmcli.scene.entry import Entry
from mpmcli.scene.expression import POSITION
from mpmcli.scene.expression_reader import parse
from mpmcli.scene.quantity import NAME, NotNegative, Number, Positive, Table, Vector, flaw

# What is left of a push at a distance r, in radii; nothing beyond 1. A Gaussian has a third as its standard deviation.
FALLOFF = {"none": "1", "linear": "(1 - sqrt({r2}))", "gaussian": "exp(-4.5 * {r2})"}
# Length of an impulse at a time, as a part of the interval between frames.
INSTANT = 1e-3
# Radii around the centre in which a radial push falls to zero.
CORE = 1e-3


class Impulse(Table):
    """A push on what is within a radius of a place, as a hand gives it."""

    name: Annotated[str | None, Field(pattern=NAME, description="Name of the impulse, for --set.")] = None
    body: Annotated[str | None, Field(description="Name of the body that it acts on. Default: all of them.")] = None
    start: Annotated[NotNegative, Field(description="When it begins, s.")]
    end: Annotated[
        Positive | None,
        Field(description="When it ends, s. Default: a thousandth of the interval between frames after it begins."),
    ] = None
    center: Annotated[Vector, Field(description="Where it is strongest, m.")]
    radius: Annotated[Positive, Field(description="Distance from the centre beyond which nothing is pushed, m.")]
    strength: Annotated[
        Number,
        Field(description="Change of velocity at the centre in all, m/s; a negative one pulls, or pushes backwards."),
    ]
    direction: Annotated[
        Vector | None, Field(description="Of the push, of any length. Default: away from the centre.")
    ] = None
    falloff: Annotated[
        Literal["none", "linear", "gaussian"],
        Field(
            description="How the push falls with the distance: not at all, linearly to the radius, or as a Gaussian."
        ),
    ] = "linear"

    @model_validator(mode="after")
    def _lasts_and_points(self) -> "Impulse":
        if self.end is not None and self.end <= self.start:
            raise flaw(f"must be after start, {self.start:g} s; found {self.end:g}", "end")
        if self.direction is not None and not any(self.direction):
            raise flaw("must not be zero; leave it out for a push away from the centre", "direction")
        return self

    def acceleration(self, interval: float) -> tuple[Entry, ...]:
        """Return the acceleration, m/s^2, an expression of t and the position along each axis.

        Args:
            interval: between frames, s.
        """
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

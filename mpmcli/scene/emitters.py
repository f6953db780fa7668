"""Emitters: mouths through which material flows into a scene, sheet after sheet."""

from typing import Annotated

from pydantic import Field, field_validator, model_validator

from mpmcli.scene.lattice import ParticlesPerCell
from mpmcli.scene.material import MaterialParameters
from mpmcli.scene.quantity import NAME, Integer, NotNegative, Positive, Table, Vector, flaw
from mpmcli.scene.shapes import OneShape


class Emitter(Table):
    """A mouth that material flows out of at a steady velocity.

    The mouth is the section of the shape through its centre, across the velocity. Particles lie on a lattice that moves
    with the velocity: a sheet of it enters each time the one before has moved on by the distance of two sheets.
    """

    name: Annotated[str, Field(pattern=NAME, description="Name of the emitter, used in messages and --set.")]
    material: Annotated[
        MaterialParameters,
        Field(description="A preset in quotes, or a table: a law or a preset, with parameters and knobs."),
    ]
    shape: Annotated[OneShape, Field(description="Its section through the centre, across the velocity, is the mouth.")]
    velocity: Annotated[Vector, Field(description="Velocity of what flows in, m/s; not zero.")]
    start: Annotated[NotNegative, Field(description="When the first sheet enters, s.")] = 0.0
    end: Annotated[
        Positive | None, Field(description="No sheet enters from then on, s. Default: the end of the scene.")
    ] = None
    particles: Annotated[
        Integer | None,
        Field(ge=1, description="Particles in all, as far as whole sheets allow; or give volume. Default: until end."),
    ] = None
    volume: Annotated[
        Positive | None,
        Field(description="Volume at rest in all, m^3 (m^2 in 2D); or give particles. Default: until end."),
    ] = None
    particles_per_cell: ParticlesPerCell = None  # type: ignore[assignment]

    @field_validator("velocity")
    @classmethod
    def _moves(cls, velocity: tuple[float, ...]) -> tuple[float, ...]:
        if not any(velocity):
            raise flaw("must not be zero, as nothing would flow; give the velocity of the material in m/s")
        return velocity

    @model_validator(mode="after")
    def _one_total(self) -> "Emitter":
        if self.particles is not None and self.volume is not None:
            raise flaw("particles is given as well; leave one of them out", "volume")
        if self.end is not None and self.end <= self.start:
            raise flaw(f"must be after start, {self.start:g} s; found {self.end:g}", "end")
        return self

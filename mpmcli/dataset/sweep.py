"""What a sweep file says, read and complete."""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PlainValidator, model_validator

from mpmcli.dataset.distributions import Distribution, read_distribution
from mpmcli.dataset.unit_numbers import Method, generator
from mpmcli.scene.quantity import AXES, Integer, NotNegative, Number, Table, flaw, list_of_axes

# 2^64 / golden ratio, made odd.
GOLDEN = 0x9E3779B97F4A7C15
ROUND_OFF = 1e-9

Accepted = Literal["stable", "suspect"]
Drawn = Annotated[Distribution, PlainValidator(read_distribution)]


class Region(Table):
    """A box with faces along the axes that bodies are placed in."""

    min: Annotated[list_of_axes(Number), Field(description="Lower corner, m.")]
    max: Annotated[list_of_axes(Number), Field(description="Upper corner, m.")]

    @model_validator(mode="after")
    def _upper_corner_above_lower(self) -> "Region":
        flat = [a for a, lo, hi in zip(AXES, self.min, self.max, strict=False) if not lo < hi]
        if flat:
            raise flaw(f"must be above min along {' and '.join(flat)}, so that the region holds bodies", "max")
        return self


class Placement(Table):
    """Bodies or colliders that take the place of one of the base scene, at random within a region."""

    body: Annotated[
        str | None, Field(description="Name of a body of the base scene, a box or a ball: the template.")
    ] = None
    collider: Annotated[str | None, Field(description="Name of a collider in place of a body.")] = None
    count: Annotated[Drawn, Field(description="Number of bodies or colliders.")]
    size: Annotated[Drawn | None, Field(description="Edge lengths of a box, m. Default: those of the template.")] = None
    radius: Annotated[Drawn | None, Field(description="Radius of a ball, m. Default: that of the template.")] = None
    velocity: Annotated[
        Drawn | None, Field(description="Velocity, m/s, of a body the initial one. Default: that of the template.")
    ] = None
    region: Annotated[Region, Field(description="Box that they lie in, m.")]
    min_distance: Annotated[
        NotNegative, Field(description="Smallest distance to every other body and collider, m. Default: none.")
    ] = 0.0

    @model_validator(mode="after")
    def _one_template(self) -> "Placement":
        if (self.body is None) == (self.collider is None):
            found = "neither" if self.body is None else "both"
            raise flaw(f"must be the name of a body, or collider that of a collider; found {found}", "body")
        return self

    @property
    def template(self) -> str:
        """Name of the template."""
        return self.collider if self.body is None else self.body

    @property
    def list(self) -> Literal["bodies", "colliders"]:
        """The list of the scene that the template is in."""
        return "colliders" if self.body is None else "bodies"

    @property
    def key(self) -> str:
        """The key of what is placed among the drawn values."""
        return f"place.{self.template}" if self.collider is None else f"place.colliders.{self.template}"

    @property
    def distributions(self) -> dict[str, Distribution]:
        """What is drawn, by the key under which it is drawn, such as `place.sand.size`."""
        drawn = {name: getattr(self, name) for name in ("count", "size", "radius", "velocity")}
        return {f"{self.key}.{name}": one for name, one in drawn.items() if one is not None}


Share = Annotated[float, Field(strict=True, ge=0, le=1)]


class Split(Table):
    """Fractions of the trajectories by their purpose; 1 together."""

    train: Annotated[Share, Field(description="Fraction to train with, 0 to 1.")] = 0.0
    valid: Annotated[Share, Field(description="Fraction to choose parameters with, 0 to 1.")] = 0.0
    test: Annotated[Share, Field(description="Fraction to measure errors with, 0 to 1.")] = 0.0

    @model_validator(mode="after")
    def _whole(self) -> "Split":
        total = self.train + self.valid + self.test
        if abs(total - 1) > ROUND_OFF:
            raise flaw(f"must make 1 together, as train = 0.8, valid = 0.1, test = 0.1 do; found {total:g}")
        return self


class SweepTable(Table):
    """The keys of a sweep file."""

    base: Annotated[str, Field(description="The base scene, a TOML file beside the sweep.")]
    count: Annotated[Integer, Field(ge=1, le=10**9, description="Number of trajectories.")]
    seed: Annotated[Integer, Field(ge=0, le=2**63 - 1, description="Seed of everything that is drawn.")] = 0
    method: Annotated[Method, Field(description="How continuous distributions of [vary] are drawn.")] = "random"
    accept: Annotated[Accepted, Field(description="The worst verdict of a trajectory of the dataset.")] = "stable"
    vary: Annotated[dict[str, Drawn], Field(description="Keys of the base scene and what they are drawn from.")] = {}  # noqa: RUF012
    place: Annotated[tuple[Placement, ...], Field(description="Bodies and colliders placed at random.")] = ()
    split: Annotated[Split, Field(description="Fractions of the trajectories by their purpose.")] = Split(
        train=0.8, valid=0.1, test=0.1
    )


@dataclass(frozen=True, eq=False)
class Sweep:
    """A sweep file and its base scene, checked; see `sweep_file.load_sweep`.

    Attributes:
        path, text, data: the sweep file, its text, and its parsed TOML.
        base, base_text, base_data: the same of the base scene.
        count: number of trajectories.
        seed: of everything that is drawn.
        method: how the continuous distributions of `vary` are drawn.
        accept: the worst verdict of a trajectory that belongs to the dataset.
        vary: distributions by key of the base scene, in the order of the file.
        placements: bodies and colliders placed at random.
        split: fractions of the trajectories by their purpose.
    """

    path: Path
    text: str
    data: dict[str, Any]
    base: Path
    base_text: str
    base_data: dict[str, Any]
    count: int
    seed: int
    method: Method
    accept: Accepted
    vary: dict[str, Distribution]
    placements: tuple[Placement, ...]
    split: Split

    @cached_property
    def key(self) -> str:
        """SHA-256, hexadecimal, of the base scene, the sweep and the count, whatever their files look like.

        The order of keys in [vary] and of [[place]] counts, as grids and Sobol components follow it.
        """
        vary, place = self.data.get("vary", {}), self.data.get("place", [])
        content = {
            "base": self.base_data,
            "count": self.count,
            "seed": self.seed,
            "method": self.method,
            "accept": self.accept,
            "vary": list(vary.items()),
            "place": [place] if isinstance(place, dict) else place,
            "split": self.split.model_dump(),
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()

    @cached_property
    def distributions(self) -> dict[str, Distribution]:
        """Everything that is drawn, by key: those of `vary`, then those of the placements, `place.sand.size`."""
        return self.vary | {key: one for place in self.placements for key, one in place.distributions.items()}

    def split_of(self, number: int) -> str:
        """Return "train", "valid" or "test" for a trajectory.

        A golden-ratio sequence frac(offset + number / golden ratio), with an offset from the seed, falls into
        consecutive intervals as long as the fractions. So a trajectory keeps its purpose when the count grows,
        and each purpose has its fraction of the first n trajectories for every n: up to 2 or so too many or too few
        of a thousand, up to 4 of 200,000.
        """
        offset = int(generator(self.seed, 0, "split").integers(2**64, dtype=np.uint64))
        place = (offset + number * GOLDEN) % 2**64 / 2**64
        last, total = "train", 0.0
        for name, share in self.split:
            total += share
            last = name if share > 0 else last
            if share > 0 and place < total:
                break
        return last

"""Scenes that blow up above their step: particles alone and in bulk."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

SPACING = 0.1
DENSITY = 1000.0
# Cells of a domain without walls near: the body lies in its middle, or travels through it between two readings.
FREE, TRAVELLED = 12, 60
# Speed of moving bodies over the speed of pressure waves, and its direction: no offset in a cell comes back soon.
MACH, HEADING = 0.3, (math.cos(0.6), math.sin(0.6))

Kind = Literal["alone", "bulk"]


@dataclass(frozen=True, eq=False)
class BlowUpScene:
    """Particles of one body without gravity, in a state of equilibrium where it is stable.

    Attributes:
        name: what it is; kind: "alone" (one particle, for which the bound is exact) or "bulk".
        material: its table.
        cells: of the domain, per axis; a filled box where `position` fills it.
        position: (n, d), m; volume: of a particle at rest, m^d.
        velocity: of the whole body, (d,), m/s.
        stretches: principal stretches of the start, (d,), along the axes.
        internal: internal variables of the start by name, those at rest where not given.
        exact: whether one particle answers expansion and compression alike, so that the bound is met to 2 %.
    """

    name: str
    kind: Kind
    material: Mapping[str, object]
    cells: tuple[int, ...]
    position: np.ndarray
    volume: float
    velocity: np.ndarray
    stretches: np.ndarray
    internal: Mapping[str, float] = field(default_factory=dict)
    exact: bool = False


def law(name: str, **parameters: object) -> dict[str, object]:
    """Return the table of a material."""
    return {"law": name, "density": DENSITY, **parameters}


def solid(name: str, modulus: float, nu: float, **parameters: object) -> dict[str, object]:
    """Return the table of an elastic material of this Young's modulus, Pa, and Poisson's ratio."""
    return law(name, youngs_modulus=modulus, poissons_ratio=nu, **parameters)


def liquid(**parameters: object) -> dict[str, object]:
    """Return the table of a fluid of K = 1e5 Pa, with c = 10 m/s, that takes tension."""
    return law("fluid", **{"bulk_modulus": 1e5, "tension_cutoff": False, **parameters})


def pressure_wave_speed(material: Mapping[str, object]) -> float:
    """Return sqrt((lambda + 2 mu) / rho), or sqrt(K / rho) of a fluid, m/s."""
    if "bulk_modulus" in material:
        modulus = float(material["bulk_modulus"])
    else:
        E, nu = float(material["youngs_modulus"]), float(material["poissons_ratio"])
        modulus = E * (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    return math.sqrt(modulus / DENSITY)


def alone(name: str, material: dict, dimension: int, *, moving: bool = False, **start: object) -> BlowUpScene:
    """Return a scene of one particle, off the middle of its cell."""
    return _free(name, "alone", material, np.array([[0.31, 0.42, 0.17][:dimension]]), 4, moving, start)


def block(
    name: str,
    material: dict,
    dimension: int,
    per_axis: int,
    *,
    side: int = 4,
    offset: float = 0.0,
    jittered: bool = False,
    moving: bool = False,
    **start: object,
) -> BlowUpScene:
    """Return a scene of a free block, `side` cells along each axis, with per_axis^d particles in a cell.

    They lie on a lattice, which is `offset` cells off that of the grid, or at random in its cells where `jittered`.
    """
    places = offset + lattice(side, per_axis, dimension, jittered=jittered)
    return _free(name, "bulk", material, places, per_axis**dimension, moving, start)


def lattice(side: int, per_axis: int, dimension: int, *, jittered: bool = False) -> np.ndarray:
    """Return the places, (n, d), of particles that fill side^d cells, in cells."""
    n = side * per_axis
    index = np.stack(np.meshgrid(*[np.arange(n)] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
    offset = np.random.default_rng(1).random(index.shape) if jittered else 0.5
    return (index + offset) / per_axis


def _free(
    name: str, kind: Kind, material: dict, places: np.ndarray, per_cell: int, moving: bool, start: dict
) -> BlowUpScene:
    """Put particles at `places`, in cells, into the middle of a domain, or near its corner where they travel."""
    d = places.shape[1]
    cells, first = (TRAVELLED, 6) if moving else (FREE, 4)
    velocity = np.zeros(d)
    if moving:
        velocity[:2] = MACH * pressure_wave_speed(material) * np.array(HEADING)
    stretches = np.array(start.pop("stretches", [1.0] * d))
    volume = SPACING**d / per_cell / float(np.prod(stretches))
    position = (first + places) * SPACING
    return BlowUpScene(name, kind, material, (cells,) * d, position, volume, velocity, stretches, **start)

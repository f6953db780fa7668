"""The scenes whose blow-up step is measured: particles alone, in clusters and in bulk, of every law."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

SPACING = 0.1
DENSITY = 1000.0
# Cells of a domain without walls near: the body lies in its middle, or travels through it between two readings.
FREE, TRAVELLED = 12, 60
# Speed of moving bodies over the speed of pressure waves, and its direction: no offset in a cell comes back soon.
MACH, HEADING = 0.3, (math.cos(0.6), math.sin(0.6))

Kind = Literal["alone", "cluster", "bulk"]


@dataclass(frozen=True, eq=False)
class BlowUpScene:
    """Particles of one body without gravity, in a state of equilibrium where it is stable.

    Attributes:
        name: what it is; kind: "alone" (one particle, for which the bound is exact), "cluster" or "bulk".
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


def cluster(
    name: str, material: dict, dimension: int, count: int, *, seed: int, moving: bool = False, **start: object
) -> BlowUpScene:
    """Return a scene of a few particles at random places of a patch of 1.5 cells across."""
    places = 1.5 * np.random.default_rng(seed).random((count, dimension))
    return _free(name, "cluster", material, places, 4, moving, start)


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


def pairs(name: str, material: dict, *, side: int = 4) -> BlowUpScene:
    """Return a scene of a free block in 2D with two particles at random places of every cell."""
    corner = lattice(side, 1, 2) - 0.5
    places = np.repeat(corner, 2, axis=0) + np.random.default_rng(2).random((2 * len(corner), 2))
    return _free(name, "bulk", material, places, 2, False, {})


def confined(
    name: str,
    material: dict,
    stretches: Sequence[float],
    per_axis: int,
    *,
    side: int = 6,
    jittered: bool = False,
    internal: Mapping[str, float] | None = None,
) -> BlowUpScene:
    """Return a scene of a box filled with matter that is stretched alike everywhere: its slip walls hold it.

    The particles lie as densely as in the other scenes; at rest they would take another volume.
    """
    d = len(stretches)
    places = lattice(side, per_axis, d, jittered=jittered) * SPACING
    volume = (SPACING / per_axis) ** d / math.prod(stretches)
    return BlowUpScene(
        name, "bulk", material, (side,) * d, places, volume, np.zeros(d), np.array(stretches), internal or {}
    )


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


def study_scenes() -> list[BlowUpScene]:
    """Return the scenes of the study."""
    soft, mild, stiff = solid("neo_hookean", 1e4, 0.0), solid("neo_hookean", 1e5, 0.3), solid("neo_hookean", 1e9, 0.49)
    rubber = solid("fixed_corotated", 1e6, 0.4999)
    metal = solid("von_mises", 1e7, 0.3, yield_stress=2e5)
    damp = solid("sand", 1e7, 0.3, friction_angle=30.0, cohesion=2e5)
    dry = solid("sand", 1e7, 0.3, friction_angle=30.0)
    snow, packed = solid("snow", 1.4e5, 0.2), {"internal": {"plastic_volume_ratio": 0.85}}
    paste = law("viscoplastic", bulk_modulus=1e5, shear_modulus=4e5, yield_stress=4e4, consistency=10.0)
    mud = law("viscoplastic", bulk_modulus=1e5, shear_modulus=2.5e4, yield_stress=2e3, consistency=10.0)
    slurry = law("viscoplastic", bulk_modulus=1e5, shear_modulus=4e5, yield_stress=0.0, consistency=10.0)
    honey = liquid(viscosity=200.0, bulk_viscosity=100.0)
    treacle = liquid(viscosity=1e4)
    return [
        alone("fluid", liquid(), 2, exact=True),
        alone("fluid", liquid(), 3, exact=True),
        alone("fluid, viscosity and waves", honey, 2, exact=True),
        alone("fluid, viscosity dominates", treacle, 2, exact=True),
        alone("fluid with tension cut-off", liquid(tension_cutoff=True), 2),
        alone("neo-Hookean, moving at Mach 0.3", mild, 2, moving=True, exact=True),
        alone("neo-Hookean, nu 0.49, E 1e9", stiff, 3, exact=True),
        alone("fixed corotated, nu 0.4999", rubber, 2, exact=True),
        alone("von Mises", metal, 3, exact=True),
        alone("snow, packed to J_P 0.85", snow, 2, exact=True, **packed),
        alone("sand with cohesion", damp, 2, exact=True),
        alone("sand without cohesion", dry, 2),
        alone("viscoplastic below yield, stiff in shear", paste, 2, exact=True),
        alone("viscoplastic flowing, stiff in shear", slurry, 2),
        cluster("fluid, droplet of 2", liquid(), 2, 2, seed=1),
        cluster("fluid, droplet of 5", liquid(), 2, 5, seed=2),
        cluster("neo-Hookean, nu 0, 3 particles, moving", soft, 2, 3, seed=4, moving=True),
        cluster("neo-Hookean, nu 0.49, 4 particles", stiff, 3, 4, seed=5),
        block("neo-Hookean, nu 0, 1 per cell", soft, 2, 1),
        block("neo-Hookean, nu 0.3, 1 per cell, moving", mild, 2, 1, moving=True),
        pairs("neo-Hookean, nu 0.3, 2 per cell", mild),
        block("neo-Hookean, nu 0.3, 4 per cell", mild, 2, 2),
        block("neo-Hookean, nu 0.3, 9 per cell", mild, 2, 3),
        block("neo-Hookean, nu 0.3, 8 per cell, moving", mild, 3, 2, side=3, moving=True),
        block("neo-Hookean, nu 0.49, 4 per cell", stiff, 2, 2),
        block("fixed corotated, nu 0.4999, 1 per cell", rubber, 3, 1, side=3),
        block("von Mises, 4 per cell, jittered", metal, 2, 2, jittered=True),
        confined("von Mises at yield, 4 per cell", metal, (1.03, 0.97), 2),
        block("snow, packed to J_P 0.85, 4 per cell", snow, 2, 2, **packed),
        confined("sand without cohesion, compressed, 4 per cell", dry, (0.99, 0.985), 2),
        block("viscoplastic below yield, 4 per cell", mud, 2, 2),
        confined("viscoplastic at yield, 4 per cell", mud, (1.06, 1 / 1.06), 2),
        block("fluid, 2 x 2 per cell, moving", liquid(), 2, 2, moving=True),
        block("fluid, 8 per cell, jittered", liquid(), 3, 2, side=3, jittered=True),
        block("fluid, viscosity and waves, 4 per cell", honey, 2, 2),
        block("fluid, viscosity dominates, 4 per cell", treacle, 2, 2),
        block("fluid let go at J 0.9, 4 per cell", liquid(), 2, 2, stretches=(math.sqrt(0.9),) * 2),
        block("fluid let go at J 1.2, 4 per cell", liquid(), 2, 2, stretches=(math.sqrt(1.2),) * 2),
        confined("fluid held at J 0.8, 4 per cell", liquid(), (math.sqrt(0.8),) * 2, 2, jittered=True),
        confined("fluid with cut-off held at J 0.8", liquid(tension_cutoff=True), (math.sqrt(0.8),) * 2, 2),
        confined("fluid held at J 1.2, 4 per cell", liquid(), (math.sqrt(1.2),) * 2, 2, jittered=True),
        confined("fluid held at J 0.5, 1 per cell", liquid(), (math.sqrt(0.5),) * 2, 1, jittered=True),
        confined("fluid held at J 0.3, 1 per cell", liquid(), (math.sqrt(0.3),) * 2, 1, jittered=True),
        confined("fluid held at J 0.3, 4 per cell", liquid(), (math.sqrt(0.3),) * 2, 2, jittered=True),
        confined("fluid held at J 0.4, 1 per cell", liquid(), (0.4 ** (1 / 3),) * 3, 1, side=5, jittered=True),
        confined("viscoplastic held at J 0.5, 1 per cell", mud, (math.sqrt(0.5),) * 2, 1, jittered=True),
    ]

"""Particles of bodies: where they start, how fast they move, and how much volume and mass each one has."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mpmcli.errors import InputError
from mpmcli.scene.domain import Domain
from mpmcli.scene.initial import initial_deformation, initial_faults, initial_motion
from mpmcli.scene.problem import path_text
from mpmcli.scene.schema import Body, Scene
from mpmcli.scene.shapes import Box

# Lattice points that are looked at together; bounds the memory that sampling needs beyond its result.
_POINTS_AT_ONCE = 1_000_000


@dataclass(frozen=True, eq=False)
class BodyParticles:
    """The n particles that fill one body.

    Attributes:
        name: name of the body.
        position: (n, d) float64, m, in the coordinates of the scene.
        velocity: (n, d) float64, m/s.
        affine: (n, d, d) float64, initial velocity gradient, 1/s; one read-only matrix where all have the same.
        volume: of each particle, m^3 (m^2 in 2D): that of the shape divided by n.
        mass: of each particle, kg (kg per metre of depth in 2D).
        deformation: J, (n,), or F, (n, d, d), at the start; None where there is none.
        initial: (n, d), the X of expressions, m, where that is not the position.
    """

    name: str
    position: np.ndarray
    velocity: np.ndarray
    affine: np.ndarray
    volume: float
    mass: float
    deformation: np.ndarray | None = None
    initial: np.ndarray | None = None

    @property
    def count(self) -> int:
        """Number of particles."""
        return len(self.position)


def sample_bodies(scene: Scene) -> list[BodyParticles]:
    """Fill every body of a scene with particles; the same scene always gives the same particles.

    Memory is proportional to `estimate_particles`, which callers check first.

    Raises:
        InputError: a body is too thin for its lattice and gets no particle, or what it starts with is not finite there.
    """
    return [_sample(body, index, scene.domain) for index, body in enumerate(scene.bodies)]


def estimate_particles(scene: Scene) -> int:
    """Return how many particles the scene has, from volumes alone: exact for boxes, close for the rest."""
    return sum(estimate_body(body, scene.domain.spacing) for body in scene.bodies)


def estimate_body(body: Body, h: float) -> int:
    """Return how many particles a body has at grid spacing h; see `estimate_particles`."""
    form = body.shape.form
    if isinstance(form, Box):
        return math.prod(_lattice_counts(body, h))
    return max(1, round(form.volume / lattice_spacing(body, h) ** len(body.velocity)))


def lattice_spacing(body: Body, h: float) -> float:
    """Return the distance between the particles of a body, m, at grid spacing h."""
    return h / body.particles_per_cell ** (1 / len(body.velocity))


def lattice_points(body: Body, h: float) -> int:
    """Return the number of points of the lattice that is searched for the particles of a body."""
    return math.prod(_lattice_counts(body, h))


def _lattice_counts(body: Body, h: float) -> list[int]:
    """Return the number of lattice points along each axis.

    The lattice of a box is stretched to fit it; that of another shape keeps its spacing, is
    centred on the bounding box, and covers it.
    """
    lower, upper = body.shape.form.bounds()
    ratios = ((upper - lower) / lattice_spacing(body, h)).tolist()
    if isinstance(body.shape.form, Box):
        return [max(1, round(r)) for r in ratios]
    # A bounding box of a whole number of spacings, up to round-off, needs no point more.
    return [max(1, math.ceil(r - 1e-9)) for r in ratios]


def particle_places(body: Body, index: int, h: float) -> np.ndarray:
    """Return where the particles of a body start, (n, d), m, from its index in the scene and the grid spacing h."""
    form = body.shape.form
    return np.concatenate([points[form.contains(points)] for points in _lattice(body, index, h)])


def _sample(body: Body, index: int, domain: Domain) -> BodyParticles:
    form = body.shape.form
    position = particle_places(body, index, domain.spacing)
    if not len(position):
        raise InputError(no_particles(body, domain.spacing))
    # A body too large to be looked at when the scene was loaded.
    faults = [f"{path_text(('bodies', index, *key))}: {said}" for key, said in initial_faults(body, position, domain)]
    if faults:
        raise InputError("\n".join(faults))
    velocity, affine = initial_motion(body, position)
    volume = form.volume / len(position)
    return BodyParticles(
        name=body.name,
        position=position,
        velocity=velocity,
        affine=affine,
        volume=volume,
        mass=body.material.density * volume,
        deformation=initial_deformation(body, position, domain),
    )


def holds_particles(body: Body, index: int, h: float) -> bool:
    """Say whether a body, of the given index in its scene, gets any particle at grid spacing h."""
    return any(body.shape.form.contains(points).any() for points in _lattice(body, index, h))


def no_particles(body: Body, h: float) -> str:
    """Say that a body holds no particle, and what would be right."""
    return (
        f'body "{body.name}" is too thin to hold a particle: its particles would be '
        f"{lattice_spacing(body, h):.6g} m apart; make it thicker, or the grid finer"
    )


def _lattice(body: Body, index: int, h: float) -> Iterator[np.ndarray]:
    """Yield the points (k, d) of the body's lattice in order, a bounded number at a time.

    A jittered body has one point at random in each cell of the lattice instead of one at its centre.
    """
    lower, upper = body.shape.form.bounds()
    counts = np.array(_lattice_counts(body, h))
    if isinstance(body.shape.form, Box):
        spacing = (upper - lower) / counts
        start = lower
    else:
        spacing = np.full(len(counts), lattice_spacing(body, h))
        start = (lower + upper - counts * spacing) / 2
    total = math.prod(counts.tolist())
    generator = np.random.Generator(np.random.PCG64([body.seed, index]))
    for first in range(0, total, _POINTS_AT_ONCE):
        flat = np.arange(first, min(first + _POINTS_AT_ONCE, total))
        cells = np.stack(np.unravel_index(flat, counts), axis=1)
        offset = generator.random(cells.shape) if body.sampling == "jittered" else 0.5
        points = start + (cells + offset) * spacing
        # Round-off may carry a point of a box past a face by one unit in the last place.
        yield np.clip(points, lower, upper) if isinstance(body.shape.form, Box) else points

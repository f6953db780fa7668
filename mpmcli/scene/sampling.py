"""Particles of bodies: where they start, how fast they move, and how much volume and mass each one has."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mpmcli.errors import InputError
from mpmcli.scene.domain import Domain
from mpmcli.scene.emitters import Emitter
from mpmcli.scene.initial import initial_deformation, initial_faults, initial_motion
from mpmcli.scene.points import Points
from mpmcli.scene.poisson_disk import disk_radius, poisson_disk
from mpmcli.scene.primitives import Box
from mpmcli.scene.problem import path_text
from mpmcli.scene.schema import Body, Scene
from mpmcli.scene.sheets import sheets_of

# Lattice points that are looked at together; bounds the memory that sampling needs beyond its result.
_POINTS_AT_ONCE = 2**16
# Particles of which a body with random ones gets some.
_SURE = 100


@dataclass(frozen=True, eq=False)
class BodyParticles:
    """The n particles that fill one body.

    Attributes:
        name: name of the body.
        position: (n, d) float64, m, in the coordinates of the scene.
        velocity: (n, d) float64, m/s; one read-only row where all have the same.
        affine: (n, d, d) float64, initial velocity gradient, 1/s; one read-only matrix where all have the same.
        volume: of each particle, m^3 (m^2 in 2D): that of the shape divided by n.
        mass: of each particle, kg (kg per metre of depth in 2D).
        deformation: J, (n,), or F, (n, d, d), at the start; None where there is none.
        initial: (n, d), the X of expressions, m, where that is not the position.
        waits: whether they belong to an emitter, and come later.
    """

    name: str
    position: np.ndarray
    velocity: np.ndarray
    affine: np.ndarray
    volume: float
    mass: float
    deformation: np.ndarray | None = None
    initial: np.ndarray | None = None
    waits: bool = False

    @property
    def count(self) -> int:
        """Number of particles."""
        return len(self.position)


def sample_bodies(scene: Scene) -> list[BodyParticles]:
    """Fill every body of a scene with particles, and then every emitter; they are always the same for a scene.

    Memory is proportional to `estimate_particles`, which callers check first.

    Raises:
        InputError: a body is too thin for its lattice and gets no particle, or what it starts with is not finite there.
    """
    bodies = [_sample(body, index, scene.domain) for index, body in enumerate(scene.bodies)]
    return bodies + [_waiting(emitter, scene) for emitter in scene.emitters]


def _waiting(emitter: Emitter, scene: Scene) -> BodyParticles:
    """Return the particles of an emitter, sheet after sheet, at the places where they will enter."""
    sheets = sheets_of(emitter, scene)
    position = np.tile(sheets.places, (sheets.count, 1))
    n, d = position.shape
    affine = np.broadcast_to(np.zeros((d, d)), (n, d, d))
    mass = emitter.material.density * sheets.volume
    return BodyParticles(emitter.name, position, np.zeros((n, d)), affine, sheets.volume, mass, waits=True)


def estimate_particles(scene: Scene) -> int:
    """Return how many particles the scene has, from volumes alone: exact for boxes with a lattice, else close."""
    bodies = sum(estimate_body(body, scene.domain.spacing) for body in scene.bodies)
    return bodies + sum(sheets_of(emitter, scene).particles for emitter in scene.emitters)


def estimate_body(body: Body, h: float) -> int:
    """Return how many particles a body has at grid spacing h; see `estimate_particles`."""
    form = body.shape.form
    if isinstance(form, Points):
        return len(form.position)
    if isinstance(form, Box) and body.sampling != "poisson":
        return math.prod(_lattice_counts(body, h))
    return max(1, round(form.volume / lattice_spacing(body, h) ** len(body.velocity)))


def lattice_spacing(body: Body, h: float) -> float:
    """Return the distance between the particles of a body, m, at grid spacing h."""
    if isinstance(form := body.shape.form, Points):
        return form.edge
    return h / body.particles_per_cell ** (1 / len(body.velocity))


def points_per_cell(body: Body, h: float) -> int:
    """Return the particles per cell of a body: what it says, or that of its points, at least 1."""
    form = body.shape.form
    return max(1, round((h / form.edge) ** len(body.velocity))) if isinstance(form, Points) else body.particles_per_cell


def lattice_points(body: Body, h: float) -> int:
    """Return the number of points that are searched for the particles of a body."""
    if isinstance(form := body.shape.form, Points):
        return len(form.position)
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
    if isinstance(form, Points):
        return form.position
    if body.sampling == "poisson":
        radius = disk_radius(lattice_spacing(body, h), len(body.velocity))
        points = poisson_disk(*form.bounds(), radius, _generator(body, index))
        return points[form.contains(points)]
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
    if isinstance(form, Points) and form.file_velocity is not None:
        velocity = velocity + form.file_velocity
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


def _generator(body: Body, index: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64([body.seed, index]))


def holds_particles(body: Body, index: int, h: float) -> bool:
    """Say whether a body, of the given index in its scene, gets any particle at grid spacing h."""
    if isinstance(body.shape.form, Points):
        return True
    if body.sampling == "poisson":
        # Points at random miss no body that holds as many of them, however thin.
        return estimate_body(body, h) > _SURE or len(particle_places(body, index, h)) > 0
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
    generator = _generator(body, index)
    for first in range(0, total, _POINTS_AT_ONCE):
        flat = np.arange(first, min(first + _POINTS_AT_ONCE, total))
        cells = np.stack(np.unravel_index(flat, counts), axis=1)
        offset = generator.random(cells.shape) if body.sampling == "jittered" else 0.5
        points = start + (cells + offset) * spacing
        # Round-off may carry a point of a box past a face by one unit in the last place.
        yield np.clip(points, lower, upper) if isinstance(body.shape.form, Box) else points

"""Particles of bodies: initial position, velocity and deformation, volume and mass."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from mpmcli.errors import InputError
from mpmcli.scene.domain import Domain
from mpmcli.scene.entry import Entry, entries_in, value_of, varies
from mpmcli.scene.expression import INITIAL, Expression, derivative, evaluate
from mpmcli.scene.fitting import fitted
from mpmcli.scene.points import DEFORMATIONS, Points
from mpmcli.scene.primitives import Box
from mpmcli.scene.problem import Path, path_text
from mpmcli.scene.quantity import place_text
from mpmcli.scene.relaxation import relaxed
from mpmcli.scene.schema import Body, Scene
from mpmcli.scene.shapes import Form
from mpmcli.scene.sheets import Sheets, sheets_in

# Points per radius^d of a sample, as measured, in 2D and 3D. Sampling to saturation would give 0.6965 and 0.7334.
DENSITY = {2: 0.680, 3: 0.647}
# Cells per radius along an axis, number of rounds of dart throwing, and candidate points per radius^d in each round.
_FINE, _ROUNDS, _OFFERED = {2: 6, 3: 4}, 14, 1.0
# Radii by which the box is enlarged: points are denser at an edge, which has no competing points beyond it.
_MARGIN = 3
# Number of places in a bounding box over which a deformation is averaged.
_AVERAGED = 4096
_PLACES_AT_ONCE = 2_000


def disk_radius(spacing: float, d: int) -> float:
    """Return the radius, m, at which a sample has as many points as a lattice of the given spacing, m."""
    return DENSITY[d] ** (1 / d) * spacing


def poisson_disk(lower: np.ndarray, upper: np.ndarray, radius: float, generator: np.random.Generator) -> np.ndarray:
    """Return points in a box with corners (d,), at least `radius` apart, and nearly everywhere within it of each other.

    Dart throwing in cells that have room, after Ebeida et al. (2012): in each round some cells propose a point, points
    too close to an accepted or an earlier proposed one are refused, and covered cells are dropped. The same generator
    always gives the same points, (n, d), m; about DENSITY[d] per radius^d.
    """
    from scipy.spatial import KDTree

    d = len(lower)
    width = radius / _FINE[d]
    # Cells beyond the margin can be covered but propose no points.
    pad = _FINE[d] + 1
    start = lower - _MARGIN * radius - pad * width
    counts = np.ceil((upper + _MARGIN * radius - start) / width).astype(int) + pad
    free = np.zeros(counts, dtype=bool)
    free[(slice(pad, -pad),) * d] = True
    free = free.reshape(-1)
    share = _OFFERED / _FINE[d] ** d
    many = int(np.prod(counts - 2 * pad) * share) + 1
    found = np.empty((0, d))
    for _ in range(_ROUNDS):
        room = np.flatnonzero(free)
        if not len(room):
            break
        chosen = generator.choice(room, min(many, len(room)), replace=False)
        offered = np.stack(np.unravel_index(chosen, counts), axis=1) + generator.random((len(chosen), d))
        offered = start + width * offered
        if len(found):
            offered = offered[np.isinf(KDTree(found).query(offered, distance_upper_bound=radius, workers=-1)[0])]
        new = offered[first_come(KDTree(offered).query_pairs(radius, output_type="ndarray"), len(offered))]
        found = np.concatenate([found, new])
        for first in range(0, len(new), _PLACES_AT_ONCE):
            free[_covered((new[first : first + _PLACES_AT_ONCE] - start) / width, counts)] = False
    return found[np.all((found >= lower) & (found <= upper), axis=1)]


def _covered(places: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the numbers of the cells whose corners are all within a radius of a place, (n, d), in cells."""
    d = places.shape[1]
    fine = _FINE[d]
    offsets = np.array(list(product(range(-fine, fine + 1), repeat=d)))
    offsets = offsets[np.sum(np.maximum(np.abs(offsets) - 0.5, 0.0) ** 2, axis=1) <= fine**2]
    cells = np.floor(places).astype(np.int64)
    inside = np.zeros((len(places), len(offsets)))
    for k in range(d):
        # The farthest corner of a cell is half a cell beyond its centre along each axis.
        inside += (np.abs(offsets[:, k] + (cells[:, k] + 0.5 - places[:, k])[:, None]) + 0.5) ** 2
    strides = np.cumprod([1, *counts[:0:-1]])[::-1]
    return ((cells @ strides)[:, None] + offsets @ strides)[inside <= fine**2]


def first_come(pairs: np.ndarray, n: int) -> np.ndarray:
    """Return which of n points stay, (n,) bool: in order, each stays unless it is too close to one that stays.

    `pairs`, (k, 2), are the numbers of points that are too close to each other, the smaller one first.
    """
    stays, undecided = np.zeros(n, dtype=bool), np.ones(n, dtype=bool)
    while len(pairs):
        waits = np.zeros(n, dtype=bool)
        waits[pairs[:, 1]] = True
        stays |= undecided & ~waits
        undecided &= waits
        undecided[pairs[stays[pairs[:, 0]], 1]] = False
        pairs = pairs[undecided[pairs[:, 1]] & (undecided[pairs[:, 0]])]
    return stays | undecided


def has_expressions(body: Body) -> bool:
    """Return whether any initial value of a body depends on the position."""
    return moves_unevenly(body) or body.deformation is not None


def starts_deformed(body: Body) -> bool:
    """Return whether a body starts with a deformation, that of the scene or of a result that it goes on from."""
    form = body.shape.form
    stored = isinstance(form, Points) and form.deformation(body.material.stores, form.position[:1]) is not None
    return stored or body.deformation is not None or body.initial_pressure is not None


def missing_state(body: Body) -> list[str]:
    """Return the fields that a result lacks, so that the particles of a body cannot go on as they were."""
    form, d = body.shape.form, len(body.velocity)
    if not isinstance(form, Points) or form.state is None:
        return []
    wanted = [DEFORMATIONS[body.material.stores], *(one.name for one in body.material.internal_in(d))]
    wanted += ["affine"] * (form.file_velocity is not None) + ["initial_position"] * body.material.has_surface
    return [name for name in wanted if name not in form.state.fields]


def moves_unevenly(body: Body) -> bool:
    """Return whether the velocity of a body, or its gradient, is an expression."""
    return varies(*body.velocity) or replaces_gradient(body)


def replaces_gradient(body: Body) -> bool:
    """Return whether velocity_gradient is the affine velocity C itself and adds nothing to the velocity."""
    return varies(*(entry for _, entry in entries_in(body.velocity_gradient)))


def initial_motion(body: Body, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the velocity, (n, d), m/s, and the affine velocity C, (n, d, d), 1/s, at some places, (n, d), m.

    C is grad(velocity) + L, and the velocity velocity(X) + L (X - c), where velocity_gradient L is all numbers, c the
    centre of the bounding box; an L with an expression in it is C alone.
    """
    n, d = position.shape
    if not moves_unevenly(body):
        velocity = np.broadcast_to(np.array(body.velocity), position.shape)
        affine = np.zeros((d, d))
        if body.velocity_gradient is not None:
            affine = np.array(body.velocity_gradient)
            velocity = velocity + _offset(body, position) @ affine.T
        return velocity, np.broadcast_to(affine, (n, d, d))
    velocity = entries_at(body.velocity, position)
    if replaces_gradient(body):
        return velocity, matrix_at(body.velocity_gradient, position)
    affine = np.zeros((n, d, d))
    for c, entry in enumerate(body.velocity):
        if isinstance(entry, Expression):
            for a, name in enumerate(INITIAL[:d]):
                affine[:, c, a] = evaluate(derivative(entry.tree, name), _places(position))
    if body.velocity_gradient is not None:
        L = np.array(body.velocity_gradient)
        velocity = velocity + _offset(body, position) @ L.T
        affine = affine + L
    return velocity, affine


def initial_deformation(body: Body, position: np.ndarray, domain: Domain) -> np.ndarray | None:
    """Return J, (n,), or F, (n, d, d), at some places, (n, d), m; None where the body starts undeformed."""
    if body.initial_pressure == "hydrostatic":
        return body.material.volume_ratio_under(hydrostatic_load(body, position, domain))
    if body.deformation is None:
        form = body.shape.form
        return form.deformation(body.material.stores, position) if isinstance(form, Points) else None
    if isinstance(body.deformation, tuple):
        return matrix_at(body.deformation, position)
    return _at(body.deformation, position).astype(np.float64)


def rest_volume(body: Body, domain: Domain) -> float:
    """Return the volume of a body at rest, m^3: that of its shape, which it fills at the start, over J.

    A J that varies is averaged over places in the shape. A modulus that is still "auto" counts as incompressible.
    """
    form = body.shape.form
    unknown = body.initial_pressure == "hydrostatic" and getattr(body.material, "bulk_modulus", None) == "auto"
    if unknown or (body.deformation is None and body.initial_pressure != "hydrostatic"):
        # The volume of particles of a result is that at rest.
        return form.volume
    places = form.position if isinstance(form, Points) else _places_in(form)
    J = initial_deformation(body, places, domain)
    J = J if J.ndim == 1 else np.linalg.det(J)
    return form.volume * float(np.mean(1.0 / J[J > 0]))


def _places_in(form: Form) -> np.ndarray:
    """Return places spread evenly over a form, (n, d), m, at least one."""
    lower, upper = form.bounds()
    count = round(_AVERAGED ** (1 / len(lower)))
    places = lower + (upper - lower) * (np.stack(np.indices((count,) * len(lower)), axis=-1) + 0.5) / count
    places = places.reshape(-1, len(lower))
    inside = places[form.contains(places)]
    return inside if len(inside) else (lower + upper)[None] / 2


def hydrostatic_load(body: Body, position: np.ndarray, domain: Domain) -> np.ndarray:
    """Return density times g times depth, (n,), Pa; depth is measured along gravity from the top of the bounding box.

    It is the value of J p: particles start evenly spaced with the mass of their volume at rest, V0, and the force of
    their stress is proportional to V0 J p.
    """
    gravity = domain.gravity_at(0.0)
    lower, upper = body.shape.form.bounds()
    top = np.minimum(gravity * lower, gravity * upper).sum()
    return body.material.density * (position @ gravity - top)


def initial_faults(body: Body, position: np.ndarray, domain: Domain) -> Iterator[tuple[Path, str]]:
    """Yield each key of a body with an invalid value at some position, and a sentence on the first such position."""
    d = position.shape[1]
    for c, entry in enumerate(body.velocity):
        yield from _not_finite(("velocity", c), entry, position)
        if isinstance(entry, Expression) and not replaces_gradient(body):
            for name in INITIAL[:d]:
                slope = np.broadcast_to(evaluate(derivative(entry.tree, name), _places(position)), len(position))
                where = _first(~np.isfinite(slope), position)
                if where and np.isfinite(_at(entry, position)).all():
                    said = f"has no finite slope along {name} at the particle {where}; give velocity_gradient as well"
                    yield ("velocity", c), said
    for path, entry in entries_in(body.velocity_gradient, ("velocity_gradient",)):
        yield from _not_finite(path, entry, position)
    if body.deformation is not None:
        yield from _deformation_faults(body, position, domain)
    elif body.initial_pressure == "hydrostatic" and getattr(body.material, "bulk_modulus", None) != "auto":
        load = hydrostatic_load(body, position, domain)
        where = _first(~np.isfinite(body.material.volume_ratio_under(load)), position)
        if where:
            said = f"requires {load.max():.4g} Pa, more than the material can bear; give it a larger bulk_modulus"
            yield ("initial_pressure",), said


def _deformation_faults(body: Body, position: np.ndarray, domain: Domain) -> Iterator[tuple[Path, str]]:
    """Yield (path, sentence) for entries that are not finite, or a first particle whose J is not positive."""
    entries = entries_in(body.deformation, ("deformation",))
    found = [fault for path, entry in entries for fault in _not_finite(path, entry, position)]
    yield from found
    if found or not len(position):
        return
    values = initial_deformation(body, position, domain)
    J = values if values.ndim == 1 else np.linalg.det(values)
    where = _first(~(J > 0), position)
    if where:
        name = "J" if values.ndim == 1 else "det F"
        sentence = f"must keep {name} above 0; it is {J[np.argmax(~(J > 0))]:.4g} at the particle {where}"
        yield ("deformation",), sentence


def entries_at(entries: tuple[Entry, ...], position: np.ndarray) -> np.ndarray:
    """Return a list of k entries at some places, (n, d), as (n, k)."""
    return np.stack([_at(entry, position) for entry in entries], axis=1)


def matrix_at(rows: tuple[tuple[Entry, ...], ...], position: np.ndarray) -> np.ndarray:
    """Return a matrix of entries at some places, (n, d), as (n, d, d)."""
    return np.stack([entries_at(row, position) for row in rows], axis=1)


def _offset(body: Body, position: np.ndarray) -> np.ndarray:
    return position - np.mean(body.shape.form.bounds(), axis=0)


def _places(position: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(INITIAL, position.T, strict=False))


def _at(entry: Entry, position: np.ndarray) -> np.ndarray:
    return np.broadcast_to(value_of(entry, **_places(position)), len(position))


def _not_finite(key: Path, entry: Entry, position: np.ndarray) -> Iterator[tuple[Path, str]]:
    if isinstance(entry, Expression):
        values = _at(entry, position)
        where = _first(~np.isfinite(values), position)
        if where:
            found = values[np.argmax(~np.isfinite(values))]
            yield key, f"is {found} at the particle {where}; it must be finite everywhere"


def _first(wrong: np.ndarray, position: np.ndarray) -> str:
    """Return the position of the first faulty particle, "" if there is none."""
    return f"at {place_text(position[np.argmax(wrong)])}" if wrong.any() else ""


# Lattice points per batch; bounds the memory that sampling needs beyond its result.
_POINTS_AT_ONCE = 2**16
# Expected number of random particles from which on a body certainly gets one.
_SURE = 100
# Particles that are counted in no time, and those of a Poisson sample, which takes 0.02 to 0.1 ms for each.
MOST_COUNTED, MOST_POISSON = 200_000, 10_000


@dataclass(frozen=True, eq=False)
class BodyParticles:
    """The n particles that fill one body.

    Attributes:
        name: name of the body.
        position: (n, d) float64, m, in the coordinates of the scene.
        velocity: (n, d) float64, m/s; one read-only row where all have the same.
        affine: (n, d, d) float64, initial velocity gradient, 1/s; one read-only matrix where all have the same.
        volume: volume of each particle at rest, m^3 (m^2 in 2D): that of the body divided by n, see `rest_volume`.
        mass: mass of each particle, kg (kg per metre of depth in 2D).
        deformation: J, (n,), or F, (n, d, d), at the start; None where there is none.
        initial: (n, d), the X of expressions, m, if it differs from the position.
        sheets: those of the emitter to which they belong; None for a body.
        internal: internal variables at the start, (n,), by name, among others; those at rest are missing.
    """

    name: str
    position: np.ndarray
    velocity: np.ndarray
    affine: np.ndarray
    volume: float
    mass: float
    deformation: np.ndarray | None = None
    initial: np.ndarray | None = None
    sheets: Sheets | None = None
    internal: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of particles."""
        return len(self.position)

    @property
    def waits(self) -> bool:
        """Whether they enter later."""
        return self.sheets is not None


def sample_bodies(scene: Scene, places: dict[int, np.ndarray] | None = None) -> list[BodyParticles]:
    """Fill every body of a scene with particles, and then every emitter; the result is deterministic.

    Memory is proportional to `estimate_particles`, which callers check first. `places` are positions that
    `count_sources` found, by the index of the body; they are removed from it.

    Raises:
        InputError: a body is too thin for its lattice and gets no particle, or an initial value is not finite.
    """
    known = {} if places is None else places
    found = [_sample(body, index, scene.domain, known.pop(index, None)) for index, body in enumerate(scene.bodies)]
    for emitter, sheets in zip(scene.emitters, sheets_in(scene), strict=True):
        # Sheet after sheet, at the positions at which they enter.
        position = sheets.places(emitter)
        n, d = position.shape
        affine = np.broadcast_to(np.zeros((d, d)), (n, d, d))
        mass = emitter.material.density * sheets.volume
        velocity, volume = sheets.velocities(), sheets.volume
        found.append(BodyParticles(emitter.name, position, velocity, affine, volume, mass, sheets=sheets))
    return found


def estimate_particles(scene: Scene) -> int:
    """Return the number of particles of a scene from volumes alone: exact for boxes with a lattice, else close."""
    return sum(estimate_sources(scene))


def estimate_sources(scene: Scene) -> list[int]:
    """Return how many particles each source of a scene has; see `estimate_particles`."""
    bodies = [estimate_body(body, scene.domain.spacing) for body in scene.bodies]
    return bodies + [sheets.particles for sheets in sheets_in(scene)]


def estimate_body(body: Body, h: float) -> int:
    """Return how many particles a body has at grid spacing h; see `estimate_particles`."""
    form = body.shape.form
    if isinstance(form, Points):
        return len(form.position)
    counts = _lattice_counts(body, h)
    if isinstance(form, Box) and body.sampling != "poisson":
        return math.prod(counts)
    cell = lattice_spacing(body, h) ** len(body.velocity)
    if body.sampling in ("lattice", "jittered"):
        lower, upper = form.bounds()
        cell = math.prod((upper - lower).tolist()) / math.prod(counts)
    return max(1, round(form.volume / cell))


def count_sources(scene: Scene, places: dict[int, np.ndarray] | None = None) -> list[int]:
    """Return how many particles each source of a scene has: counted where that takes little time, else estimated.

    `places` takes the positions found, up to MOST_COUNTED in all, by the index of the body.
    """
    counts, room = estimate_sources(scene), MOST_COUNTED
    for index, body in enumerate(scene.bodies):
        if counts[index] <= (MOST_POISSON if body.sampling == "poisson" else MOST_COUNTED):
            found = particle_places(body, index, scene.domain.spacing)
            counts[index] = len(found)
            if places is not None and len(found) <= room:
                places[index] = found
                room -= len(found)
    return counts


def lattice_spacing(body: Body, h: float) -> float:
    """Return the distance between the particles of a body, m, at grid spacing h."""
    if isinstance(form := body.shape.form, Points):
        return form.edge
    return h / body.particles_per_cell ** (1 / len(body.velocity))


def points_per_cell(body: Body, h: float) -> int:
    """Return the particles per cell of a body: the given number, or that of its points, at least 1."""
    form = body.shape.form
    return max(1, round((h / form.edge) ** len(body.velocity))) if isinstance(form, Points) else body.particles_per_cell


def lattice_points(body: Body, h: float) -> int:
    """Return the number of points that are searched for the particles of a body."""
    if isinstance(form := body.shape.form, Points):
        return len(form.position)
    return math.prod(_lattice_counts(body, h))


def _lattice_counts(body: Body, h: float) -> list[int]:
    """Return the number of lattice points along each axis of the bounding box, to which the lattice is stretched."""
    lower, upper = body.shape.form.bounds()
    return [max(1, round(r)) for r in ((upper - lower) / lattice_spacing(body, h)).tolist()]


def particle_places(body: Body, index: int, h: float) -> np.ndarray:
    """Return the initial positions of a body's particles, (n, d), m, from its scene index and the grid spacing h.

    The particles of a relaxed body are then moved slightly.
    """
    form = body.shape.form
    if isinstance(form, Points):
        return form.position
    spacing, d = lattice_spacing(body, h), len(body.velocity)
    if body.sampling == "poisson":
        points = poisson_disk(*form.bounds(), disk_radius(spacing, d), _generator(body, index))
        return points[form.contains(points)]
    if body.sampling == "turned":
        return _turned(body, h)
    if isinstance(form, Box):
        return np.concatenate([points for points, _ in _lattice(body, index, h)])
    lower, upper = form.bounds()
    cell = np.diag((upper - lower) / _lattice_counts(body, h))
    return fitted(form, lambda: _lattice(body, index, h), cell)


def _turned(body: Body, h: float) -> np.ndarray:
    """Return the points of a turned lattice in a body, (n, d), m; see `_lattice_counts`."""
    form, spacing = body.shape.form, lattice_spacing(body, h)
    lower, upper = form.bounds()
    if isinstance(form, Box):
        return turned_box(lower, upper, np.array(_lattice_counts(body, h)))
    points = (lower + upper) / 2 + spacing * turned_points((upper - lower) / (2 * spacing) + 1)
    return fitted(form, lambda: [(points, points)], spacing * turned_axes(len(lower)).T)


def _sample(body: Body, index: int, domain: Domain, position: np.ndarray | None) -> BodyParticles:
    """Return the particles of a body, at `position`, m, if given. Raises InputError if there are none."""
    form = body.shape.form
    if position is None:
        position = particle_places(body, index, domain.spacing)
    if not len(position):
        raise InputError(no_particles(body, domain.spacing))
    if body.relaxed:
        position = relaxed(position, form.volume / len(position), form, domain)
    # A body too large to be examined when the scene was loaded.
    faults = [f"{path_text(('bodies', index, *key))}: {said}" for key, said in initial_faults(body, position, domain)]
    if faults:
        raise InputError("\n".join(faults))
    velocity, affine = initial_motion(body, position)
    state = form.state.fields if isinstance(form, Points) and form.state else {}
    if isinstance(form, Points) and form.file_velocity is not None:
        velocity, affine = velocity + form.file_velocity, affine + state.get("affine", 0.0)
    deformation = initial_deformation(body, position, domain)
    volume = rest_volume(body, domain) / len(position)
    mass = body.material.density * volume
    initial = state["initial_position"][:, : position.shape[1]] if "initial_position" in state else None
    return BodyParticles(body.name, position, velocity, affine, volume, mass, deformation, initial, internal=state)


def _generator(body: Body, index: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64([body.seed, index]))


def holds_particles(body: Body, index: int, h: float) -> bool:
    """Return whether a body, of the given index in its scene, gets any particle at grid spacing h."""
    if isinstance(body.shape.form, Points):
        return True
    if body.sampling == "poisson":
        # Random points miss no body with this expected number of them, however thin.
        return estimate_body(body, h) > _SURE or len(particle_places(body, index, h)) > 0
    if body.sampling == "turned":
        return len(_turned(body, h)) > 0
    return any(body.shape.form.contains(points).any() for points, _ in _lattice(body, index, h)) or bool(
        len(particle_places(body, index, h))
    )


def no_particles(body: Body, h: float) -> str:
    return (
        f'body "{body.name}" is too thin to hold a particle: its particles would be '
        f"{lattice_spacing(body, h):.6g} m apart; make it thicker, or the grid finer"
    )


def _lattice(body: Body, index: int, h: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the points (k, d) of the body's lattice in order and the middles of their cells, some at a time.

    A jittered body has one random point in each cell of the lattice instead of the middle.
    """
    lower, upper = body.shape.form.bounds()
    counts = np.array(_lattice_counts(body, h))
    spacing = (upper - lower) / counts
    total = math.prod(counts.tolist())
    generator = _generator(body, index)
    for first in range(0, total, _POINTS_AT_ONCE):
        flat = np.arange(first, min(first + _POINTS_AT_ONCE, total))
        cells = np.stack(np.unravel_index(flat, counts), axis=1)
        # Round-off may carry a point past a face by one unit in the last place.
        middles = points = np.clip(lower + (cells + 0.5) * spacing, lower, upper)
        if body.sampling == "jittered":
            points = np.clip(lower + (cells + generator.random(cells.shape)) * spacing, lower, upper)
        yield points, middles


def turned_axes(d: int) -> np.ndarray:
    """Return the rotation R, (d, d), of the turned lattice R Z^d.

    The product of the coordinates of any of its points but 0 is at least 1 / sqrt(5) (2D) or 1 / 7 (3D).
    """
    if d == 2:
        angle = math.atan(2.0) / 2
        return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    a, b, c = (2 / math.sqrt(7) * math.sin(k * math.pi / 7) for k in (1, 2, 3))
    return np.array([[-a, -b, -c], [-c, -a, b], [-b, c, -a]])


def turned_points(half: np.ndarray, offset: float = 0.5) -> np.ndarray:
    """Return the points of R (Z^d + offset) that are no farther than `half`, (d,), from 0 along each axis, (n, d)."""
    axes = turned_axes(len(half))
    reach = np.ceil(np.abs(axes.T) @ half).astype(int) + 1
    # Lines along the last axis of the lattice: the indices of the first and the last point of each in the box.
    starts = np.meshgrid(*[np.arange(-r, r) + offset for r in reach[:-1]], indexing="ij")
    lines = np.stack(starts, axis=-1).reshape(-1, len(half) - 1) @ axes[:, :-1].T
    middle, span = -lines / axes[:, -1], half / np.abs(axes[:, -1])
    first = np.ceil(np.max(middle - span, axis=1) - offset)
    last = np.floor(np.min(middle + span, axis=1) - offset)
    counts = np.maximum(0, last - first + 1).astype(int)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    along = np.repeat(first, counts) + number + offset
    return np.repeat(lines, counts, axis=0) + along[:, None] * axes[:, -1]


def turned_box(lower: np.ndarray, upper: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return as many points of a turned lattice in a box, (n, d), m, as a lattice of `counts` points per axis has.

    The lattice is stretched as that one is, and then slightly more, until the box contains exactly that number.
    """
    half, n = counts / 2, math.prod(counts.tolist())
    # A box centred on a lattice point contains an odd number of points; one centred on a cell, an even number.
    points = turned_points(half + 1, offset=0.0 if n % 2 else 0.5)
    reach = np.max(np.abs(points) / half, axis=1)
    chosen = np.argsort(reach, kind="stable")[: n + 1]
    # The faces lie midway between the last point inside and the first one outside.
    points = points[np.sort(chosen[:n])] / (counts * reach[chosen[n - 1 :]].mean())
    return np.clip((lower + upper) / 2 + points * (upper - lower), lower, upper)

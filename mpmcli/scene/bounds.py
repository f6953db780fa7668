"""Bounds on speed, depth and density that a scene can reach, computed from its initial state alone."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.scene.colliders import Collider
from mpmcli.scene.displaced_flow import displaced_flow
from mpmcli.scene.domain import STICKING
from mpmcli.scene.entry import Entry, value_of, varies
from mpmcli.scene.expression import INITIAL, POSITION, VELOCITY, Apply, Expression, Tree, bounds_of, names_in
from mpmcli.scene.material import SceneBounds
from mpmcli.scene.points import Points
from mpmcli.scene.primitives import box_corners, grid_points
from mpmcli.scene.quadrature import parts_of
from mpmcli.scene.sampling import estimate_body, initial_motion, moves_unevenly, particle_places
from mpmcli.scene.schema import Body, Emitter, Force, Scene
from mpmcli.scene.sheets import fastest_inflow, mouth_of

# Number of equal parts of a run, in addition to those in which a time-dependent term varies; largest number of parts.
SLICES, MOST_SLICES = 32, 400
# Cells along each axis of the lattice in 2D and 3D, the number of times that cells with a larger possible value are
# halved, and the largest number of such cells.
CELLS, HALVINGS, MOST_CELLS = {2: 16, 3: 8}, 10, 4096
# Largest number of particles of a body that are examined.
MOST_PLACES = 4096
# Shear rates at which a layer on a wall is tried, over six decades.
RATES = 64
# Instants at which cells are halved: those of the strongest forces.
SEARCHED = 3


@dataclass(frozen=True)
class Drive:
    """An acceleration over a run: its largest magnitude, m/s^2, and the integral of the largest at each time, m/s."""

    largest: float = 0.0
    impulse: float = 0.0


@dataclass(frozen=True)
class Slices:
    """Division of a run into parts that resolve every pulse, with sample times.

    Attributes:
        lengths: of the parts, (n,), s.
        times: (m,), s: the middle of each part, the times of the largest and smallest values of terms that depend on
            time alone, and the start and the end of the run.
        part: index of the part of each time, (m,).
    """

    lengths: np.ndarray
    times: np.ndarray
    part: np.ndarray

    def largest(self, values: np.ndarray) -> np.ndarray:
        """Return the largest of the values at the times of each part, (n,)."""
        found = np.zeros(len(self.lengths))
        np.maximum.at(found, self.part, values)
        return found


def slices_of(entries: tuple[Entry, ...], end: float) -> Slices:
    """Divide a run of `end` seconds for some entries."""
    edges, peaks = [np.linspace(0.0, end, SLICES + 1)], [np.array([0.0, end])]
    for tree in {tree for entry in entries if isinstance(entry, Expression) for tree in _timed(entry.tree)}:
        parts = parts_of(tree, 0.0, end, precise=False)
        chosen = slice(None, None, len(parts.low) // MOST_SLICES + 1)
        edges += [parts.low[chosen], parts.high[chosen]]
        each = np.arange(len(parts.low))
        for node in (parts.values.argmax(axis=1), parts.values.argmin(axis=1)):
            times = parts.times()[each, node]
            # If there are too many parts, keep those with the largest values.
            peaks.append(times[np.argsort(-np.abs(parts.values[each, node]), kind="stable")[:MOST_SLICES]])
    found = np.unique(np.concatenate(edges))
    times = np.unique(np.concatenate([0.5 * (found[1:] + found[:-1]), *peaks]))
    part = np.clip(np.searchsorted(found, times, side="right") - 1, 0, len(found) - 2)
    return Slices(np.diff(found), times, part)


def _timed(tree: Tree) -> Iterator[Tree]:
    """Yield the largest parts of a tree that depend on time alone."""
    names = names_in(tree)
    if names == {"t"}:
        yield tree
    elif "t" in names and isinstance(tree, Apply):
        for argument in tree.arguments:
            yield from _timed(argument)


def gravity_drive(scene: Scene) -> tuple[Drive, list[np.ndarray]]:
    """Return the drive of gravity, and its values, (d,), m/s^2, at instants of the run."""
    if scene.domain.steady:
        gravity = scene.domain.gravity_at(0.0)
        size = float(np.linalg.norm(gravity))
        return Drive(size, size * scene.time.end), [gravity]
    slices = slices_of(scene.domain.gravity, scene.time.end)
    times = slices.times
    columns = [np.broadcast_to(value_of(entry, t=times), times.shape) for entry in scene.domain.gravity]
    values = np.nan_to_num(np.stack(columns, axis=1))
    with np.errstate(over="ignore"):
        sizes = np.linalg.norm(values, axis=1)
    return Drive(float(sizes.max()), float(slices.largest(sizes) @ slices.lengths)), list(values)


def force_drive(scene: Scene, body: Body, places: np.ndarray, speed: float, gravity: Drive) -> Drive:
    """Return the drive of the forces on a body, magnitudes added up, at an initial speed (m/s) and under gravity.

    A position-dependent force is evaluated at the start of particles, (n, d), m, at most MOST_PLACES of them, and in
    the cells of a lattice that they can reach by free motion under the forces at their start. Cells in which interval
    arithmetic permits a larger value than was found are halved, so that a narrow force is found.
    """
    found = [_one(scene, force, places, speed, gravity) for force in scene.forces if force.body in (None, body.name)]
    return Drive(sum(one.largest for one in found), sum(one.impulse for one in found))


def _one(scene: Scene, force: Force, places: np.ndarray, speed: float, gravity: Drive) -> Drive:
    """Return the bound on the acceleration by one force; `speed`, m/s, and gravity tell how far particles come."""
    end = scene.time.end
    if not varies(*force.acceleration):
        size = float(np.linalg.norm(force.acceleration))
        return Drive(size, size * end)
    names = frozenset().union(*(entry.names for entry in force.acceleration if varies(entry)))
    still = Slices(np.array([end]), np.array([0.0]), np.array([0]))
    slices = slices_of(force.acceleration, end) if "t" in names else still
    places = places[:: len(places) // MOST_PLACES + 1]
    times = slices.times.tolist()
    strongest = np.array([_largest(force, t, places, places) for t in times])
    way = (speed + gravity.impulse + float(slices.largest(strongest) @ slices.lengths)) * end
    if names & set(POSITION):
        low, high = _cells(scene, places, way)
        # At the centres of the cells that particles can reach from any start.
        for start in (places[0], places[-1], places[len(places) // 2]):
            there = np.array([_largest(force, t, 0.5 * (low + high), start[None]) for t in times])
            strongest = np.maximum(strongest, there)
        begun = places.min(axis=0), places.max(axis=0)
        for k in np.argsort(strongest)[-SEARCHED:]:
            strongest[k] = _search(force, times[k], low, high, begun, float(strongest[k]))
    return Drive(float(strongest.max()), float(slices.largest(strongest) @ slices.lengths))


def _cells(scene: Scene, places: np.ndarray, way: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners, (n, d), m, of the lattice cells within a distance `way` of any place."""
    d, domain = scene.dimension, scene.domain
    size = np.array(domain.size) / CELLS[d]
    index = grid_points(*[np.arange(CELLS[d])] * d)
    low = np.array(domain.origin) + index * size
    middle = low + size / 2
    near = np.full(len(low), np.inf)
    for place in np.array_split(places, max(1, len(places) * len(low) // 1_000_000)):
        apart = np.linalg.norm(middle[:, None] - place[None], axis=2).min(axis=1)
        near = np.minimum(near, apart)
    reached = near <= way + float(np.linalg.norm(size)) / 2
    return low[reached], (low + size)[reached]


def _largest(force: Force, time: float, x: np.ndarray, X: np.ndarray) -> float:
    """Return the largest finite magnitude at a time, s, of particles at x that started at X, m/s^2."""
    # Forces that depend on the velocity are those at rest: what slows a body down adds nothing.
    values = dict.fromkeys(VELOCITY, 0.0)
    values |= dict(zip(POSITION, x.T, strict=False)) | dict(zip(INITIAL, X.T, strict=False))
    squares = np.asarray(sum(np.square(value_of(entry, t=time, **values)) for entry in force.acceleration))
    # Values that are not finite occur at no particle, or stop the run.
    return float(np.max(squares, initial=0.0, where=np.isfinite(squares))) ** 0.5


def _search(
    force: Force, time: float, low: np.ndarray, high: np.ndarray, begun: tuple[np.ndarray, np.ndarray], found: float
) -> float:
    """Return the largest magnitude in some cells, where bounds are finite; at least `found`."""
    d = low.shape[1]
    instant = np.float64(time)
    for _ in range(HALVINGS):
        ranges = {name: (np.float64(0.0),) * 2 for name in VELOCITY} | {"t": (instant, instant)}
        ranges |= {name: (low[:, a], high[:, a]) for a, name in enumerate(POSITION[:d])}
        ranges |= {name: (begun[0][a], begun[1][a]) for a, name in enumerate(INITIAL[:d])}
        squares = np.zeros(len(low))
        for entry in force.acceleration:
            if isinstance(entry, Expression):
                least, most = bounds_of(entry.tree, ranges)
                squares = squares + np.maximum(np.abs(least), np.abs(most)) ** 2
            else:
                squares = squares + entry**2
        bound = np.sqrt(squares)
        middle = 0.5 * (low + high)
        X = np.clip(middle, *begun)
        found = max(found, _largest(force, time, middle, X))
        # Stop if at most a twentieth more is possible, or if the force is unbounded (a pole).
        open_cells = np.flatnonzero((bound > 1.05 * found) & np.isfinite(bound))
        if not len(open_cells):
            break
        best = open_cells[np.argsort(bound[open_cells])[-MOST_CELLS // 2**d :]]
        low, middle, high = low[best], middle[best], high[best]
        corners = grid_points(*[np.array([False, True])] * d)
        upper = np.concatenate([np.where(corner, high, middle) for corner in corners])
        low = np.concatenate([np.where(corner, middle, low) for corner in corners])
        high = upper
    return found


# Points along each axis of a box at which the velocity of a body is evaluated, 2D and 3D, corners included.
POINTS = {2: 65, 3: 17}
# Largest number of particles for which a body is evaluated at its particles; a larger body uses a lattice.
MOST_LOOKED_AT = 500_000

# Range of magnitudes whose squares, and sums of a few squares, neither underflow nor overflow.
SQUARED = (1e-150, 1e150)


def reaching(source: Body | Emitter, scene: Scene) -> list[Body | Emitter]:
    """Return the sources that can fall on, press on or flow around a source of particles, and the source itself.

    A solid at rest less than a cell above the lowest point of the domain is left out if no force acts on it.
    Moving colliders and walls contribute their speed only (`scene_bounds`).
    """
    gravity, periodic = scene.domain.gravity_at(0.0), np.array(scene.domain.periodic)
    steady = scene.domain.steady and not gravity[periodic].any()
    impelled = {force.body for force in scene.pushes}
    found = []
    for other in scene.sources:
        solid = isinstance(other, Body) and other.material.solid
        stands = steady and solid and not (impelled & {None, other.name} or highest_speed(other, scene.time.end) > 0)
        if stands and gravity.any():
            above = _falls(scene, box_corners(*other.shape.form.bounds()), gravity)
            stands = float(np.min(above)) < scene.domain.spacing
        if other is source or not stands:
            found.append(other)
    return found


def scene_bounds(scene: Scene, sources: Sequence[Body | Emitter] | None = None) -> SceneBounds:
    """Return bounds on the speed, the depth and the density of a scene, or of some of its sources.

    speed = sqrt(v0^2 + 2 g H), with v0 the highest initial speed of any body and H the height of the
    highest matter above the lowest point of the domain, both measured against gravity; v0 alone where
    there is no gravity. height = H, or the largest extent of the matter where there is no gravity.

    The speed is at least that of the fastest wall, of the fastest point of a collider, and of the material that
    colliders push through what is open; the load is the pressure with which they do (`displaced_flow`), or that of the
    weight of rigid bodies. Along a periodic axis there is no lowest point: gravity along it adds its impulse over the
    run and no height, but no more than a layer reaches whose shear stress on a wall that sticks bears it.

    For time-dependent gravity, g is the largest magnitude and H the largest of any instant; the impulse also bounds the
    speed. Forces of magnitude a add min(2 a L, I^2) to the square of the speed, L the largest extent of the domain and
    I their impulse over the run, and add a to g in the pressure. `force_drive` states where they are evaluated.
    Impulses add their strength to the speed.
    """
    sources = scene.sources if sources is None else sources
    pull, gravities = gravity_drive(scene)
    push = Drive()
    if scene.forces:
        drives = [
            force_drive(scene, body, body_places(body, index, scene.domain.spacing), highest_speed(body), pull)
            for index, body in enumerate(scene.bodies)
            if any(body is one for one in sources)
        ]
        push = Drive(
            max((one.largest for one in drives), default=0.0), max((one.impulse for one in drives), default=0.0)
        )
    g = pull.largest
    pushed_by = [collider.fastest(scene.domain, scene.time.end) for collider in scene.colliders]
    flow = displaced_flow(scene)
    initial = max(
        [scene.domain.wall_speed, flow.speed, *pushed_by, *(highest_speed(body, scene.time.end) for body in sources)]
    )
    closed = ~np.array(scene.domain.periodic)
    # Without material the rigid bodies are what falls.
    forms = [body.shape.form for body in sources] or [one.form for one in scene.colliders if one.free]
    corners = np.concatenate([box_corners(*form.bounds()) for form in forms])
    if any((gravity * closed).any() for gravity in gravities):
        pulling = [gravity * closed for gravity in gravities if (gravity * closed).any()]
        height = max(0.0, *(float(np.max(_falls(scene, corners, gravity))) for gravity in pulling))
    else:
        height = float(np.max(np.ptp(corners, axis=0)))
    # Along a periodic axis gravity accelerates the material for the whole run.
    weight = g if closed.all() else max(float(np.linalg.norm(gravity * closed)) for gravity in gravities)
    fallen = 2 * weight * height if scene.domain.steady else min(2 * weight * height, pull.impulse * pull.impulse)
    if not closed.all():
        initial += max(_glide(scene, sources, corners, gravity) for gravity in gravities)
    pushed = min(2 * push.largest * max(scene.domain.size), push.impulse * push.impulse)
    weighted = g + push.largest
    speed = float(np.sqrt(initial * initial + fallen + pushed)) + sum(abs(one.strength) for one in scene.impulses)
    density = max((body.material.density for body in sources), default=0.0)
    pressure = density * (weighted * height + speed * speed)
    resisting = max((body.material.shear_stress_at(flow.rate, pressure) for body in sources), default=0.0)
    # What a joint or a fixed axis may bear does not count.
    heavy = [one for one in scene.colliders if one.free and not (one.fixed or one.joint)]
    load = max([flow.pressure(density, resisting), *(_weight(one, gravities) for one in heavy)])
    drawn = max([0.0, *(_suction(body, scene, gravities) for body in sources if isinstance(body, Emitter))])
    return SceneBounds(scene.dimension, scene.domain.spacing, weighted, speed, height, density, load, drawn)


def _glide(scene: Scene, sources: Sequence[Body | Emitter], corners: np.ndarray, gravity: np.ndarray) -> float:
    """Return the speed that gravity along periodic axes gives in the run, m/s, or until a wall that sticks bears it."""
    closed, domain = ~np.array(scene.domain.periodic), scene.domain
    along, across = (float(np.linalg.norm(gravity[axes])) for axes in (~closed, closed))
    least = along * scene.time.end
    for a, words in enumerate(domain.walls.faces(scene.dimension)):
        for word, face, way in zip(words, (domain.origin[a], domain.upper[a]), (1.0, -1.0), strict=True):
            depth = float((way * (corners[:, a] - face)).max())
            if word in STICKING and depth > 0.0:
                rates = np.array([0.0, *np.geomspace(1e-6, 1.0, RATES)]) * (along * scene.time.end / depth)
                found = (_balanced(body, rates, depth, along, across) for body in sources)
                least = min(least, max(found, default=rates[-1]) * depth)
    return least


def _balanced(body: Body | Emitter, rates: np.ndarray, depth: float, along: float, across: float) -> float:
    """Return the first shear rate at which a layer bears its weight along it; the last one if none does."""
    weight = body.material.density * depth
    with np.errstate(over="ignore"):
        bears = [body.material.shear_stress_at(rate, weight * across) >= weight * along for rate in rates]
    return float(rates[np.argmax(bears)] if any(bears) else rates[-1])


def _weight(one: Collider, gravities: Sequence[np.ndarray]) -> float:
    """Return the weight of a rigid body over the area of its bounding box across gravity, Pa; the largest one."""
    extent = np.ptp(one.form.bounds(), axis=0)
    return max(float((np.abs(gravity) * extent).max() * one.moments.mass / extent.prod()) for gravity in gravities)


def _suction(emitter: Emitter, scene: Scene, gravities: Sequence[np.ndarray]) -> float:
    """Return density (w g/v)^2, Pa, of a stream of the width w that leaves a mouth at the speed v and falls freely.

    Its sides start inwards at w g/(2 v), drawn by a suction of half of it. It is 0 where viscosity bears the stream:
    density v w < 3 viscosity.
    """
    mouth = mouth_of(emitter, scene.domain.spacing)
    width = float((mouth.spacing[1:] * mouth.counts).min())
    fall = max(float(gravity @ mouth.direction) for gravity in gravities)
    speed = fastest_inflow(emitter, scene.time.end)
    material = emitter.material
    if not material.hydrostatic or min(fall, speed, width) <= 0.0:
        return 0.0
    starts = width * fall / speed
    drawn = material.density * starts * starts
    viscous = 3 * material.shear_stress_at(speed / width, 0.0) > material.density * speed * speed
    return 0.0 if viscous else drawn


def highest_speed(body: Body | Emitter, end: float = math.inf) -> float:
    """Return a bound on the initial speed of a body, or of the inflow of an emitter until `end`, s: m/s.

    It is the largest at the corners of the bounding box.

    For a velocity that is an expression, it is the largest over a lattice of points of the body. The largest velocity
    given with the points of a file is added.
    """
    if isinstance(body, Emitter):
        return fastest_inflow(body, end)
    form, velocity = body.shape.form, body.velocity
    if moves_unevenly(body):
        speeds = np.linalg.norm(initial_motion(body, body_points(body))[0], axis=1)
        speed = float(np.max(speeds, initial=0.0, where=np.isfinite(speeds)))
    elif body.velocity_gradient is None:
        speed = float(np.linalg.norm(velocity))
    else:
        lower, upper = form.bounds()
        offsets = box_corners(lower, upper) - (lower + upper) / 2
        speed = float(np.max(np.linalg.norm(velocity + offsets @ np.array(body.velocity_gradient).T, axis=1)))
    if isinstance(form, Points) and form.file_velocity is not None:
        speed += float(np.linalg.norm(form.file_velocity, axis=1).max())
    return speed


def body_points(body: Body) -> np.ndarray:
    """Return points of a body, (n, d), m: those of a lattice over its bounding box that lie inside."""
    form = body.shape.form
    if isinstance(form, Points):
        return form.position
    points = grid_points(*np.linspace(*form.bounds(), POINTS[len(body.velocity)], axis=1))
    inside = form.contains(points)
    return points[inside] if inside.any() else points


def body_places(body: Body, index: int, h: float) -> np.ndarray:
    """Return the initial positions of the particles of a body, (n, d), m; lattice points if there are too many."""
    if estimate_body(body, h) > MOST_LOOKED_AT:
        return body_points(body)
    found = particle_places(body, index, h)
    return found if len(found) else body_points(body)


def _falls(scene: Scene, corners: np.ndarray, gravity: np.ndarray) -> np.ndarray:
    """Return the height of each point above the lowest point of the domain, m, against gravity."""
    largest = float(np.max(np.abs(gravity)))
    if not SQUARED[0] < largest < SQUARED[1]:
        # Only its direction is used; its square could overflow.
        gravity = gravity / largest
    down = gravity / float(np.linalg.norm(gravity))
    floor = np.max(box_corners(np.array(scene.domain.origin), np.array(scene.domain.upper)) @ down)
    return floor - corners @ down

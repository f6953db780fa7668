"""Rules on shapes and on their motion.

Resolution: thin bodies, gaps, distance from walls, particles per cell, and stretch. Motion: bodies that spin too fast,
    colliders that leave too little room or cannot move.
"""

import math
from collections.abc import Iterator
from itertools import combinations

import numpy as np

from mpmcli.check.facts import BodyFacts, SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.geometry import close_pairs, thin_colliders
from mpmcli.check.result_state import STRETCHED, TORN
from mpmcli.scene import Scene
from mpmcli.scene.bounds import body_points
from mpmcli.scene.colliders import Motion, Plane
from mpmcli.scene.domain import OPEN, PASSED, SEPARATING
from mpmcli.scene.primitives import grid_points
from mpmcli.scene.problem import quoted, several
from mpmcli.scene.quantity import AXES
from mpmcli.scene.sampling import initial_deformation, initial_motion, moves_unevenly, starts_deformed
from mpmcli.scene.surface import form_surface, surface_points

# Cells across a body below which internal motion is not resolved, and a rigid body is permeable. The stencil is three
# nodes wide, so that with three cells one row of particles is not affected by the surface (tests/hard_cases, H12).
FEWEST_CELLS = 3.0
# Distance, in cells, below which two particles always share a node, by kernel.
COUPLED_WITHIN = {"quadratic": 2.0, "cubic": 3.0}
# Laws of solids without a surface of their own.
WELDING = ("snow", "von_mises")
# Distance, in cells, below which a gap counts as intended contact.
TOUCHING = 0.1
# Distance, in cells, below which a wall acts on a body.
WALL_MARGIN = 1.0
# Particles per axis of a cell. Below two, stretched matter tears (numerical fracture) and sums over particles are poor
# quadratures; above four, the cost grows without a gain in accuracy.
FEWEST_PER_AXIS, MOST_PER_AXIS = 2, 4
# Largest strain of a spinning disc over the squared ratio of its rim speed to its wave speed (Timoshenko and Goodier,
# Theory of Elasticity, section 32: (3 + nu) / 8 rho v^2 in the middle); strains that are reported, and that destroy it.
STRAIN, STRAINED, BURST = 3 / 8, 0.05, 1.0
# Room over the volume of the material in it: material is compressed below the first, and crushed below the second.
TIGHT, CRUSHED = 0.95, 0.25
# Cells by which a rigid body may begin inside another body.
BEGINS_INSIDE = 0.1
# Cells between a rigid body and the body below it from which on liquid enters the gap.
UNDER = 1.0
# Cells across a gap beside a rigid body below which liquid hardly flows through it.
NARROW = 4.0
# Stretch beside a grip over that of the body between two grips, as measured for a bar pulled to twice its length.
UNEVEN = 1.11
# Cells within which liquids and grains come to rest on colliders where they arrive, and that they stand off those that
# are thinner than a cell; cells across an opening that sand passes freely.
NEAR, STANDOFF, OPENING = 0.2, (0.6, 1.5), 10.0
# Points along the longest axis of the lattice that measures room, and number of instants of the run.
POINTS, INSTANTS = {2: 96, 3: 32}, 33


def shape_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on shapes and their particles."""
    for rule in (_thin, _gaps, _sticking, _welding, _walls, _particles, _stretched, _pulled):
        yield from rule(facts)


def _thin(facts: SceneFacts) -> Iterator[Finding]:
    """Yield bodies that are thinner than FEWEST_CELLS cells."""
    h = facts.scene.domain.spacing
    for body in facts.bodies:
        cells = body.thickness / h
        # The tolerance allows for rounding of the corners.
        if cells < FEWEST_CELLS * (1 - 1e-6):
            lost = "at best its motion as a whole is correct" if cells < 1 else "it is too stiff in bending and waves"
            what = (
                f'Body "{body.name}" is {cells:.3g} cells thick at its thinnest, and fewer than {FEWEST_CELLS:g} do '
                f"not resolve it: {lost}."
            )
            fix = f"Make it {FEWEST_CELLS * h:.3g} m thick, or domain.spacing {body.thickness / FEWEST_CELLS:.3g} m."
            yield Finding("warning", "thin-body", what, fix, cells, body.name)


def _gaps(facts: SceneFacts) -> Iterator[Finding]:
    """Yield pairs of bodies with a gap between them, across which they already act on each other."""
    h, table = facts.scene.domain.spacing, facts.contacts
    bodies, fields = facts.scene.bodies, table.numbers
    reach = COUPLED_WITHIN[facts.scene.solver.kernel]
    for i, j, distance in close_pairs(facts.scene, [body.shape.form for body in bodies], reach * h):
        cells = distance / h
        first, second = bodies[i], bodies[j]
        if cells <= TOUCHING or cells >= reach * (1 - 1e-6) or table.between(fields[i], fields[j])[0] is not None:
            continue
        # Bodies with equal velocity would come to rest in contact; bodies that pass each other are dragged along.
        passing = not np.array_equal(first.velocity, second.velocity)
        what = (
            f'Bodies "{first.name}" and "{second.name}" are {cells:.2g} cells apart and already act on each other, as '
            f"the grid couples particles closer than {reach:g} cells."
        )
        fix = f"Set them {reach * h:.3g} m apart, or make the spacing {distance / reach:.3g} m, to keep them apart."
        yield Finding("warning" if passing else "note", "gap", what, fix, cells, first.name)


def _sticking(facts: SceneFacts) -> Iterator[Finding]:
    """Yield elastic bodies that stick although they could separate, in a scene that does not set contact."""
    scene, table = facts.scene, facts.contacts
    elastic = [source.name for source in scene.sources if source.has_surface]
    if not elastic or scene.contact.default != "auto" or table.parts or scene.contact.pairs:
        return
    reach = COUPLED_WITHIN[scene.solver.kernel]
    if len(elastic) > 1:
        how = f"share one velocity field: they act on each other within {reach:g} cells, and do not slide on each other"
        if scene.solver.solids == "total":
            how = "meet a quarter of a cell early, and slide on each other without friction"
        what = f"With {table.one_field} the elastic bodies {several(quoted(elastic))} {how}."
        fix = "Change this to resolve contact at their surfaces."
        yield Finding("note", "contact", what, fix, len(elastic), elastic[0])
        return
    if table.one_field and table.has_obstacles:
        what = f'With {table.one_field} body "{elastic[0]}" meets walls and colliders on the grid, and does not roll.'
        fix = "Change this to resolve contact at its surface."
        yield Finding("note", "contact", what, fix, 1, elastic[0])


def _welding(facts: SceneFacts) -> Iterator[Finding]:
    """Yield solids that weld on contact, because those that yield share one velocity field."""
    scene = facts.scene
    yielding = [one.name for one in scene.sources if one.material.law in WELDING and not facts.contacts.separates(one)]
    if yielding and len(yielding) + sum(one.has_surface and not facts.contacts.parts for one in scene.sources) > 1:
        what = f"The material of {several(quoted(yielding))} yields: solids that it meets weld to it, and do not slide."
        fix = "Make those elastic, or rigid, that need not yield; with a surface_friction, metal and clay separate."
        yield Finding("note", "weld", what, fix, len(yielding), yielding[0])


def _walls(facts: SceneFacts) -> Iterator[Finding]:
    """Yield bodies that do not touch a wall, but begin so near that it acts on them."""
    domain = facts.scene.domain
    h = domain.spacing
    for body in facts.bodies:
        lower, upper = body.body.shape.form.bounds()
        words = domain.walls.faces(facts.scene.dimension)
        for a, axis in enumerate(AXES[: facts.scene.dimension]):
            gaps = {f"{axis}_min": lower[a] - domain.origin[a], f"{axis}_max": domain.upper[a] - upper[a]}
            for (face, gap), word in zip(gaps.items(), words[a], strict=True):
                meets = word in SEPARATING and facts.contacts.separates(body.body)
                if not meets and not domain.periodic[a] and 1e-3 < gap / h < WALL_MARGIN * (1 - 1e-6):
                    begins = f'Body "{body.name}" begins {gap / h:.2g} cells from the wall {face}'
                    what = f"{begins}, which already acts on it."
                    fix = f"Let it touch the wall, or set it {WALL_MARGIN * h:.3g} m or more from it."
                    yield Finding("note", "wall-margin", what, fix, float(gap / h), body.name)


def _particles(facts: SceneFacts) -> Iterator[Finding]:
    """Yield bodies with too few particles per cell for large stretch, or more than the grid can use."""
    d = facts.scene.dimension
    fewest, most = FEWEST_PER_AXIS**d, MOST_PER_AXIS**d
    for body in facts.bodies:
        count = body.body.particles_per_cell
        has = f'Body "{body.name}" has {"one particle" if count == 1 else f"{count} particles"} per cell'
        if count < fewest:
            lost = "under large stretch gaps open between them, and it tears where the material would not."
            if count == 1:
                lost = "stretched by half it tears, and its volume and pressure depend on where its particles lie in "
                lost += "their cells."
            fix = f"Set particles_per_cell = {fewest} or more."
            yield Finding("warning", "particles-per-cell", f"{has}: {lost}", fix, count, body.name)
        elif count > most:
            what = (
                f"{has}, which cost {count / fewest:.3g} times the usual {fewest}; the resolution is that of the grid, "
                "not of the particles."
            )
            fix = f"Set particles_per_cell = {most} or fewer, and spend the time on a finer grid."
            yield Finding("note", "particles-per-cell", what, fix, count, body.name)


def _stretched(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the distances to which the start of an elastic body on the updated grid will stretch its particles."""
    d = facts.scene.dimension
    if facts.scene.solver.solids == "total":
        return
    for body in facts.bodies:
        if not body.law.coherent or body.law.projects or body.law.deformation == "J":
            continue
        stretch = _stretch_to_come(facts, body)
        cells = stretch * body.body.particles_per_cell ** (-1 / d)
        # One particle per cell has a finding of its own.
        if not STRETCHED < cells < math.inf or stretch * STRETCHED <= 1:
            continue
        what = (
            f'The start of body "{body.name}" stretches it by about {stretch:.3g}, so that its particles come to stand '
            f"{cells:.3g} cells apart: above {STRETCHED:g} the grid hardly resolves motion between them, noise grows, "
            f"and above {TORN:g} it tears."
        )
        more = f"Set particles_per_cell = {math.ceil(stretch / STRETCHED) ** d}, or start" if stretch < 10 else "Start"
        fix = f"{more} it slower or less deformed."
        yield Finding("warning" if cells > TORN else "note", "stretch", what, fix, cells, body.name)


def _pulled(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the distances to which colliders that hold two parts of an elastic body will pull its particles apart."""
    scene, d = facts.scene, facts.scene.dimension
    for body in facts.bodies if scene.solver.solids != "total" else ():
        if not body.law.coherent or body.law.projects or body.law.deformation == "J":
            continue
        stretch = pulled_stretch(scene, body)
        cells = UNEVEN * stretch * body.body.particles_per_cell ** (-1 / d)
        if cells <= STRETCHED or stretch <= 1.0:
            continue
        what = (
            f'Colliders pull body "{body.name}" to {stretch:.3g} times its length between them, so that its particles '
            f"come to stand {cells:.3g} cells apart beside them: above {STRETCHED:g} they let go of it."
        )
        fix = f"Set particles_per_cell = {math.ceil(UNEVEN * stretch / STRETCHED) ** d}, or pull it less."
        yield Finding("warning", "pulled", what, fix, cells, body.name)


def pulled_stretch(scene: Scene, body: BodyFacts) -> float:
    """Return the largest stretch of a body between two colliders that hold it and move, 1 without any."""
    grips = [collider for collider in scene.colliders if collider.wall == "hold" and not collider.free]
    if not any(collider.driven for collider in grips):
        return 1.0
    points = body_points(body.body)
    parts = [(grip.motion, points[grip.form.contains(points)]) for grip in grips]
    return max((_pull(*pair, scene.time.end) for pair in combinations(parts, 2)), default=1.0) or 1.0


def _pull(first: tuple[Motion, np.ndarray], second: tuple[Motion, np.ndarray], end: float) -> float:
    """Return the largest ratio of the distance of two held parts of a body to that at the start; 0 if not both hold."""
    (one, held), (other, gripped) = first, second
    if not len(held) or not len(gripped):
        return 0.0
    from scipy.spatial import KDTree

    away, nearest = KDTree(held).query(gripped)
    k = int(np.argmin(away))
    ends = (one, held[nearest[k]]), (other, gripped[k])
    apart = [
        float(np.linalg.norm(np.subtract(*(_carried(motion, point, time) for motion, point in ends))))
        for time in np.linspace(0.0, end, INSTANTS).tolist()
    ]
    return max(apart) / apart[0] if apart[0] > 0 else 0.0


def _carried(motion: Motion, point: np.ndarray, time: float) -> np.ndarray:
    """Return where a point of a collider, given as it is without `offset`, is at a time, s."""
    place, turn = motion.pose(time)
    return place + turn @ (point - np.array(motion.pivot))


def _stretch_to_come(facts: SceneFacts, body: BodyFacts) -> float:
    """Return the stretch of initial distances that the initial state of an elastic body will cause.

    Relaxation undoes the initial deformation, a stretch of 1 over its smallest one. Matter that moves at v relative to
    the body, apart from its rotation, strains it by v / c, c = sqrt(E / density), where its waves meet its ends.
    """
    stretch, material = 1.0, body.body.material
    points = body_points(body.body)
    if starts_deformed(body.body):
        F = initial_deformation(body.body, points, facts.scene.domain)
        F = F[np.isfinite(F).reshape(len(F), -1).all(1)]
        least = np.linalg.svd(F, compute_uv=False).min(initial=math.inf) if F.ndim == 3 else math.inf
        stretch = max(1.0, 1 / float(least)) if least > 0 else math.inf
    modulus = getattr(material, "youngs_modulus", body.stiffness)
    moving = body.body.velocity_gradient is not None or moves_unevenly(body.body)
    if not moving or not modulus > 0:
        return stretch
    C = initial_motion(body.body, points)[1].mean(0)
    with np.errstate(over="ignore", invalid="ignore"):
        speed = np.linalg.norm((points - points.mean(0)) @ (C + C.T) / 2, axis=1).max()
    return stretch * (1 + float(speed) / math.sqrt(modulus / material.density))


def drive_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on rotation, on room, and on colliders."""
    for body in facts.bodies:
        yield from _rotation(facts, body)
    for rule in (_room, _rigid, _standoff):
        yield from rule(facts)


def _rotation(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """Yield solids whose rim moves too fast relative to their waves; material that flows is exempt."""
    if body.flows or body.stiffness == 0:
        return
    places = body_points(body.body)
    velocity = initial_motion(body.body, places)[0]
    if not np.isfinite(velocity).all() or not velocity.any():
        return
    arms, motion = places - places.mean(axis=0), velocity - velocity.mean(axis=0)
    # Least-squares linear fit of the velocities; its skew part is the rotation.
    linear = np.linalg.lstsq(arms, motion, rcond=None)[0].T
    rim = float(np.linalg.norm(arms @ (0.5 * (linear - linear.T)).T, axis=1).max())
    modulus = getattr(body.body.material, "youngs_modulus", None)
    if not isinstance(modulus, int | float):
        modulus = body.stiffness / facts.scene.dimension
    waves = math.sqrt(modulus / body.body.material.density)
    strain = STRAIN * (rim / waves) ** 2
    if not strain > STRAINED:
        return
    does = "flies apart" if strain > BURST else "widens"
    what = (
        f'Body "{body.name}" spins with a rim speed of {rim:.3g} m/s and a wave speed of {waves:.3g} m/s: it is '
        f"strained by about {100 * strain:.2g} %, and {does}."
    )
    least = strain / STRAINED
    fix = f"Spin it {math.sqrt(least):.2g} times slower, or make it {least:.2g} times as stiff."
    yield Finding("error" if strain > BURST else "warning", "rotation", what, fix, strain, body.name)


def _rigid(facts: SceneFacts) -> Iterator[Finding]:
    """Yield rigid bodies that are too small for the grid, and those that begin inside another body."""
    scene, h = facts.scene, facts.scene.domain.spacing
    # A single elastic body has material on one side only.
    between = scene.emitters or len(facts.bodies) > 1 or any(not one.body.has_surface for one in facts.bodies)
    shut, told = np.array(scene.domain.walls.faces(scene.dimension)) != OPEN, set()
    for body in (collider for collider in scene.colliders if collider.free):
        lower, upper = np.array(body.form.bounds())
        cells = float((upper - lower).min() / h)
        if cells < FEWEST_CELLS and between:
            what = f'Rigid body "{body.name}" is {cells:.2g} cells thick: material on both sides interacts through it.'
            fix = f"Make it {FEWEST_CELLS:g} cells thick, or the spacing {h * cells / FEWEST_CELLS:.2g} m."
            yield Finding("warning", "thin-body", what, fix, cells, body.name)
        long = np.where(shut.all(axis=1), (upper - lower) / scene.domain.size, 0.0)
        if long.max() > 1:
            what = f'Rigid body "{body.name}" is {long.max():.3g} times as long as the domain between its walls.'
            yield Finding("error", "too-large", what, "Make it smaller, or the domain larger.", long.max(), body.name)
            continue
        points = surface_points(form_surface(body.form), h)
        sides = np.stack([points - scene.domain.origin, scene.domain.upper - points], axis=-1)[:, shut]
        boxes = [one.body.shape.form.bounds() for one in facts.bodies if one.law.deformation == "J"]
        wet = any((lower <= high).all() and (low <= upper).all() for low, high in boxes)
        others = [
            (f'collider "{one.name}"', one.signed_distance(points))
            for one in scene.colliders
            if one is not body and not one.holds
        ]
        liquids = [one.body.shape.form for one in facts.bodies if one.law.flows and one.law.coherent]
        beside = np.min([form.signed_distance(points) for form in liquids], axis=0, initial=np.inf)
        told.add(f'collider "{body.name}"')
        for name, distance in [("a wall", sides), *others]:
            depth = -float(distance.min(initial=np.inf)) / h
            if depth > BEGINS_INSIDE:
                what = f'Rigid body "{body.name}" begins {depth:.2g} cells inside of {name}, and is pushed out.'
                yield Finding("warning", "overlap", what, f"Move it by {depth * h:.2g} m.", depth, body.name)
            elif depth > -UNDER * (1 - 1e-6) and wet:
                what = (
                    f'Rigid body "{body.name}" begins {abs(min(depth, 0)):.2g} cells from {name}: no liquid '
                    "enters the gap, so that pressure holds it there and it does not float up."
                )
                fix = f"Set it {UNDER * h:.3g} m away if it should."
                yield Finding("note", "no-liquid-between", what, fix, -depth, body.name)
            elif depth > -NARROW * (1 - 1e-6) and name not in told:
                gap = np.where(beside < h, distance if distance.ndim == 1 else distance.min(axis=1), np.inf).min()
                if gap < NARROW * h * (1 - 1e-6):
                    what = (
                        f'The gap between rigid body "{body.name}" and {name} is {gap / h:.2g} cells wide: of liquid '
                    )
                    what += (
                        f"that fills it, fewer than {NARROW:g} hardly let any through, and the body moves too slowly."
                    )
                    fix = f"Make it {NARROW * h:.3g} m wide, or domain.spacing {gap / NARROW:.3g} m."
                    yield Finding("warning", "narrow-gap", what, fix, gap / h, body.name)


def _standoff(facts: SceneFacts) -> Iterator[Finding]:
    """Yield how near liquids and grains come to colliders, and openings between colliders that hinder grains."""
    scene, h = facts.scene, facts.scene.domain.spacing
    solid = [one for one in scene.colliders if not one.holds]
    loose = [one.name for one in scene.sources if not one.has_surface]
    if not (solid and loose):
        return
    what = f"Material that arrives at a collider or a rigid body comes to rest within {NEAR * h:.2g} m of its surface."
    fix, off = "Refine the domain if that matters.", NEAR * h
    if thin := thin_colliders(scene, h):
        low, off = (cells * h for cells in STANDOFF)
        what += f" It stands {low:.2g} to {off:.2g} m off {several(quoted(thin))}, thinner than a cell."
        fix = f"Make colliders at least {h:.2g} m thick, or refine the domain."
    yield Finding("note", "stand-off", what, fix, off, loose[0])
    grains = [one.name for one in scene.sources if one.material.law == "sand"]
    still = [one for one in solid if not (one.free or one.motion.moves or isinstance(one.form, Plane))]
    pairs = close_pairs(scene, [one.form for one in still], OPENING * h) if grains and len(still) > 1 else ()
    for i, j, width in pairs:
        if TOUCHING < width / h < OPENING * (1 - 1e-6):
            what = f'The opening between "{still[i].name}" and "{still[j].name}" is {width / h:.3g} cells wide: '
            what += f"fewer than {OPENING:g} let too little sand through."
            fix = f"Make it {OPENING * h:.3g} m wide, or domain.spacing {width / OPENING:.3g} m."
            yield Finding("note", "opening", what, fix, width / h, grains[0])


def _room(facts: SceneFacts) -> Iterator[Finding]:
    """Yield moving colliders that leave bodies less room than their volume."""
    scene = facts.scene
    words = {word for pair in scene.domain.walls.faces(scene.dimension) for word in pair}
    moving = [collider for collider in scene.colliders if collider.driven and not collider.holds]
    if not moving or scene.emitters or PASSED & words:
        return
    found = min(_rooms(scene), default=(math.inf, 0.0, 0.0, ""))
    ratio, time, volume, names = found
    if ratio >= TIGHT:
        return
    unit = "m^2" if scene.dimension == 2 else "m^3"
    what = (
        f"Moving colliders leave {ratio * volume:.2g} {unit} at {time:.3g} s for material that fills "
        f"{volume:.2g} {unit} at the start ({names}): it is {'crushed' if ratio < CRUSHED else 'pressed together'}."
    )
    fix = "Let them stop earlier, or leave a way out of more than two cells."
    yield Finding("error" if ratio < CRUSHED else "warning", "room", what, fix, ratio)


def _rooms(scene: Scene) -> Iterator[tuple[float, float, float, str]]:
    """Yield (room / volume, time, volume, names) for the bodies in each initial room, at several times.

    A room is a connected part of the domain outside colliders. At each time, the bodies' room becomes the union of the
    connected parts that overlap their room at the time before; `volume` is that of the bodies, m^d.
    """
    from scipy.ndimage import label

    origin, size = np.array(scene.domain.origin), np.array(scene.domain.size)
    counts = np.maximum(2, np.round(POINTS[scene.dimension] * size / size.max())).astype(int)
    cell = size / counts
    lattice = grid_points(*(np.arange(n) + 0.5 for n in counts)) * cell + origin

    def parts(time: float) -> np.ndarray:
        """Return the number of the part that contains each point, from 1 on; 0 inside a collider."""
        free = np.ones(len(lattice), bool)
        for collider in (collider for collider in scene.colliders if not collider.holds):
            free &= collider.signed_distance(lattice, time) > 0
        return label(free.reshape(counts))[0].ravel()

    first = parts(0.0)
    filled: dict[int, list[tuple[float, str]]] = {}
    for body in scene.bodies:
        index = np.clip(((body_points(body) - origin) / cell).astype(int), 0, counts - 1)
        there = first[np.ravel_multi_index(tuple(index.T), tuple(counts))]
        held = there[there > 0]
        if len(held):
            filled.setdefault(int(np.bincount(held).argmax()), []).append((body.shape.form.volume, body.name))
    room = {number: first == number for number in filled}
    for time in np.linspace(0.0, scene.time.end, INSTANTS)[1:].tolist():
        now = parts(time)
        for number, bodies in filled.items():
            reached = np.unique(now[room[number]])
            room[number] = np.isin(now, reached[reached > 0])
            volume = sum(volume for volume, _ in bodies)
            left = float(np.count_nonzero(room[number]) * np.prod(cell))
            yield left / volume, time, volume, ", ".join(f'"{name}"' for _, name in bodies)

"""Checks that need the whole scene: geometry and initial state of bodies, names, output fields."""

import math
from collections.abc import Iterator
from typing import get_args

import numpy as np

from mpmcli.scene.bounds import body_places
from mpmcli.scene.cameras import camera_problems
from mpmcli.scene.colliders import Collider, Plane, has_jump, slope_of
from mpmcli.scene.domain import OPEN, SEPARATING, STICKING
from mpmcli.scene.entry import entries_in, tree_of, value_of, varies
from mpmcli.scene.expression import Expression
from mpmcli.scene.mesh import Mesh, leaving, moved_inside
from mpmcli.scene.points import Points
from mpmcli.scene.primitives import Polygon, TurnedBox, grid_points
from mpmcli.scene.problem import Problem, hint_at, listed
from mpmcli.scene.quadrature import integral_of, parts_of, telling_times
from mpmcli.scene.quantity import AXES, place_text
from mpmcli.scene.sampling import (
    has_expressions,
    holds_particles,
    initial_faults,
    lattice_points,
    lattice_spacing,
    no_particles,
    particle_places,
    starts_deformed,
)
from mpmcli.scene.schema import Body, Emitter, ParticleField, Scene
from mpmcli.scene.shapes import Box, Composite
from mpmcli.scene.sheets import most_in_mouth, most_until_end, mouth_of, sheets_of

# Lengths below this fraction of the grid spacing are round-off.
_TOLERANCE = 1e-6
# Largest number of particles of a run.
_MOST = 2**31 - 1
# Largest number of particles of one sheet.
_MOST_IN_MOUTH = 10_000_000


def emitter_problems(scene: Scene) -> Iterator[Problem]:
    """Find invalid emitters, and solvers that support neither emitters nor open faces."""
    for k, emitter in enumerate(scene.emitters):
        where = ("emitters", k)
        count = most_in_mouth(emitter, scene.domain.spacing)
        if not count <= _MOST_IN_MOUTH:
            said = f'the mouth of "{emitter.name}" could hold {count:.3g} particles at once, and {_MOST_IN_MOUTH:g} is '
            yield Problem((*where, "shape"), said + "the most; make it narrower, or the grid coarser")
            continue
        mouth = mouth_of(emitter, scene.domain.spacing)
        if not mouth.filled.any():
            said = (
                f'"{emitter.name}" has no particle in its mouth, the section through the centre of its shape across '
                f"the velocity: they would be {mouth.spacing[0]:.6g} m apart; make it wider, or the grid finer"
            )
            yield Problem((*where, "shape"), said)
            continue
        places, origin, upper = mouth.places, np.array(scene.domain.origin), np.array(scene.domain.upper)
        beyond = np.maximum(origin - places, places - upper).max(axis=0)
        for axis in np.flatnonzero(beyond > _TOLERANCE * scene.domain.spacing):
            said = f'the mouth of "{emitter.name}" extends beyond the domain along {AXES[axis]} by {beyond[axis]:.6g} m'
            yield Problem((*where, "shape"), said + "; move it or enlarge the domain")
        yield from (Problem((*where, "shape"), said) for said in _in_the_way(emitter, places, scene))
        if emitter.start >= scene.time.end:
            said = f"must be before the end of the scene, {scene.time.end:g} s; found {emitter.start:g}"
            yield Problem((*where, "start"), said)
            continue
        yield from (Problem((*where, key), said) for key, said in _emitted(emitter, scene))
    if scene.output.drop_retired and not scene.particle_count_varies:
        said = "is for scenes with emitters or open faces, where particles come and go; leave it out"
        yield Problem(("output", "drop_retired"), said)
    opens = scene.domain.walls.any_open(scene.dimension)
    found = [("emitters",)] * bool(scene.emitters) + [("domain", "walls")] * opens
    if scene.solver.solids == "total" and found:
        what = "emitters" if scene.emitters else "open faces"
        said = f'solver.solids = "total" supports no {what}: give solids = "updated", or leave them out'
        yield Problem(found[0], said)


def _in_the_way(emitter: Emitter, places: np.ndarray, scene: Scene) -> Iterator[str]:
    """Find bodies (if inflow begins at the start) and colliders at rest that overlap a mouth."""
    h = scene.domain.spacing
    found = [
        (f'body "{body.name}"', body.shape.form.contains(places, inset=_TOLERANCE * h))
        for body in scene.bodies
        if emitter.start == 0
    ]
    found += [
        (f'collider "{collider.name}"', collider.signed_distance(places) < -_PENETRATION_CELLS * h)
        for collider in scene.colliders
        if not collider.motion.moves and not collider.holds
    ]
    for what, inside in found:
        if inside.any():
            where = place_text(places[inside.argmax()])
            yield f'the mouth of "{emitter.name}" lies in {what}, for example at {where}; move one of them'


def _emitted(emitter: Emitter, scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield (key, sentence) for a negative rate, and for amounts that do not come out until the end."""
    if emitter.rate is not None:
        until = scene.time.end if emitter.end is None else min(scene.time.end, emitter.end)
        times = np.array([emitter.start, *telling_times(tree_of(emitter.rate), emitter.start, until)])
        rates = np.broadcast_to(value_of(emitter.rate, t=times), times.shape)
        if not (rates >= 0).all() or not rates.any():
            k = np.argmax(~(rates >= 0))
            found = "nothing flows" if not rates.any() else f"at t = {times[k]:.4g} s it is {rates[k]:.4g}"
            yield "rate", f"must not be negative, and positive at some time: {found}"
            return
    sheets = sheets_of(emitter, scene)
    most = most_until_end(emitter, scene, sheets.period, sheets.size)
    for key, unit, one in (("particles", "particles", 1.0), ("volume", "m^3", sheets.volume)):
        asked = getattr(emitter, key)
        if asked is not None and round(asked / one) > most:
            end = "end" if emitter.end is not None else "time.end"
            unit = "m^2" if key == "volume" and scene.dimension == 2 else unit
            pace = sheets.period / sheets.size
            if varies(emitter.rate):
                yield key, f'is more than "{emitter.name}" lets in until {end}: {most * one:.6g} {unit} at most'
                continue
            yield (
                key,
                f'takes {asked / one * pace:.4g} s to flow out of "{emitter.name}", which has '
                f"{most * pace:.4g} s until {end}; {most * one:.6g} {unit} at most come out by then",
            )
    if sheets.particles > _MOST:
        yield "particles", f"would be {sheets.particles:.3g}, more than a run can number, {_MOST}; give fewer"


# Depth in cells at which a particle may lie inside a collider: round-off, and chords of curved surfaces.
_PENETRATION_CELLS = 0.1
# Lattices above this size are not examined.
_MOST_PLACES = 1_000_000
# Largest number of cells in the bounding box of a collider whose distances are stored on a grid.
_MOST_CELLS = 100_000_000


def gravity_problems(scene: Scene) -> Iterator[Problem]:
    """Find gravity that is not finite at some time of the run."""
    for path, entry in entries_in(scene.domain.gravity, ("domain", "gravity")):
        if isinstance(entry, Expression):
            parts = parts_of(entry.tree, 0.0, scene.time.end, precise=False)
            lost = ~np.isfinite(parts.values)
            if lost.any():
                time = float(parts.times()[lost][0])
                value = "not a number" if np.isnan(parts.values[lost][0]) else "infinite"
                yield Problem(path, f"must be finite from time 0 to time.end; at {time:.3g} s it is {value}")


def collider_problems(scene: Scene) -> Iterator[Problem]:
    """Find colliders that share a name, overlap bodies, lie outside the domain, or jump."""
    if scene.solver.solids == "total" and not all(collider.holds for collider in scene.colliders):
        said = '"total" supports walls and colliders that hold, and the scene has others: give solids = "updated"'
        yield Problem(("solver", "solids"), said)
    first: dict[str, int] = {}
    placed = True
    for k, collider in enumerate(scene.colliders):
        if first.setdefault(collider.name, k) != k:
            said = f'"{collider.name}" is the name of colliders[{first[collider.name]}] already; each needs its own'
            yield Problem(("colliders", k, "name"), said)
        unfit = list(_unfit(collider, k, scene.time.end))
        yield from unfit
        placed = placed and not unfit
        if unfit:
            continue
        yield from _out_of_reach(collider, k, scene)
        # Its distances are stored at nodes.
        if isinstance(collider.form, Mesh | Composite | Polygon | TurnedBox):
            spans = np.ptp(np.array(collider.form.bounds()), axis=0) / scene.domain.spacing
            if not (count := float(np.prod(spans + 1))) <= _MOST_CELLS:
                said = (
                    f'"{collider.name}" spans {count:.3g} cells, and {_MOST_CELLS:g} is the most for meshes, polygons '
                )
                said += "and shapes of several; leave out what is out of reach"
                yield Problem(("colliders", k, "shape"), said)
    # Bodies with a particle that starts inside a collider.
    h = scene.domain.spacing
    for i, body in enumerate(scene.bodies if placed and scene.colliders else ()):
        if lattice_points(body, h) > _MOST_PLACES:
            continue
        places = particle_places(body, i, h)
        for k, collider in enumerate(scene.colliders if len(places) else ()):
            distance = collider.signed_distance(places)
            if distance.min() < -_PENETRATION_CELLS * h and not collider.holds:
                where = place_text(places[distance.argmin()])
                said = (
                    f'body "{body.name}" overlaps collider "{collider.name}" at the start, for example at {where}; '
                    "move one of them, or subtract the shape of the collider from that of the body"
                )
                yield Problem(("colliders", k, "shape"), said)


def _unfit(collider: Collider, index: int, end: float) -> Iterator[Problem]:
    """Find motions that are not finite, and positions that jump."""
    for key in ("velocity", "angular_velocity", "offset", "angle"):
        for path, entry in entries_in(getattr(collider, key), ("colliders", index, key)):
            if isinstance(entry, Expression):
                values = [float(entry(t=time)) for time in (0.0, 0.5 * end, end)]
                if not np.isfinite([*values, integral_of(entry.tree, 0.0, end)]).all():
                    yield Problem(path, "must be finite from time 0 to time.end; it is not, as 1 / t at 0 is not")
                    return
    for key in ("offset", "angle"):
        for path, entry in entries_in(getattr(collider, key), ("colliders", index, key)):
            if isinstance(entry, Expression) and has_jump(entry.tree, slope_of(entry), end):
                said = "jumps between 0 and time.end, and a collider must move; let it go from place to place in "
                yield Problem(path, said + "some time")


def _out_of_reach(collider: Collider, index: int, scene: Scene) -> Iterator[Problem]:
    domain = scene.domain
    motion, inside = collider.motion, collider.side == "inside"
    if isinstance(collider.form, Plane) or inside or motion.moves or motion.angle != 0.0:
        return
    (lower, upper), shift = collider.form.bounds(), np.array(motion.offset)
    if np.any(upper + shift < domain.origin) or np.any(lower + shift > domain.upper):
        spans, box = (" x ".join(f"{size:.4g}" for size in sizes) for sizes in (upper - lower, domain.size))
        cure = "give its mesh scale = 0.001, if it is in millimetres" if collider.shape.files else "leave it out"
        said = f'collider "{collider.name}" ({spans} m) lies outside of the domain ({box} m); move it, or {cure}'
        yield Problem(("colliders", index, "shape"), said)


# Cells from a wall beyond which no kernel of a body reaches it.
_CLEAR = 2
# Cells between bodies beyond which they share no node.
_APART = 3
# Points per axis that are tested in the common box of two bodies, 2D and 3D.
_MOST_TRIED = {2: 512, 3: 64}
# Largest number of cells in the bounding box of a relaxed body: some 1.6 GB of nodes.
_MOST_RELAXED = 10_000_000
# Lattices above this size are not searched for a first particle here; sampling does so later.
_MOST_SEARCHED = 1_000_000


def problems_in(scene: Scene) -> list[Problem]:
    """Return the problems of a scene whose tables are valid one by one."""
    outside = list(_outside(scene))
    # A body that is much too large is reported but not filled.
    empty = [] if outside else list(_empty(scene))
    unstarted = [] if outside or empty else list(_initial(scene))
    colliding = [] if outside or empty else list(collider_problems(scene))
    where = [*_repeated_names(scene), *outside, *_overlaps(scene), *empty, *_too_large_to_relax(scene)]
    found = [*where, *unstarted, *colliding, *_pushed(scene), *_paired(scene), *_unstored(scene), *_total(scene)]
    seen = camera_problems(scene.cameras, scene.time.end)
    return [*found, *gravity_problems(scene), *emitter_problems(scene), *seen]


def _repeated_names(scene: Scene) -> Iterator[Problem]:
    first: dict[str, str] = {}
    for table, entries, one in (("bodies", scene.bodies, "body"), ("emitters", scene.emitters, "emitter")):
        for i, body in enumerate(entries):
            place = f"{table}[{i}]"
            if first.setdefault(body.name, place) != place:
                sentence = f'"{body.name}" is the name of {first[body.name]} already; every {one} needs its own'
                yield Problem((table, i, "name"), sentence)


def _outside(scene: Scene) -> Iterator[Problem]:
    """Yield a problem for each body that leaves the domain, with the faces and by how much, m."""
    domain, words = scene.domain, scene.domain.walls.faces(scene.dimension)
    for i, body in enumerate(scene.bodies):
        form = body.shape.form
        goes_on = isinstance(form, Points) and form.state
        lower, upper = form.bounds()
        faces = []
        for k, axis in enumerate(AXES[: scene.dimension]):
            # The particles of a result may overlap walls by half a cell, and be two cells beyond open faces.
            low, high = ((2.0 if word == OPEN else 0.5) if goes_on else _TOLERANCE for word in words[k])
            start, end = domain.origin[k], domain.upper[k]
            faces.append((f"{axis}_min", start - lower[k], lower[k], start, low))
            faces.append((f"{axis}_max", upper[k] - end, upper[k], end, high))
        said = [
            f"{face} by {out:.6g} m (it reaches {face[0]} = {reach:.6g}, the face is at {wall:.6g})"
            for face, out, reach, wall, margin in faces
            if out > margin * domain.spacing
        ]
        if said:
            ways = " and ".join(said)
            corners, instead, too_large = (np.array(domain.origin), np.array(domain.upper)), "move it", ""
            if isinstance(form, Mesh):
                too_large, instead = leaving(form, *corners), f"give translate = {moved_inside(form, *corners)}"
            how = f": {too_large}" if too_large else f" through {ways}; {instead} or enlarge the domain"
            yield Problem(("bodies", i, "shape"), f'body "{body.name}" leaves the domain{how}')


def _overlaps(scene: Scene) -> Iterator[Problem]:
    """Yield a problem for each pair of bodies with a common point."""
    h = scene.domain.spacing
    bounds = [body.shape.form.bounds() for body in scene.bodies]
    lowers, uppers = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    for j in range(1, len(bounds)):
        # Only bodies whose bounding boxes meet are compared in detail.
        lower, upper = np.maximum(lowers[:j], lowers[j]), np.minimum(uppers[:j], uppers[j])
        for i in np.flatnonzero(np.all(upper - lower > _TOLERANCE * h, axis=1)):
            first, second = scene.bodies[i], scene.bodies[j]
            point = _common_point(first, second, lower[i], upper[i], h)
            if point is not None:
                said = f'body "{second.name}" overlaps body "{first.name}", for example at {place_text(point)}; '
                yield Problem(("bodies", j, "shape"), said + "bodies may touch but not overlap")


def _common_point(first: Body, second: Body, lower: np.ndarray, upper: np.ndarray, h: float) -> np.ndarray | None:
    """Return a point well inside both bodies, of a lattice of half the distance of particles, or None."""
    forms = first.shape.form, second.shape.form
    if all(isinstance(form, Box) for form in forms):
        return (lower + upper) / 2
    most = _MOST_TRIED[len(lower)]
    finest = min(lattice_spacing(first, h), lattice_spacing(second, h)) / 2
    counts = [int(np.clip(math.ceil(min(r, most)), 8, most)) for r in (upper - lower) / finest]
    axes = [lo + (np.arange(n) + 0.5) * (hi - lo) / n for lo, hi, n in zip(lower, upper, counts, strict=True)]
    points = grid_points(*axes)
    # A distance costs more than an inside test, and few points lie in both bodies.
    for inset in (0.0, _TOLERANCE * h):
        for form in forms:
            points = points[form.contains(points, inset=inset)]
    return points[0] if len(points) else None


def _empty(scene: Scene) -> Iterator[Problem]:
    h = scene.domain.spacing
    for i, body in enumerate(scene.bodies):
        # The lattice of a box is fitted to it and has at least one point.
        fitted = isinstance(body.shape.form, Box) and body.sampling != "poisson"
        if not fitted and lattice_points(body, h) <= _MOST_SEARCHED and not holds_particles(body, i, h):
            yield Problem(("bodies", i, "shape"), no_particles(body, h))


def _too_large_to_relax(scene: Scene) -> Iterator[Problem]:
    for i, body in enumerate(scene.bodies):
        count = float(np.prod(np.ptp(np.array(body.shape.form.bounds()), axis=0) / scene.domain.spacing + 1))
        if body.relaxed and not count <= _MOST_RELAXED:
            said = (
                f'is for bodies of {_MOST_RELAXED:g} cells at most, and "{body.name}" spans {count:.3g}; leave it out'
            )
            yield Problem(("bodies", i, "relaxed"), said)


def _initial(scene: Scene) -> Iterator[Problem]:
    """Find deformations that do not fit their law, and initial values that are not finite at a particle."""
    h = scene.domain.spacing
    for i, body in enumerate(scene.bodies):
        misfits = list(_misfits(body, scene))
        yield from (Problem(("bodies", i, key), said) for key, said in misfits)
        starts_unevenly = has_expressions(body) or body.initial_pressure is not None
        if not misfits and starts_unevenly and lattice_points(body, h) <= _MOST_SEARCHED:
            for key, said in initial_faults(body, particle_places(body, i, h), scene.domain):
                yield Problem(("bodies", i, *key), said)


def _misfits(body: Body, scene: Scene) -> Iterator[tuple[str, str]]:
    """Find a deformation that the law does not store, and a pressure that does not follow from the depth."""
    law, keeps_J, d = body.material.law, body.material.stores == "J", scene.dimension
    if body.deformation is not None and isinstance(body.deformation, tuple) == keeps_J:
        rest = [[int(i == j) for j in range(d)] for i in range(d)]
        right = "J, one number or expression" if keeps_J else f"F, {d} rows such as {rest}"
        stored = "no more; found a matrix" if keeps_J else "it; found one value"
        yield "deformation", f"must be {right}, as the law {law} stores {stored}"
    if body.initial_pressure is None:
        return
    key = "initial_pressure"
    if not body.material.hydrostatic:
        yield key, f"is for fluids: the law {law} has no pressure that the depth alone sets"
    elif body.deformation is not None:
        yield key, "sets the deformation, which is given as well; leave one of them out"
    elif not scene.domain.steady:
        yield key, "needs gravity that stays the same; domain.gravity depends on t"
    elif not any(scene.domain.gravity):
        yield key, "needs gravity: give domain.gravity, or leave it out"


def _pushed(scene: Scene) -> Iterator[Problem]:
    """Yield problems of forces and impulses: unknown bodies, and what emitters and rigid bodies cannot have."""
    names = [*(body.name for body in scene.sources), *(one.name for one in scene.colliders if one.free)]
    for table, entries in (("forces", scene.forces), ("impulses", scene.impulses)):
        for k, force in enumerate(entries):
            if force.body is not None and force.body not in names:
                hint = hint_at(force.body, names, f"the bodies are {listed(names, 'and')}")
                yield Problem((table, k, "body"), f'no body has the name "{force.body}"; {hint}')
    for k, force in enumerate(scene.forces):
        found = [(i, body) for i, body in enumerate(scene.bodies) if force.body in (None, body.name)]
        solid = any(one.free and one.name == force.body for one in scene.colliders)
        if force.force is not None and force.body in names and not found and not solid:
            yield Problem(
                ("forces", k, "force"), f'"{force.body}" is an emitter, and has no mass at the start; give acceleration'
            )
        if force.region is not None and solid:
            yield Problem(
                ("forces", k, "region"), f'"{force.body}" is rigid, and a force acts on all of it; leave it out'
            )
        elif force.region is not None and found:
            h = scene.domain.spacing
            if not any(force.region.form.contains(body_places(body, i, h)).any() for i, body in found):
                yield Problem(("forces", k, "region"), "no particle starts there; move it or make it larger")


def _paired(scene: Scene) -> Iterator[Problem]:
    """Yield problems of `contact.pairs`: bodies unknown, named twice, paired twice or unable to separate."""
    sources = {body.name: body for body in scene.sources}
    seen: dict[frozenset[str], int] = {}
    for k, pair in enumerate(scene.contact.pairs):
        path = ("contact", "pairs", k, "between")
        unknown = [name for name in pair.between if name not in sources]
        for name in unknown:
            hint = hint_at(name, list(sources), f"the bodies are {listed(list(sources), 'and')}")
            yield Problem(path, f'no body has the name "{name}"; {hint}')
        first, second = pair.between
        if first == second:
            yield Problem(path, f'names "{first}" twice; a pair has two bodies')
        earlier = seen.setdefault(frozenset(pair.between), k)
        if earlier != k:
            yield Problem(path, f"names the bodies of contact.pairs[{earlier}]; leave one of them out")
        if pair.friction != "stick" and not unknown and not any(sources[name].has_surface for name in pair.between):
            said = f'"{first}" and "{second}" cannot separate: one must be of an elastic law, or of metal with a '
            yield Problem(path, said + 'surface_friction, and not one of points; give friction = "stick"')


def _total(scene: Scene) -> Iterator[Problem]:
    """Find the parts of a scene that solver.solids = "total" does not support."""
    if scene.solver.solids != "total":
        return
    where = ("solver", "solids")
    names = sorted({body.material.law for body in scene.bodies})
    if len(names) > 1:
        said = f'"total" is for bodies of one law; found {listed(names, "and")}: give solids = "updated"'
        yield Problem(where, said)
    # Bodies that share nodes at rest would stay joined.
    h = scene.domain.spacing
    bounds = [body.shape.form.bounds() for body in scene.bodies]
    for j, (lower, upper) in enumerate(bounds):
        for i, (other_lower, other_upper) in enumerate(bounds[:j]):
            gap = float(np.maximum(lower - other_upper, other_lower - upper).max())
            if gap < (_APART - _TOLERANCE) * h:
                said = (
                    f'"{scene.bodies[j].name}" begins {max(gap, 0.0):.4g} m from "{scene.bodies[i].name}", along the '
                    f'axis on which they are farther apart; with solver.solids = "total" it must be {_APART * h:.4g} m'
                )
                yield Problem(("bodies", j, "shape"), said)
    for i, body in enumerate(scene.bodies):
        if not body.material.elastic:
            said = (
                f'"total" is for elastic laws; body "{body.name}" follows {body.material.law}: give solids = "updated"'
            )
            yield Problem(where, said)
        if body.deformation is not None:
            said = 'must be left out with solver.solids = "total", whose state at rest is the one at the start'
            yield Problem(("bodies", i, "deformation"), said)
        elif starts_deformed(body):
            said = 'starts as a result was, and "total" starts at rest: give solver.solids = "updated"'
            yield Problem(("bodies", i, "shape"), said)
        yield from _nearly_held(body, i, scene)
    if any(scene.domain.periodic):
        said = '"total" keeps bodies whole on a grid that does not repeat; give solids = "updated", or other walls'
        yield Problem(where, said)


def _nearly_held(body: Body, index: int, scene: Scene) -> Iterator[Problem]:
    """Find "stick" walls that a body can meet only later, and walls not "separate" that only its kernels reach."""
    h, domain = scene.domain.spacing, scene.domain
    lower, upper = body.shape.form.bounds()
    for k, pair in enumerate(domain.walls.faces(scene.dimension)):
        gaps = (lower[k] - domain.origin[k], domain.upper[k] - upper[k])
        for side, word, gap in zip(("min", "max"), pair, gaps, strict=True):
            if word not in SEPARATING and _TOLERANCE * h < gap < _CLEAR * h:
                said = (
                    f'body "{body.name}" begins {gap:.4g} m from the wall {AXES[k]}_{side}, which does not separate; '
                    f'with solver.solids = "total" it must touch it, or begin {_CLEAR * h:.4g} m away, or the wall be '
                    '"separate"'
                )
                yield Problem(("bodies", index, "shape"), said)
            elif word in STICKING and gap >= _CLEAR * h:
                said = (
                    f'"stick" is, with solver.solids = "total", for a wall that the body touches at the start; '
                    f'"{body.name}" begins {gap:.4g} m away, and would not stick to it later: give "separate" and '
                    "domain.friction"
                )
                yield Problem(("domain", "walls", f"{AXES[k]}_{side}"), said)


def _unstored(scene: Scene) -> Iterator[Problem]:
    """Find output fields that are internal variables of laws that no body follows."""
    stored = {variable.name for body in scene.sources for variable in body.material.internal_in(scene.dimension)}
    available = [*get_args(ParticleField), *sorted(stored)]
    for k, name in enumerate(scene.output.fields):
        if name not in available:
            sentence = (
                f'no body of this {scene.dimension}D scene stores "{name}"; it can store {listed(available, "and")}'
            )
            yield Problem(("output", "fields", k), sentence)

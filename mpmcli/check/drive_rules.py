"""Rules on what drives a scene: bodies that spin too fast, colliders that leave too little room or cannot move."""

import math
from collections.abc import Iterator

import numpy as np

from mpmcli.check.facts import BodyFacts, SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.scene import Scene
from mpmcli.scene.bounds import body_points
from mpmcli.scene.domain import PERIODIC
from mpmcli.scene.primitives import grid_points
from mpmcli.scene.sampling import initial_motion
from mpmcli.scene.surface import form_surface, surface_points

# Largest strain of a disc that spins, over the square of the speed of its rim over its waves' (Timoshenko and Goodier,
# Theory of Elasticity, section 32: (3 + nu) / 8 rho v^2 in the middle); strains that matter, and that nothing survives.
STRAIN, STRAINED, TORN = 3 / 8, 0.05, 1.0
# Room over the volume of what fills it: matter is pressed below the first, and crushed below the second.
TIGHT, CRUSHED = 0.95, 0.25
# Cells across the thinnest part of a rigid body, at least, and by which it may begin inside of something.
FEWEST_CELLS, BEGINS_INSIDE = 3.0, 0.1
# Cells between a rigid body and what stands below it, from which on liquid gets there.
UNDER = 1.0
# Points along the longest axis of the lattice on which room is measured, and instants of the run.
POINTS, INSTANTS = {2: 96, 3: 32}, 33


def drive_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on rotation and on room."""
    for body in facts.bodies:
        yield from _rotation(facts, body)
    yield from _room(facts)
    yield from _rigid(facts)


def _rotation(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """Yield a spin whose rim is fast beside the waves that hold it; what flows is not held."""
    if body.flows or body.stiffness == 0:
        return
    places = body_points(body.body)
    velocity = initial_motion(body.body, places)[0]
    if not np.isfinite(velocity).all() or not velocity.any():
        return
    arms, motion = places - places.mean(axis=0), velocity - velocity.mean(axis=0)
    # The linear field nearest to the velocities; its skew part is the rotation.
    linear = np.linalg.lstsq(arms, motion, rcond=None)[0].T
    rim = float(np.linalg.norm(arms @ (0.5 * (linear - linear.T)).T, axis=1).max())
    modulus = getattr(body.body.material, "youngs_modulus", None)
    if not isinstance(modulus, int | float):
        modulus = body.stiffness / facts.scene.dimension
    waves = math.sqrt(modulus / body.body.material.density)
    strain = STRAIN * (rim / waves) ** 2
    if not strain > STRAINED:
        return
    does = "flies apart" if strain > TORN else "widens"
    what = (
        f'Body "{body.name}" spins so that its rim has {rim:.3g} m/s and its waves {waves:.3g} m/s: it is strained by '
        f"about {100 * strain:.2g} %, and {does}."
    )
    least = strain / STRAINED
    fix = f"Spin it {math.sqrt(least):.2g} times slower, or make it {least:.2g} times as stiff."
    yield Finding("error" if strain > TORN else "warning", "rotation", what, fix, strain, body.name)


def _rigid(facts: SceneFacts) -> Iterator[Finding]:
    """Yield rigid bodies that are too small for the grid, and those that begin inside of something."""
    scene, h = facts.scene, facts.scene.domain.spacing
    shut = np.array(scene.domain.walls.faces(scene.dimension)) != "open"
    for body in (collider for collider in scene.colliders if collider.free):
        lower, upper = np.array(body.form.bounds())
        cells = float((upper - lower).min() / h)
        if cells < FEWEST_CELLS:
            what = f'Rigid body "{body.name}" is {cells:.2g} cells thick: what is on its two sides meets through it.'
            fix = f"Make it {FEWEST_CELLS:g} cells thick, or the spacing {h * cells / FEWEST_CELLS:.2g} m."
            yield Finding("warning", "thin", what, fix, cells, body.name)
        long = np.where(shut.all(axis=1), (upper - lower) / scene.domain.size, 0.0)
        if long.max() > 1:
            what = f'Rigid body "{body.name}" is {long.max():.3g} times as long as the domain between its walls.'
            yield Finding("error", "too-large", what, "Make it smaller, or the domain larger.", long.max(), body.name)
            continue
        points = surface_points(form_surface(body.form), h)
        sides = np.stack([points - scene.domain.origin, scene.domain.upper - points], axis=-1)[:, shut]
        others = [
            (f'collider "{one.name}"', one.signed_distance(points))
            for one in scene.colliders
            if one is not body and not one.holds
        ]
        for name, distance in [("a wall", sides), *others]:
            depth = -float(distance.min(initial=np.inf)) / h
            if depth > BEGINS_INSIDE:
                what = f'Rigid body "{body.name}" begins {depth:.2g} cells inside of {name}, and is pushed out.'
                yield Finding("warning", "overlap", what, f"Move it by {depth * h:.2g} m.", depth, body.name)
            elif depth > -UNDER * (1 - 1e-6) and _wet(facts, lower, upper):
                what = (
                    f'Rigid body "{body.name}" begins {abs(min(depth, 0)):.2g} cells from {name}: no liquid gets '
                    "between them, so that it is pressed there and does not float up."
                )
                fix = f"Set it {UNDER * h:.3g} m away if it should."
                yield Finding("note", "no-liquid-between", what, fix, -depth, body.name)


def _wet(facts: SceneFacts, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Return whether any liquid begins around a box."""
    liquids = [body.body.shape.form.bounds() for body in facts.bodies if body.law.deformation == "J"]
    return any((lower <= high).all() and (low <= upper).all() for low, high in liquids)


def _room(facts: SceneFacts) -> Iterator[Finding]:
    """Yield moving colliders that leave some bodies less room than they fill."""
    scene = facts.scene
    words = {word for pair in scene.domain.walls.faces(scene.dimension) for word in pair}
    moving = [collider for collider in scene.colliders if collider.driven and not collider.holds]
    if not moving or scene.emitters or {PERIODIC, "open"} & words:
        return
    found = min(_rooms(scene), default=(math.inf, 0.0, 0.0, ""))
    ratio, time, volume, names = found
    if ratio >= TIGHT:
        return
    unit = "m^2" if scene.dimension == 2 else "m^3"
    what = (
        f"Colliders that move leave {ratio * volume:.2g} {unit} at {time:.3g} s to what fills {volume:.2g} {unit} at "
        f"the start ({names}): it is {'crushed' if ratio < CRUSHED else 'pressed together'}."
    )
    fix = "Let them stop earlier, or leave a way out of more than two cells."
    yield Finding("error" if ratio < CRUSHED else "warning", "room", what, fix, ratio)


def _rooms(scene: Scene) -> Iterator[tuple[float, float, float, str]]:
    """Yield (room over volume, time, volume, names of bodies) at instants, for the matter of each room of the start.

    A room is a part of the domain outside of colliders that is connected; matter stays in those parts that its own
    room overlaps from one instant to the next.
    """
    from scipy.ndimage import label

    origin, size = np.array(scene.domain.origin), np.array(scene.domain.size)
    counts = np.maximum(2, np.round(POINTS[scene.dimension] * size / size.max())).astype(int)
    cell = size / counts
    lattice = grid_points(*(np.arange(n) + 0.5 for n in counts)) * cell + origin

    def parts(time: float) -> np.ndarray:
        """Return the number of the part in which each point lies, from 1 on; 0 of what is in a collider."""
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

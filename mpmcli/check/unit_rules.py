"""Rules on numbers that are probably in other units, or of another kind, than they are read in."""

import math
from collections.abc import Iterator

import numpy as np

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.scene_limits import law_of
from mpmcli.check.shape_rules import INSTANTS
from mpmcli.scene.colliders import Collider
from mpmcli.scene.entry import tree_of
from mpmcli.scene.mesh import Rotation
from mpmcli.scene.problem import several
from mpmcli.scene.quadrature import largest_of
from mpmcli.scene.quantity import AXES
from mpmcli.scene.rigid import Hinge
from mpmcli.scene.shapes import Shape

# Gravity, m/s^2, in whose range it is that of the earth in cm/s^2, and in mm/s^2.
CENTIMETRES, MILLIMETRES = (900.0, 1100.0), (9000.0, 11000.0)
# Largest usual coefficient of friction, and smallest usual angle of internal friction, degrees.
ROUGH, SMOOTH = 2.0, 5.0
# Share of the domain that bodies fill, and number of its cells, below and above which it is much too large.
SPARSE, MANY = 0.01, 100_000
# Density, kg/m^3, below which a material is a gas or a foam; modulus, Pa, below which and share of the load on it below
# which it is probably not in Pa.
LIGHT, WEAK, LOADED = 25.0, 2e3, 0.1
# Rate of rotation, rad/s, from which on it may be meant in degrees; a part of a turn that is an angle in radians, to
# this share of itself.
FAST, PART, NEAR = 30.0, math.pi / 12, 5e-3
# Cells over the height of a heap of sand that resolve its slope.
HEAP = 8.0


def unit_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on numbers that look wrong."""
    units = (_gravity, _density, _modulus, _turns, _rotations)
    for rule in (*units, _friction, _angle, _room, _heap, _restitution):
        yield from rule(facts)


def _gravity(facts: SceneFacts) -> Iterator[Finding]:
    """Yield warnings if gravity is that of the earth in cm/s^2 or mm/s^2, or points up."""
    domain = facts.scene.domain
    gravity = np.nan_to_num(domain.gravity_at(0.0))
    size, up = float(np.linalg.norm(gravity)), AXES[facts.scene.dimension - 1]
    for (low, high), unit, factor in ((CENTIMETRES, "cm", 100.0), (MILLIMETRES, "mm", 1000.0)):
        if low < size < high:
            what = f"Gravity is {size:.4g} m/s^2, that of the earth in {unit}/s^2: all numbers are in SI units."
            fix = f"Divide lengths, speeds and accelerations by {factor:g}, and give densities in kg/m^3, moduli in Pa."
            yield Finding("warning", "units", what, fix, size)
    if domain.steady and gravity[-1] > 0.5 * size:
        what = f"Gravity points along +{up}, which is up in pictures: bodies rise."
        yield Finding("warning", "gravity-up", what, f"Give the {up} component a minus sign if they should fall.", size)


def _density(facts: SceneFacts) -> Iterator[Finding]:
    """Yield densities that may be in g/cm^3."""
    found = {one.name: one.material.density for one in facts.scene.sources}
    found |= {one.name: one.density for one in facts.scene.colliders if one.density}
    for name, density in found.items():
        if density < LIGHT:
            what = f'The density of "{name}" is {density:.4g} kg/m^3, that of a gas or a foam.'
            fix = f"Give it in kg/m^3: {density:.4g} g/cm^3 are {1000 * density:.4g}."
            yield Finding("note", "units", what, fix, density, name)


def _modulus(facts: SceneFacts) -> Iterator[Finding]:
    """Yield moduli far below the pressures of the scene, which may be in MPa or GPa."""
    bounds = facts.bounds
    for source in facts.scene.sources:
        law = law_of(source, facts.scene.dimension)
        name, modulus = law.first_set(source.material, law.stiffness_parameters) or ("", math.inf)
        load = source.material.density * max(bounds.gravity * bounds.height, bounds.speed**2)
        if modulus < min(WEAK, LOADED * load):
            what = f'The {name} of "{source.name}" is {modulus:.4g} Pa, in a scene with pressures up to {load:.2g} Pa.'
            fix = f"Give it in Pa: {modulus:.4g} MPa are {1e6 * modulus:.4g}, {modulus:.4g} GPa {1e9 * modulus:.4g}."
            yield Finding("note", "units", what, fix, modulus, source.name)


def _turns(facts: SceneFacts) -> Iterator[Finding]:
    """Yield rates of rotation and angles of colliders that may be in degrees."""
    end = facts.scene.time.end
    for one in facts.scene.colliders:
        rates = [tree_of(one.angular_velocity) if one.free else one.motion.spin]
        rates += [tree_of(one.joint.motor)] if isinstance(one.joint, Hinge) and one.joint.motor is not None else []
        rate = max(largest_of(tree, 0.0, end) for tree in rates)
        if rate >= FAST and (_spins if one.free else _goes_round)(one, rate, end):
            what = f'Collider "{one.name}" turns at up to {rate:.4g} rad/s, {rate / math.tau:.3g} turns in a second.'
            fix = f"Rates are in rad/s: {rate:.4g} degrees in a second are {math.radians(rate):.4g}."
            yield Finding("note", "units", what, fix, rate, one.name)
            continue
        angle = max(abs(key) for key in (one.motion.angle, *(key.angle for key in one.keyframes)))
        if angle > math.tau and angle % 1 == 0:
            what = f'Collider "{one.name}" is turned by {angle:g} rad, {angle / math.tau:.3g} turns.'
            fix = f"Angles of a motion are in rad: {angle:g} degrees are {math.radians(angle):.4g}."
            yield Finding("note", "units", what, fix, angle, one.name)


def _spins(one: Collider, rate: float, _end: float) -> bool:
    """Return whether a rigid body turns by itself, faster than it would roll."""
    return rate * one.radius > 2 * float(np.linalg.norm(one.velocity))


def _goes_round(one: Collider, rate: float, end: float) -> bool:
    """Return whether a collider does not vibrate: it makes a full turn, or its rate is constant."""
    angles = [one.motion.at(time)[1] for time in np.linspace(0.0, end, INSTANTS)]
    return float(np.ptp(angles)) > math.tau or float(np.ptp(np.diff(angles, n=2))) < 1e-9 * rate * end


def _rotations(facts: SceneFacts) -> Iterator[Finding]:
    """Yield rotations of shapes that may be in radians."""
    for one in (*facts.scene.sources, *facts.scene.colliders):
        for angle in _angles_of(one.shape):
            parts = abs(angle) / PART
            if 0 < abs(angle) < 1 or (parts < 25 and angle % 1 and abs(parts - round(parts)) < NEAR * parts):
                what = f'The shape of "{one.name}" is rotated by {angle:.4g} degrees.'
                fix = f"Rotations of shapes are in degrees: {angle:.4g} rad are {math.degrees(angle):.4g}."
                yield Finding("note", "units", what, fix, angle, one.name)


def _angles_of(shape: Shape) -> Iterator[float]:
    """Yield the angles, degrees, by which a shape and its parts are rotated."""
    for rotated in (shape.rotation, shape.mesh and shape.mesh.rotate):
        if rotated is not None:
            yield rotated.angle if isinstance(rotated, Rotation) else rotated
    for part in (*(shape.add or ()), *(shape.subtract or ())):
        yield from _angles_of(part)


def _friction(facts: SceneFacts) -> Iterator[Finding]:
    """Yield coefficients of friction above ROUGH, which may be angles, each value once."""
    scene, words = facts.scene, facts.scene.domain.walls.faces(facts.scene.dimension)
    found = {f"collider {collider.name}": collider.friction for collider in scene.colliders}
    for a, axis in enumerate(AXES[: scene.dimension]):
        for side, end in enumerate(("min", "max")):
            if words[a][side] != "periodic":
                found[f"wall {axis}_{end}"] = scene.domain.frictions[a][side]
    found |= {"contact": scene.contact.friction or 0.0}
    for friction in sorted({friction for friction in found.values() if friction > ROUGH}):
        names = several([name for name, own in found.items() if own == friction])
        what = f"The friction of {names} is {friction:.3g}: a coefficient is the tangent of an angle, about 0.5."
        fix = 'Use "stick" for a surface that holds material at any load.'
        if friction < 90:
            fix = f"For an angle of {friction:.3g} degrees give {math.tan(math.radians(friction)):.3g}."
        yield Finding("warning", "friction-coefficient", what, fix, friction)


def _angle(facts: SceneFacts) -> Iterator[Finding]:
    """Yield bodies with a friction angle below SMOOTH degrees, which may be radians."""
    for body in facts.bodies:
        angle = getattr(body.body.material, "friction_angle", None)
        if angle is not None and 0 < angle < SMOOTH:
            what = f'The friction angle of body "{body.name}" is {angle:.3g} degrees: it flows almost as a liquid.'
            fix = "Give it in degrees, for dry sand about 30."
            if cohesion := getattr(body.body.material, "cohesion", 0.0):
                what = f'The friction angle of body "{body.name}" is {angle:.3g} degrees: its cohesion alone holds it.'
                fix = f'For that take law = "von_mises" with yield_stress = {math.sqrt(3) * cohesion:.4g}.'
            elif angle < math.pi / 2:
                fix = f"In degrees, {angle:.3g} rad are {math.degrees(angle):.3g}."
            yield Finding("warning", "friction-angle", what, fix, angle, body.name)


def _room(facts: SceneFacts) -> Iterator[Finding]:
    """Yield a note if all bodies and colliders begin in a small part of a large dense grid."""
    scene = facts.scene
    if scene.emitters or not scene.bodies or math.prod(scene.domain.cells) < MANY or scene.solver.grid == "sparse":
        return
    forms = [*(body.shape.form for body in scene.bodies), *(collider.form for collider in scene.colliders)]
    bounds = [form.bounds() for form in forms]
    lower = np.maximum(np.min([low for low, _ in bounds], axis=0), scene.domain.origin)
    upper = np.minimum(np.max([high for _, high in bounds], axis=0), scene.domain.upper)
    share = float(np.prod(np.maximum(upper - lower, 0.0) / np.array(scene.domain.size)))
    if share < SPARSE:
        what = f"All bodies and colliders begin in {100 * share:.2g} % of the domain."
        fix = 'Make domain.size that of the motion, or set solver.grid = "sparse", to save memory.'
        yield Finding("note", "large-domain", what, fix, share)


def _heap(facts: SceneFacts) -> Iterator[Finding]:
    for body in facts.bodies:
        cells = body.height / facts.scene.domain.spacing
        if body.body.material.law == "sand" and cells < HEAP * (1 - 1e-6):
            what = f'Body "{body.name}" of sand is {cells:.3g} cells high: the slope of a lower heap is not resolved.'
            fix = f"Make domain.spacing {body.height / HEAP:.3g} m for {HEAP:g} cells."
            yield Finding("note", "low-heap", what, fix, cells, body.name)


def _restitution(facts: SceneFacts) -> Iterator[Finding]:
    """Yield rigid bodies with a coefficient of restitution among bodies of material, which it does not concern."""
    bouncing = [one for one in facts.scene.colliders if one.free and one.restitution > 0]
    if bouncing and facts.bodies:
        one = bouncing[0]
        what = f'The restitution of "{one.name}" acts where it meets walls, colliders and rigid bodies, not material.'
        fix = "A rebound from material follows from the stiffness and losses of the material."
        yield Finding("note", "restitution", what, fix, one.restitution, one.name)

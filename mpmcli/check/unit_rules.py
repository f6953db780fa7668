"""Rules on numbers that are probably in other units, or of another kind, than they are read in."""

import math
from collections.abc import Iterator

import numpy as np

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.scene.problem import quoted, several
from mpmcli.scene.quantity import AXES

# Gravity, m/s^2, in whose range it is that of the earth in cm/s^2, and in mm/s^2.
CENTIMETRES, MILLIMETRES = (900.0, 1100.0), (9000.0, 11000.0)
# Largest usual coefficient of friction, and smallest usual angle of internal friction, degrees.
ROUGH, SMOOTH = 2.0, 5.0
# Share of the domain that bodies fill, and number of its cells, below and above which it is much too large.
SPARSE, MANY = 0.01, 100_000
# Cells over the height of a heap of sand that resolve its slope.
HEAP = 8.0


def unit_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on numbers that look wrong."""
    for rule in (_gravity, _friction, _angle, _room, _heap, _welds, _restitution):
        yield from rule(facts)


def _gravity(facts: SceneFacts) -> Iterator[Finding]:
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


def _friction(facts: SceneFacts) -> Iterator[Finding]:
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
    for body in facts.bodies:
        angle = getattr(body.body.material, "friction_angle", None)
        if angle is not None and 0 < angle < SMOOTH:
            what = f'The friction angle of body "{body.name}" is {angle:.3g} degrees: it flows almost as a liquid.'
            fix = "Give it in degrees, for dry sand about 30."
            if angle < math.pi / 2:
                fix = f"In degrees, {angle:.3g} rad are {math.degrees(angle):.3g}."
            yield Finding("warning", "friction-angle", what, fix, angle, body.name)


def _room(facts: SceneFacts) -> Iterator[Finding]:
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


def _welds(facts: SceneFacts) -> Iterator[Finding]:
    """Yield plastic solids, which share a velocity field and join where they meet."""
    shared = (one for one in facts.bodies if not facts.contacts.separates(one.body))
    plastic = (one for one in shared if one.law.deformation == "F" and one.law.projects)
    solid = [one.name for one in plastic if one.body.material.law != "sand"]
    if len(solid) > 1:
        what = f"The bodies {several(quoted(solid))} can flow: where they meet they stick, and become one."
        fix = "Make those that need not deform elastic, or colliders with a density."
        yield Finding("note", "welds", what, fix, len(solid), solid[0])


def _restitution(facts: SceneFacts) -> Iterator[Finding]:
    """Yield rigid bodies with a coefficient of restitution among bodies of material, which it does not concern."""
    bouncing = [one for one in facts.scene.colliders if one.free and one.restitution > 0]
    if bouncing and facts.bodies:
        one = bouncing[0]
        what = f'The restitution of "{one.name}" acts where it meets walls, colliders and rigid bodies, not material.'
        fix = "A rebound from material follows from the stiffness and losses of the material."
        yield Finding("note", "restitution", what, fix, one.restitution, one.name)

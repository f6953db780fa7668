"""Rules on materials: impact speed, softness, locking, density ratio, friction, rest on the floor, sand in liquids."""

import math
from collections.abc import Iterator
from itertools import permutations

import numpy as np

from mpmcli.check.facts import BodyFacts, SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.geometry import touched_walls
from mpmcli.check.strikes import strike_speed
from mpmcli.plain_text import plain_number
from mpmcli.scene.bounds import body_points
from mpmcli.scene.domain import PASSED, STICKING
from mpmcli.scene.primitives import Box
from mpmcli.scene.problem import quoted, several
from mpmcli.scene.quantity import AXES

# Poisson's ratio above which displacement fields of four particles per cell lock (tests/hard_cases, H10).
LOCKING = 0.49
# Ratio of densities above which the light body follows the heavy one within a step (tests/hard_cases, H4).
DENSITY_RATIO = 100.0
# Ratios of speed to wave speed. The density of a fluid varies by the square, and "auto" allows at most 0.1. A block of
# linear fluid that hits a wall at five times its speed of sound collapses.
FAST, SUPERSONIC = 1 / 3, 1.0
# Ratio of the weight of a column to Young's modulus above which the body does not keep its initial shape.
SOFT = 0.3
# Degrees by which the friction angle in triaxial extension may exceed the given one.
STEEP = 10.0
# Largest number of particles whose way to a wall is followed.
MOST_WAYS = 256
# Viscosity from which on a fluid is viscous, Pa s: between oil and honey.
VISCOUS = 0.1


def material_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on materials."""
    for body in facts.bodies:
        for rule in (_impact, _soft, _locking, _friction):
            yield from rule(facts, body)
    yield from _density(facts)
    yield from _slippery(facts)
    yield from _pulling(facts)
    yield from _unpressed(facts)
    yield from _submerged(facts)
    yield from _overturning(facts)


def _impact(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """Yield impact speeds near the wave speed; in scenes with flow any body may be hit at the largest speed."""
    speed = facts.bounds.speed if facts.flowing else body.arrival.speed
    struck, name = strike_speed(facts.scene, body.body, body.arrival.time)
    by, speed, waves = f' by "{name}"' if struck > speed else "", max(speed, struck), body.wave_speed
    if waves == 0 or speed <= FAST * waves:
        return
    if body.body.material.elastic:
        # It stiffens only as it is crushed.
        waves = math.sqrt(body.stiffness / (body.law.dimension * body.body.material.density))
    ratio = speed / waves
    if ratio > SUPERSONIC:
        said = "faster than its waves: impacts are shocks, smeared over some cells, and may crush it to nothing"
    elif body.law.deformation == "J":
        said = f"{ratio:.2g} of its speed of sound: its density varies by up to {100 * ratio**2:.0f} % in smooth flow"
    else:
        said = f"{ratio:.2g} of its wave speed: impacts crush it by about as much"
    what = f'Body "{body.name}" may be hit{by} at {speed:.3g} m/s and its waves run at {waves:.3g} m/s, so {said}.'
    stiffness = body.law.first_set(body.body.material, body.law.stiffness_parameters)
    name, value = stiffness or ("its stiffness", body.stiffness)
    needed = value * (ratio / FAST) ** 2
    fix = f"Raise {name} from {plain_number(value)} to {plain_number(needed)} Pa or more, or slow the scene down."
    yield Finding("warning", "impact-speed", what, fix, ratio, body.name)


def _soft(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """Yield a warning if the weight of a solid body, Pa at its foot, exceeds SOFT times its modulus."""
    modulus = getattr(body.body.material, "youngs_modulus", body.stiffness)
    if body.law.deformation == "J" or not isinstance(modulus, int | float):
        return
    weight = body.body.material.density * facts.bounds.gravity * body.height
    if weight > SOFT * modulus:
        what = (
            f'Body "{body.name}" is so soft that its own weight, {plain_number(weight)} Pa at its foot, is '
            f"{plain_number(weight / modulus)} times its modulus of {plain_number(modulus)} Pa: it collapses."
        )
        lower = f"make the body lower than {body.height * SOFT * modulus / weight:.2g} m."
        fix = f"Raise the modulus above {plain_number(weight / SOFT)} Pa, or {lower}"
        yield Finding("warning", "soft", what, fix, weight / modulus, body.name)


def _locking(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    ratio = getattr(body.body.material, "poissons_ratio", 0.0)
    # With F-bar its steps are small and damp what moves, which is in the finding on dissipation.
    if ratio <= LOCKING or (facts.scene.solver.f_bar is not False and not body.flows):
        return
    has = f'Body "{body.name}" has a Poisson\'s ratio of {ratio:g}'
    lost = f"above {LOCKING:g} it bends too stiffly, its pressure varies from particle to particle, and its steps are "
    fix = f"Set solver.f_bar = true, poissons_ratio = {LOCKING:g} or less, or model it as a fluid."
    yield Finding("warning", "locking", f"{has}: {lost}small.", fix, ratio, body.name)


def _friction(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """Yield the friction angles in triaxial compression and extension of a cone matched to plane strain."""
    angle = getattr(body.body.material, "friction_angle", None)
    if angle is None or facts.scene.dimension == 2:
        return
    s, root = math.sin(math.radians(angle)), 2 * math.sqrt(3)
    compression = math.degrees(math.asin(3 * s / (root + s)))
    extension = math.degrees(math.asin(min(1.0, 3 * s / (root - s))))
    what = (
        f'The friction angle of body "{body.name}", {angle:.3g} degrees in plane strain, acts as {compression:.1f} '
        f"degrees in triaxial compression and as {extension:.1f} degrees in extension."
    )
    fix = "Give the angle of plane strain; where triaxial compression dominates, as in the middle of a cone, give more."
    yield Finding("warning" if extension - angle > STEEP else "note", "friction", what, fix, angle, body.name)


def _density(facts: SceneFacts) -> Iterator[Finding]:
    """Yield a warning if the densities of two bodies differ by more than the factor DENSITY_RATIO."""
    if not facts.bodies:
        return
    light = min(facts.bodies, key=lambda body: body.body.material.density)
    heavy = max(facts.bodies, key=lambda body: body.body.material.density)
    ratio = heavy.body.material.density / light.body.material.density
    if ratio > DENSITY_RATIO:
        what = (
            f'Body "{heavy.name}" is {ratio:.3g} times as dense as body "{light.name}": on shared nodes the '
            "light one is dragged along."
        )
        fix = f"Keep the ratio of densities under {DENSITY_RATIO:g}, or leave the light body out."
        yield Finding("warning", "density-ratio", what, fix, ratio, light.name)


def _slippery(facts: SceneFacts) -> Iterator[Finding]:
    """Yield materials that slide on a frictionless floor although they would adhere to it."""
    (axis, side), domain = _floor(facts), facts.scene.domain
    if side is None or domain.walls.faces(facts.scene.dimension)[axis][side] in PASSED | STICKING:
        return
    if domain.frictions[axis][side] == 0:
        face = f"{AXES[axis]}_{('min', 'max')[side]}"
        fix = f'Set domain.walls = {{ {face} = "stick" }}, or domain.friction = {{ {face} = 0.5 }}, if it should not.'
        for body in facts.bodies:
            if _grips(body) and not _covered(facts, body, axis, side):
                what = f'Body "{body.name}" slides on the wall {face}, which has no friction.'
                yield Finding("note", "slippery", what, fix, 0.0, body.name)


def _pulling(facts: SceneFacts) -> Iterator[Finding]:
    """Yield colliders that slip, which push and pull."""
    slips = [one.name for one in facts.scene.colliders if one.wall == "slip"]
    if slips and facts.scene.sources:
        what = f'The wall = "slip" of {several(quoted(slips))} also pulls: material may leave it late or never.'
        fix = 'Set wall = "separate", the default, where material should leave.'
        yield Finding("note", "slip", what, fix, len(slips), slips[0])


def _unpressed(facts: SceneFacts) -> Iterator[Finding]:
    """Yield pools at rest that begin without hydrostatic pressure."""
    axis, side = _floor(facts)
    for body in facts.bodies if side is not None else ():
        form, source = body.body.shape.form, body.body
        if body.law.deformation != "J" or source.initial_pressure or not isinstance(form, Box):
            continue
        # Hydrostatic pressure is that of constant gravity.
        if not facts.scene.domain.steady:
            continue
        touched = touched_walls(facts.scene, form)
        level = all(all(faces) for a, faces in enumerate(touched) if a != axis)
        if level and touched[axis][side] and source.deformation is None and not np.any(source.velocity):
            pressure = source.material.density * facts.bounds.gravity * body.height
            what = (
                f'Body "{body.name}" fills the domain from wall to wall and begins without pressure: it sinks and '
                f"bounces for seconds, and its pressure varies by up to {plain_number(pressure)} Pa."
            )
            fix = 'Set initial_pressure = "hydrostatic" to begin at rest.'
            yield Finding("note", "no-pressure", what, fix, pressure, body.name)


def _submerged(facts: SceneFacts) -> Iterator[Finding]:
    """Yield sand beside liquids, which do not enter its pores: the friction of sand is that of the total pressure."""
    sources = facts.scene.sources
    sand = [source.name for source in sources if hasattr(source.material, "friction_angle")]
    liquids = [source.name for source in sources if source.material.hydrostatic]
    if sand and liquids:
        what = (
            f"The pressure of {several(quoted(liquids))} on {several(quoted(sand))} counts for its friction, because "
        )
        what += "no liquid enters its pores: where it is submerged it holds steep slopes."
        fix = "To let it slide, leave the liquid out, and lower the density of the sand by that of the liquid."
        yield Finding("note", "submerged", what, fix, len(sand), sand[0])


def _overturning(facts: SceneFacts) -> Iterator[Finding]:
    """Yield liquids on a lattice of which a heavier one lies on a lighter one: its rows resist the first motion."""
    (axis, side), h = _floor(facts), facts.scene.domain.spacing
    liquids = [one.body for one in facts.bodies if one.body.material.hydrostatic] if side is not None else []
    for heavy, light in permutations(liquids, 2):
        over, under = heavy.shape.form.bounds(), light.shape.form.bounds()
        # Positive where the lowest point of one is above the highest of the other.
        gap = over[0][axis] - under[1][axis] if side == 0 else under[0][axis] - over[1][axis]
        across = np.arange(facts.scene.dimension) != axis
        beside = (np.minimum(over[1], under[1]) - np.maximum(over[0], under[0]))[across] > 0
        lattices = [one.name for one in (heavy, light) if one.sampling == "lattice"]
        if heavy.material.density > light.material.density and abs(gap) < h and beside.all() and lattices:
            what = f'"{heavy.name}" lies on the lighter "{light.name}": on a lattice its fall begins late.'
            fix = f'Set sampling = "turned" for {several(quoted(lattices))}.'
            yield Finding("note", "overturning", what, fix, heavy.material.density, heavy.name)


def _floor(facts: SceneFacts) -> tuple[int, int | None]:
    """Return axis and side, 0 or 1, of the wall in the direction of gravity; the side is None without gravity."""
    gravity = np.nan_to_num(facts.scene.domain.gravity_at(0.0))
    axis = int(np.abs(gravity).argmax())
    return axis, int(gravity[axis] > 0) if gravity.any() else None


def _covered(facts: SceneFacts, body: BodyFacts, axis: int, side: int) -> bool:
    """Return whether colliders lie on all ways of a body along an axis to a wall."""
    points, domain = body_points(body.body), facts.scene.domain
    ways = points[:: max(1, len(points) // MOST_WAYS)]
    drops = ((domain.origin, domain.upper)[side][axis] - ways[:, axis]) * np.eye(facts.scene.dimension)[axis][:, None]
    # So near to each other that no plate is missed.
    shares = np.linspace(0.0, 1.0, 2 + int(2 * np.abs(drops).max() / domain.spacing))
    places = ways + shares[:, None, None] * drops.T
    blocked = np.zeros(len(ways), bool)
    for one in (one for one in facts.scene.colliders if not (one.holds or one.free)):
        distance = one.signed_distance(places.reshape(-1, facts.scene.dimension)).reshape(len(shares), -1)
        blocked |= (distance < domain.spacing / 4).any(axis=0)
    return bool(blocked.all())


def _grips(body: BodyFacts) -> bool:
    """Return whether a body would adhere to a floor: grains, mud and the like, and viscous liquids."""
    material = body.body.material
    if hasattr(material, "friction_angle") or hasattr(material, "consistency"):
        return True
    viscosity = getattr(material, "viscosity", 0.0)
    return body.law.deformation == "J" and isinstance(viscosity, int | float) and viscosity >= VISCOUS

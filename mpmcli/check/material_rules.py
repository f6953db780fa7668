"""Rules on materials in their scene: too fast, too soft, nearly incompressible, too unequal, too steep."""

import math
from collections.abc import Iterator

from mpmcli.check.facts import BodyFacts, SceneFacts
from mpmcli.check.finding import Finding

# Poisson's ratio from which linear fields of one particle per quarter cell lock (H10).
LOCKING = 0.49
# Densities further apart make the light body follow the heavy one within a step (H4).
DENSITY_RATIO = 100.0
# Speed over wave speed: the density of a fluid varies by its square, and 0.1 is the most that "auto" allows. A block of
# linear fluid that hits a wall at five times its speed of sound is crushed to nothing.
FAST, SUPERSONIC = 1 / 3, 1.0
# Weight of the column over Young's modulus: a third is the strain under which a body is no longer the shape that was
# drawn.
SOFT = 0.3
# Degrees by which the friction angle that acts in triaxial extension may exceed the one that was asked for.
STEEP = 10.0


def material_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield what is to be said of the materials."""
    flowing = any(body.flows for body in facts.bodies)
    for body in facts.bodies:
        yield from _impact(facts, body, flowing=flowing)
        yield from _soft(facts, body)
        yield from _locking(body)
        yield from _friction(facts, body)
    yield from _density(facts)


def _impact(facts: SceneFacts, body: BodyFacts, *, flowing: bool) -> Iterator[Finding]:
    """What keeps its shape meets others as fast as it falls; what flows, and whatever it may hit, at any speed."""
    speed = facts.bounds.speed if flowing else body.arrival.speed
    if body.wave_speed == 0 or speed <= FAST * body.wave_speed:
        return
    ratio = speed / body.wave_speed
    if ratio > SUPERSONIC:
        said = "faster than its waves: impacts are shocks, smeared over some cells, and may crush it to nothing"
    elif body.law.deformation == "J":
        said = f"{ratio:.2g} of its speed of sound: its density varies by up to {100 * ratio**2:.0f} % in smooth flow"
    else:
        said = f"{ratio:.2g} of its wave speed: impacts crush it by about as much"
    name, value = _stiffness(body)
    yield Finding(
        "warning",
        "impact-speed",
        f'Body "{body.name}" may be hit at {speed:.3g} m/s and its waves run at {body.wave_speed:.3g} m/s, so {said}.',
        f"Raise {name} from {value:.3g} to {value * (ratio / FAST) ** 2:.2g} Pa or more, or slow the scene down.",
        ratio,
        body.name,
    )


def _soft(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    modulus = getattr(body.body.material, "youngs_modulus", body.stiffness)
    if body.law.deformation == "J" or not isinstance(modulus, int | float):
        return
    weight = body.body.material.density * facts.bounds.gravity * body.height
    if weight > SOFT * modulus:
        yield Finding(
            "warning",
            "soft",
            f'Body "{body.name}" is so soft that its own weight, {weight:.3g} Pa at its foot, is '
            f"{weight / modulus:.2g} of its modulus of {modulus:.3g} Pa: it collapses.",
            f"Raise the modulus above {weight / SOFT:.2g} Pa, or make the body lower than "
            f"{body.height * SOFT * modulus / weight:.2g} m.",
            weight / modulus,
            body.name,
        )


def _locking(body: BodyFacts) -> Iterator[Finding]:
    ratio = getattr(body.body.material, "poissons_ratio", 0.0)
    if ratio > LOCKING:
        yield Finding(
            "warning",
            "locking",
            f'Body "{body.name}" has a Poisson\'s ratio of {ratio:g}: above {LOCKING:g} it bends too stiffly, its '
            "pressure varies from particle to particle, and its steps are small.",
            f"Set poissons_ratio = {LOCKING:g} or less, or model it as a fluid or viscoplastic material.",
            ratio,
            body.name,
        )


def _friction(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """The cone that is matched to plane strain acts in triaxial compression and extension as another angle."""
    angle = getattr(body.body.material, "friction_angle", None)
    if angle is None or facts.scene.dimension == 2:
        return
    s, root = math.sin(math.radians(angle)), 2 * math.sqrt(3)
    compression = math.degrees(math.asin(3 * s / (root + s)))
    extension = math.degrees(math.asin(min(1.0, 3 * s / (root - s))))
    yield Finding(
        "warning" if extension - angle > STEEP else "note",
        "friction",
        f'The friction angle of body "{body.name}", {angle:g} degrees in plane strain, acts as {compression:.1f} '
        f"degrees in triaxial compression and as {extension:.1f} degrees in extension.",
        "Give the angle of plane strain; where compression from all sides decides, as in a cone's middle, give more.",
        angle,
        body.name,
    )


def _density(facts: SceneFacts) -> Iterator[Finding]:
    light = min(facts.bodies, key=lambda body: body.body.material.density)
    heavy = max(facts.bodies, key=lambda body: body.body.material.density)
    ratio = heavy.body.material.density / light.body.material.density
    if ratio > DENSITY_RATIO:
        yield Finding(
            "warning",
            "density-ratio",
            f'Body "{heavy.name}" is {ratio:.3g} times as dense as body "{light.name}": on the nodes that they share '
            "the light one is carried along.",
            f"Keep the ratio of densities under {DENSITY_RATIO:g}, or leave the light body out.",
            ratio,
            light.name,
        )


def _stiffness(body: BodyFacts) -> tuple[str, float]:
    """Return the name of the parameter that sets the stiffness of a body, and its value, Pa."""
    found = body.law.first_set(body.body.material, body.law.stiffness_parameters)
    return found or ("its stiffness", body.stiffness)

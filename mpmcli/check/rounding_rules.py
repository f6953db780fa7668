"""Rules on single precision: small motions in a wide domain, small strains of a stiff body (docs/theory.md, 8.3)."""

from collections.abc import Iterator

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding

# Largest relative rounding error of a number of 32 bits.
HALF_ULP = 2.0**-24
# Rounding of a position over the displacement of the fastest particle in a step. At 1 that particle does not move, at
# 0.1 particles ten times slower do not (docs/theory.md, 8.3; docs/hard-cases.md, H18).
LOST_MOTION = 0.1
# Ratio of the stress from rounding of F to the stress from gravity or speed (docs/hard-cases.md, H9).
STRESS_NOISE = 0.01


def rounding_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on solver.precision."""
    if facts.scene.solver.precision == "f64":
        return
    yield from _positions(facts)
    yield from _strains(facts)


def _positions(facts: SceneFacts) -> Iterator[Finding]:
    """Positions are relative to the origin of the domain, so that its extent is the largest."""
    extent = max(facts.scene.domain.size)
    way = facts.bounds.speed * facts.taken(facts.step_at_start)
    if way == 0:
        return
    share = HALF_ULP * extent / way
    if share > LOST_MOTION:
        yield Finding(
            "warning",
            "rounding-positions",
            f"Positions in a domain of {extent:.3g} m are rounded by {HALF_ULP * extent:.2g} m in single precision, "
            f"{100 * share:.2g} % of the {way:.2g} m that the fastest particle moves in a step: slow ones stand still.",
            'Set solver.precision = "f64".',
            share,
        )


def _strains(facts: SceneFacts) -> Iterator[Finding]:
    for body in facts.bodies:
        density = body.body.material.density
        weight = density * facts.bounds.gravity * body.height
        typical = weight if weight > 0 else density * facts.bounds.speed**2
        noise = HALF_ULP * body.stiffness
        if typical > 0 and noise > STRESS_NOISE * typical:
            yield Finding(
                "warning",
                "rounding-strains",
                f'Body "{body.name}" is so stiff that rounding its strain in single precision makes {noise:.2g} Pa, '
                f"{100 * noise / typical:.2g} % of the {typical:.2g} Pa of its {'weight' if weight > 0 else 'motion'}.",
                'Set solver.precision = "f64", or take a softer material.',
                noise / typical,
                body.name,
            )

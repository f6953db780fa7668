"""Rules on single precision: small motions in a wide domain, small strains of a stiff body (docs/theory.md, 8.3)."""

from collections.abc import Iterator

import numpy as np

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.scene.bounds import highest_speed

# Largest relative rounding error of a number of 32 bits.
HALF_ULP = 2.0**-24
# Rounding of a position in a frame over the way of its body in the run. A step loses nothing: particles carry what
# rounding takes from their positions (docs/theory.md, 8.3).
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
    """Positions are relative to the origin of the domain, so that the farthest of a body is rounded most."""
    end = facts.scene.time.end
    deformed = any(start.deformed for start in facts.starts)
    for body in facts.bodies:
        farthest = float(np.max(body.body.shape.form.bounds()[1] - facts.scene.domain.origin))
        speed = facts.bounds.speed if deformed else highest_speed(body.body)
        way = (speed + facts.bounds.gravity * end) * end
        if way > 0 and HALF_ULP * farthest > LOST_MOTION * way:
            yield Finding(
                "warning",
                "rounding-positions",
                f'Body "{body.name}" moves {way:.2g} m at most in the run, and its positions, up to {farthest:.3g} m '
                f"from the corner of the domain, are rounded by {HALF_ULP * farthest:.2g} m in single precision.",
                'Set solver.precision = "f64".',
                HALF_ULP * farthest / way,
                body.name,
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

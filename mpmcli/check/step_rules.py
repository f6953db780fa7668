"""Rules on the time step of a scene."""

import math
from collections.abc import Iterator

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.forecast import wave_loss
from mpmcli.stability.transfer_factors import step_inertia

# Ratio to the stable step below which a step is reported: four times the cost and loss of energy (docs/hard-cases.md,
# H19).
SMALL_STEP = 0.25
# Share of energy, lost in the run by the longest wave across the thinnest body, above which it is reported.
NOTED_LOSS = 0.1
# Consequence of a step above each limit.
LONE = "above it a lone particle, and with it the run, is unstable"
CONSEQUENCE = {
    "wave": LONE,
    "viscosity": LONE,
    "speed": "particles leave the nodes that they act on",
    "deformation": "particles are inverted",
}


def step_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on time.step, and on the energy lost by the steps."""
    step = facts.scene.time.step
    if step != "auto":
        yield from _asked(facts, step)
    yield from _dissipation(facts)


def _asked(facts: SceneFacts, step: float) -> Iterator[Finding]:
    rest, throughout = facts.binding_at_start, facts.binding
    safety = facts.scene.time.safety
    whose = f' of body "{rest.body}"' if rest.body else ""
    fix = f'Set time.step to {facts.step:.4g} s or less, or to "auto".'
    if step > rest.value:
        yield Finding(
            "error",
            "step-above-limit",
            f"A time.step of {step:.4g} s is above {rest.value:.4g} s, the {rest.name} limit{whose} at the start"
            f"{_courant(facts, step)}: {CONSEQUENCE[rest.name]}.",
            fix,
            step / rest.value,
            rest.body,
        )
    elif step > safety * rest.value:
        yield Finding(
            "warning",
            "step-above-safety",
            f"A time.step of {step:.4g} s is above {safety * rest.value:.4g} s, which time.safety = {safety:g} leaves "
            f"of the {rest.name} limit{whose}: the run will take smaller steps than asked.",
            fix,
            step / rest.value,
            rest.body,
        )
    elif step > safety * throughout.value:
        where = f' of body "{throughout.body}"' if throughout.body else ""
        yield Finding(
            "warning",
            "step-above-safety",
            f"A time.step of {step:.4g} s is above {safety * throughout.value:.4g} s, which time.safety = {safety:g} "
            f"leaves of the {throughout.name} limit{where} that the scene can reach ({throughout.meaning}): the run "
            "will take smaller steps than asked.",
            fix,
            step / throughout.value,
            throughout.body,
        )
    elif step < SMALL_STEP * facts.step:
        yield Finding(
            "warning",
            "small-step",
            f"A time.step of {step:.4g} s is {facts.step / step:.3g} times smaller than the stable step, "
            f"{facts.step:.4g} s: the run takes as many times longer and "
            f"loses as many times the energy, as {facts.scene.solver.transfer.upper()} damps per step.",
            f'Set time.step to {facts.step:.4g} s, or to "auto".',
            step / facts.step,
        )


def _courant(facts: SceneFacts, step: float) -> str:
    """Return the Courant number c dt / h, c = sqrt(S / (d density)), in brackets if a wave limit binds, else ""."""
    rest = facts.binding_at_start
    if rest.name != "wave":
        return ""
    limit = math.sqrt(step_inertia(facts.scene.solver) / facts.scene.dimension)
    return f" (Courant number c dt / h = {limit * step / rest.value:.3f}, the limit is {limit:.3f})"


def _dissipation(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the loss of energy by the transfers, unless plastic flow or viscosity of the body dissipates more."""
    step = facts.taken(facts.step_at_start)
    h, end = facts.scene.domain.spacing, facts.scene.time.end
    # The loss per step is of order (k h)^4, with PIC (k h)^2, in twice as many steps.
    part = "a half" if facts.scene.solver.transfer == "pic" else "an eighth"
    for body in facts.bodies:
        rate = wave_loss(body.thickness, h, step, facts.scene.solver)
        lost = -math.expm1(-rate * end)
        if lost < NOTED_LOSS or body.own_loss > rate:
            continue
        yield Finding(
            "note",
            "dissipation",
            f"At a step of {step:.3g} s the transfers take {100 * -math.expm1(-rate):.2g} % of the energy of a wave "
            f'across body "{body.name}", {body.thickness / h:.3g} cells thick, in a second, and '
            f"{100 * lost:.2g} % in the run.",
            f"The largest stable step, {facts.step_at_start:.3g} s, loses least; half the spacing loses {part}.",
            rate,
            body.name,
        )

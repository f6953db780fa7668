"""Rules on the time step of a scene."""

import math
from collections.abc import Iterator

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.stability.transfer_factors import step_inertia

# Ratio to the stable step below which a step is reported: four times the cost and loss of energy (docs/hard-cases.md,
# H19).
SMALL_STEP = 0.25
# Consequence of a step above each limit.
LONE = "above it a lone particle, and with it the run, is unstable"
CONSEQUENCE = {
    "wave": LONE,
    "viscosity": LONE,
    "speed": "particles leave the nodes that they act on",
    "deformation": "particles are inverted",
    "collider": "colliders pass the material by",
}


def step_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on time.step."""
    step = facts.scene.time.step
    if step != "auto":
        yield from _asked(facts, step)


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

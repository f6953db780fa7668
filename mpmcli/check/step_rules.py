"""Rules on the time step that a scene asks for."""

import math
from collections.abc import Iterator

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.forecast import wave_loss
from mpmcli.stability.transfer_factors import step_inertia

# A step this much smaller than the stable one costs four times the time and loses four times the energy (H19).
SMALL_STEP = 0.25
# Share of its energy that the longest wave across the thinnest body may lose in the whole run before it is told.
NOTED_LOSS = 0.1
# What a step above the limit does.
LONE = "a lone particle blows up above it, and the run with it"
CONSEQUENCE = {
    "wave": LONE,
    "viscosity": LONE,
    "speed": "particles outrun what the grid says of them",
    "deformation": "particles are turned inside out",
}


def step_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield what is to be said of time.step, and of the energy that the steps lose."""
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
    """Return the Courant number in brackets where a wave binds: c dt / h with c = sqrt(S / (d density))."""
    rest = facts.binding_at_start
    if rest.name != "wave":
        return ""
    limit = math.sqrt(step_inertia(facts.scene.solver) / facts.scene.dimension)
    return f" (Courant number c dt / h = {limit * step / rest.value:.3f}, the limit is {limit:.3f})"


def _dissipation(facts: SceneFacts) -> Iterator[Finding]:
    """Only of bodies that would keep their energy: plastic flow and viscosity take more than the scheme does."""
    step = facts.taken(facts.step_at_start)
    h, end = facts.scene.domain.spacing, facts.scene.time.end
    # Of (k h)^4 or, with PIC, (k h)^2, in twice as many steps.
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

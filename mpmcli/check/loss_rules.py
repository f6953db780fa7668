"""Rules on what the transfers take: energy of waves and of impacts, and a viscosity that adds to that of a fluid."""

import math
from collections.abc import Iterator

import numpy as np

from mpmcli.check.extent import TOUCHING, spanned_axes
from mpmcli.check.facts import BodyFacts, SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.forecast import expected_steps, steps_at, wave_loss
from mpmcli.scene.schema import SolverSettings, Time
from mpmcli.scene.shapes import Ball, Box, Form, Points
from mpmcli.scene.solver_settings import USUAL_FLIP
from mpmcli.stability.transfer_factors import impact_loss, loss_per_step

# Share of energy that a wave loses in the run, and that viscosity takes, above which they matter.
NOTED_LOSS = 0.1
# Share of the viscosity asked, or of the energy of an impact, above which the scheme's own loss is noted.
NOTED_SHARE = 0.02


def loss_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on the loss by the transfers."""
    # What flows loses its energy anyway, and what it hits may be carried along.
    flowing = any(body.flows for body in facts.bodies)
    for body in facts.bodies:
        # No wave across less than a cell is on the grid.
        resolved = body.thickness >= facts.scene.domain.spacing
        added = list(_viscosity(facts, body)) if resolved else []
        yield from added or _dissipation(facts, body)
        # Known for the grid on which bodies move: on that of their state at rest they lose a third of it.
        if resolved and not flowing and facts.scene.solver.solids == "updated":
            yield from _impact(facts, body)


def _dissipation(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """Yield the loss of a wave in the run, unless plastic flow or viscosity of the body dissipates more."""
    step = facts.taken(facts.step_at_start)
    h, end = facts.scene.domain.spacing, facts.scene.time.end
    # The loss per step is of order (k h)^4, with PIC (k h)^2, in twice as many steps.
    part = "a half" if facts.scene.solver.transfer == "pic" else "an eighth"
    rate = wave_loss(body.thickness, h, step, facts.scene.solver)
    lost = -math.expm1(-rate * end)
    if lost < NOTED_LOSS or body.own_loss > rate:
        return
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


def _viscosity(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """Yield the viscosity that the transfers add to that of a fluid, where the latter matters within the run."""
    scene = facts.scene
    viscosity = getattr(body.body.material, "viscosity", 0.0)
    if body.law.deformation != "J" or not isinstance(viscosity, int | float) or viscosity == 0:
        return
    width = flow_width(facts, body)
    k, own = math.pi / width, viscosity / body.body.material.density
    if facts.bounds.speed == 0 or -math.expm1(-2 * own * k * k * scene.time.end) < NOTED_LOSS:
        return
    step = scene.time.end / expected_steps(facts)

    def share(settings: SolverSettings, spacing: float, step: float) -> float:
        """nu_num / nu: a wave of a free transfer loses its amplitude as an elastic one its energy."""
        return loss_per_step(settings, k * spacing) / (step * (own * k * k))

    h = scene.domain.spacing
    added = share(scene.solver, h, step)
    if not added >= NOTED_SHARE:
        return
    # With half the spacing waves allow half the step, viscosity a quarter.
    finer = share(scene.solver, h / 2, step / (4 if facts.binding.name == "viscosity" else 2))
    yield Finding(
        "note",
        "numerical-viscosity",
        f'On a flow across body "{body.name}", half a wave of {width / h:.3g} cells, the transfers act as '
        f"{percent(added)} of its viscosity in addition, at steps of {step:.3g} s: driven, it is "
        f"{percent(added / (1 + added))} too slow.",
        _cure(facts, finer, share(_aflip(scene.solver), h, step)),
        added,
        body.name,
    )


def _impact(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """Yield the loss of energy in the first impact of an elastic body."""
    scene, velocity = facts.scene, np.array(body.arrival.impact)
    speed = float(np.linalg.norm(velocity))
    # A body whose stiffness vanishes has no waves.
    if speed == 0 or body.stiffness == 0:
        return
    waves = math.sqrt(body.stiffness / body.body.material.density)
    h, mach = scene.domain.spacing, speed / waves
    courant = waves * scene.time.end / steps_at(facts, facts.step_expected) / h
    if not (courant > 0 and math.isfinite(speed)):
        return
    length, share = chord(body.body.shape.form, velocity / speed), flat_share(body.body.shape.form, h, mach)

    def lost(settings: SolverSettings, spacing: float) -> float:
        # Waves cross as many cells in a step with any spacing.
        return share * impact_loss(settings, length / spacing, mach, courant)

    now = lost(scene.solver, h)
    if not now >= NOTED_SHARE:
        return
    yield Finding(
        "note",
        "impact-loss",
        f'In its impact at {speed:.3g} m/s, {mach:.2g} of its wave speed, body "{body.name}", {length / h:.3g} cells '
        f"long, loses about {percent(now)} of the energy to the transfers, at steps of {courant * h / waves:.3g} s.",
        _cure(facts, lost(scene.solver, h / 2), lost(_aflip(scene.solver), h)),
        now,
        body.name,
    )


def _cure(facts: SceneFacts, finer: float, aflip: float) -> str:
    """Return what lowers a loss, given what half the spacing and AFLIP leave of it."""
    ways = [f"Half the spacing leaves {percent(finer)}"]
    if facts.scene.solver.transfer != "aflip":
        ways.append(f'solver.transfer = "aflip" {percent(aflip)}')
    time, usual = facts.scene.time, Time.model_fields["safety"].default
    if time.step != "auto" and time.step < facts.step_expected:
        ways.append('time.step = "auto" less, as the loss is per step')
    elif time.safety < usual:
        ways.append(f"time.safety = {usual:g} about {time.safety / usual:.2g} of it, as the loss is per step")
    return ", ".join(ways) + "."


def _aflip(settings: SolverSettings) -> SolverSettings:
    return settings.model_copy(update={"transfer": "aflip", "flip": settings.flip or USUAL_FLIP})


def percent(share: float) -> str:
    """Return a share as text, such as "2.9 %"."""
    return f"{100 * share:.2g} %" if share < 1 else f"{100 * share:.0f} %"


def flow_width(facts: SceneFacts, body: BodyFacts) -> float:
    """Return half of the longest wave of a flow along walls that a body allows, m: pi over its wave number.

    Across a box it is its width; twice that with "stick" on one side only, as of a film on a floor. Axes along which it
    spans the domain without "stick" are endless.
    """
    scene, domain, form = facts.scene, facts.scene.domain, body.body.shape.form
    if not isinstance(form, Box):
        return body.thickness
    endless, touching = spanned_axes(scene, form), TOUCHING * domain.spacing
    found = []
    for a, (lower, upper) in enumerate(domain.walls.faces(scene.dimension)):
        sticking = [
            lower == "stick" and form.min[a] - domain.origin[a] < touching,
            upper == "stick" and domain.upper[a] - form.max[a] < touching,
        ]
        if a not in endless:
            found.append((form.max[a] - form.min[a]) * (2 if sum(sticking) == 1 else 1))
    return min(found, default=max(domain.size))


def chord(form: Form, direction: np.ndarray) -> float:
    """Return the mean length of a shape along a unit vector, (d,), m: its volume over its projection.

    That of a body other than a ball is taken to be the projection of its bounding box.
    """
    if isinstance(form, Ball):
        return form.radius * (math.pi / 2 if len(direction) == 2 else 4 / 3)
    # The bounding box of points ends at their centres.
    edges = np.ptp(form.bounds(), axis=0) + (form.edge if isinstance(form, Points) else 0.0)
    return float(form.volume / (np.prod(edges) * np.sum(np.abs(direction) / edges)))


def flat_share(form: Form, spacing: float, mach: float) -> float:
    """Return the share of the projection of a shape that an impact brings together; 1 for all but balls.

    Within a gap of two cells, and flattened by 2 mach R each, disks touch over a width of R sqrt(2 h / R + 4 mach) on
    either side of the middle.
    """
    if not isinstance(form, Ball):
        return 1.0
    return min(1.0, (2 * spacing / form.radius + 4 * mach) ** ((len(form.center) - 1) / 2))

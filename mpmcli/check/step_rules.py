"""Rules on the time step, on losses of the transfers in each step, and on single precision."""

import math
from collections.abc import Iterator

import numpy as np

from mpmcli.check.facts import BodyFacts, SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.forecast import damped_step, expected_steps, steps_at, wave_loss
from mpmcli.check.geometry import spanned_axes, touched_walls
from mpmcli.check.material_rules import LOCKING
from mpmcli.check.scene_limits import law_of
from mpmcli.check.shape_rules import pulled_stretch
from mpmcli.plain_text import plain_number
from mpmcli.scene.bounds import body_points, highest_speed
from mpmcli.scene.domain import STICKING
from mpmcli.scene.schema import USUAL_FLIP, SolverSettings
from mpmcli.scene.shapes import Ball, Box, Form, Points
from mpmcli.stability.transfer_factors import impact_loss, loss_per_step, step_inertia

# Ratio to the stable step below which a step is reported: four times the cost and loss of energy (tests/hard_cases,
# H19).
SMALL_STEP = 0.25
# Factor on the step without a body from which on it is reported.
MUCH_STIFFER = 4.0
# Consequence of a step above each limit.
LONE = "above it a lone particle, and with it the run, is unstable"
CONSEQUENCE = {
    "wave": LONE,
    "viscosity": LONE,
    "speed": "particles leave the nodes that they act on",
    "deformation": "particles are inverted",
    "collider": "colliders pass the material by",
}
# Fraction of the energy of a wave or an impact, or of the given viscosity, from which on the scheme's loss is reported.
NOTED_LOSS = 0.1
# Fraction of a loss that a remedy leaves at most.
REMEDIED = 0.5
# Largest relative rounding error of a number of 32 bits.
HALF_ULP = 2.0**-24
# Rounding of a position in a frame over the displacement of its body in the run. A step loses nothing: particles carry
# the rounding error of their positions (docs/theory.md, 8.3).
LOST_MOTION = 0.1
# Ratio of the stress from rounding of F to the stress from gravity or speed (tests/hard_cases, H9).
STRESS_NOISE = 0.01


def step_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on time.step, and on a body that is much stiffer than the others."""
    yield from _stiff(facts)
    step, safety = facts.scene.time.step, facts.scene.time.safety
    if step == "auto":
        return
    start, throughout = facts.binding_at_start, facts.binding
    asked = f"A time.step of {step:.4g} s is"
    fix = f'Set time.step to {facts.step:.4g} s or less, or to "auto".'
    if step > start.value:
        courant = ""
        if start.name == "wave":
            # c dt / h, c = sqrt(S / (d density)).
            scene = facts.scene
            relief = next((law_of(one, scene.dimension).relief for one in scene.sources if one.name == start.body), 1.0)
            most = math.sqrt(step_inertia(scene.solver) * relief / scene.dimension)
            courant = f" (Courant number c dt / h = {most * step / start.value:.3f}, the limit is {most:.3f})"
        whose = f' of body "{start.body}"' if start.body else ""
        limit = f"{start.value:.4g} s, the {start.name} limit{whose} at the start{courant}"
        what = f"{asked} above {limit}: {CONSEQUENCE[start.name]}."
        yield Finding("error", "step-above-limit", what, fix, step / start.value, start.body)
        return
    for limit, state in ((start, ""), (throughout, f" that the scene can reach ({throughout.meaning})")):
        if step > safety * limit.value:
            whose = f' of body "{limit.body}"' if limit.body else ""
            what = (
                f"{asked} above {safety * limit.value:.4g} s, which time.safety = {safety:g} leaves of the "
                f"{limit.name} limit{whose}{state}: the run will take smaller steps than asked."
            )
            yield Finding("warning", "step-above-safety", what, fix, step / limit.value, limit.body)
            return
    if step < SMALL_STEP * facts.step:
        what = (
            f"{asked} {facts.step / step:.3g} times smaller than the stable step, {facts.step:.4g} s: the run takes as "
            "many times longer."
        )
        fix = f'Set time.step to {facts.step:.4g} s, or to "auto".'
        yield Finding("warning", "small-step", what, fix, step / facts.step)


def _stiff(facts: SceneFacts) -> Iterator[Finding]:
    """Yield a solid that alone limits the step; a rigid body would not."""
    binding = facts.binding
    body = next((one for one in facts.scene.bodies if one.name == binding.body), None)
    if body is None or not body.material.solid or body.shape.points or len(facts.scene.sources) < 2:
        return
    times = min(limit.value for limit in facts.limits if limit.body != binding.body) / binding.value
    if times < MUCH_STIFFER:
        return
    what = f'Body "{body.name}" alone sets the step: without it steps would be {times:.2g} times as long.'
    fix = f"If it need not deform, make it a collider with density = {body.material.density:g}: a rigid body."
    yield Finding("note", "stiff", what, fix, times, body.name)


def loss_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on losses by the transfers: energy of waves and of impacts, and added viscosity."""
    for body in facts.bodies:
        # The grid has no waves across less than a cell.
        resolved = body.thickness >= facts.scene.domain.spacing
        added = list(_viscosity(facts, body)) if resolved else []
        yield from added or _dissipation(facts, body)
        # A body that flows dissipates its energy anyway, and a body hit by it may be carried along. The loss is known
        # for the updated grid; on the grid of the state at rest it is a third.
        if resolved and not facts.flowing and facts.scene.solver.solids == "updated":
            yield from _impact(facts, body)


def _dissipation(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """Yield the loss of a wave in the run, unless plastic flow or viscosity of the body dissipates more.

    An elastic body moves in its longest wave, as a beam that bends does; a liquid also in shorter ones.
    """
    step = damped_step(facts, body, facts.taken(facts.step_at_start))
    h, end = facts.scene.domain.spacing, facts.scene.time.end
    length, extent = body.thickness, "thick"
    if body.body.material.elastic:
        length, extent = float(np.ptp(body.body.shape.form.bounds(), axis=0).max()), "long"
    rate = wave_loss(length, h, step, facts.scene.solver)
    lost = -math.expm1(-rate * end)
    # A wave loses an eighth: a sixteenth in each of twice as many steps.
    finer, locks = -math.expm1(-rate * end / 8), getattr(body.body.material, "poissons_ratio", 0.0) > LOCKING
    cures = [f"Half the spacing lowers that to {_percent(finer)} in the run."] * (finer <= REMEDIED * lost)
    cures += [f"Longer steps with poissons_ratio = {LOCKING:g} or less lower it."] * locks
    if lost < NOTED_LOSS or body.own_loss > rate or not cures:
        return
    what = (
        f"At a step of {step:.3g} s the transfers take {_percent(-math.expm1(-rate))} of the energy of a wave across "
        f'body "{body.name}", {length / h:.3g} cells {extent}, in a second, and {_percent(lost)} in the run.'
    )
    yield Finding("note", "dissipation", what, " ".join(cures), rate, body.name)


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
    step = damped_step(facts, body, scene.time.end / expected_steps(facts))

    def share(settings: SolverSettings, spacing: float, step: float) -> float:
        """Return nu_num / nu: a shear wave loses amplitude at the rate at which an elastic wave loses energy."""
        return loss_per_step(settings, k * spacing) / (step * (own * k * k))

    h = scene.domain.spacing
    added = share(scene.solver, h, step)
    if not added >= NOTED_LOSS:
        return
    # Half the spacing permits half the step for waves, a quarter for viscosity.
    finer = share(scene.solver, h / 2, step / (4 if facts.binding.name == "viscosity" else 2))
    what = (
        f'On a flow across body "{body.name}", half a wave of {width / h:.3g} cells, the transfers act as '
        f"{_percent(added)} of its viscosity in addition, at steps of {step:.3g} s: driven, it is "
        f"{_percent(added / (1 + added))} too slow."
    )
    fix = _cure(facts, finer, share(_aflip(scene.solver), h, step))
    yield Finding("note", "numerical-viscosity", what, fix, added, body.name)


def _impact(facts: SceneFacts, body: BodyFacts) -> Iterator[Finding]:
    """Yield a note if a body loses the fraction NOTED_LOSS of its energy or more in its impact."""
    scene, velocity = facts.scene, np.array(body.arrival.impact)
    speed = float(np.linalg.norm(velocity))
    # A body whose stiffness vanishes has no waves, and one that is held does not fall.
    if speed == 0 or body.stiffness == 0 or _held(facts, body):
        return
    waves = math.sqrt(body.stiffness / body.body.material.density)
    h, mach = scene.domain.spacing, speed / waves
    step, shorter = scene.time.end / steps_at(facts, facts.step_expected), facts.step_expected / facts.step_at_start
    courant = waves * damped_step(facts, body, step, shorter) / h
    if not (courant > 0 and math.isfinite(speed)):
        return
    form, share = body.body.shape.form, 1.0
    if isinstance(form, Ball):
        # The zone that an impact of a ball brings into contact, sqrt(2 h / R + 4 mach) per side.
        share = min(1.0, (2 * h / form.radius + 4 * mach) ** ((len(form.center) - 1) / 2))
    length, surfaces = chord(form, velocity / speed), facts.contacts.separates(body.body)

    def lost(settings: SolverSettings, spacing: float) -> float:
        # Waves cross as many cells in a step with any spacing.
        return share * impact_loss(settings, length / spacing, mach, courant, surfaces=surfaces)

    now = lost(scene.solver, h)
    if not now >= NOTED_LOSS:
        return
    takers = "contact and the transfers" if surfaces else f"the transfers, at steps of {courant * h / waves:.3g} s"
    what = (
        f'In its impact at {speed:.3g} m/s, {mach:.2g} times its wave speed, body "{body.name}", '
        f"{length / h:.3g} cells long, loses about {_percent(now)} of the energy to {takers}."
    )
    fix = _cure(facts, lost(scene.solver, h / 2), None if surfaces else lost(_aflip(scene.solver), h))
    yield Finding("note", "impact-loss", what, fix, now, body.name)


def _held(facts: SceneFacts, body: BodyFacts) -> bool:
    """Return whether a collider holds a part of a body at the start."""
    grips = [collider.form for collider in facts.scene.colliders if collider.wall == "hold"]
    return any(form.contains(body_points(body.body)).any() for form in grips)


def _cure(facts: SceneFacts, finer: float, aflip: float | None) -> str:
    """Return what lowers a loss, given what half the spacing and AFLIP leave of it; None where AFLIP lowers nothing."""
    ways = [f"Half the spacing leaves {_percent(finer)}"]
    if facts.scene.solver.transfer != "aflip" and aflip is not None:
        ways.append(f'solver.transfer = "aflip" {_percent(aflip)}')
    return ", ".join(ways) + "."


def _aflip(settings: SolverSettings) -> SolverSettings:
    return settings.model_copy(update={"transfer": "aflip", "flip": settings.flip or USUAL_FLIP})


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"


def flow_width(facts: SceneFacts, body: BodyFacts) -> float:
    """Return half the longest wave of a flow along walls, m: the width of a box, twice that if one side sticks."""
    scene, form = facts.scene, body.body.shape.form
    if not isinstance(form, Box):
        return body.thickness
    endless = spanned_axes(scene, form)
    widths = [
        (form.max[a] - form.min[a]) * (2 if sum(word in STICKING for word in faces) == 1 else 1)
        for a, faces in enumerate(touched_walls(scene, form))
        if a not in endless
    ]
    return min(widths, default=max(scene.domain.size))


def chord(form: Form, direction: np.ndarray) -> float:
    """Return the mean length of a shape along a unit vector, m: volume over projection of the ball or bounding box."""
    if isinstance(form, Ball):
        return form.radius * (math.pi / 2 if len(direction) == 2 else 4 / 3)
    # The bounding box of points ends at their centres.
    edges = np.ptp(form.bounds(), axis=0) + (form.edge if isinstance(form, Points) else 0.0)
    return float(form.volume / (np.prod(edges) * np.sum(np.abs(direction) / edges)))


def rounding_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on solver.precision: small motions in a wide domain, small strains of a stiff body."""
    if facts.scene.solver.precision == "f64":
        return
    end = facts.scene.time.end
    for body in facts.bodies:
        # Positions are relative to the origin of the domain, so that the farthest one of a body has the largest
        # rounding.
        farthest = float(np.max(body.body.shape.form.bounds()[1] - facts.scene.domain.origin))
        speed = facts.bounds.speed if facts.deformed else highest_speed(body.body)
        way = (speed + facts.bounds.gravity * end) * end
        if way > 0 and HALF_ULP * farthest > LOST_MOTION * way:
            what = (
                f'Body "{body.name}" moves {way:.2g} m at most in the run, and its positions, up to {farthest:.3g} m '
                f"from the corner of the domain, are rounded by {HALF_ULP * farthest:.2g} m in single precision."
            )
            fix = 'Set solver.precision = "f64".'
            yield Finding("warning", "rounding-positions", what, fix, HALF_ULP * farthest / way, body.name)
    for body in facts.bodies:
        density = body.body.material.density
        weight = density * facts.bounds.gravity * body.height
        typical = weight if weight > 0 else density * facts.bounds.speed**2
        # The stress between grips exceeds that of motion.
        typical = max(typical, body.stiffness * (pulled_stretch(facts.scene, body) - 1))
        noise = HALF_ULP * body.stiffness
        if typical > 0 and noise > STRESS_NOISE * typical:
            what = (
                f'Body "{body.name}" is so stiff that rounding its strain in single precision makes '
                f"{plain_number(noise)} Pa, {_percent(noise / typical)} of the {plain_number(typical)} Pa of its "
                f"{'weight' if weight > 0 else 'motion'}."
            )
            fix = 'Set solver.precision = "f64", or take a softer material.'
            yield Finding("warning", "rounding-strains", what, fix, noise / typical, body.name)

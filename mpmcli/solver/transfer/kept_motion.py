"""Relaxed APIC: in steps shorter than its own step, a body keeps a fraction of the motion that nodes do not resolve.

APIC removes all of this motion in each step, whatever its length. If another body, a setting or a frame makes a step
shorter than a body requires, the body keeps a fraction, so that it loses as much per second as in steps of its own
length (docs/theory.md, 2.3).
"""

import math
from collections.abc import Sequence

from mpmcli.materials.law import Law, StateBound
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene, highest_speed
from mpmcli.scene.schema import Body, Emitter
from mpmcli.stability.limits import collider_limit, mode_limit, speed_limit
from mpmcli.stability.transfer_factors import step_inertia

# The own step of a body divided by the bound that the body alone sets: the default of time.safety.
OWN_STEP = 0.8
# Steps from this fraction of the own step on count as a whole one.
NEAR = 0.8


def keeps_motion(scene: Scene, members: Sequence[Law]) -> bool:
    """Return whether any body of a scene keeps a fraction of its motion: by its law, by AFLIP, or in short steps.

    The step is that estimated before the run.
    """
    time, h = scene.time, scene.domain.spacing
    if scene.solver.flip or any(law.lost < 1 for law in members):
        return True
    if not scene.sources:
        return False
    of_name = {law.name: law for law in members}
    own = [own_limit(source, of_name[source.material.law], scene) for source in scene.sources]
    driven = [collider_limit(h, collider.fastest(scene.domain, time.end)) for collider in scene.colliders]
    longest = math.inf if time.step == "auto" else time.step
    step = min(time.safety * min(own + driven), longest, time.end / time.frames)
    return bool(step < NEAR * OWN_STEP * max(own))


def own_limit(source: Body | Emitter, law: Law, scene: Scene) -> float:
    """Return the stable step of a source of particles at the start, s."""
    material, h, inertia = source.material, scene.domain.spacing, step_inertia(scene.solver)
    modes = law.reference_modes if scene.solver.solids == "total" else law.modes
    found = modes(material, StateBound())
    ends = ((mode.stiffness / law.relief, mode.viscosity) for mode in found)
    stiffness = (mode_limit(h, material.density, *pair, inertia)[0] for pair in ends)
    return min(*stiffness, speed_limit(h, highest_speed(source, scene.time.end), 0.0))


@ti.pyfunc
def kept_share(ratio: ti.template(), damped: ti.template()):
    """Return the fraction that a body keeps in a step, given the ratio of the step to the bound set by the body.

    `damped` is the fraction lost in a step of its own length: 1 with APIC, less with AFLIP or by a law.
    """
    lost = ratio / OWN_STEP
    if ratio > NEAR * OWN_STEP:
        lost = 1.0
    return 1.0 - damped * lost

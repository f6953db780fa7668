"""Relaxed APIC: bodies keep a share of what the nodes do not see of their motion in steps shorter than their own.

APIC damps all of it in each step, whatever its length. Where a step is shorter than a body needs, since another body, a
setting or a frame asks for it, the body keeps a share, so that it loses as much in a second as in steps of its own
(docs/theory.md, 2.3).
"""

import math
from collections.abc import Sequence

from mpmcli.materials.law import Law, StateBound
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene, highest_speed
from mpmcli.scene.schema import Body, Emitter
from mpmcli.stability.limits import collider_limit, mode_limit, speed_limit
from mpmcli.stability.transfer_factors import step_inertia

# The step of its own that a body is damped for, over the bound that it sets by itself: that of time.safety by default.
OWN_STEP = 0.8
# Steps from this share of it on damp as a whole one.
NEAR = 0.8


def keeps_motion(scene: Scene, members: Sequence[Law]) -> bool:
    """Return whether any body of a scene keeps a share of its motion, by what is known before the run."""
    time, h = scene.time, scene.domain.spacing
    if scene.solver.flip:
        return True
    of_name = {law.name: law for law in members}
    own = [own_limit(source, of_name[source.material.law], scene) for source in scene.sources]
    driven = [collider_limit(h, collider.fastest(scene.domain, time.end)) for collider in scene.colliders]
    longest = math.inf if time.step == "auto" else time.step
    step = min(time.safety * min(own + driven), longest, time.end / time.frames)
    return step < NEAR * OWN_STEP * max(own)


def own_limit(source: Body | Emitter, law: Law, scene: Scene) -> float:
    """Return the step that a source of particles allows at the start, s."""
    material, h, inertia = source.material, scene.domain.spacing, step_inertia(scene.solver)
    modes = law.reference_modes if scene.solver.solids == "total" else law.modes
    found = modes(material, StateBound())
    stiffness = (mode_limit(h, material.density, mode.stiffness, mode.viscosity, inertia)[0] for mode in found)
    return min(*stiffness, speed_limit(h, highest_speed(source), 0.0))


@ti.pyfunc
def kept_share(ratio: ti.template(), damped: ti.template()):
    """Return the share that a body keeps in a step, given that step over the bound that the body sets itself.

    damped: the share that is lost in a step of its own: 1 with APIC.
    """
    lost = ratio / OWN_STEP
    if ratio > NEAR * OWN_STEP:
        lost = 1.0
    return 1.0 - damped * lost

"""States that are not finite, set on purpose: how soon the run stops, and whom it names."""

import numpy as np
from scenes import block, liquid

from hard_cases.case import HardCase, Outcome
from hard_cases.running import scene, start
from mpmcli.solver.frames.diagnosis import Diagnosis, UnstableRunError

H = 0.1
PARTICLE = 7


# What is set, in which field.
POISONS = {"J": ("deformation", np.nan), "v": ("v", np.nan), "C": ("C", np.inf)}


def stop_after(field: str, value: float) -> tuple[Diagnosis | None, int]:
    """Return the diagnosis of a run of two bodies that is poisoned after 20 steps, and the step then."""
    bodies = [
        block("drop", liquid(1e4), [0.2] * 2, [0.6] * 2, velocity=[0.1, 0.1]),
        block("second drop", liquid(1e4, density=700.0), [1.0] * 2, [1.4] * 2, velocity=[-0.1, 0.1]),
    ]
    run = start(scene(bodies, [16, 16], H))
    for _ in range(20):
        run.step(1e-3)
    group = run.groups[0]
    # The particles of the first body are those with the smallest ids.
    first = 64
    values = group.read()[field]
    values[np.flatnonzero(group.read()["id"] == first + PARTICLE)[0]] = value
    group.replace(**{field: values})
    began = run.step_count
    try:
        for _ in range(20):
            run.step(1e-3)
    except UnstableRunError as error:
        return error.diagnosis, began
    return None, began


def named() -> Outcome:
    """H23: NaN in J and v and infinity in C of one particle of the second of two bodies."""
    right, said = True, []
    for name, poison in POISONS.items():
        found, began = stop_after(*poison)
        if found is None:
            right = False
            said.append(f"{name}: the run goes on")
            continue
        # What a velocity does reaches its neighbours within the same step.
        exact = found.particle == 64 + PARTICLE
        steps = found.step - began
        right = right and steps <= 1 and found.body == "second drop" and (exact or name != "J")
        who = "the particle" if exact else "a neighbour"
        said.append(f'{name}: {who} of "{found.body}" {found.cause}, {steps} step later')
    return Outcome(right, "stops within one step, with the name" if right else "not as asked", "; ".join(said) + ".")


CASES = [
    HardCase("H23", "a NaN appears",
        "J or v of a particle of the second of two bodies is set to NaN, or its C to infinity",
        "stops within one step, with step, particle and body", True, named),
]  # fmt: skip

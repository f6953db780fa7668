"""Random scenes of bodies that start deformed, under pulses of gravity and local forces."""

from typing import Any

import numpy as np
import state_run
from scenes import block, scene_of

from mpmcli.scene import Scene

CELLS, END = 24, 0.05
# Stiff enough that a run takes some hundred steps.
LAWS: dict[str, dict[str, Any]] = {
    "fluid": {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e6},
    "fluid with tension": {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e6, "tension_cutoff": False},
    "neo_hookean": {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e6},
    "fixed_corotated": {"law": "fixed_corotated", "density": 1000.0, "youngs_modulus": 1e6},
    "von_mises": {"law": "von_mises", "density": 1000.0, "youngs_modulus": 1e6, "yield_stress": 2e4},
    "sand": {"law": "sand", "density": 1000.0, "youngs_modulus": 1e6, "friction_angle": 30.0},
    "snow": dict(state_run.MATERIALS["snow"]),
    "viscoplastic": dict(state_run.MATERIALS["viscoplastic"]),
}


def random_scene(seed: int, *, driven: bool = True) -> Scene:
    """Return a scene in 2D, the same for the same seed; without pulses and forces where not `driven`."""
    random = np.random.default_rng([14, seed])
    material = LAWS[list(LAWS)[seed % len(LAWS)]]
    low = random.uniform(0.1, 0.4, 2)
    body: dict[str, Any] = block(
        "block",
        material,
        low.tolist(),
        (low + random.uniform(0.2, 0.45, 2)).tolist(),
        velocity=random.uniform(-2, 2, 2).tolist(),
        sampling=["lattice", "jittered"][int(random.integers(2))],
    )
    if random.random() < 0.6:
        size = random.uniform(0.02, 0.6)
        if material["law"] == "fluid":
            body["deformation"] = (
                f"{np.exp(size * random.uniform(-1, 0.5))} * (1 + 0.1 * sin({random.uniform(5, 40)} * X))"
            )
        else:
            body["deformation"] = (np.eye(2) + size * random.uniform(-0.7, 0.7, (2, 2))).tolist()
            if np.linalg.det(body["deformation"]) < 0.05:
                del body["deformation"]
    gravity: list[float | str] = [0.0, -9.81]
    if random.random() < 0.5:
        begin, length = random.uniform(0.05, 0.9) * END, 10 ** random.uniform(-5, -2)
        strength = 10 ** random.uniform(1, 3.5)
        gravity[int(random.integers(2))] = f"{strength} if t > {begin} and t < {begin + length} else 0"
    forces = []
    if random.random() < 0.5:
        centre, width = random.uniform(0.1, 0.8, 2), 10 ** random.uniform(-2.5, -0.5)
        strength = 10 ** random.uniform(1, 3.5)
        bump = f"{strength} * exp(-((x - {centre[0]}) ** 2 + (y - {centre[1]}) ** 2) / {width} ** 2)"
        forces = [{"acceleration": [[bump, "0"], ["0", bump], [bump, bump]][int(random.integers(3))]}]
    if not driven:
        gravity, forces = [0.0, -9.81], []
    return scene_of(
        body,
        domain={"size": [1.0, 1.0], "cells": [CELLS, CELLS], "gravity": gravity},
        walls=["slip", "separate", "stick"][seed % 3],
        end=END,
        forces=forces,
    )

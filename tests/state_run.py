"""Saves and loads runs of small scenes, in its own process: `python state_run.py THREADS` prints JSON."""

import json
import sys

from scenes import block, box, collider, scene_of

from mpmcli.scene import Scene
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.engine.saved_state import SavedState
from mpmcli.solver.machine.backend import start_backend, stop_backend

# Not a multiple of the steps between two relaxations of volume.
BEFORE, AFTER = 33, 50
SOFT = {"density": 1000.0, "youngs_modulus": 2e5, "poissons_ratio": 0.3}
MATERIALS = {
    "fluid": {"law": "fluid", "density": 1000.0, "bulk_modulus": 2e4, "viscosity": 0.5, "volume_correction": True},
    "viscoplastic": {
        "law": "viscoplastic",
        "density": 1000.0,
        "bulk_modulus": 2e5,
        "shear_modulus": 5e4,
        "yield_stress": 20.0,
        "consistency": 2.0,
    },
    "neo_hookean": {"law": "neo_hookean", **SOFT},
    "fixed_corotated": {"law": "fixed_corotated", **SOFT},
    "snow": {"law": "snow", "density": 400.0, "youngs_modulus": 1.4e5, "poissons_ratio": 0.2},
    "sand": {"law": "sand", "density": 1600.0, "youngs_modulus": 3e5, "poissons_ratio": 0.3, "friction_angle": 30.0},
    "von_mises": {"law": "von_mises", **SOFT, "yield_stress": 500.0},
}
# It falls into the material, and turns.
RAFT = collider("raft", box([0.3, 0.45], [0.6, 0.6]), density=500.0, velocity=[0.0, -5.0], angular_velocity=1.0)
WHEEL = collider(
    "wheel",
    box([0.78, 0.3], [0.86, 0.7]),
    mass=30.0,
    restitution=0.5,
    joint={"type": "hinge", "point": [0.82, 0.6], "motor": "8 * t", "strength": 60.0},
)
# By the name of each scene: the materials of its bodies, its dimension, and further tables.
SCENES = {name: ((name,), 2, {}) for name in MATERIALS} | {
    "3D": (("fluid",), 3, {}),
    "several bodies, FLIP": (("fluid", "fluid"), 2, {"solver": {"transfer": "aflip", "flip": 0.9}}),
    "total": (("neo_hookean", "neo_hookean"), 2, {"solver": {"solids": "total"}}),
    "forces": (("fluid", "neo_hookean"), 2, {"forces": [{"acceleration": ["3*sin(20*t) - 5*x", "2*X"]}]}),
    "rigid": (("fluid",), 2, {"colliders": [RAFT, WHEEL]}),
    "contact": (("neo_hookean", "neo_hookean"), 2, {"contact": {"default": "separate", "friction": 0.3}}),
}
NAMES = tuple(SCENES)
# Scenes that are loaded into another run, too.
TWICE = ("snow", "several bodies, FLIP", "forces", "contact", "rigid")


def laws_in(name: str) -> set[str]:
    """Return the laws of a scene."""
    return {MATERIALS[material]["law"] for material in SCENES[name][0]}


def scene_named(name: str) -> Scene:
    """Return blocks that fall side by side onto a floor, fast enough to meet it within the run."""
    materials, d, more = SCENES[name]
    width = 0.8 / len(materials)
    # Bodies that meet where they are begin apart, and fly at each other.
    total = "solids" in more.get("solver", {}) or "contact" in more
    bodies = [
        block(
            f"body {k}",
            MATERIALS[material],
            [0.1 + width * k, 0.02, 0.3][:d],
            [0.1 + width * (k + (0.6 if total else 0.8)), 0.4, 0.6][:d],
            velocity=[-2.0 if total and k == 1 else 1.0, -2.0, 0.5][:d],
        )
        for k, material in enumerate(materials)
    ]
    domain = {"size": [1.0] * d, "cells": [20 if d == 2 else 12] * d, "gravity": [0.0, -9.81, 0.0][:d]}
    return scene_of(*bodies, domain=domain, **more)


def advance(run: Run, steps: int) -> None:
    """Take some steps, each as long as is stable."""
    for _ in range(steps):
        run.step(run.stable_step()[0])


def saved_of(run: Run) -> SavedState:
    """Return the state of a run, less the steps of its next launch, which follow from wall times."""
    saved = run.save().copied()
    saved.arrays["counts"][run.batch.layout.counts["budget"]] = 0
    return saved


def through_json(saved: SavedState) -> SavedState:
    """Return the state with its numbers written and read as JSON."""
    return SavedState(json.loads(json.dumps(saved.numbers)), saved.arrays)


def differences(expected: SavedState, found: SavedState) -> list[str]:
    """Return the names of what two states differ in."""
    arrays = [name for name, array in expected.arrays.items() if array.tobytes() != found.arrays[name].tobytes()]
    # JSON makes lists of tuples.
    pair = through_json(expected).numbers, through_json(found).numbers
    return arrays + [name for name in pair[0] if pair[0][name] != pair[1][name]]


def outcome(name: str, threads: int) -> dict[str, list[str]]:
    """Return what a run that was loaded has otherwise than one that went on."""
    # A fresh backend numbers its fields from 0, and finds the kernels that were compiled before.
    stop_backend()
    run = build_run(scene_named(name), start_backend("cpu", threads))
    advance(run, BEFORE)
    start = saved_of(run)
    advance(run, AFTER)
    expected = saved_of(run)
    run.load(start)
    advance(run, AFTER)
    found = {"same run": differences(expected, saved_of(run))}
    if name in TWICE:
        stop_backend()
        other = build_run(scene_named(name), start_backend("cpu", threads))
        other.load(through_json(start))
        advance(other, AFTER)
        found["other run"] = differences(expected, saved_of(other))
    return found


if __name__ == "__main__":
    print(json.dumps({name: outcome(name, int(sys.argv[1])) for name in sys.argv[2:] or NAMES}))

"""Drops a soft block and poisons a drop, on any backend, in its own process: `python fall_run.py ARCH` prints JSON.

Exit status 77: this machine has no such backend.
"""

import json
import sys

import numpy as np
from path_run import NO_DEVICE
from scenes import block, scene_of

from mpmcli.errors import InputError
from mpmcli.scene import Scene
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import Backend, start_backend

GRAVITY, SECONDS, H = 9.81, 0.5, 0.05


def soft_block() -> Scene:
    """Return a block that falls from rest, so soft that gravity alone moves it by cells within a few steps."""
    return scene_of(
        block("block", {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e3}, [0.35, 1.6], [0.65, 1.9]),
        domain={"size": [1.0, 2.0], "spacing": H, "gravity": [0.0, -GRAVITY]},
        end=SECONDS,
    )


def fall(backend: Backend) -> dict:
    """Return the fall, the speed and the largest Courant number of the block."""
    run = build_run(soft_block(), backend)
    (first, _), (last, row) = run.frames()
    return {
        "fallen": float((first.position - last.position)[:, 1].mean()),
        "speeds": [float(v) for v in (last.velocity[:, 1].min(), last.velocity[:, 1].max())],
        "courant": float(row.courant_max),
        "step_max": float(row.step_max),
        "last": run.last_step,
    }


def lose(backend: Backend) -> dict:
    """Return how a run ends whose particle 10 loses its state after 20 steps."""
    run = build_run(soft_block(), backend)
    for _ in range(20):
        run.step(1e-4)
    group = run.groups[0]
    deformation = group.read()["deformation"]
    deformation[np.flatnonzero(group.read()["id"] == 10)] = np.nan
    group.replace(deformation=deformation)
    try:
        for _ in range(40):
            run.step(1e-4)
    except UnstableRunError as error:
        return {"particle": error.diagnosis.particle, "step": error.diagnosis.step, "sentence": str(error)}
    return {}


if __name__ == "__main__":
    try:
        backend = start_backend(sys.argv[1], 2, "f32")
    except InputError as error:
        print(error)
        sys.exit(NO_DEVICE)
    try:
        fallen = fall(backend)
    except UnstableRunError as error:
        fallen = {"lost": str(error)}
    print(json.dumps({"fall": fallen, "lose": lose(backend)}))

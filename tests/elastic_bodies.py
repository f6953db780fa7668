"""Scenes of elastic bodies on the grid of their state at rest, for the tests of it and of their contact."""

import math

import numpy as np
from contact_scenes import DENSITY, E, jelly
from scenes import block, scene_of

from mpmcli.scene import Scene
from mpmcli.solver.engine.run import Run

H = 0.1


def body_scene(own: dict, cells: list[int], *, spacing: float = H, **keys: object) -> Scene:
    """Return a scene of one body."""
    size = [n * spacing for n in cells]
    usual = {"walls": "separate", "solids": "total", "precision": "f64", "fields": ["velocity", "initial_position"]}
    return scene_of(own, size=size, cells=cells, **usual | keys)


def stirred(run: Run, dimension: int) -> None:
    """Give the particles velocities at random, and deformations of up to a fifth, where they are."""
    group, rng = run.groups[0], np.random.default_rng(0)
    n, d = group.count, dimension
    v, C = rng.uniform(-1, 1, (n, d)), rng.uniform(-3, 3, (n, d, d))
    deformation = np.eye(d) + rng.uniform(-0.2, 0.2, (n, d, d))
    group.replace(x=group.read()["x"] + rng.uniform(-0.02, 0.02, (n, d)), v=v, C=C, deformation=deformation)
    run.state_was_replaced()


def bars(n: int, shift: float, *, precision: str = "f64", solids: str = "total", frames: int = 400) -> Scene:
    """Return two equal bars of length 1, n cells long, four cells apart, that fly at each other, at 0.05 m/s each."""
    h, width, gap = 1 / n, 0.25, 4
    time = gap * h / 0.1 + 5 / math.sqrt(E / DENSITY)
    lows = [[4 * h + k * (1 + gap * h), (8 + k * shift) * h] for k in (0, 1)]
    return scene_of(
        *(
            block(f"bar {k}", jelly(poissons_ratio=0.0), [x, y], [x + 1, y + width], velocity=[0.05 * (1 - 2 * k), 0.0])
            for k, (x, y) in enumerate(lows)
        ),
        domain={"size": [2 + 12 * h, width + 16 * h], "spacing": h},
        time={"end": time, "frames": frames},
        solver={"solids": solids, "precision": precision},
        fields=["velocity"],
    )

"""Scenes of elastic bodies on the grid of their state at rest, for the tests of it and of their contact."""

import math

import numpy as np
from solver_state import scene_of

from mpmcli.scene import Scene
from mpmcli.solver.engine.run import Run

H = 0.1
E, NU, DENSITY = 1e5, 0.3, 1000.0
MU, LAMBDA = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))


def jelly(**more: object) -> dict:
    """Return a material."""
    return {"law": "neo_hookean", "density": DENSITY, "youngs_modulus": E, "poissons_ratio": NU, **more}


def body_scene(
    low: list[float],
    high: list[float],
    cells: list[int],
    *,
    walls: object = "separate",
    gravity: list[float] | None = None,
    material: dict | None = None,
    end: float = 1.0,
    frames: int = 1,
    precision: str = "f64",
    safety: float = 0.8,
    spacing: float = H,
    **more: object,
) -> Scene:
    """Return a scene of one box."""
    domain = {"size": [n * spacing for n in cells], "cells": cells, "walls": walls}
    return scene_of(
        domain=domain | ({"gravity": gravity} if gravity else {}),
        time={"end": end, "frames": frames, "safety": safety},
        solver={"solids": "total", "precision": precision},
        output={"fields": ["velocity", "initial_position"]},
        bodies=[{"name": "body", "material": material or jelly(), "shape": {"box": {"min": low, "max": high}}, **more}],
    )


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
    return scene_of(
        domain={"size": [2 + 12 * h, width + 16 * h], "spacing": h},
        time={"end": time, "frames": frames},
        solver={"solids": solids, "precision": precision},
        output={"fields": ["velocity"]},
        bodies=[
            {
                "name": f"bar {k}",
                "material": jelly(poissons_ratio=0.0),
                "shape": {
                    "box": {
                        "min": [4 * h + k * (1 + gap * h), (8 + k * shift) * h],
                        "max": [4 * h + k * (1 + gap * h) + 1, (8 + k * shift) * h + width],
                    }
                },
                "velocity": [0.05 * (1 - 2 * k), 0.0],
            }
            for k in (0, 1)
        ],
    )

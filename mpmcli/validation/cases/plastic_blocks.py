"""Free blocks of one law each in homogeneous motion: hardening, cohesion, tearing, viscous flow, in 2D and 3D.

As in `homogeneous`, a block whose velocity is linear in the place feels no force until waves come in from its faces:
F = I + t L. Paths are such that principal directions and the ratios of the plastic strains stay the same, so that the
stress is a closed form of F at the end, for any number of steps.
"""

from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure
from mpmcli.validation.plastic_paths import (
    END,
    FLUID_BLOCKS,
    METAL_BLOCKS,
    PASTE_BLOCKS,
    SAND_BLOCKS,
    SIZE,
    SNOW_BLOCKS,
    SWING,
    Block,
)

# Width of the middle that is looked at, in parts of the size, and empty cells around a block.
MIDDLE, GAP = 0.15, 4


class PlasticBlocks(Case):
    """v = L (x - c) in free blocks of one law, a path each."""

    group = "plastic"
    source = "Closed forms of the law at F = I + t L (docs/theory.md, 5)"
    resolution = "cells across a block"
    varies = ("precision",)
    note = (
        "A check of the law in the solver, with hardly any discretisation in it. As particles come closer to each "
        "other, sums over them are no longer exact, and homogeneous stress makes small forces, in proportion to 1/h; "
        "the strain that they cause until the end is in proportion to 1/h^2. Stress that depends on the rate of "
        "deformation is first order in the step."
    )

    def __init__(self, law: str, title: str, dimension: int, blocks: tuple[Block, ...]) -> None:
        self.name = f"{law}_blocks" + ("_3d" if dimension == 3 else "")
        self.title = title + (" in 3D" if dimension == 3 else "")
        self.dimension, self.blocks = dimension, blocks
        coarse, usual, fine = (32, 64, 128) if dimension == 2 else (16, 24, 32)
        self.levels = {"coarse": (coarse,), "default": (coarse, usual), "fine": (coarse, usual, fine)}
        self.measures = tuple(
            Measure(block.name, "", block.text, bound=block.bound, single=lambda n: 2e-4) for block in blocks
        )

    def tables(self, n: int) -> dict[str, Any]:
        d, h = self.dimension, SIZE / n
        cells = [n + 2 * GAP] * (d - 1) + [len(self.blocks) * (n + GAP) + GAP]
        bodies, forces = [], []
        for k, block in enumerate(self.blocks):
            low = [GAP * h] * (d - 1) + [(GAP + k * (n + GAP)) * h]
            bodies.append(
                {
                    "name": block.name,
                    "material": block.material,
                    "shape": {"box": {"min": low, "max": [x + SIZE for x in low]}},
                    "velocity_gradient": (block.motion(d) / END).tolist(),
                }
            )
            if block.swings:
                pull = [f"{-(SWING**2)!r} * ({axis} - {x + SIZE / 2!r})" for axis, x in zip("xyz", low, strict=False)]
                forces.append({"body": block.name, "acceleration": pull})
        return {
            "domain": {"size": [count * h for count in cells], "cells": cells, "walls": "separate"},
            "time": {"end": END, "frames": 1},
            "output": {"fields": ["stress", "initial_position"]},
            "bodies": bodies,
            "forces": forces,
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        for frame, _ in frames:
            last = frame
        d = self.dimension
        place = last.fields["initial_position"].astype(np.float64)
        stress = last.fields["stress"].astype(np.float64).reshape(-1, 3, 3)[:, :d, :d]
        found = {}
        for k, block in enumerate(self.blocks):
            off = place - np.mean(scene.bodies[k].shape.form.bounds(), axis=0)
            middle = (last.body == k) & (np.abs(off).max(axis=1) < MIDDLE * SIZE / 2)
            F = np.eye(d) + block.motion(d)
            if block.swings:
                # As the places have it: the force, step by step, leaves it off by (swing dt)^2.
                x = last.position[middle, 0].astype(np.float64)
                F = np.polyfit(place[middle, 0], x, 1)[0] * np.eye(d)
            known = block.stress(F)
            off_by = (np.linalg.det(F) * stress[middle].mean(axis=0) - known)[np.isfinite(known)]
            scale = block.scale or np.linalg.norm(known[np.isfinite(known)])
            found[block.name] = float(np.linalg.norm(off_by) / scale)
        return found


CASES = (
    PlasticBlocks("metal", "Free blocks of a metal that hardens", 2, METAL_BLOCKS),
    PlasticBlocks("metal", "Free blocks of a metal that hardens", 3, METAL_BLOCKS),
    PlasticBlocks("sand", "Free blocks of sand", 2, SAND_BLOCKS),
    PlasticBlocks("sand", "Free blocks of sand", 3, SAND_BLOCKS),
    PlasticBlocks("snow", "Free blocks of snow", 2, SNOW_BLOCKS),
    PlasticBlocks("paste", "Free blocks of a Bingham fluid", 2, PASTE_BLOCKS),
    PlasticBlocks("fluid", "Free blocks of a fluid", 2, FLUID_BLOCKS),
)

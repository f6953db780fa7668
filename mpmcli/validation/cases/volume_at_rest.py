"""Liquids and sand that are thrown, dropped and stirred, and must fill at rest what they filled at first."""

from dataclasses import replace
from typing import ClassVar

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Levels, case_text
from mpmcli.validation.tables import Tables, body, box, problem

GRAVITY = 9.81
WATER = {"law": "fluid", "density": 1000.0}
SAND = {"law": "sand", "density": 1600.0, "friction_angle": 30.0}
# What has come to rest fills the same volume to this fraction.
TOLERANCE = 0.02


class VolumeAtRest(Case):
    """The depth of a pool when it is quiet again, over what its volume amounts to between walls.

    The depth is averaged from `start`, s, to the end. `h` and `cells` are those of the domain at resolution 1, `time`
    the end and the number of frames; `width`, `height` and `state` describe the body, a box in the lower left corner.
    """

    text = case_text("volume_at_rest")
    varies: ClassVar[tuple[str, ...]] = ()
    measures = (text.measure("volume error", TOLERANCE),)
    levels: ClassVar[Levels] = {"coarse": (1,), "default": (1, 2), "fine": (1, 2)}
    depth: ClassVar[float]
    start: ClassVar[float]
    h: ClassVar[float] = 1 / 32
    cells: ClassVar[tuple[int, int]]
    walls: ClassVar[str | Tables] = "separate"
    time: ClassVar[tuple[float, int]]
    material: ClassVar[Tables] = WATER
    width: ClassVar[float]
    height: ClassVar[float]
    state: ClassVar[Tables] = {"initial_pressure": "hydrostatic"}
    forces: ClassVar[tuple[Tables, ...]] = ()

    def tables(self, n: int) -> Tables:
        block = body("material", self.material, box([0.0, 0.0], [self.width, self.height]), **self.state)
        domain = {
            "size": [count * self.h for count in self.cells],
            "cells": [n * count for count in self.cells],
            "gravity": [0.0, -GRAVITY],
            "walls": self.walls,
        }
        return problem(domain, self.time, "velocity", [block], forces=[*self.forces])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        # A small wave has as much potential energy, above that of the level, as kinetic energy.
        heights = [
            frame.position[:, 1].astype(np.float64).mean() - row.kinetic / row.mass / GRAVITY
            for frame, row in frames
            if frame.time >= self.start
        ]
        # A window, so that it does not matter where in a period the run ends.
        window = np.hanning(len(heights) + 2)[1:-1]
        return {"volume error": 2 * float(np.average(heights, weights=window)) / self.depth - 1}


class Toss(VolumeAtRest):
    """A pool 0.6 m wide and 0.3 m deep, thrown up by v = 2 Y/0.3 m/s: it opens everywhere, and falls back."""

    text = case_text("toss")
    name, title, group = "toss", "Water tossed up", "fluids"
    varies = ("precision", "per_axis", "safety")
    depth, start = 0.3, 0.6
    h, cells, walls, time = 0.025, (24, 40), "slip", (1.0, 40)
    width, height, state = 0.6, 0.3, {"velocity": ["0", "2*Y/0.3"]}


class SandToss(VolumeAtRest):
    """A layer of sand 0.4 m wide and 0.2 m deep, thrown up by v = 4 Y/0.2 m/s: its grains part, and rain down."""

    text = case_text("sand_toss")
    name, title, group = "sand_toss", "Sand tossed up", "plastic"
    varies = ("precision", "per_axis", "safety")
    depth, start = 0.2, 1.1
    h, cells, walls, time = 0.025, (16, 56), {"default": "slip", "y_min": "stick"}, (1.3, 26)
    material, width, height, state = SAND, 0.4, 0.2, {"velocity": ["0", "4*Y/0.2"]}
    # Where grains fall among others rounding decides: what comes of it differs by as much as between lattices.
    measures = tuple(replace(measure, rounding=TOLERANCE) for measure in VolumeAtRest.measures)


class DamAtRest(VolumeAtRest):
    """The dam break of a column 0.25 m wide and 0.5 m high in a tank 1 m long, until it is quiet."""

    name, title, group = "dam_at_rest", "Dam break, at rest again", "fluids"
    depth, start = 0.125, 8.0
    cells, time = (32, 32), (12.0, 240)
    width, height = 0.25, 0.5
    note = "Without relaxation towards the density of the grid a tenth of the volume is gone."


class StirredPool(VolumeAtRest):
    """A pool 1 m wide and six cells deep, rocked for 30 s near its lowest frequency, after 36 s."""

    name, title, group = "stirred_pool", "Stirred pool", "fluids"
    levels = {"coarse": (1,), "default": (1,), "fine": (1, 2)}  # noqa: RUF012
    depth, start = 6 / 32, 31.0
    cells, time = (32, 16), (36.0, 720)
    width, height = 1.0, 6 / 32
    forces = ({"acceleration": ["sin(4.04 * t) if t < 30 else 0", 0.0]},)
    note = "Without relaxation towards the density of the grid a sixth of the volume is gone."


CASES = (Toss(), SandToss(), DamAtRest(), StirredPool())

"""Liquids and sand that are thrown, dropped and stirred, and must fill at rest what they filled at first."""

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Level, Measure

GRAVITY = 9.81
WATER = {"law": "fluid", "density": 1000.0}
SAND = {"law": "sand", "density": 1600.0, "friction_angle": 30.0}
# What has come to rest fills the same volume to this fraction.
TOLERANCE = 0.02


class VolumeAtRest(Case):
    """The depth of a pool when it is quiet again, over what its volume amounts to between walls.

    Attributes:
        depth: of the material at rest, m; width: between the walls, m.
        cells: of the width at resolution 1; up: height of the domain in cells, at resolution 1.
        start, end: of the time over which the depth is averaged, s.
        frames: of the whole run.
    """

    resolution = "cells per unit of the box"
    varies: ClassVar[tuple[str, ...]] = ()
    measures = (
        Measure(
            "volume error",
            "",
            "Depth of the pool at rest, twice the mean height less what its motion adds to that, over the depth that "
            "its volume amounts to, less 1; the mean over the last frames.",
            bound=lambda n: TOLERANCE,
        ),
    )
    source = "Conservation of volume: a liquid fills at rest what it filled at first"
    levels: ClassVar[dict[Level, tuple[int, ...]]] = {"coarse": (1,), "default": (1, 2), "fine": (1, 2)}
    depth: ClassVar[float]
    start: ClassVar[float]

    def pool(self, n: int, h: float, cells: tuple[int, int], end: float, frames: int, **more: Any) -> dict[str, Any]:
        """Return the tables of a scene of these cells at resolution 1, its spacing there h, m."""
        size = [count * h for count in cells]
        return {
            "domain": {
                "size": size,
                "cells": [n * count for count in cells],
                "gravity": [0.0, -GRAVITY],
                "walls": more.pop("walls", "slip"),
            },
            "time": {"end": end, "frames": frames},
            "output": {"fields": ["velocity"]},
            **more,
        }

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


def block(material: dict[str, Any], width: float, height: float, **more: Any) -> list[dict[str, Any]]:
    """Return the only body of a scene: a box in the lower left corner."""
    box = {"min": [0.0, 0.0], "max": [width, height]}
    return [{"name": "material", "material": material, "shape": {"box": box}, **more}]


class Toss(VolumeAtRest):
    """A pool 0.6 m wide and 0.3 m deep, thrown up by v = 2 Y/0.3 m/s: it opens everywhere, and falls back."""

    name = "toss"
    title = "Water tossed up"
    group = "fluids"
    varies = ("precision", "per_axis", "safety")
    depth, start = 0.3, 0.6
    note = (
        "Where opening is forgotten at the tension cut-off, closing makes pressure at once and nothing ever closes: "
        "the pool stays 45 % too deep, at any spacing and with any number of particles."
    )

    def tables(self, n: int) -> dict[str, Any]:
        bodies = block(WATER, 0.6, self.depth, velocity=["0", "2*Y/0.3"])
        return self.pool(n, 0.025, (24, 40), 1.0, 40, bodies=bodies)


class SandToss(VolumeAtRest):
    """A layer of sand 0.4 m wide and 0.2 m deep, thrown up by v = 4 Y/0.2 m/s: its grains part, and rain down."""

    name = "sand_toss"
    title = "Sand tossed up"
    group = "plastic"
    varies = ("precision", "per_axis", "safety")
    depth, start = 0.2, 1.1
    # Where grains fall among others rounding decides: what comes of it differs by as much as between lattices.
    measures = tuple(replace(measure, single=lambda n: TOLERANCE) for measure in VolumeAtRest.measures)
    source = "Conservation of volume: sand that sheared no further fills at rest what it filled at first"
    note = (
        "Velocity gradients no longer say how far apart scattered grains are. Where nothing else says when they have "
        "closed up, they bear pressure up to a cell early, and the layer is a third too deep."
    )

    def tables(self, n: int) -> dict[str, Any]:
        bodies = block(SAND, 0.4, self.depth, velocity=["0", "4*Y/0.2"])
        return self.pool(n, 0.025, (16, 56), 1.3, 26, walls={"default": "slip", "y_min": "stick"}, bodies=bodies)


class DamAtRest(VolumeAtRest):
    """The dam break of a column 0.25 m wide and 0.5 m high in a tank 1 m long, until it is quiet."""

    name = "dam_at_rest"
    title = "Dam break, at rest again"
    group = "fluids"
    depth, start = 0.125, 8.0
    note = "Without relaxation towards the density of the grid a tenth of the volume is gone."

    def tables(self, n: int) -> dict[str, Any]:
        bodies = block(WATER, 0.25, 0.5, initial_pressure="hydrostatic")
        return self.pool(n, 1 / 32, (32, 32), 12.0, 240, walls="separate", bodies=bodies)


class StirredPool(VolumeAtRest):
    """A pool 1 m wide and six cells deep, rocked for 30 s near its lowest frequency, after 36 s."""

    name = "stirred_pool"
    title = "Stirred pool"
    group = "fluids"
    levels = {"coarse": (1,), "default": (1,), "fine": (1, 2)}  # noqa: RUF012
    depth, start = 6 / 32, 31.0
    note = "Without relaxation towards the density of the grid a sixth of the volume is gone."

    def tables(self, n: int) -> dict[str, Any]:
        bodies = block(WATER, 1.0, self.depth, initial_pressure="hydrostatic")
        forces = [{"acceleration": ["sin(4.04 * t) if t < 30 else 0", 0.0]}]
        return self.pool(n, 1 / 32, (32, 16), 36.0, 720, walls="separate", bodies=bodies, forces=forces)


CASES = (Toss(), SandToss(), DamAtRest(), StirredPool())

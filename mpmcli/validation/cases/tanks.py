"""Water and sand in tanks: a standing wave, a column, a floating box, and volumes after violent motion."""

import math
from dataclasses import replace
from typing import ClassVar

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Levels, Tables, case_text
from mpmcli.validation.shared import body, box, field, fit_oscillation, fluid, problem, shaft

GRAVITY, DENSITY = 9.81, 1000.0


def standing_wave_frequency(gravity: float, wave_number: float, depth: float, amplitude: float = 0.0) -> float:
    """Return the angular frequency of a standing wave in water of finite depth, rad/s, to third order in its steepness.

    For small waves w^2 = g k tanh(k d). In general w / sqrt(g k) = w0 + (a k)^2/2 w2, with w0^2 = tanh(k d) and
    w2 = (9 w0^-7 - 12 w0^-3 - 3 w0 - 2 w0^5)/32 (Tadjbakhsh and Keller 1960, JFM 8:442).
    """
    w = math.sqrt(math.tanh(wave_number * depth))
    curvature = (9 * w**-7 - 12 * w**-3 - 3 * w - 2 * w**5) / 32
    return math.sqrt(gravity * wave_number) * (w + (amplitude * wave_number) ** 2 / 2 * curvature)


# Length of the tank, depth of the water and amplitude of the wave, m.
LENGTH, DEPTH, AMPLITUDE = 1.0, 0.5, 0.02
# The speed of sound is ten times that of free fall from the surface to the floor.
MODULUS = 100 * 2 * DENSITY * GRAVITY * DEPTH
WAVE_NUMBER = math.pi / LENGTH
LINEAR = standing_wave_frequency(GRAVITY, WAVE_NUMBER, DEPTH)
EXACT = standing_wave_frequency(GRAVITY, WAVE_NUMBER, DEPTH, AMPLITUDE)
PERIODS = 5
FRAMES_PER_PERIOD = 24


class Sloshing(Case):
    """Initially flat, with v = a w (-sin kX cosh kY, cos kX sinh kY)/sinh kd: the centre of mass oscillates at w."""

    text = case_text("sloshing")
    name, title, group = "sloshing", "Sloshing in a tank", "fluids"
    varies = ("precision", "kernel", "transfer", "safety")
    levels = {"coarse": (24, 32), "default": (24, 32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    measures = (
        text.measure("period error", lambda n: 5e-3 * (32 / n) ** 1.5),
        text.measure("amplitude loss", lambda n: 0.018 * (32 / n) ** 2),
        text.measure("amplitude error", lambda n: 0.018 * 32 / n),
    )

    def tables(self, n: int) -> Tables:
        h, k = LENGTH / n, WAVE_NUMBER
        speed = AMPLITUDE * LINEAR / math.sinh(k * DEPTH)
        size, cells = [LENGTH, n * 5 // 8 * h], [n, n * 5 // 8]
        velocity = [f"{-speed!r} * sin({k!r} * X) * cosh({k!r} * Y)", f"{speed!r} * cos({k!r} * X) * sinh({k!r} * Y)"]
        start = {"velocity": velocity, "initial_pressure": "hydrostatic"}
        water = body("water", fluid(DENSITY, MODULUS), box([0.0, 0.0], [LENGTH, DEPTH]), **start)
        domain = {"size": size, "cells": cells, "gravity": [0.0, -GRAVITY], "walls": "slip"}
        time = PERIODS * 2 * math.pi / LINEAR, PERIODS * FRAMES_PER_PERIOD
        return problem(domain, time, "velocity", [water])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        signal = [(frame.time, frame.position[:, 0].astype(np.float64).mean() - LENGTH / 2) for frame, _ in frames]
        wave = fit_oscillation(*np.array(signal).T, EXACT)
        swing = 2 * AMPLITUDE * LENGTH / (math.pi**2 * DEPTH)
        return {
            "period error": EXACT / wave.frequency - 1,
            "amplitude loss": 1 - math.exp(-wave.decay * 2 * math.pi / wave.frequency),
            "amplitude error": wave.amplitude / swing - 1,
        }


# Height of the column, m.
HEIGHT = 1.0
WEIGHT = DENSITY * GRAVITY * HEIGHT
# Terms of the series of a triangle wave; the first omitted term is 1e-6 of the first.
TERMS = 500


def column(n: int, modulus: float, time: tuple[float, int], **start: str) -> Tables:
    """Return the tables of a column of n cells in a shaft with slip walls."""
    domain, shape = shaft(n, HEIGHT, -GRAVITY, across=8, room=4)
    fields = "velocity pressure volume_ratio initial_position"
    return problem(domain, time, fields, [body("water", fluid(DENSITY, modulus), shape, **start)])


class Hydrostatic(Case):
    """p = density g (H - Y) from the start; the column stays at rest."""

    text = case_text("hydrostatic")
    name, title, group = "hydrostatic", "Hydrostatic column", "fluids"
    levels = {"coarse": (16, 32), "default": (16, 32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    measures = (
        text.measure("pressure error", lambda n: 6e-4 * (32 / n) ** 1.5, order=1.4, expected=1.5),
        text.measure("resting speed (sqrt(g H))", lambda n: 6.5e-6 * (32 / n) ** 1.3),
        text.measure("row spread (density g H)", 1e-12),
    )

    def tables(self, n: int) -> Tables:
        return column(n, 100 * 2 * WEIGHT, (2.0, 40), initial_pressure="hydrostatic")

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return the largest error and spread of the pressure, and the largest speed over that of waves."""
        errors, speeds, spreads = [], [], []
        for frame, row in frames:
            Y = field(frame, "initial_position")[:, 1]
            pressure = field(frame, "pressure")
            exact = WEIGHT * (1 - Y / HEIGHT)
            errors.append(np.linalg.norm(pressure * frame.fields["volume_ratio"] - exact) / np.linalg.norm(exact))
            speeds.append(row.speed_max)
            # About the mean of particles with the same initial height.
            _, rows = np.unique(np.round(Y, 6), return_inverse=True)
            spreads.append(np.std(pressure - (np.bincount(rows, pressure) / np.bincount(rows))[rows]))
        return {
            "pressure error": float(max(errors)),
            "resting speed": max(speeds) / math.sqrt(GRAVITY * HEIGHT),
            "row spread": float(max(spreads)) / WEIGHT,
        }


class HydrostaticDrop(Case):
    """Gravity switched on at t = 0: the base pressure is a triangle wave from 0 to 2 density g H, period 4 H/c."""

    text = case_text("hydrostatic_drop")
    name, title, group = "hydrostatic_drop", "Column of water let go", "fluids"
    varies = ("precision", "transfer")
    levels = {"coarse": (16, 32), "default": (16, 32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    # Stiff, so that the column is nearly linear: its weight at rest compresses it by 0.1 % at the base. The speed of
    # sound rises in proportion to the compression: by half of that along each characteristic, whenever that starts.
    modulus = 1000 * WEIGHT
    period = 4 * HEIGHT / math.sqrt(modulus / DENSITY) * (1 - WEIGHT / modulus / 2)
    periods = 3
    measures = (
        text.measure("pressure error", lambda n: 0.02 * 16 / n, order=0.9, expected=1.0),
        text.measure("period error", lambda n: 1.5e-4 + 2.3e-3 * (16 / n) ** 2),
        text.measure("peak error", lambda n: 0.04 * (16 / n) ** (2 / 3), expected=2 / 3),
    )

    def tables(self, n: int) -> Tables:
        return column(n, self.modulus, (self.periods * self.period, 40 * self.periods))

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of the pressure, of the period of its first harmonic, and of its peak at the base."""
        times, base, exact_base, errors = [], [], [], []
        odd = 2 * np.arange(TERMS) + 1
        share = None
        for frame, _ in frames:
            if share is None:
                Y, row = np.unique(np.round(frame.fields["initial_position"][:, 1], 6), return_inverse=True)
                share = 8 / (np.pi * odd) ** 2 * np.cos(odd * np.pi * Y[:, None] / (2 * HEIGHT))
            exact = 1 - Y / HEIGHT - share @ np.cos(2 * np.pi * odd * frame.time / self.period)
            pressure = field(frame, "pressure") / WEIGHT
            errors.append(np.abs(pressure - exact[row]).mean())
            times.append(frame.time)
            base.append(pressure[row == 0].mean())
            exact_base.append(exact[0])
        # Phase of the first harmonic in each period: the other harmonics of a triangle wave are orthogonal to it.
        turns = np.exp(-2j * math.pi / self.period * np.array(times[1:])) * base[1:]
        phases = turns.reshape(self.periods, -1).mean(1)
        lead = np.angle(phases[-1] / phases[0]) / (2 * math.pi * (self.periods - 1))
        return {
            "pressure error": float(np.mean(errors)),
            "period error": float(1 / (1 + lead) - 1),
            "peak error": max(base) / max(exact_base) - 1,
        }


# Density of the box over that of water; its height, m; size of the tank, in heights of the box; initial angle of the
# box, degrees.
SHARE, BOX, TANK, TILT = 0.5, 0.4, (6.0, 4.0), 10.0
END, FRAMES, STILL = 4.0, 80, 60


class FloatingBox(Case):
    """A box twice as wide as high, released at a tilt; the measures are means over the last second."""

    text = case_text("floating_box")
    name, title, group = "floating_box", "Rigid box that floats", "fluids"
    levels = {"coarse": (8,), "default": (8, 16), "fine": (8, 16, 32)}  # noqa: RUF012
    varies = ("precision", "per_axis")
    # Colliders act on nodes up to three quarters of a cell outside.
    measures = (
        text.measure("draught error", lambda n: 0.35 / n, expected=1.0),
        text.measure("force error", 0.01, rounding=1e-3),
        text.measure("tilt (degrees)", 3.0),
    )

    def tables(self, n: int) -> Tables:
        (width, depth), angle = TANK, math.radians(TILT)
        turned = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        corners = BOX * (np.array([[-1, -0.5], [1, -0.5], [1, 0.5], [-1, 0.5]]) @ turned.T + [width / 2, depth / 2])
        shape = {"polygon": {"vertices": corners.tolist()}}
        pool = box([0.0, 0.0], [width * BOX, depth / 2 * BOX]) | {"subtract": [shape]}
        domain = {"size": [width * BOX, depth * BOX], "spacing": BOX / n, "gravity": [0.0, -GRAVITY]}
        water = body("water", fluid(DENSITY, 1e5), pool, initial_pressure="hydrostatic")
        raft = {"name": "box", "shape": shape, "density": SHARE * DENSITY}
        return problem(domain, (END, FRAMES), "velocity", [water], colliders=[raft])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of draught, in edges of the box, and force, and the tilt, degrees, of means of the rest."""
        rows = [row for _, row in frames][STILL:]
        pose = np.array([row.rigid_pose[0] for row in rows]).mean(axis=0)
        mass = scene.colliders[0].moments.mass
        # The volume below the level is that of the water, compressed from the start, and that displaced by the box.
        level = (scene.bodies[0].shape.form.volume + mass / DENSITY) / scene.domain.size[0]
        force = float(np.mean([row.collider_force[0][1] for row in rows]))
        return {
            "draught error": (level - pose[1]) / BOX + 0.5 - SHARE,
            "force error": force / (mass * GRAVITY) - 1,
            "tilt": math.degrees(pose[2]) + TILT,
        }


WATER = {"law": "fluid", "density": 1000.0}
SAND = {"law": "sand", "density": 1600.0, "friction_angle": 30.0}
# Admissible relative change of the volume at rest.
TOLERANCE = 0.02


class VolumeAtRest(Case):
    """The depth of a pool at rest after motion, over the depth of its initial volume between the walls.

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
        # The potential energy of a small wave, above that of the level, equals its kinetic energy.
        heights = [
            frame.position[:, 1].astype(np.float64).mean() - row.kinetic / row.mass / GRAVITY
            for frame, row in frames
            if frame.time >= self.start
        ]
        # With a window the mean does not depend on the phase at which the run ends.
        window = np.hanning(len(heights) + 2)[1:-1]
        return {"volume error": 2 * float(np.average(heights, weights=window)) / self.depth - 1}


class Toss(VolumeAtRest):
    """A pool 0.6 m wide and 0.3 m deep, thrown up by v = 2 Y/0.3 m/s: it opens everywhere and falls back."""

    text = case_text("toss")
    name, title, group = "toss", "Water tossed up", "fluids"
    varies = ("precision", "per_axis", "safety")
    depth, start = 0.3, 0.6
    h, cells, walls, time = 0.025, (24, 40), "slip", (1.0, 40)
    width, height, state = 0.6, 0.3, {"velocity": ["0", "2*Y/0.3"]}


class SandToss(VolumeAtRest):
    """A layer of sand 0.4 m wide and 0.2 m deep, thrown up by v = 4 Y/0.2 m/s: its grains separate and fall back."""

    text = case_text("sand_toss")
    name, title, group = "sand_toss", "Sand tossed up", "plastic"
    varies = ("precision", "per_axis", "safety")
    depth, start = 0.2, 1.1
    h, cells, walls, time = 0.025, (16, 56), {"default": "slip", "y_min": "stick"}, (1.3, 26)
    material, width, height, state = SAND, 0.4, 0.2, {"velocity": ["0", "4*Y/0.2"]}
    # Rounding affects where grains fall: results differ by as much as between lattices.
    measures = tuple(replace(measure, rounding=TOLERANCE) for measure in VolumeAtRest.measures)


class DamAtRest(VolumeAtRest):
    """The dam break of a column 0.25 m wide and 0.5 m high in a tank 1 m long, until it is at rest."""

    name, title, group = "dam_at_rest", "Dam break, at rest again", "fluids"
    depth, start = 0.125, 8.0
    cells, time = (32, 32), (12.0, 240)
    width, height = 0.25, 0.5
    note = "Without relaxation towards the density of the grid a tenth of the volume is lost."


class StirredPool(VolumeAtRest):
    """A pool 1 m wide and six cells deep, excited for 30 s near its lowest frequency, at 36 s."""

    name, title, group = "stirred_pool", "Stirred pool", "fluids"
    levels = {"coarse": (1,), "default": (1,), "fine": (1, 2)}  # noqa: RUF012
    depth, start = 6 / 32, 31.0
    cells, time = (32, 16), (36.0, 720)
    width, height = 1.0, 6 / 32
    forces = ({"acceleration": ["sin(4.04 * t) if t < 30 else 0", 0.0]},)
    note = "Without relaxation towards the density of the grid a sixth of the volume is lost."

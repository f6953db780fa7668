"""Vibrating bars: effects of the grid, and of motion through it, on the frequency and energy of an axial wave.

The bars are those of Bardenhagen 2002; von Neumann analysis gives the errors of the scheme (docs/theory.md, 2.4 and
10).
"""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import body, box, damped_step, elastic, field, fit_oscillation, problem

LENGTH, YOUNG, DENSITY, SPEED = 25.0, 100.0, 1.0, 0.01
WAVE_SPEED = math.sqrt(YOUNG / DENSITY)
BAR = elastic("fixed_corotated", DENSITY, YOUNG, 0.0)
# The grid has at least five cells per axis; the strip fills them, between slip walls, so that it stays one-dimensional.
STRIP = 5
# The interval of frames is just under two steps of 0.8 of the limit for the coarsest bar, and just under four for the
# next, so that steps are at most slightly smaller than those of the setting.
PERIODS, FRAMES_PER_PERIOD = 5, 17
FRAMES = PERIODS * FRAMES_PER_PERIOD
# Ratio of the loss at a free end to that of the wave, times n; measured with 13, 26 and 52 cells.
END_LOSS = 5.8
# Offsets of cells within the support of a quadratic B-spline.
NEIGHBOURS = range(-3, 4)


def discrete_wave(kh: float, courant: float, per_axis: int) -> tuple[float, float]:
    """Return the errors of MLS-MPM with APIC, quadratic B-splines and leapfrog for a wave e^(i(kx - wt)) along an axis.

    They are its period over the exact one, minus 1, and the fraction of its energy lost in a step. `kh` is the wave
    number times the spacing, `courant` is c dt / h, and each cell has `per_axis` evenly spaced particles. Each particle
    of a cell has the amplitudes v, C and the strain e, in units of h and c. The nodal velocity is
    sum_p w (v + (x_i - x_p)(C - 4 C_0 e)) / sum_p w with the Courant number C_0; the particles gather v and C from the
    nodes, and e increases by C_0 C. The matrix of this step has an eigenvalue near e^(i kh C_0): its angle gives the
    frequency, the square of its modulus the remaining energy.
    The loss does not depend on the step: it is (kh)^4 / 42 for small kh with very many particles, and 0.0238 to
    0.0242 (kh)^4 with 2 to 4 per axis.
    """
    scatter = np.zeros(3 * per_axis, complex)
    gather = np.zeros((3 * per_axis, 1), complex)
    kept = np.zeros((3 * per_axis, 3 * per_axis))
    mass = 0.0
    for p, x in enumerate((np.arange(per_axis) + 0.5) / per_axis):
        v, C, e = 3 * p, 3 * p + 1, 3 * p + 2
        kept[e, e] = 1.0
        for j in NEIGHBOURS:
            # P2G from the particle of cell j to node 0, then G2P from node j to the particle of cell 0.
            w, away, phase = _weight(x + j), -(x + j), np.exp(1j * kh * j)
            mass += w
            scatter[v] += w * phase
            scatter[C] += w * away * phase
            scatter[e] -= 4 * courant * w * away * phase
            w, away = _weight(j - x), j - x
            gather[v] += w * phase
            gather[C] += 4 * w * away * phase
        gather[e] = courant * gather[C]
    values = np.linalg.eigvals(kept + gather * scatter / mass)
    value = values[np.argmin(np.abs(values - np.exp(1j * kh * courant)))]
    return float(kh * courant / np.angle(value)) - 1, 1 - float(abs(value)) ** 2


def _weight(distance: float) -> float:
    """Return the quadratic B-spline at a distance in cells."""
    y = abs(distance)
    if y < 0.5:
        return 0.75 - y * y
    return 0.5 * (1.5 - y) ** 2 if y < 1.5 else 0.0


class Bar(Case):
    """v = v0 sin(b x) at t = 0; then u = v0/w sin(w t) sin(b x), w = b c."""

    text = case_text("bar")
    group = "solids"
    levels = {"coarse": (13, 26), "default": (13, 26, 52), "fine": (13, 26, 52, 104)}  # noqa: RUF012

    def __init__(self, name: str, title: str, quarters: int, room: int) -> None:
        """`quarters` is the number of quarter waves in the bar, `room` that of empty cells beyond a free end."""
        self.name, self.title, self.room = name, title, room
        self.b = b = quarters * math.pi / (2 * LENGTH)
        self.frequency = b * WAVE_SPEED
        free = room > 0
        # The bar between two walls covers the other settings.
        self.varies = ("precision",) if free else Case.varies
        self.measures = (
            self.text.measure("period error", lambda n: 1.3 * 0.105 * (b * LENGTH / n) ** 2, order=1.9, expected=2.0),
            # Between walls: limit of the fit to a signal of finite amplitude.
            self.text.measure(
                "period error against theory",
                (lambda n: 0.3 / n) if free else (lambda n: 2.8e-6 * (n / 13) ** 1.4),
                rounding=0.008,
            ),
            # Bounded where the loss, which falls as n^-3 in a period, is above the effect of the finite amplitude; the
            # rounding is that of a loss of 1e-5 and less.
            self.text.measure(
                "dissipation against theory",
                (lambda n: 1.3 * END_LOSS / n if n <= 26 else math.inf)
                if free
                else (lambda n: 0.004 * (n / 13) ** 1.3 if n <= 52 else 0.13),
                rounding=0.9 if free else 0.15,
            ),
            self.text.measure("amplitude error", lambda n: 0.3 * (b * LENGTH / n) ** 2, expected=2.0),
            self.text.measure("energy loss", expected=3.0),
        )
        self.note = case_text("bar_free" if free else "bar_fixed").filled(end_loss=END_LOSS).note

    def tables(self, n: int) -> Tables:
        h = LENGTH / n
        shape = box([0.0, 0.0], [LENGTH, STRIP * h])
        return problem(
            {"size": [LENGTH + self.room * h, STRIP * h], "cells": [n + self.room, STRIP], "walls": "slip"},
            (PERIODS * (2 * math.pi / self.frequency), FRAMES),
            "velocity initial_position",
            [body("bar", BAR, shape, velocity=[f"{SPEED} * sin({self.b!r} * X)", 0.0])],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of the period, damping and amplitude of the mode, fitted to its projection over time."""
        times, signal, steps = [], [], 0
        for frame, row in frames:
            X = field(frame, "initial_position")[:, 0]
            shape = np.sin(self.b * X)
            times.append(frame.time)
            signal.append(float((frame.position[:, 0] - X) @ shape / (shape @ shape)))
            steps += row.steps
        wave = fit_oscillation(np.array(times), np.array(signal), self.frequency)
        error = self.frequency / wave.frequency - 1
        dt, h = times[-1] / steps, scene.domain.spacing
        theory, _ = discrete_wave(self.b * h, WAVE_SPEED * dt / h, math.isqrt(scene.bodies[0].particles_per_cell))
        loss = 0.024 * (self.b * h) ** 4
        return {
            "period error": error,
            "period error against theory": error / theory - 1,
            "dissipation against theory": -math.expm1(-2 * wave.decay * damped_step(scene, dt)) / loss - 1,
            "amplitude error": wave.amplitude * self.frequency / SPEED - 1,
            "energy loss": wave.energy_loss(),
        }


# The rods: speed of the vibration, and velocity of the flying rod, ten times that along the rod, which travels its own
# length until the end.
ROD_SPEED = 0.1
FLIGHT = (10 * ROD_SPEED, 3 * ROD_SPEED)
B = math.pi / LENGTH
FREQUENCY = B * WAVE_SPEED
# Height of a rod and gaps around and between the rods, cells; initial offset of the flying rod within a cell.
HEIGHT, ROOM, OFFSET = 4, 4, (0.37, 0.23)


class Galilean(Case):
    """u = v0/w sin(w t) cos(b X) in two free rods, one of which flies at ten times the speed of the vibration."""

    text = case_text("galilean")
    name, title, group = "galilean", "Vibrating rod in flight and at rest", "invariants"
    levels = Bar.levels
    varies = ("precision", "kernel", "transfer")
    measures = (
        text.measure("period error", lambda n: 1.3 * 0.105 * (math.pi / n) ** 2, order=1.9, expected=2.0),
        text.measure("change by flight", 0.012, rounding=0.01),
        text.measure("energy loss", expected=3.0),
        text.measure("energy loss at rest", expected=3.0),
    )

    def tables(self, n: int) -> Tables:
        h = LENGTH / n
        end = PERIODS * 2 * math.pi / FREQUENCY
        low = (ROOM * h, ROOM * h)
        start = ((ROOM + OFFSET[0]) * h, (2 * ROOM + HEIGHT + OFFSET[1]) * h)
        cells = [math.ceil((start[a] + FLIGHT[a] * end) / h) + extent + ROOM for a, extent in enumerate((n, HEIGHT))]
        rods = [self._rod("rod at rest", low, (0.0, 0.0), h), self._rod("rod in flight", start, FLIGHT, h)]
        return problem(
            {"size": [c * h for c in cells], "cells": cells}, (end, FRAMES), "velocity initial_position", rods
        )

    def _rod(self, name: str, low: tuple[float, float], flight: tuple[float, float], h: float) -> Tables:
        vibration = f"{ROD_SPEED} * cos({B!r} * (X - {low[0]!r}))"
        velocity = [f"{flight[0]} + {vibration}" if flight[0] else vibration, flight[1]]
        return body(name, BAR, box(low, [low[0] + LENGTH, low[1] + HEIGHT * h]), velocity=velocity)

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return the error of the period of the rod in flight, its change by flight, and the losses of both rods."""
        times: list[float] = []
        signals: tuple[list[float], list[float]] = ([], [])
        for frame, _ in frames:
            times.append(frame.time)
            for rod, signal in enumerate(signals):
                mine = frame.body == rod
                X = field(frame, "initial_position")[mine, 0]
                shape = np.cos(B * (X - scene.bodies[rod].shape.form.bounds()[0][0]))
                # Uniform motion does not contribute to this sum: the shape is odd about the middle of the rod.
                signal.append(float((frame.position[mine, 0] - X) @ (shape - shape.mean())))
        rest, flying = (fit_oscillation(np.array(times), np.array(signal), FREQUENCY) for signal in signals)
        at_rest, in_flight = (FREQUENCY / wave.frequency - 1 for wave in (rest, flying))
        return {
            "period error": in_flight,
            "change by flight": (in_flight - at_rest) / abs(at_rest),
            "energy loss": flying.energy_loss(),
            "energy loss at rest": rest.energy_loss(),
        }


CASES = (
    Bar("bar_fixed_fixed", "Vibrating bar between two walls", 2, 0),
    Bar("bar_fixed_free", "Vibrating bar with a free end", 1, 4),
    Galilean(),
)

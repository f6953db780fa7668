"""A Taylor-Green vortex in a slip box: viscosity of the fluid and numerical viscosity of the transfers."""

import math
from collections.abc import Sequence

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import body, box, damped_step, fluid, problem

# L = 1 m, U = 1 m/s, density 1 kg/m^3.
VISCOSITY, SOUND, PRESSURE, END, FRAMES = 0.01, 20.0, 1.0, 1.0, 20
K = math.pi
# Nodes of a stencil relative to the central one, in cells.
NODES = np.arange(-1, 2)
# Decay rate of kinetic energy, 1/s.
DECAY = 4 * VISCOSITY * K**2


def apic_factor(angles: Sequence[float], places: np.ndarray | None = None) -> float:
    """Return the amplification factor of a velocity wave exp(i k.x) in a step without forces, with quadratic weights.

    A step multiplies the nodal amplitude of the wave by the mean over particles of
    |sum w_i e_i|^2 + 4 |sum w_i (x_i - x_p) e_i|^2, with the weights w_i, the offsets x_i - x_p in cells, and
    e_i = exp(i k.x_i). On a lattice it is a product over axes: A A + A B + B A in 2D. Hence 1 - 0.024 (kh)^4 along an
    axis, and 1 - 0.110 (kh)^4 for the wave vector (k, k) (docs/theory.md, 2.4). `angles` are k h along each axis,
    `places` the positions of particles along each axis, in cells from the nearest node; uniform by default.
    """
    if places is None:
        # The integrands are polynomials of degree six in the position: four-point Gauss quadrature is exact.
        points, parts = np.polynomial.legendre.leggauss(4)
        places, parts = points / 2, parts / 2
    else:
        parts = np.full(len(places), 1 / len(places))
    x = np.asarray(places)[:, None]
    weights = np.concatenate([(0.5 - x) ** 2 / 2, 0.75 - x**2, (0.5 + x) ** 2 / 2], axis=1)
    factor, affine = 1.0, 0.0
    for angle in angles:
        waves = weights * np.exp(1j * angle * NODES)
        A = parts @ np.abs(waves.sum(1)) ** 2
        B = 4 * parts @ np.abs((waves * (NODES - x)).sum(1)) ** 2
        factor, affine = factor * A, affine * A + factor * B
    return float(factor + affine)


def predicted_decay(h: float, step: float) -> float:
    """Return the decay rate of the kinetic energy of the vortex by APIC with quadratic weights, 1/s; `step` in s."""
    return -2 * math.log(apic_factor([K * h, K * h])) / step


def excess(n: int) -> float:
    """Return the ratio of the predicted decay rate to that of viscosity, at the steps of the default setting."""
    return predicted_decay(1 / n, 0.8 / (n * math.sqrt(2) * SOUND)) / DECAY


class TaylorGreen(Case):
    """v = (sin kx cos ky, -cos kx sin ky) exp(-2 nu k^2 t), k = pi, p = p_b + (cos 2kx + cos 2ky)/4 at the start."""

    text = case_text("taylor_green")
    name, title, group = "taylor_green", "Taylor-Green vortex", "fluids"
    levels = {"coarse": (16, 32), "default": (16, 32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    measures = (
        text.measure("decay error", lambda n: 1.05 * excess(n) + 0.014, order=0.9, expected=3.0),
        text.measure("decay unexplained", lambda n: 0.02 * (16 / n) ** 0.6),
        # Damping by the transfers until END, and noise of the particles.
        text.measure("velocity error", lambda n: 1.25 * (1 - math.exp(-0.5 * DECAY * END * excess(n))) + 0.25 / n),
    )

    def tables(self, n: int) -> Tables:
        """Return the vortex in n cells per axis, with J from its pressure."""
        modulus = SOUND**2
        vortex = body(
            "fluid",
            # The flow has no tension; the noise of particle pressures must not be cut off on one side.
            fluid(1.0, modulus, viscosity=VISCOSITY, tension_cutoff=False),
            box([0.0, 0.0], [1.0, 1.0]),
            velocity=["sin(pi * X) * cos(pi * Y)", "-cos(pi * X) * sin(pi * Y)"],
            # p = K (1/J - 1), with a mean that keeps p positive everywhere.
            deformation=f"1 / (1 + ({PRESSURE!r} + 0.25 * (cos(2 * pi * X) + cos(2 * pi * Y))) / {modulus!r})",
            sampling="jittered",
        )
        domain = {"size": [1.0, 1.0], "cells": [n, n], "gravity": [0.0, 0.0], "walls": "slip"}
        return problem(domain, (END, FRAMES), "velocity", [vortex])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of the rate of decay, with and without the transfers', and of the velocity at the end."""
        times, energies, steps = [], [], 0
        for frame, row in frames:
            # Velocities lag positions by half a step.
            times.append(frame.time - row.step_max / 2)
            energies.append(row.kinetic)
            steps += row.steps
        v = frame.velocity.astype(np.float64)
        x, y = K * (frame.position - row.step_max / 2 * v).T
        exact = np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y)], axis=1)
        exact *= math.exp(-DECAY / 2 * times[-1])
        rate = -np.polyfit(times, np.log(energies), 1)[0]
        predicted = predicted_decay(scene.domain.spacing, damped_step(scene, END / steps))
        return {
            "decay error": float(rate / DECAY - 1),
            "decay unexplained": float(rate / (DECAY + predicted) - 1),
            "velocity error": float(np.abs(v - exact).mean() / np.abs(exact).mean()),
        }

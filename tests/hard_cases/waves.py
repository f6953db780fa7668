"""Waves in an elastic bar: what a fine sampling keeps of noise, and what small steps lose."""

from dataclasses import replace

import numpy as np
from scenes import block

from hard_cases.case import HardCase, Outcome
from hard_cases.running import scene, sound, start
from mpmcli.frames.frame import Frame
from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.engine.run import Run
from mpmcli.solver.transfer.kept_motion import OWN_STEP

# The bar of docs/theory.md, 10: fixed at x = 0, free at x = L unless its end is fixed too.
L, YOUNG, DENSITY = 25.0, 100.0, 1.0
C = np.sqrt(YOUNG / DENSITY)
CELLS, STRIP = 13, 5
H = L / CELLS
BAR = {"law": "neo_hookean", "density": DENSITY, "youngs_modulus": YOUNG, "poissons_ratio": 0.0}


def bar(speed: float, per_cell: int, free: bool) -> tuple[Scene, BodyParticles, float]:
    """Return the bar, its particles in the first mode, v = speed sin(b x) and C = dv/dx, and its frequency b c."""
    b = np.pi / (2 * L if free else L)
    body = block("bar", BAR, [0, 0], [L, STRIP * H], particles_per_cell=per_cell)
    asked = scene([body], [CELLS + (4 if free else 0), STRIP], H, walls="slip", precision="f64")
    sample = sample_bodies(asked)[0]
    x = sample.position[:, 0]
    velocity, affine = np.zeros_like(sample.velocity), np.zeros(sample.affine.shape)
    velocity[:, 0] = speed * np.sin(b * x)
    affine[:, 0, 0] = speed * b * np.cos(b * x)
    return asked, replace(sample, velocity=velocity, affine=affine), b * C


def filtered(frame: Frame) -> np.ndarray:
    """Return what the particles' velocities are after one transfer to the grid and back, (n, 2).

    With the affine part, so that fields which are linear over a kernel pass unchanged.
    """
    x, v = frame.position / H, frame.velocity
    C = frame.fields["affine"].reshape(-1, 2, 2)
    base = np.floor(x - 0.5).astype(int)
    f = x - base
    w = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
    momentum = np.zeros((CELLS + 10, STRIP + 6, 2))
    mass = np.zeros(momentum.shape[:2])
    stencil = [(i, j) for i in range(3) for j in range(3)]
    for i, j in stencil:
        weight = w[i, :, 0] * w[j, :, 1]
        node = tuple((base + np.array([i + 2, j + 2])).T)
        away = (base + np.array([i, j]) - x) * H
        np.add.at(momentum, node, weight[:, None] * (v + np.einsum("nij,nj->ni", C, away)))
        np.add.at(mass, node, weight)
    velocity = momentum / np.maximum(mass, 1e-30)[..., None]
    return sum(
        (w[i, :, 0] * w[j, :, 1])[:, None] * velocity[tuple((base + np.array([i + 2, j + 2])).T)] for i, j in stencil
    )


def ringing(periods: int) -> Outcome:
    """H2: the bar with 16 particles per cell: what of its velocities the grid cannot see."""
    speed = 0.1
    asked, sample, w = bar(speed, 16, free=True)
    run = start(asked, [sample])
    shape = np.sin(np.pi / (2 * L) * sample.position[:, 0])
    noise, fine, swing = 0.0, True, 0.0
    for period in range(1, periods + 1):
        while run.time < period * 2 * np.pi / w:
            run.step(run.stable_step()[0])
        frame, row = run.frame()
        fine = fine and sound(frame, row)
        noise = max(noise, float(np.abs(frame.velocity - filtered(frame)).max()))
        # Kinetic and elastic energy share one amplitude.
        swing = np.sqrt((row.kinetic + row.elastic) / (0.5 * sample.mass * speed**2 * (shape**2).sum()))
    return Outcome(
        fine and noise < 1e-2 * speed,
        f"noise {noise / speed:.1e} of v0 after {periods} periods",
        f"{run.step_count:,} steps; {100 * swing:.1f} % of the amplitude are left.",
    )


def loss(run: Run, sample: BodyParticles, w: float, courant: float, periods: int) -> tuple[float, int]:
    """Return the energy lost per period of the first mode of a bar fixed at both ends, and the steps of one."""
    steps = round(2 * np.pi / w / (courant * H / C))
    at_rest, ids = np.tile(np.eye(2), (sample.count, 1, 1)), np.arange(sample.count)
    run.groups[0].replace(x=sample.position, v=sample.velocity, C=sample.affine, deformation=at_rest, id=ids)
    run.state_was_replaced()
    energies = []
    # The first period settles what the start gets wrong at first order.
    for _ in range(periods + 1):
        for _ in range(steps):
            run.step(2 * np.pi / w / steps)
        energies.append(run.frame()[1].energy)
    return float(1 - (energies[-1] / energies[0]) ** (1 / periods)), steps


def small_steps() -> Outcome:
    """H19: the energy that the bar loses per period in its own steps, and in a tenth and a fiftieth of them."""
    asked, sample, w = bar(0.01, 4, free=False)
    short = asked.time.model_copy(update={"step": OWN_STEP / 50 * H / C})
    run = start(asked.model_copy(update={"time": short}), [sample])
    (whole, few), (tenth, _), (fiftieth, _) = (loss(run, sample, w, OWN_STEP / n, 4) for n in (1, 10, 50))
    return Outcome(
        abs(tenth / whole - 1) < 0.05 and abs(fiftieth / whole - 1) < 0.05,
        f"ratios {tenth / whole:.3f} and {fiftieth / whole:.3f}: {100 * whole:.3f} % per period in its own steps",
        f"By 0.024 (kh)^4 per step of its own {100 * 0.024 * (np.pi / CELLS) ** 4 * few:.3f} %; where each step took "
        "as much, the ratios would be 10 and 50.",
    )


CASES = [
    HardCase("H2", "ringing, null space", "the fixed-free bar with 4 particles per cell and direction, 50 periods",
        "velocities that the grid cannot see stay below 1e-2 v0", True, lambda: ringing(50), lambda: ringing(5)),
    HardCase("H19", "steps that are too small",
        "the first mode of a bar between two walls in its own steps, a tenth and a fiftieth of them",
        "the energy lost per period is the same within 5 %", False, small_steps),
]  # fmt: skip

"""Matter that should come to rest and stay there: columns under their weight, a block, and a long slosh."""

from dataclasses import replace

import numpy as np
from scenes import block

from hard_cases.case import HardCase, Outcome
from hard_cases.running import GRAVITY, scene, sound, start
from mpmcli.scene import sample_bodies
from mpmcli.solver.engine.run import Run

DENSITY = 1000.0


def stretch_under(weight: np.ndarray, law: str, modulus: float) -> np.ndarray:
    """Return the vertical stretch where the first Piola stress is -weight, Pa, and nothing gives sideways.

    p = K (1/J - 1) for water; P = E/2 (F - 1/F) for rubber without lateral contraction.
    """
    if law == "fluid":
        return 1 / (1 + weight / modulus)
    return -weight / modulus + np.sqrt((weight / modulus) ** 2 + 1)


def column(law: str, precision: str) -> Run:
    """Return a column of 1 m between slip walls that starts with the stress and the places of rest."""
    h, height, width = 1 / 32, 1.0, 8
    modulus = 1.962e6
    materials = {
        "fluid": {"law": "fluid", "density": DENSITY, "bulk_modulus": modulus},
        "neo_hookean": {"law": "neo_hookean", "density": DENSITY, "youngs_modulus": modulus, "poissons_ratio": 0.0},
    }
    body = block("column", materials[law], [0, 0], [width * h, height])
    walls = {"default": "slip", "y_min": "separate"}
    asked = scene([body], [width, 40], h, gravity=GRAVITY, walls=walls, precision=precision)
    sample = sample_bodies(asked)[0]
    Y = sample.position[:, 1]
    fine = np.linspace(0, height, 20001)
    middle = (fine[1:] + fine[:-1]) / 2
    stretch = stretch_under(DENSITY * GRAVITY * (height - middle), law, modulus)
    y = np.interp(Y, fine, np.concatenate([[0.0], np.cumsum(stretch * np.diff(fine))]))
    run = start(asked, [replace(sample, position=np.stack([sample.position[:, 0], y], 1))])
    there = stretch_under(DENSITY * GRAVITY * (height - Y), law, modulus)
    F = np.tile(np.eye(2), (sample.count, 1, 1))
    F[:, 1, 1] = there
    run.groups[0].replace(deformation=there if law == "fluid" else F)
    run.state_was_replaced()
    return run


def jitter(precision: str) -> Outcome:
    """H14: water and rubber at rest in a channel: the largest speed between 1 and 2 s."""
    found, details, fine = {}, [], True
    scale = np.sqrt(GRAVITY * 1.0)
    for law in ("fluid", "neo_hookean"):
        run = column(law, precision)
        fastest, early = 0.0, 0.0
        while run.time < 2.0:
            for _ in range(20):
                run.step(run.stable_step()[0])
            frame, row = run.frame()
            fine = fine and sound(frame, row)
            if run.time > 1.0:
                fastest = max(fastest, row.speed_max)
            else:
                early = max(early, row.speed_max)
        found[law] = fastest / scale
        details.append(f"{law} {early / scale:.1e} in the first second")
    return Outcome(
        fine and max(found.values()) < 1e-3,
        "max|v| / sqrt(g H) " + ", ".join(f"{law} {value:.1e}" for law, value in found.items()),
        ", ".join(details) + f"; {precision}.",
    )


def block_at_rest(steps: int) -> Outcome:
    """H11: a rubber block that is set on the floor unstressed, swings, and comes to rest."""
    h, side = 0.1, 0.4
    rubber = {"law": "neo_hookean", "density": DENSITY, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
    body = block("block", rubber, [0.3, 0.0], [0.3 + side, side])
    run = start(scene([body], [10, 8], h, gravity=GRAVITY))
    scale = DENSITY * side**2 * GRAVITY * side
    places, kinetic, fine = [], [], True
    for part in range(1, 21):
        while run.step_count < part * steps // 20:
            run.step(run.stable_step()[0])
        frame, row = run.frame()
        fine = fine and sound(frame, row)
        places.append(frame.position.astype(np.float64))
        kinetic.append(row.kinetic / scale)
    drift = np.abs(places[-1] - places[9]).max() / h
    return Outcome(
        fine and drift < 0.1 and kinetic[-1] < 1e-8,
        f"block: drift {drift:.1e} h over the second half, KE {kinetic[-1]:.1e} m g H",
        f"{steps:,} steps; KE after a twentieth of them {kinetic[0]:.1e} m g H.",
    )


def slosh(periods: int) -> Outcome:
    """H11: the first slosh mode of a tank of 1 m, 0.5 m deep, from linear waves at its greatest speed.

    w^2 = g k tanh(k d), k = pi / L; the surface would rise by 0.02 m (docs/theory.md, 10).
    """
    n, depth, rise = 16, 0.5, 0.02
    h, k = 1 / n, np.pi
    w = np.sqrt(GRAVITY * k * np.tanh(k * depth))
    body = block("water", {"law": "fluid", "density": DENSITY}, [0, 0], [1, depth])
    walls = {"default": "slip", "y_max": "separate"}
    asked = scene([body], [n, 12], h, gravity=GRAVITY, walls=walls)
    sample = sample_bodies(asked)[0]
    x, y = sample.position.T
    scale = rise * w / np.sinh(k * depth)
    velocity = scale * np.stack([np.sin(k * x) * np.cosh(k * y), -np.cos(k * x) * np.sinh(k * y)], 1)
    run = start(asked, [replace(sample, velocity=velocity)])
    modulus = asked.bodies[0].material.bulk_modulus
    run.groups[0].replace(deformation=1 / (1 + DENSITY * GRAVITY * (depth - y) / modulus))
    run.state_was_replaced()
    period, fine = 2 * np.pi / w, True
    centres, kinetic, energy = [], [], []
    for part in range(4 * periods):
        while run.time < (part + 1) * period / 4:
            run.step(run.stable_step()[0])
        frame, row = run.frame()
        fine = fine and sound(frame, row)
        centres.append(frame.position.astype(np.float64).mean(0))
        kinetic.append(row.kinetic)
        energy.append(row.energy)
    tenth = max(1, periods // 10) * 4
    drift = np.abs(np.mean(centres[-tenth:], 0) - np.mean(centres[:tenth], 0)).max() / h
    weight = sample.mass * sample.count * GRAVITY * depth
    over = (max(energy) - energy[0]) / (energy[0] - min(energy))
    return Outcome(
        fine and drift < 0.1 and kinetic[-1] < 1e-8 * weight,
        f"slosh: drift {drift:.1e} h, KE {kinetic[-1] / weight:.1e} m g H",
        f"{periods} periods, {run.step_count:,} steps; energy rose by {100 * over:.2g} % of what was lost. "
        f"The scheme damps the wave: KE {kinetic[len(kinetic) // 5 - 1] / weight:.1e} m g H after a fifth of the time.",
    )


def long_runs(steps: int, periods: int) -> Outcome:
    """H11: both."""
    first, second = block_at_rest(steps), slosh(periods)
    return Outcome(
        first.passed and second.passed, f"{first.figure}; {second.figure}", f"{first.detail} {second.detail}"
    )


CASES = [
    HardCase("H11", "long runs",
        "a rubber block set on the floor, 2e5 steps; the first slosh mode of a tank on 16 x 8 cells, 100 periods",
        "centre of mass and particles drift by < 0.1 h; at the end KE < 1e-8 m g H", True,
        lambda: long_runs(200_000, 100)),
    HardCase("H14", "jitter at rest",
        "columns of water and of rubber, 1 m high, that start in the state of rest; h = 1/32, f32",
        "max|v| < 1e-3 sqrt(g H) from 1 s to 2 s", True, lambda: jitter("f32")),
]  # fmt: skip

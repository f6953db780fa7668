"""Impacts: a fast cube on a wall, a cube that collapses or is inverted, and a wave that hits a wall."""

from dataclasses import replace

import numpy as np
from scenes import block

from hard_cases.case import HardCase, Outcome
from hard_cases.running import GRAVITY, growth, run, scene, start, with_springs
from mpmcli.scene import sample_bodies
from mpmcli.solver.frames.diagnosis import UnstableRunError

H, SIDE, DENSITY = 0.1, 0.8, 1000.0
YOUNG, NU = 1e6, 0.3
MU, LAMBDA = YOUNG / (2 * (1 + NU)), YOUNG * NU / ((1 + NU) * (1 - 2 * NU))
WAVE_SPEED = np.sqrt((LAMBDA + 2 * MU) / DENSITY)
RUBBER = {"law": "neo_hookean", "density": DENSITY, "youngs_modulus": YOUNG, "poissons_ratio": NU}


def impact() -> Outcome:
    """H5: a cube thrown at the floor with half the speed of sound and with all of it, without gravity.

    Once as `simulate` runs it, where steps change to land on the frames, and once with steps of one length.
    """
    passed, figures, details = True, [], []
    for fraction in (0.5, 1.0):
        cube = block("cube", RUBBER, [0.4, 0.3], [1.2, 1.1], velocity=[0.0, -fraction * WAVE_SPEED])
        asked = scene([cube], [16, 16], H, end=4 * SIDE / WAVE_SPEED / fraction, frames=100)
        solver = start(asked)
        begin = solver.save().copied()
        done = run(solver)
        if done.stopped is not None:
            raise done.stopped
        rise, over = growth(with_springs(done.rows)) / done.energy[0], done.energy.max() / done.energy[0] - 1
        steps = [row.step_max for row in done.rows[1:]]
        adapts = min(steps) < 0.8 * steps[0]
        passed = passed and done.sound and done.ratios[0] > 0 and adapts and rise <= 1e-3
        figures.append(f"{100 * rise:.2f} % at {fraction:g} c")
        solver.load(begin)
        rows, even = [], min(row.step_min for row in done.rows[1:])
        while solver.time < asked.time.end:
            solver.step(even)
            rows.append(solver.frame()[1])
        steady = growth(with_springs(rows)) / done.energy[0]
        details.append(
            f"At {fraction:g} c J goes down to {done.ratios[0]:.2f}, energy up to {100 * over:.2f} % above its start; "
            f"with steps of one length, {even:.2g} s, it rises by {100 * steady:.2f} %."
        )
    return Outcome(passed, f"energy rises by {', '.join(figures)}", " ".join(details))


def crushed() -> Outcome:
    """H6: a cube whose sides move in at 1 and at 10 times the speed of sound, and one particle turned over."""
    outcomes, right = [], True
    for material in (RUBBER, {**RUBBER, "law": "fixed_corotated"}):
        asked = scene([block("cube", material, [0.4] * 2, [1.2] * 2)], [16, 16], H, end=1.0, frames=60)
        cube = sample_bodies(asked)[0]
        for haste in (1.0, 10.0):
            rate = -haste * WAVE_SPEED / (SIDE / 2)
            velocity = rate * (cube.position - cube.position.mean(0))
            affine = np.tile(rate * np.eye(2), (cube.count, 1, 1))
            timed = asked.model_copy(
                update={"time": asked.time.model_copy(update={"end": 6 * SIDE / WAVE_SPEED / haste})}
            )
            done = run(start(timed, [replace(cube, velocity=velocity, affine=affine)]))
            right = right and done.sound
            if done.stopped is None:
                outcomes.append(f"{material['law']} at {haste:g} c goes on, J down to {done.ratios[0]:.2g}")
            else:
                said = done.stopped.diagnosis
                right = right and said.body == "cube" and any(w in said.cause for w in ("was inverted", "collapsed"))
                outcomes.append(f"{material['law']} at {haste:g} c stops: particle {said.particle} {said.cause}")
        solver = start(asked)
        F = np.tile(np.eye(2), (cube.count, 1, 1))
        F[7] = np.diag([-1.0, 1.0])
        solver.groups[0].replace(deformation=F)
        try:
            solver.step(1e-4)
            right = False
            outcomes.append(f"{material['law']} with F = diag(-1, 1) goes on")
        except UnstableRunError as error:
            said = error.diagnosis
            right = right and (said.particle, said.step) == (7, 1) and "was inverted" in said.cause
            outcomes.append(f"F = diag(-1, 1) stops at step {said.step}: particle {said.particle} {said.cause}")
    return Outcome(
        right, "no NaN; every stop names the particle" if right else "not as asked", "; ".join(outcomes) + "."
    )


def alone(position: np.ndarray, h: float) -> int:
    """Return how many particles have no other in their cell and in those around it."""
    cells = np.floor(position / h).astype(int) + 1
    count = np.zeros(cells.max(0) + 2, int)
    np.add.at(count, tuple(cells.T), 1)
    around = sum(np.roll(count, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1))
    return int((around[tuple(cells.T)] == 1).sum())


def wave_on_wall(resolutions: tuple[int, ...]) -> Outcome:
    """H24: a column of water collapses and hits the opposite wall; the affine velocity C at two resolutions."""
    depth, end = 0.5, 0.8
    speed = np.sqrt(2 * GRAVITY * depth)
    water = {"law": "fluid", "density": DENSITY}
    gradients, shreds, rises, fine, details = [], [], [], True, []
    for n in resolutions:
        h = 1 / n
        asked = scene([block("water", water, [0, 0], [depth, depth])], [n, n], h, end=end, frames=80, gravity=GRAVITY)
        solver = start(asked)
        done = run(solver)
        if done.stopped is not None:
            raise done.stopped
        C = max(np.abs(frame.fields["affine"]).max() for frame in done.frames)
        gradients.append(C * h / speed)
        shreds.append(max(alone(frame.position.astype(np.float64), h) for frame in done.frames) / solver.particle_count)
        rises.append(growth(done.energy) / done.energy[0])
        fine = fine and done.sound
        details.append(f"h = 1/{n}: {solver.step_count:,} steps, J in [{done.ratios[0]:.3f}, {done.ratios[1]:.3f}]")
        details.append(f"max|v| {max(row.speed_max for row in done.rows) / speed:.2f} sqrt(2 g H)")
    return Outcome(
        fine and max(gradients) <= 4 and max(shreds) < 0.01 and max(rises) <= 1e-3,
        f"max|C| h / sqrt(2 g H) {' and '.join(f'{g:.2f}' for g in gradients)}; alone {100 * max(shreds):.2f} %; "
        f"energy rise {100 * max(rises):.2f} %",
        ", ".join(details) + ".",
    )


CASES = [
    HardCase("H5", "high-speed impact",
        "a neo-Hookean cube of 8 cells thrown at the floor at 0.5 c and at c, no gravity",
        "the step adapts, J > 0, and total energy, springs included, never rises by more than 1e-3 of the start", False,
        impact),
    HardCase("H6", "det F <= 0",
        "a cube crushed from all sides at c and at 10 c; one particle with F = diag(-1, 1); two laws",
        "goes on, or stops with the name of the particle; never NaN", True, crushed),
    HardCase("H24", "large C on impact",
        "a dam break of 0.5 m that hits the wall 0.5 m away and falls back, h = 1/64 and 1/128",
        "max|C| h <= 4 sqrt(2 g H) at both; under 1 % of the particles alone; energy rises by 1e-3 at most", True,
        lambda: wave_on_wall((64, 128)), lambda: wave_on_wall((32,))),
]  # fmt: skip

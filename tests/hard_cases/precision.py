"""What the digits of single precision carry: stiff bodies, places far from zero, fast spin, and absolute rest."""

from dataclasses import replace

import numpy as np
from scenes import block

from hard_cases.case import HardCase, Outcome
from hard_cases.running import GRAVITY, scene, sound, start
from mpmcli.errors import InputError
from mpmcli.scene import sample_bodies

H, DENSITY = 0.1, 1000.0
YOUNG, NU = 1e6, 0.3
RUBBER = {"law": "neo_hookean", "density": DENSITY, "youngs_modulus": YOUNG, "poissons_ratio": NU}
SPEED = np.sqrt(YOUNG / DENSITY)


def stiff_cube() -> Outcome:
    """H9: a cube of 1 m and E = 2e9 Pa takes up its weight in f32 and, with the same steps, in f64.

    Gravity strains it by rho g L / E = 5e-6, and a step of 1/80 of the time in which a wave crosses it by less than
    the last digit of F: what f32 adds to the stress is compared with f64 after one crossing, and after ten.
    """
    young, side, h = 2e9, 1.0, 0.05
    stone = {**RUBBER, "youngs_modulus": young}
    crossing = side / np.sqrt(young / DENSITY)
    off, steps, fine, bound = {}, 0, True, 0.0
    scale = DENSITY * GRAVITY * side
    stresses: dict[tuple[str, int], np.ndarray] = {}
    for precision in ("f64", "f32"):
        body = block("cube", stone, [0.5, 0.0], [0.5 + side, side])
        asked = scene(
            [body], [40, 24], h, gravity=GRAVITY, precision=precision, fields=["velocity", "stress", "volume_ratio"]
        )
        run = start(asked)
        # The stiffness grows by no more than the strain: the first step serves for all.
        bound = run.stable_step()[0]
        steps = int(np.ceil(crossing / bound))
        for crossings in range(1, 11):
            for _ in range(steps):
                run.step(crossing / steps)
            if crossings in (1, 10):
                frame, row = run.frame()
                fine = fine and sound(frame, row)
                stresses[precision, crossings] = frame.fields["stress"].astype(np.float64)
    for crossings in (1, 10):
        difference = (stresses["f32", crossings] - stresses["f64", crossings])[:, [0, 1, 4]]
        off[crossings] = float(np.sqrt((difference**2).mean()) / scale)
    return Outcome(
        fine and off[10] < 0.05,
        f"stress noise of f32 {100 * off[1]:.2g} % of rho g L after one crossing, {100 * off[10]:.2g} % after ten",
        f"{steps} steps of {bound:.2g} s in a crossing. F - I is stored, and F rounded once, when the stress is taken: "
        f"that predicts {100 * noise_of_rounding(young, 1) / scale:.2g} % at any time. Stored as F it would be rounded "
        f"in every step, and {100 * noise_of_rounding(young, 10 * steps) / scale:.2g} % off after ten crossings.",
    )


def noise_of_rounding(young: float, steps: int) -> float:
    """Return the RMS error of the stresses xx, yy and xy, Pa, after so many roundings of F near 1 in f32.

    Each is off by up to half a last digit, 2^-24 below 1 and 2^-23 above, uniformly: by 2.7e-8 RMS. The diagonal of F
    walks at random by this, xx and yy answer with lambda + 2 mu and lambda, and xy with next to nothing.
    """
    rounding = 2**-24 * np.sqrt((1 + 4) / 2 / 12)
    lame, shear = young * NU / ((1 + NU) * (1 - 2 * NU)), young / (2 * (1 + NU))
    return float(rounding * np.sqrt(steps) * np.sqrt(2 / 3 * ((lame + 2 * shear) ** 2 + lame**2)))


def far_origin() -> Outcome:
    """H18: the same falling cube in a domain whose lower corner lies at 0, 1e3 and 1e6 m, in f32.

    Positions count from that corner, so that only their start is rounded, to 1e-16 of the distance. Stored from zero,
    a step of v dt would be rounded by 6e-8 |x| / (v dt) (docs/theory.md, 8.3).
    """
    places, rounded = {}, 0.0
    origins = (0.0, 1e3, 1e6)
    for origin in origins:
        body = block("cube", RUBBER, [origin + 0.4] * 2, [origin + 1.2] * 2)
        run = start(scene([body], [16, 16], H, gravity=GRAVITY, origin=origin))
        dt = run.stable_step()[0]
        for _ in range(300):
            run.step(dt)
        frame, row = run.frame()
        if not sound(frame, row):
            return Outcome(False, f"not finite at {origin:g} m")
        places[origin] = frame.position.astype(np.float64) - origin
        rounded = 2**-24 * origin / (row.speed_max * dt)
    off = {origin: np.abs(places[origin] - places[0.0]).max() / H for origin in origins[1:]}
    # Half a last digit of the start, which two roundings and 300 steps may carry into some digits of f32.
    bounds = {origin: 2**-52 * origin / H + 2**-24 * 16 * 20 for origin in origins[1:]}
    return Outcome(
        all(off[origin] <= bounds[origin] for origin in off),
        f"off by {off[1e6]:.1e} h at 1e6 m",
        ", ".join(f"{off[origin]:.1e} h at {origin:.0e} m" for origin in off)
        + f". Counted from zero, every step would be rounded by {rounded:.2g} of itself at 1e6 m.",
    )


def fast_spin() -> Outcome:
    """H21: a disc that turns by 0.05 in a step, three times round.

    F <- (I + dt C) F of a rigid spin w makes J grow by (1 + w^2 dt^2) in a step if no stress answers.
    """
    radius, turn, turns = 0.5, 0.05, 3
    disc = {"name": "disc", "material": RUBBER, "shape": {"ball": {"center": [1.0, 1.0], "radius": radius}}}
    asked = scene([disc], [20, 20], H, precision="f64")
    sample = sample_bodies(asked)[0]
    run = start(asked)
    dt = run.stable_step()[0]
    w = turn / dt
    spin = np.array([[0.0, -w], [w, 0.0]])
    offset = sample.position - 1.0
    run = start(asked, [replace(sample, velocity=offset @ spin.T, affine=np.tile(spin, (sample.count, 1, 1)))])
    steps = round(turns * 2 * np.pi / turn)
    low, high, fine = 1.0, 1.0, True
    for _ in range(steps // 10):
        for _ in range(10):
            run.step(dt)
        frame, row = run.frame()
        fine = fine and sound(frame, row)
        low, high = min(low, row.volume_ratio_min), max(high, row.volume_ratio_max)
    bound = np.exp(turn**2 * steps)
    return Outcome(
        fine and high <= bound and low >= 1 / bound,
        f"J in [{low:.3f}, {high:.3f}], bound {bound:.3f}",
        f"{steps} steps; the rim moves at {w * radius / SPEED:.2f} sqrt(E / rho).",
    )


def rest(steps: int) -> Outcome:
    """H22: water and rubber that nothing moves stay bit by bit as they are; a body without particles is refused."""
    water = {"law": "fluid", "density": DENSITY, "bulk_modulus": 1e5}
    bodies = [block("water", water, [0, 0], [0.5, 0.5]), block("rubber", RUBBER, [0.5, 0.0], [1.2, 0.7])]
    fields = ["velocity", "affine", "volume_ratio", "deformation_gradient"]
    run = start(scene(bodies, [16, 16], H, fields=fields))
    before, _ = run.frame()
    for _ in range(steps):
        run.step(run.stable_step()[0])
    after, row = run.frame()
    same = np.array_equal(before.position, after.position) and np.array_equal(before.velocity, after.velocity)
    same = same and all(np.array_equal(before.fields[name], after.fields[name]) for name in before.fields)
    sliver = {"polygon": {"vertices": [[0.5, 0.5], [0.9, 0.6], [0.9, 0.599]]}}
    try:
        scene([{"name": "sliver", "material": water, "shape": sliver}], [16, 16], H)
        refused = False
    except InputError:
        refused = True
    return Outcome(
        same and row.energy == 0 and refused,
        f"{'bitwise equal' if same else 'moved'} after {steps:,} steps",
        f"Energy {row.energy:g} J. A body too thin for any particle is {'refused' if refused else 'accepted'}.",
    )


CASES = [
    HardCase("H9", "stiff body in f32", "a cube of 1 m and E = 2e9 Pa under gravity, h = 0.05, in f32 and in f64",
        "runs; stress within 5 % of rho g L of that in f64 after ten crossings of a wave", True, stiff_cube),
    HardCase("H18", "f32 far from zero", "a falling cube with the domain's corner at 0, 1e3 and 1e6 m, 300 steps",
        "the same as at 0 to the rounding of the start and 20 last digits of f32", False, far_origin),
    HardCase("H21", "fast rotation", "a disc that turns by 0.05 in a step, three times round, F explicit",
        "J within exp(w^2 dt t) of 1", False, fast_spin),
    HardCase("H22", "absolute rest",
        "water and rubber side by side without gravity and velocity, 1e4 steps; a body without a particle",
        "bitwise the same; refused", True, lambda: rest(10_000), lambda: rest(1_000)),
]  # fmt: skip

"""Snow crushed from all sides, sand that is tossed, that falls freely, and that yields in plane strain."""

from dataclasses import replace

import numpy as np
from scenes import block

from hard_cases.case import HardCase, Outcome
from hard_cases.running import GRAVITY, run, scene, sound, start
from mpmcli.scene import sample_bodies

H, SIDE = 0.1, 0.8
SAND = {"law": "sand", "density": 1600.0, "youngs_modulus": 5e5, "friction_angle": 30.0}


def packed_snow() -> Outcome:
    """H15: a cube of snow whose sides move in until it fills half of its volume and more."""
    snow = {"law": "snow", "density": 400.0, "youngs_modulus": 1.4e5, "poissons_ratio": 0.2}
    fields = ["velocity", "volume_ratio", "plastic_volume_ratio"]
    speed = 80.0
    asked = scene([block("snow", snow, [0.4] * 2, [1.2] * 2)], [16, 16], H, end=0.02, frames=40, fields=fields)
    cube = sample_bodies(asked)[0]
    rate = -speed / (SIDE / 2)
    velocity = rate * (cube.position - cube.position.mean(0))
    affine = np.tile(rate * np.eye(2), (cube.count, 1, 1))
    run = start(asked, [replace(cube, velocity=velocity, affine=affine)])
    frames, hardness, waves, fine = [], [], [], True
    for frame, row in run.frames():
        frames.append(frame)
        fine = fine and sound(frame, row)
        hardness.append(float(np.exp(10 * (1 - frame.fields["plastic_volume_ratio"])).max()))
        waves.append(min(limit.value for limit in run.limits() if limit.name == "wave"))
    stored = min(frame.fields["volume_ratio"].min() for frame in frames)
    # Waves are faster by the root of the hardening, so that the limit must fall by as much at every frame.
    follows = np.max(np.array(waves) / waves[0] * np.sqrt(hardness))
    # The stored ratio goes no lower than the packing limit lets it; where the particles are says how far it went.
    spread = np.array([frame.position.astype(np.float64).var(0).sum() for frame in frames])
    mean = spread.min() / spread[0]
    return Outcome(
        fine and mean < 0.5 and max(hardness) <= 100 * (1 + 1e-4) and follows <= 1.01,
        f"crushed to {mean:.2f} of its area, hardening up to {max(hardness):.0f}, "
        f"wave limit down to {min(waves) / waves[0]:.3f} of the first",
        f"{run.step_count} steps. J as it is stored goes down to {stored:.2f} only, where the hardening limit ends "
        "the packing, although the particles lie closer than that.",
    )


def toss(correction: bool) -> tuple[float, float]:
    """Return the gain of volume of sand that was thrown up unevenly and landed, and its speed at the end, m/s."""
    cells, depth = 8, 0.2
    h, width = depth / cells, 2 * depth
    body = block("sand", {**SAND, "volume_correction": correction}, [0, 0], [width, depth])
    walls = {"default": "slip", "y_min": "stick"}
    asked = scene([body], [2 * cells, 3 * cells], h, end=0.75, frames=3, gravity=GRAVITY, walls=walls)
    sample = sample_bodies(asked)[0]
    x, y = sample.position.T
    throw = 2 * np.cos(2 * np.pi * x / width) ** 2 * y / depth
    done = run(start(asked, [replace(sample, velocity=np.stack([0 * x, throw], 1))]))
    if done.stopped is not None:
        raise done.stopped
    heights = [frame.position[:, 1].mean() for frame in done.frames]
    return float(heights[-1] / heights[0] - 1), float(np.abs(done.last.velocity).max())


def volume_gain() -> Outcome:
    """H16: toss and land, with and without volume correction (Tampubolon et al. 2017)."""
    (kept, calm), (gained, _) = toss(True), toss(False)
    return Outcome(
        abs(kept) < 0.05 and gained > 0.10,
        f"{100 * kept:+.1f} % with correction, {100 * gained:+.1f} % without",
        f"Fastest particle at the end {calm:.3f} m/s.",
    )


def free_fall() -> Outcome:
    """H17: a cube of sand that expands in free fall: every particle at the tip of the cone, with no stress at all."""
    d, end = 2, 0.15
    asked = scene([block("sand", SAND, [0.4, 0.6], [1.2, 1.4])], [16, 16], H, end=end, frames=10, gravity=GRAVITY)
    cube = sample_bodies(asked)[0]
    rate = 2.0
    velocity = rate * (cube.position - cube.position.mean(0))
    affine = np.tile(rate * np.eye(d), (cube.count, 1, 1))
    done = run(start(asked, [replace(cube, velocity=velocity, affine=affine)]))
    if done.stopped is not None:
        raise done.stopped
    row = done.rows[-1]
    # Velocities are those of the middle of the last step, which is as long as one of those before the frame.
    middle = end - (row.step_min + row.step_max) / 4
    off = np.abs(np.array(row.linear_momentum) / row.mass + [0.0, GRAVITY * middle]).max()
    off = max(off - GRAVITY * (row.step_max - row.step_min) / 4, 0.0) / (GRAVITY * end)
    elastic = max(row.elastic for row in done.rows) / done.rows[0].kinetic
    return Outcome(
        done.sound and elastic < 1e-9 and off < 1e-5 and row.volume_ratio_min > 1,
        f"elastic energy {elastic:.1g} of the kinetic one; v_cm off g t by {off:.1e}",
        f"J in [{row.volume_ratio_min:.2f}, {row.volume_ratio_max:.2f}] at the end; no logarithm of zero.",
    )


def steep_sand() -> Outcome:
    """H20: dense sand of 45 degrees in 3D, sheared in plane strain until it yields.

    A cube under a pressure that its inertia holds for the time of the test is sheared at a constant rate, faster than
    waves come in from its surface: sin(phi) = (s1 - s3) / (s1 + s3) in the plane, in its middle. Klar's alpha for 45
    degrees never yields there (docs/theory.md, 5.7).
    """
    E, nu, density, phi = 1e6, 0.3, 1600.0, 45.0
    sand = {**SAND, "youngs_modulus": E, "poissons_ratio": nu, "friction_angle": phi}
    fields = ["velocity", "stress", "volume_ratio"]
    walls = {"default": "separate", "z_min": "slip", "z_max": "slip"}
    body = block("sand", sand, [0.2, 0.2, 0.0], [1.4, 1.4, 0.5])
    asked = scene([body], [16, 16, 5], H, fields=fields, walls=walls)
    cube = sample_bodies(asked)[0]
    speed = np.sqrt(E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / density)
    # The middle is six cells from the surface, which the kernel brings two cells nearer: it hears of it later.
    time = 3 * H / speed
    strain = 1e-3
    shear = np.zeros((3, 3))
    shear[0, 1] = 6 * strain / time
    start_at = replace(
        cube, velocity=(cube.position - cube.position.mean(0)) @ shear.T, affine=np.tile(shear, (cube.count, 1, 1))
    )
    run = start(asked, [start_at])
    run.groups[0].replace(deformation=np.tile(np.exp(-strain) * np.eye(3), (cube.count, 1, 1)))
    run.state_was_replaced()
    middle = np.linalg.norm((cube.position - cube.position.mean(0))[:, :2], axis=1) < 1.2 * H
    ratios = []
    while run.time < time:
        run.step(min(run.stable_step()[0] / 2, time - run.time + 1e-12))
        frame, _ = run.frame()
        stress = frame.fields["stress"].reshape(-1, 3, 3)[middle, :2, :2].astype(np.float64)
        s3, s1 = np.linalg.eigvalsh(stress).mean(0)
        ratios.append((s1 - s3) / -(s1 + s3))
    found = float(np.degrees(np.arcsin(min(1.0, ratios[-1]))))
    return Outcome(
        sound(*run.frame()) and abs(found - phi) < 0.5 and abs(ratios[-1] - ratios[-2]) < 1e-3,
        f"yields at {found:.2f} degrees",
        f"After a shear of {100 * strain * 6:.1f} %; the ratio of stresses no longer changes.",
    )


CASES = [
    HardCase("H15", "hardening snow",
        "a cube of snow whose sides move in at 80 m/s, until it fills less than half of its area",
        "the wave limit falls as 1 / sqrt(hardening), which stays below its limit of 100; no NaN", True, packed_snow),
    HardCase("H16", "volume gain of sand",
        "sand thrown up by 2 cos^2(2 pi x / W) y / H m/s and landed, with and without volume correction",
        "the deposit gains < 5 % with correction, > 10 % without", True, volume_gain),
    HardCase("H17", "tip of the cone", "a cube of sand that falls freely and expands",
        "no NaN, no stress, free fall of the centre of mass to 1e-5", True, free_fall),
    HardCase("H20", "steep friction angle in 3D", "sand of 45 degrees in 3D, compressed and sheared in plane strain",
        "yields at 45 degrees in the plane, where Klar's alpha would never", True, steep_sand),
]  # fmt: skip

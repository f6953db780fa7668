"""Bodies that are pulled, and bodies that are thinner than the kernel: clustering, gaps and contact."""

from dataclasses import replace

import numpy as np
from scenes import block

from hard_cases.case import HardCase, Outcome
from hard_cases.running import growth, nearest, run, scene, start
from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_state import StretchCheck
from mpmcli.output.header import RunHeader
from mpmcli.scene import BodyParticles, sample_bodies, scene_to_toml
from mpmcli.solver.engine.run import Run

H, DENSITY = 0.1, 1000.0
YOUNG, NU = 1e6, 0.3
MU, LAMBDA = YOUNG / (2 * (1 + NU)), YOUNG * NU / ((1 + NU) * (1 - 2 * NU))
WAVE_SPEED = np.sqrt((LAMBDA + 2 * MU) / DENSITY)
RUBBER = {"law": "neo_hookean", "density": DENSITY, "youngs_modulus": YOUNG, "poissons_ratio": NU}
BAR = (0.8, 0.4)


def side_stretch(stretch: float) -> float:
    """Return the stretch across a pulled bar: mu (s^2 - 1) + lambda ln(stretch s) = 0, by bisection."""
    low, high = 0.1, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        if MU * (middle**2 - 1) + LAMBDA * np.log(stretch * middle) > 0:
            high = middle
        else:
            low = middle
    return low


def pulled(stretch: float, per_cell: int) -> tuple[Run, BodyParticles, float]:
    """Return a bar that starts at rest, pulled to a multiple of its length, its particles at rest, and their distance.

    Nothing holds it: it snaps back to its length and swings about it. Six of its swings long.
    """
    bar = block("bar", RUBBER, [1.2, 0.6], [1.2 + BAR[0], 0.6 + BAR[1]], particles_per_cell=per_cell)
    asked = scene([bar], [32, 16], H, end=12 * BAR[0] / np.sqrt(YOUNG / DENSITY), frames=120)
    sample = sample_bodies(asked)[0]
    across = side_stretch(stretch)
    middle = np.array([1.6, 0.8])
    position = (sample.position - sample.position.mean(0)) * [stretch, across] + middle
    run = start(asked, [replace(sample, position=position)])
    run.groups[0].replace(deformation=np.tile(np.diag([stretch, across]), (sample.count, 1, 1)))
    run.state_was_replaced()
    return run, sample, H / np.sqrt(per_cell)


def bar_snaps_back() -> tuple[float, bool, str]:
    """Return the smallest distance of two particles over that at rest, whether all is finite, and the energy."""
    solver, _, distance = pulled(2.0, 4)
    done = run(solver)
    if done.stopped is not None:
        raise done.stopped
    least = min(nearest(frame.position.astype(np.float64)).min() for frame in done.frames)
    rise = growth(done.energy) / done.energy[0]
    return float(least / distance), done.sound, f"energy of the bar rises by {100 * rise:.2f} % at most"


def vortex() -> tuple[float, float, bool]:
    """Return the smallest distance over that at the start in a Taylor-Green vortex without background pressure.

    v = U (sin kx cos ky, -cos kx sin ky) in a box with slip walls, k = pi / L, to k U t = 1, with the tension cut-off;
    second, that of particles that follow this flow exactly, and whether all is finite.
    """
    L, U = 1.0, 1.0
    k = np.pi / L
    water = {"law": "fluid", "density": DENSITY, "bulk_modulus": DENSITY * (20 * U) ** 2}
    asked = scene([block("box", water, [0, 0], [L, L])], [32, 32], L / 32, end=1 / (k * U), frames=10, walls="slip")
    sample = sample_bodies(asked)[0]

    def flow(x: np.ndarray) -> np.ndarray:
        kx, ky = k * x.T
        return U * np.stack([np.sin(kx) * np.cos(ky), -np.cos(kx) * np.sin(ky)], 1)

    kx, ky = k * sample.position.T
    slope, turn = np.cos(kx) * np.cos(ky), np.sin(kx) * np.sin(ky)
    affine = U * k * np.stack([slope, -turn, turn, -slope], 1).reshape(-1, 2, 2)
    done = run(start(asked, [replace(sample, velocity=flow(sample.position), affine=affine)]))
    exact = sample.position
    dt = asked.time.end / 200
    for _ in range(200):
        exact = exact + dt * flow(exact + dt / 2 * flow(exact))
    distance = L / 64
    least = min(nearest(frame.position.astype(np.float64)).min() for frame in done.frames)
    return float(least / distance), float(nearest(exact).min() / distance), done.sound and done.stopped is None


def clustering() -> Outcome:
    """H3: a bar that is pulled to twice its length and let go, and a fluid without background pressure."""
    bar, fine, energy = bar_snaps_back()
    fluid, tracers, calm = vortex()
    return Outcome(
        fine and calm and bar > 0.3 and fluid > 0.3,
        f"least distance {bar:.2f} d0 in the bar, {fluid:.2f} d0 in the fluid",
        f"Points that follow the vortex exactly come as near as {tracers:.2f} d0; {energy}.",
    )


def fracture(per_cell: int) -> Outcome:
    """H13: a bar pulled to three times its length and let go: largest gap, and its length afterwards."""
    solver, sample, distance = pulled(3.0, per_cell)
    done = run(solver)
    if done.stopped is not None:
        raise done.stopped
    rows = np.unique(np.round(sample.position[:, 1], 6))
    row = np.abs(sample.position[:, 1] - rows[len(rows) // 2]) < 1e-6
    order = np.argsort(sample.position[row, 0])

    def gaps(position: np.ndarray) -> np.ndarray:
        return np.diff(position[row, 0][order])

    later = done.frames[len(done.frames) // 2 :]
    widest = max(gaps(frame.position).max() for frame in done.frames) / H
    length = np.mean([np.ptp(frame.position[row, 0]) for frame in later]) / np.ptp(sample.position[row, 0])
    # What `mpmcli check` says of these frames, had they begun at rest.
    facts = {"arch": "cpu", "threads": 1, "precision": solver.scene.solver.precision}
    header = RunHeader.of(solver.scene, scene_to_toml(solver.scene), [group.law for group in solver.groups], facts)
    findings = FrameFindings()
    check = StretchCheck(header, findings)
    for frame in (replace(done.frames[0], position=sample.position), *done.frames):
        check.check(frame)
    told = any(finding.severity == "warning" for finding in findings.found())
    return Outcome(
        done.sound and (widest < 1 or told),
        f"largest gap {widest:.2f} h at {per_cell} particles per cell" + (", said to have torn" if told else ""),
        f"Let go, the bar is {length:.2f} of its length on average, its largest gap in the end "
        f"{gaps(done.last.position).max() / distance:.2f} d0.",
    )


def sheets() -> Outcome:
    """H12: two sheets one particle thick, one falling on the floor and another on it; where they begin to touch.

    Each is half a cell thick, at one particle per half cell. Without gravity: the lower one lies still above the
    floor's reach, the upper one comes down slowly; then the same pair half a cell apart at the start, pulled apart.
    """
    thick = H / 2
    low = 4 * H

    def pair(gap: float, speed: float) -> tuple[Run, np.ndarray]:
        names = (("lower", low, 0.0), ("upper", low + thick + gap, speed))
        bodies = [
            block(name, RUBBER, [0.4, y], [1.2, y + thick], particles_per_cell=4, velocity=[0.0, v])
            for name, y, v in names
        ]
        solver = start(scene(bodies, [16, 16], H, end=4 * H / abs(speed), frames=80))
        return solver, solver.frame()[0].body

    speed = 0.02 * WAVE_SPEED
    solver, body = pair(3 * H, -speed)
    done = run(solver)
    if done.stopped is not None:
        raise done.stopped
    between = np.array([np.ptp([f.position[body == b, 1].mean() for b in (0, 1)]) for f in done.frames]) - thick
    above = [f.position[body == 1, 1].min() - f.position[body == 0, 1].max() for f in done.frames]
    slowed = [f.velocity[body == 1, 1].mean() > -0.99 * speed for f in done.frames]
    contact = between[slowed.index(True)] / H
    solver, body = pair(0.5 * H, speed)
    apart = run(solver)
    if apart.stopped is not None:
        raise apart.stopped
    drag = 1 - np.ptp([apart.last.velocity[body == b, 1].mean() for b in (0, 1)]) / speed
    return Outcome(
        done.sound and apart.sound and min(above) > 0,
        f"contact from a gap of {contact:.2f} h on; smallest {min(between) / H:.2f} h",
        f"Pulled apart from 0.5 h at {speed:.2g} m/s, the sheets lose {100 * drag:.0f} % of that speed to each other. "
        "Thinner than 2 h, a body has no thickness of its own on the grid.",
    )


CASES = [
    HardCase("H3", "tensile instability",
        "a bar pulled to twice its length and let go; a Taylor-Green vortex without background pressure, k U t = 1",
        "no two particles nearer than 0.3 of their distance at rest", True, clustering),
    HardCase("H12", "thin sheet and narrow gap",
        "two sheets one particle thick that meet slowly, and that part from a gap of 0.5 h",
        "none passes through the other; the gap at which they touch is said", True, sheets),
    HardCase("H13a", "numerical fracture", "a bar of 4 particles per cell pulled to three times its length and let go",
        "largest gap < 1 h, or the run says so", True, lambda: fracture(4)),
    HardCase("H13b", "numerical fracture, more particles", "the same with 16 particles per cell",
        "largest gap < 1 h, or the run says so", True, lambda: fracture(16)),
]  # fmt: skip

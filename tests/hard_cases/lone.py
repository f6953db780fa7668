"""Particles alone or in threes, particles next to the edge of a node's reach, and particles outside the domain."""

from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
from scenes import block

from hard_cases.case import HardCase, Outcome
from hard_cases.running import GRAVITY, run, scene, sound, start
from mpmcli.errors import InputError
from mpmcli.scene import sample_bodies
from mpmcli.solver.frames.diagnosis import NOT_FINITE, UnstableRunError

H = 0.1
BULK, DENSITY = 1e5, 1000.0
WAVE_SPEED = np.sqrt(BULK / DENSITY)


def droplets(steps: int) -> Outcome:
    """H1: one particle and two clusters of three, in free fall and then on the floor, at dt = 0.6 h/c.

    Each with suction and without, far from each other. All start from random velocities and velocity gradients.
    """
    random = np.random.default_rng(1)
    centres = np.array([[2.2, 4.3], [8.4, 5.1], [13.7, 3.6]]) * H
    places = np.concatenate([centres[:1], *(c + random.uniform(-0.6, 0.6, (3, 2)) * H for c in centres[1:])])
    worst, low, high, fine = 0.0, np.inf, 0.0, True
    for suction in (False, True):
        material = {"law": "fluid", "density": DENSITY, "bulk_modulus": BULK, "tension_cutoff": not suction}
        # Seven particles of a box of seven cells, put where they belong.
        drop = block("drop", material, [0, 0], [7 * H, H], particles_per_cell=1)
        asked = scene([drop], [16, 16], H, gravity=GRAVITY)
        sample = sample_bodies(asked)[0]
        velocity = random.uniform(-0.02, 0.02, places.shape) * WAVE_SPEED
        affine = random.uniform(-0.01, 0.01, (len(places), 2, 2)) * WAVE_SPEED / H
        run = start(asked, [replace(sample, position=places, velocity=velocity, affine=affine)])
        fall = np.sqrt(2 * GRAVITY * places[:, 1].max() + (velocity**2).sum(1).max())
        dt = 0.6 * H / WAVE_SPEED
        for step in range(steps):
            run.step(dt)
            if step % (20 if step < 2000 else 500) == 0 or step == steps - 1:
                frame, row = run.frame()
                fine = fine and sound(frame, row)
                worst = max(worst, row.speed_max / fall)
                low, high = min(low, row.volume_ratio_min), max(high, row.volume_ratio_max)
    return Outcome(
        fine and worst <= 1 and low >= 0.1 and high <= 2,
        f"max|v| {worst:.2f} of the fall, J in [{low:.3f}, {high:.3f}]",
        f"{steps:,} steps with suction and as many without; dt is above the default step, 0.57 h/c.",
    )


def edge_of_a_node() -> Outcome:
    """H7: the acceleration that one stressed particle gives a node at 1.499 h, lone, with a neighbour, in a corner.

    Node i receives w_i tau (x_i - x_p) 4 V0 / h^2, and as much mass as w_i says, so that no weight remains in the
    acceleration: its components are at most 4 |tau| |x_i - x_p| / (rho h^2) <= 6 |tau| / (rho h) (docs/theory.md, 6.1)
    """
    tau, dt = 1e4, 1e-6
    # J with the pressure tau per volume at rest: p J = K (1 - J).
    J = 1 - tau / BULK
    water = block("water", {"law": "fluid", "density": DENSITY, "bulk_modulus": BULK}, [0, 0], [2 * H, H])
    asked = scene([{**water, "particles_per_cell": 1}], [16, 16], H, precision="f64")
    sample = sample_bodies(asked)[0]
    run = start(asked, [sample])
    group = run.groups[0]
    bound = 6 * tau / (DENSITY * H)
    edge = np.array([6.5 + 0.999, 6.5 + 0.999])
    settings = {
        "alone": [edge, [12.0, 12.0]],
        "next to one at its edge": [edge, edge + np.array([1.0, 0.4])],
        "at the corner": [[0.001, 0.001], [12.0, 12.0]],
        "near the corner": [[0.499, 0.501], [12.0, 12.0]],
    }
    found = {}
    for name, places in settings.items():
        at_rest = {"v": np.zeros((2, 2)), "C": np.zeros((2, 2, 2)), "deformation": np.array([J, 1.0])}
        group.replace(x=np.array(places) * H, id=np.arange(2), **at_rest)
        run.state_was_replaced()
        run.step(dt)
        nodes = run.grid.nodes.to_numpy()
        found[name] = float(np.abs(nodes[nodes[:, 2] > 0, :2]).max() / dt / bound)
    worst = max(found.values())
    return Outcome(
        0 < worst <= 1 + 1e-9,
        f"largest |a| {worst:.4f} of the bound",
        "; ".join(f"{name} {value:.4f}" for name, value in found.items()) + ".",
    )


def outside(offset: float) -> str:
    """Return what comes of a run that is given one particle that far outside, in cells, in a process of its own."""
    material = {"law": "fluid", "density": DENSITY, "bulk_modulus": BULK}
    asked = scene([block("drop", material, [4 * H] * 2, [8 * H] * 2)], [16, 16], H)
    sample = sample_bodies(asked)[0]
    position = sample.position.copy()
    position[5, 0] = (16 + offset) * H
    try:
        start(asked, [replace(sample, position=position)]).step(1e-3)
    except (InputError, UnstableRunError) as error:
        return f"{type(error).__name__}: {error}"
    return "went on"


def leaving() -> Outcome:
    """H8: a ball faster than its step allows, a body outside the domain, and particles given outside."""
    material = {"law": "fluid", "density": DENSITY, "bulk_modulus": BULK}
    ball = block("ball", material, [7 * H] * 2, [9 * H] * 2)
    fast = run(start(scene([{**ball, "velocity": [300.0, 0.0]}], [16, 16], H, end=0.05, frames=5)))
    ended = "goes on" if fast.stopped is None else fast.stopped.diagnosis.cause
    solver = start(scene([{**ball, "velocity": [300.0, 0.0]}], [16, 16], H))
    try:
        solver.step(0.01)
        left = "went on"
    except UnstableRunError as error:
        left = error.diagnosis.cause
    try:
        scene([block("ball", material, [15 * H] * 2, [18 * H] * 2)], [16, 16], H)
        refused = False
    except InputError:
        refused = True
    crashed = []
    for offset in (-16.4, 0.6, 3.0, 50.0, 1e6, np.nan):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            try:
                pool.submit(outside, offset).result()
            except BrokenProcessPool:
                crashed.append(f"{offset:g}")
    return Outcome(
        fast.sound and ended != NOT_FINITE and "left the domain" in left and refused and not crashed,
        f"interpreter crashes: {len(crashed)} of 6",
        f"At 30 c against the wall the ball {ended}; with a step of 30 cells it {left}. "
        f"A body outside is {'refused' if refused else 'accepted'}. "
        + (f"Particles that a program gives {', '.join(crashed)} cells beyond the wall kill it." if crashed else ""),
    )


CASES = [
    HardCase("H1", "isolated fluid particles",
        "one particle and two clusters of three, with and without suction, dt = 0.6 h/c, 1e5 steps in gravity",
        "max|v| never above the speed of the fall; J in [0.1, 2]; no NaN", True, lambda: droplets(100_000),
        lambda: droplets(2_000)),
    HardCase("H7", "tiny nodal mass",
        "a particle at 1.499 h from a node along both axes, alone, beside another, and in a corner of walls",
        "per axis |a| <= 6 |tau| / (rho h) at every node", False, edge_of_a_node),
    HardCase("H8", "particles leave the domain",
        "a ball at 30 c against the wall; a step of 30 cells; a body outside; particles given outside, and NaN",
        "goes on or stops with a sentence; no out-of-range write, no crash of the interpreter", True, leaving),
]  # fmt: skip

"""Neighbours that differ a thousandfold in density, and a body that hardly gives in volume."""

import numpy as np
from scenes import block

from hard_cases.case import HardCase, Outcome
from hard_cases.running import GRAVITY, growth, run, scene, start
from mpmcli.scene import sample_bodies


def density_ratio() -> Outcome:
    """H4: water of 1000 kg/m^3 on one half of a layer of a fluid of 1 kg/m^3, which it pushes aside."""
    h = 0.05
    light = {"law": "fluid", "density": 1.0, "bulk_modulus": 2e4}
    heavy = {"law": "fluid", "density": 1000.0, "bulk_modulus": 2e5}
    bodies = [block("gas", light, [0, 0], [0.8, 0.3]), block("water", heavy, [0, 0.3], [0.4, 0.6])]
    solver = start(scene(bodies, [16, 16], h, end=1.0, frames=50, gravity=GRAVITY))
    step, limit = solver.stable_step()
    done = run(solver)
    if done.stopped is not None:
        raise done.stopped
    rise = growth(done.energy) / done.energy[0]
    mass = done.rows[-1].mass / done.rows[0].mass - 1
    low = [frame.position[frame.body == 1, 1].min() for frame in done.frames]
    top = max(frame.position[frame.body == 0, 1].max() for frame in done.frames)
    return Outcome(
        done.sound and limit.body == "gas" and abs(mass) < 1e-12 and rise <= 1e-3,
        f"no NaN in {solver.step_count:,} steps; energy rises by {100 * rise:.2f} %",
        f"The water sinks from {low[0]:.2f} m to {min(low):.2f} m, and gas reaches {top:.2f} m. "
        f"The first step, {step:.2g} s, is that of the gas. J in [{done.ratios[0]:.2f}, {done.ratios[1]:.2f}], "
        f"max|v| {max(row.speed_max for row in done.rows):.1f} m/s.",
    )


def sag(ratio: float, **solver: object) -> tuple[float, float, bool]:
    """Return the largest fall of a cantilever's tip, m, its pressure's checkerboard, and whether all is finite.

    A beam of 1 x 0.2 m, clamped by a sticking wall, takes up its weight; half a swing. The checkerboard is the RMS
    difference of a particle's pressure from the mean of the four of its cell over the RMS pressure.
    """
    h, length, thick = 0.05, 1.0, 0.2
    rubber = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": ratio}
    body = block("beam", rubber, [0, 0.4], [length, 0.4 + thick])
    walls = {"default": "separate", "x_min": "stick"}
    plane = 1e5 / (1 - ratio**2)
    # Half a period of the first mode of a beam, w L^2 = 3.516 sqrt(E' I / (rho A)), and some more for shear.
    end = 1.2 * np.pi * length**2 / (3.516 * thick * np.sqrt(plane / 12 / 1000.0))
    asked = scene(
        [body], [26, 16], h, end=end, frames=60, gravity=0.1, walls=walls, fields=["velocity", "stress", "volume_ratio"]
    )
    asked = asked.model_copy(update={"solver": asked.solver.model_copy(update=solver)})
    sample = sample_bodies(asked)[0]
    done = run(start(asked))
    if done.stopped is not None:
        raise done.stopped
    tip = sample.position[:, 0] > length - h
    falls = [(sample.position[tip, 1] - frame.position[tip, 1]).mean() for frame in done.frames]
    stress = done.frames[int(np.argmax(falls))].fields["stress"].reshape(-1, 3, 3).astype(np.float64)
    pressure = -np.trace(stress, axis1=1, axis2=2) / 3
    cell = np.unique((sample.position / h + 1e-6).astype(int), axis=0, return_inverse=True)[1].ravel()
    mean = (np.bincount(cell, pressure) / np.bincount(cell))[cell]
    rough = np.sqrt(((pressure - mean) ** 2).mean() / (pressure**2).mean())
    return float(max(falls)), float(rough), done.sound


def locking() -> Outcome:
    """H10: the same cantilever at nu = 0.49 and at nu = 0.4999, whose steps are a tenth as long, hardly damped."""
    (soft, smooth, fine), (hard, rough, firm) = (sag(ratio, transfer="aflip", flip=0.95) for ratio in (0.49, 0.4999))
    damped, _, whole = sag(0.4999)
    off = hard / beam(0.4999) - 1
    return Outcome(
        fine and firm and whole and abs(off) < 0.03 and abs(soft / beam(0.49) - 1) < 0.03 and rough <= 0.15,
        f"tip {100 * off:+.1f} % off beam theory",
        f"It falls by {hard:.4f} m, and by {soft:.4f} m at 0.49; by beam theory by {beam(0.4999):.4f} and "
        f"{beam(0.49):.4f} m, twice the static sag. With APIC it falls by {damped:.4f} m: its own steps damp, and are "
        f"short. Pressure is off the mean of its cell by {rough:.2g} of it ({smooth:.2g} at 0.49).",
    )


def beam(ratio: float) -> float:
    """Return twice rho g A L^4 / (8 E' I), the sag of a slender cantilever under its weight, m."""
    return 2 * 12 * 1000.0 * 0.1 / (8 * 1e5 / (1 - ratio**2) * 0.2**2)


CASES = [
    HardCase("H4", "density ratio 1:1000",
        "water on the left half of a layer of a fluid of a thousandth of its density, 1 s",
        "no NaN; the step is that of the lighter; mass stays and energy rises by 1e-3 at most", True, density_ratio),
    HardCase("H10", "nu = 0.4999",
        "a clamped beam, 1 x 0.2 m on 20 x 4 cells, that takes up its weight, at nu = 0.49 and 0.4999, AFLIP 0.95",
        "the tip falls as far as by beam theory to 3 %; pressure varies in a cell by 15 % at most", True, locking),
]  # fmt: skip

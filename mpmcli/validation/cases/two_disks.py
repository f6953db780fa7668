"""Two elastic disks that meet head on, and what that conserves (Sulsky, Chen and Schreyer 1994; docs/theory.md, 10)."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, elastic

RADIUS, CENTRE, SPEED = 0.2, 0.3, 0.1
DENSITY, YOUNG, POISSON = 1000.0, 1000.0, 0.3
END, FRAMES = 3.5, 140
# Room around the disks, so that nothing but the other disk is ever near.
MARGIN = 0.2
SIZE = 1.0 + 2 * MARGIN
CLOSING = 2 * math.sqrt(2) * SPEED
# When circles of that radius touch, s.
CONTACT = (2 * math.sqrt(2) * CENTRE - 2 * RADIUS) / CLOSING
# The part of their speed of approach that disks have lost when contact counts as begun.
ONSET = 1e-3


class TwoDisks(Case):
    """Disks of radius 0.2 at (0.2, 0.2) and (0.8, 0.8), which fly at each other with 0.1 (1, 1) and -0.1 (1, 1)."""

    name = "two_disks"
    title = "Collision of two elastic disks"
    group = "invariants"
    source = "Sulsky, Chen and Schreyer 1994 (CMAME 118:179); what must be conserved is derived"
    resolution = "cells per unit of length"
    levels = {"coarse": (20, 40), "default": (20, 40, 80), "fine": (20, 40, 80, 160)}  # noqa: RUF012
    varies = ("precision", "kernel", "transfer", "per_axis")
    measures = (
        Measure(
            "early contact",
            "",
            "Time by which they lose a thousandth of their speed of approach too early, as a way over their radius.",
            bound=lambda n: 3 / n / RADIUS,
            order=0.8,
            expected=1.0,
        ),
        Measure("momentum", "", "Largest momentum of all over the sum of m |v|.", bound=lambda n: 1e-13),
        Measure(
            "angular momentum",
            "",
            "Largest angular momentum of all about their centre over the sum of m R |v|.",
            bound=lambda n: 1e-13,
        ),
        Measure("centre of mass", "", "Largest way of the centre of mass over the radius.", bound=lambda n: 5e-13),
        Measure(
            "energy gain",
            "",
            "Largest energy of any frame over that of the start, less 1; 0 where it never grows.",
            bound=lambda n: 1e-12,
        ),
        Measure(
            "energy loss", "", "Part of the energy that has gone by the end.", bound=lambda n: 4.6 / n, expected=1.0
        ),
        Measure("rebound", "", "Speed of separation over the speed of approach."),
    )
    note = (
        "Bodies act on each other through the nodes that they share, so they meet early: at a gap of 3 cells at most, "
        "for kernels that reach 1.5 cells. The speed of separation does not tend to that of the approach: part of the "
        "energy stays in vibrations of the disks."
    )

    def tables(self, n: int) -> dict[str, Any]:
        def disk(name: str, side: int) -> dict[str, Any]:
            return {
                "name": name,
                "material": elastic("neo_hookean", DENSITY, YOUNG, POISSON),
                "shape": {"ball": {"center": [side * CENTRE + 0.5] * 2, "radius": RADIUS}},
                "velocity": [-side * SPEED] * 2,
            }

        cells = round(SIZE * n)
        return {
            "domain": {"size": [SIZE] * 2, "origin": [-MARGIN] * 2, "cells": [cells] * 2},
            "time": {"end": END, "frames": FRAMES},
            "output": {"fields": ["velocity", "mass"]},
            "bodies": [disk("lower", -1), disk("upper", 1)],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        times, approach, energies = [], [], []
        linear = angular = way = 0.0
        for frame, row in frames:
            m = frame.fields["mass"].astype(np.float64)
            v, x = frame.velocity.astype(np.float64), frame.position.astype(np.float64)
            if frame.index == 0:
                momentum = float(m @ np.linalg.norm(v, axis=1))
                centre = m @ x / m.sum()
            lower = frame.body == 0
            difference = v[lower].mean(axis=0) - v[~lower].mean(axis=0)
            approach.append(float(difference.sum() / math.sqrt(2)))
            times.append(frame.time)
            P = np.array(row.linear_momentum)
            # From the origin of the domain to the centre of all.
            r = centre - np.array(scene.domain.origin)
            linear = max(linear, float(np.abs(P).max()) / momentum)
            about = row.angular_momentum[0] - (r[0] * P[1] - r[1] * P[0])
            angular = max(angular, abs(about) / (momentum * RADIUS))
            way = max(way, float(np.linalg.norm(m @ x / m.sum() - centre)) / RADIUS)
            energies.append(row.energy)
        return {
            "early contact": (CONTACT - _onset(times, approach)) * CLOSING / RADIUS,
            "momentum": linear,
            "angular momentum": angular,
            "centre of mass": way,
            "energy gain": max(energies) / energies[0] - 1,
            "energy loss": 1 - energies[-1] / energies[0],
            "rebound": -approach[-1] / approach[0],
        }


def _onset(times: list[float], approach: list[float]) -> float:
    """Return when the speed of approach has fallen by ONSET, s; infinity if it never does."""
    lost = 1 - np.array(approach) / approach[0]
    if not (lost > ONSET).any():
        return math.inf
    k = int(np.argmax(lost > ONSET))
    share = (ONSET - lost[k - 1]) / (lost[k] - lost[k - 1])
    return times[k - 1] + float(share) * (times[k] - times[k - 1])


class TotalDisks(TwoDisks):
    """The same on the grids of their states at rest, where particles of one push those of the other."""

    name = "two_disks_total"
    title = "Collision of two elastic disks, total Lagrangian"
    solids = "total"
    varies = ("precision", "per_axis")
    measures = (
        Measure(
            "early contact",
            "",
            TwoDisks.measures[0].text,
            bound=lambda n: 0.6 / n / RADIUS,
        ),
        TwoDisks.measures[1],
        Measure("angular momentum", "", TwoDisks.measures[2].text, bound=lambda n: 2e-4),
        *TwoDisks.measures[3:5],
        Measure("energy loss", "", TwoDisks.measures[5].text, bound=lambda n: 3.0 / n, expected=1.0),
        TwoDisks.measures[6],
    )
    note = (
        "Particles push each other from one and a half spacings on: three quarters of a cell, of which a quarter is a "
        "gap; the steps of a lattice along a circle add to it. Of angular momentum the bodies "
        "lose a part once rounding has broken the symmetry: 6e-6 at 40 cells, and 6e-5 at 80."
    )


CASES = (TwoDisks(), TotalDisks())

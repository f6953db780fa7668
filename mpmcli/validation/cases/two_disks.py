"""Head-on collision of two elastic disks: conservation (Sulsky, Chen and Schreyer 1994; docs/theory.md, 10)."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, Tables, case_text
from mpmcli.validation.shared import ball, body, elastic, field, problem

RADIUS, CENTRE, SPEED = 0.2, 0.3, 0.1
DENSITY, YOUNG, POISSON = 1000.0, 1000.0, 0.3
END, FRAMES = 3.5, 140
# Margin around the disks, so that they stay away from walls.
MARGIN = 0.2
SIZE = 1.0 + 2 * MARGIN
CLOSING = 2 * math.sqrt(2) * SPEED
# Time at which circles of that radius touch, s.
CONTACT = (2 * math.sqrt(2) * CENTRE - 2 * RADIUS) / CLOSING
# Relative loss of the speed of approach that marks the onset of contact.
ONSET = 1e-3


class TwoDisks(Case):
    """Disks of radius 0.2 at (0.2, 0.2) and (0.8, 0.8), with velocities 0.1 (1, 1) and -0.1 (1, 1)."""

    text = case_text("two_disks")
    name, title, group = "two_disks", "Collision of two elastic disks", "invariants"
    levels = {"coarse": (20, 40), "default": (20, 40, 80), "fine": (20, 40, 80, 160)}  # noqa: RUF012
    varies = ("precision", "kernel", "transfer", "per_axis")
    measures = (
        text.measure("early contact", lambda n: 3 / n / RADIUS, order=0.8, expected=1.0),
        text.measure("momentum", 1e-13),
        text.measure("angular momentum", 1e-13),
        text.measure("centre of mass", 5e-13),
        text.measure("energy gain", 1e-12),
        text.measure("energy loss", lambda n: 4.6 / n, expected=1.0),
        text.measure("rebound"),
    )

    def tables(self, n: int) -> Tables:
        material = elastic("neo_hookean", DENSITY, YOUNG, POISSON)
        disks = [
            body(name, material, ball([side * CENTRE + 0.5] * 2, RADIUS), velocity=[-side * SPEED] * 2)
            for name, side in (("lower", -1), ("upper", 1))
        ]
        domain = {"size": [SIZE] * 2, "origin": [-MARGIN] * 2, "cells": [round(SIZE * n)] * 2}
        return problem(domain, (END, FRAMES), "velocity mass", disks)

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return how early contact begins, changes of momenta, centre and energy, and the rebound of the disks."""
        times, approach, energies = [], [], []
        linear = angular = way = 0.0
        for frame, row in frames:
            m = field(frame, "mass")
            v, x = frame.velocity.astype(np.float64), frame.position.astype(np.float64)
            if frame.index == 0:
                momentum = float(m @ np.linalg.norm(v, axis=1))
                centre = m @ x / m.sum()
            lower = frame.body == 0
            difference = v[lower].mean(axis=0) - v[~lower].mean(axis=0)
            approach.append(float(difference.sum() / math.sqrt(2)))
            times.append(frame.time)
            P = np.array(row.linear_momentum)
            # From the origin of the domain to the centre of mass.
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
    """Return the time at which the speed of approach has fallen by ONSET, s; infinity if it never does."""
    lost = 1 - np.array(approach) / approach[0]
    if not (lost > ONSET).any():
        return math.inf
    k = int(np.argmax(lost > ONSET))
    share = (ONSET - lost[k - 1]) / (lost[k] - lost[k - 1])
    return times[k - 1] + float(share) * (times[k] - times[k - 1])


class TotalDisks(TwoDisks):
    """The same with total Lagrangian solids, where particles of one disk push those of the other."""

    text = case_text("two_disks_total")
    name, title = "two_disks_total", "Collision of two elastic disks, total Lagrangian"
    solids = "total"
    varies = ("precision", "per_axis")
    measures = (
        Measure(TwoDisks.measures[0].definition, lambda n: 0.6 / n / RADIUS),
        TwoDisks.measures[1],
        Measure(TwoDisks.measures[2].definition, 2e-4),
        *TwoDisks.measures[3:5],
        Measure(TwoDisks.measures[5].definition, lambda n: 3.0 / n, expected=1.0),
        TwoDisks.measures[6],
    )


class SeparateDisks(TwoDisks):
    """The same with a separate velocity field for each disk."""

    text = case_text("two_disks_contact")
    name, title = "two_disks_contact", "Collision of two elastic disks with velocity fields of their own"
    measures = (Measure(TwoDisks.measures[0].definition, lambda n: 0.15 / n / RADIUS), *TwoDisks.measures[1:])

    def tables(self, n: int) -> Tables:
        return super().tables(n) | {"contact": {"default": "separate"}}

"""One, two and four particles that are let go from deformed states, many runs in one batch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scenes import block, scene_of

from mpmcli.check.facts import SceneFacts
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import Run, frames_of_all
from mpmcli.solver.machine.backend import Backend

H, FRAMES = 0.1, 20


@dataclass(frozen=True)
class Outcome:
    """What came of one start: energy about the mean motion over that of the start, the rows, and why it stopped."""

    growth: float
    rows: tuple[LedgerRow, ...]
    stopped: str


def start_of(count: int, k: int, sizes: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return F, (2, 2), the places in cells, (count, 2), and a direction, (2,), of the k-th start.

    Swollen, pressed, stretched along the axes, and any; by about each of the sizes in turn.
    """
    random, size = np.random.default_rng([count, k]), sizes[(k // 4) % len(sizes)]
    F = [
        (1 - size * random.uniform(0.5, 1)) * np.eye(2),
        (1 + size * random.uniform(0.5, 1)) * np.eye(2),
        np.diag(1 + size * random.uniform(-1, 1, 2)),
        np.eye(2) + 0.7 * size * random.uniform(-1, 1, (2, 2)),
    ][k % 4]
    places = random.uniform(8, 9, 2) + (random.uniform(-0.5, 0.5, (count, 2)) if count > 1 else np.zeros((1, 2)))
    return F, places, random.uniform(-1, 1, 2)


def let_go(
    material: Mapping[str, object], count: int, backend: Backend, *, starts: int, steps: int, sizes: Sequence[float]
) -> list[Outcome]:
    """Run `starts` starts of `count` particles for about `steps` default steps, moving by up to three cells."""
    asked = [_asked(material, *start_of(count, k, sizes), steps) for k in range(starts)]
    batch = Batch(Resolved(*asked[0]).kind, backend, starts)
    runs = {k: Run(batch, k, scene, particles) for k, (scene, particles) in enumerate(asked)}
    rows: list[list[LedgerRow]] = [[] for _ in asked]
    stopped = [""] * starts
    for k, event in frames_of_all(runs):
        if isinstance(event, tuple):
            rows[k].append(event[1])
        elif event is not None:
            stopped[k] = str(event)
    return [Outcome(_growth(own), tuple(own), why) for own, why in zip(rows, stopped, strict=True)]


def _asked(
    material: Mapping[str, object], F: np.ndarray, places: np.ndarray, heading: np.ndarray, steps: int
) -> tuple[Scene, list[BodyParticles]]:
    count, keeps_J = len(places), material["law"] == "fluid"
    J, volume = float(np.linalg.det(F)), H * H / 4
    more = {"particles_per_cell": 1, "deformation": J if keeps_J else F.tolist()}
    body = block("body", dict(material), [0.8, 0.8], [0.8 + H * max(count, 1), 0.9], **more)
    domain = {"size": [1.7, 1.7], "cells": [17, 17]}
    scene = scene_of(body, domain=domain, frames=FRAMES)
    end = steps * SceneFacts(scene).step_at_start
    scene = scene.model_copy(update={"time": scene.time.model_copy(update={"end": end})})
    deformation = np.full(count, J) if keeps_J else np.tile(F, (count, 1, 1))
    velocity = np.tile(heading * 3 * H / end, (count, 1))
    mass = volume * float(material["density"])
    return scene, [BodyParticles("body", places * H, velocity, np.zeros((count, 2, 2)), volume, mass, deformation)]


def _growth(rows: Sequence[LedgerRow]) -> float:
    """Return the largest energy about the mean motion over that of the start; 0 where the start holds none."""
    energy = [r.kinetic + r.elastic - float(np.square(r.linear_momentum).sum()) / 2 / r.mass for r in rows]
    return max(energy) / energy[0] if energy[0] > 1e-12 * rows[0].kinetic else 0.0

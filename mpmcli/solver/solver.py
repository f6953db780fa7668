"""Runs a scene: device state, time steps, and a frame for each output time."""

import math
import time
from collections.abc import Iterator

import numpy as np
import taichi as ti

from mpmcli.boundaries.walls import Walls
from mpmcli.materials.law import StateBound
from mpmcli.materials.registry import laws
from mpmcli.output.frame import Frame
from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.backend import Backend
from mpmcli.solver.diagnosis import UnstableRunError, diagnose
from mpmcli.solver.grid import DRIFT, PAD, TILE, Grid
from mpmcli.solver.ordering import SortBuffers, TileOrder, build_sort
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.snapshot import build_frame, measure, read_group
from mpmcli.solver.step import (
    GRADIENT,
    J_MAX,
    J_MIN,
    NOT_LOST,
    REPORT,
    SPEED_SQUARED,
    STRETCH_SQUARED,
    build_step,
)
from mpmcli.stability.ledger import LedgerRow
from mpmcli.stability.limits import Limit, deformation_limit, speed_limit, wave_limit

# On a GPU the state is measured once in so many steps at most: reading it back stalls the device.
MOST_UNWATCHED_STEPS = 16


class Solver:
    """A scene on a device.

    Attributes:
        scene: what is computed.
        time: s, in double precision; step_count: steps taken.
        particle_count: number of particles.
        laws: names of the laws, in the order of `Frame.material`.
        first_step_seconds: wall time of the first step, which compiles the kernels; 0 before it.
    """

    def __init__(self, scene: Scene, backend: Backend, particles: list[BodyParticles] | None = None) -> None:
        """Allocate and fill the device; `particles`, one entry per body, replaces the scene's own sampling."""
        self.scene = scene
        self.backend = backend
        self.time = 0.0
        self.step_count = 0
        self.first_step_seconds = 0.0
        self.spacing = scene.domain.spacing
        self._gravity = np.array(scene.domain.gravity)
        self._origin = np.array(scene.domain.origin)
        self._names = tuple(body.name for body in scene.bodies)

        particles = particles or sample_bodies(scene)
        self.particle_count = sum(len(b.position) for b in particles)
        first_ids = np.concatenate([[0], np.cumsum([len(b.position) for b in particles])])
        self.laws = tuple(sorted({body.material.law for body in scene.bodies}))
        layout = ti.Layout.AOS if backend.on_cpu else ti.Layout.SOA
        self.groups = []
        for name in self.laws:
            members = [i for i, body in enumerate(scene.bodies) if body.material.law == name]
            self.groups.append(
                ParticleGroup(
                    laws()[name](),
                    members,
                    [scene.bodies[i].material for i in members],
                    [particles[i] for i in members],
                    [int(first_ids[i]) for i in members],
                    self._origin,
                    layout,
                )
            )
        self.grid = Grid(scene.dimension, self.spacing, scene.domain.cells)
        walls = Walls(scene.domain.walls.faces(scene.dimension), PAD, self.grid.cells, self.grid.shape)
        buffers = SortBuffers(self.groups)
        orders = [TileOrder(g, self.grid, buffers, backend.threads, backend.on_cpu) for g in self.groups]
        self._sorts = [build_sort(order) for order in orders]
        # Without atomics a particle may drift only as far as its tile's colour allows.
        self._drift_allowed = DRIFT if backend.on_cpu else float(TILE)
        self._kernels = build_step(
            self.grid,
            walls,
            self.groups,
            orders,
            self._gravity.tolist(),
            on_cpu=backend.on_cpu,
            drift=int(self._drift_allowed),
        )
        self._drift = math.inf
        self._unwatched = 0
        self._report = self._kernels.measure()
        self._limit = min(self.limits())

    def limits(self) -> list[Limit]:
        """Return every bound on the next step, from the state as last measured."""
        bounds = []
        speed_squared = 0.0
        for g, group in enumerate(self.groups):
            report = self._report[REPORT * g : REPORT * (g + 1)]
            stretch = report[STRETCH_SQUARED] if group.law.deformation == "F" else report[J_MAX] ** 2
            reached = StateBound(report[J_MIN], report[J_MAX], stretch)
            for place, parameters in zip(group.bodies, group.parameters, strict=True):
                stiffness = group.law.stiffness(parameters, reached, self.scene.dimension)
                bound = wave_limit(self.spacing, parameters.density, stiffness)
                bounds.append(Limit(bound, "wave", self._names[place]))
            bounds.append(Limit(deformation_limit(report[GRADIENT]), "deformation", ""))
            speed_squared = max(speed_squared, report[SPEED_SQUARED])
        self._speed = math.sqrt(speed_squared)
        bounds.append(Limit(speed_limit(self.spacing, self._speed), "speed", ""))
        return bounds

    def stable_step(self) -> tuple[float, Limit]:
        """Return the step to take, safety included, and the bound that sets it."""
        step = self.scene.time.safety * self._limit.value
        maximum = self.scene.time.step
        if maximum != "auto" and maximum < step:
            return maximum, Limit(maximum, "maximum", "")
        return step, self._limit

    def step(self, dt: float) -> None:
        """Advance by dt (s).

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """
        began = time.perf_counter()
        if self._drift >= self._drift_allowed:
            for sort in self._sorts:
                sort()
            self._kernels.find_box()
            self._drift = 0.0
        result = self._kernels.step(dt)
        self.time += dt
        self.step_count += 1
        if self.step_count == 1:
            self.first_step_seconds = time.perf_counter() - began
        if self.backend.on_cpu:
            self._watch(result, dt)
            self._drift += dt * self._speed / self.spacing
            return
        # Speeds may grow unseen; half the allowance per doubling keeps the stencils inside the box.
        courant = 2 * dt * self._speed / self.spacing + 0.05
        self._drift += courant
        self._unwatched += 1
        if self._unwatched >= MOST_UNWATCHED_STEPS or self._drift + courant >= self._drift_allowed:
            self.watch(dt)

    def watch(self, dt: float) -> None:
        """Measure the device's state and stop if it is lost."""
        self._unwatched = 0
        self._watch(self._kernels.measure(), dt)

    def _watch(self, report: ti.Matrix, dt: float) -> None:
        self._report = report
        lost = report[REPORT * len(self.groups)] > 0
        if lost or not math.isfinite(sum(report)):
            self._stop(dt)
        self._limit = min(self.limits())

    def _stop(self, dt: float) -> None:
        for group, p in zip(self.groups, self._kernels.lost.to_numpy(), strict=True):
            if p != NOT_LOST:
                snapshot = read_group(group)
                raise UnstableRunError(
                    diagnose(
                        snapshot,
                        int(p),
                        self._names,
                        self._origin,
                        self.step_count,
                        self.time,
                        dt,
                        self._limit,
                    )
                )
        raise AssertionError("a step reported a lost particle and kept no trace of it")

    def frames(self) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the initial state and then one frame for each output time, with its ledger row.

        The time left to the next frame is split into equal steps, so that frames land on their times.

        Raises:
            UnstableRunError: see `step`.
        """
        count = self.scene.time.frames
        yield self.frame(0, [])
        for index in range(1, count + 1):
            target = self.scene.time.end * index / count
            taken: list[tuple[float, float, str]] = []
            while True:
                largest, limit = self.stable_step()
                left = target - self.time
                splits = max(1, math.ceil(left / largest - 1e-6))
                dt = left / splits
                self.step(dt)
                taken.append((dt, self._speed * dt / self.spacing, limit.name))
                if splits == 1:
                    break
            self.time = target
            if not self.backend.on_cpu:
                self.watch(dt)
            yield self.frame(index, taken)

    def frame(self, index: int, taken: list[tuple[float, float, str]]) -> tuple[Frame, LedgerRow]:
        """Return the state as a frame, and the ledger row for the steps (size, Courant number, limit) taken."""
        snapshots = [read_group(group) for group in self.groups]
        frame = build_frame(snapshots, self.scene.output.fields, self._origin, index, self.time, self.step_count)
        sums = measure(snapshots, self._gravity, self.spacing)
        smallest = min(taken, default=(0.0, 0.0, ""))
        row = LedgerRow(
            time=self.time,
            steps=len(taken),
            step_min=smallest[0],
            step_max=max(taken, default=(0.0,))[0],
            limit=smallest[2],
            courant_max=max((courant for _, courant, _ in taken), default=0.0),
            **vars(sums),
        )
        return frame, row

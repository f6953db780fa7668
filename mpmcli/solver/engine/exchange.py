"""What the host of a run and the kernels of its batch tell each other between launches, see `run_numbers`."""

import math
from collections.abc import Sequence

import numpy as np

from mpmcli.scene import Scene
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.emission import begin_emission
from mpmcli.solver.engine.run_numbers import HELD, LIMITS, Layout, Row
from mpmcli.solver.engine.saved_state import Progress
from mpmcli.solver.engine.step_control import HeldBound, StepControl, StepCounters
from mpmcli.stability.limits import force_limit

# Particle-steps of the first launch, wall time of the others, s, and the growth from one to the next. The bytes of a
# run depend on none of them.
FIRST, LAUNCH, GROWTH = 1_000_000, 0.4, 4


class LaunchBudget:
    """How many `steps` a run may take in the next launch: its host may stop it within some tenths of a second."""

    def __init__(self, particles: int) -> None:
        self.steps = max(1, FIRST // particles)

    def took(self, steps: int, seconds: float) -> None:
        """Take note of the last launch: its steps, and its wall time, s."""
        if steps > 0 and seconds > 0:
            self.steps = max(1, min(GROWTH * self.steps, int(LAUNCH * steps / seconds)))


# Numbers of `Progress` that the kernel changes.
FOLLOWED = ("time", "last_step", "unrelaxed", "speed", "courant", "drift", "owed")


def write_constants(batch: Batch, slot: int, scene: Scene, counts: Sequence[int]) -> None:
    """Store what does not change during a run: domain, walls, colliders, emitters and bounds on the step.

    slot: place of the run; counts: particles of each source.
    """
    h, device = scene.domain.spacing, batch.device
    walls, colliders = (device.friction, device.moving, device.grid.period), (device.colliders, device.motion)
    for data in (*walls, *colliders, device.rigid, device.rigid_contact, device.contact):
        if data is not None:
            data.write(scene, slot)
    numbers, row_counts, real, count = batch.numbers[slot], batch.counts[slot], batch.layout.real, batch.layout.count
    gravity = scene.domain.gravity_at(0.0)
    for a, n in enumerate(scene.domain.cells):
        numbers[real.gravity[a]] = gravity[a]
        numbers[real.extent[a]] = n * h
        row_counts[count.cells[a]] = n
    Row(batch.layout, numbers, row_counts).set(
        spacing=h,
        inverse_spacing=1 / h,
        gradient_scale=device.grid.scheme.spline.inverse_moment / h,
        safety=scene.time.safety,
        maximum=math.inf if scene.time.step == "auto" else scene.time.step,
        end=scene.time.end,
        force=math.inf,
        wall_speed=scene.domain.wall_speed,
    )
    begin_emission(batch, slot, scene, counts)


class Exchange:
    """The numbers and counts of one run, see `run_numbers`."""

    def __init__(self, layout: Layout, numbers: np.ndarray, counts: np.ndarray) -> None:
        self._numbers, self._counts = numbers, counts
        self._real, self._count = layout.real, layout.count
        self._row = Row(layout, numbers, counts)
        self._followed = [getattr(layout.real, name) for name in FOLLOWED]

    def pull(self, state: Progress) -> None:
        """Take what the kernel has changed."""
        for name, value in zip(FOLLOWED, self._numbers[self._followed].tolist(), strict=True):
            setattr(state, name, value)
        state.unrelaxed_steps = self._row.count("unrelaxed_steps")
        state.step_count += self._row.count("steps")

    def push(self, state: Progress) -> None:
        """Write what the host has changed."""
        self._numbers[self._followed] = [getattr(state, name) for name in FOLLOWED]
        self._row.set_counts(unrelaxed_steps=state.unrelaxed_steps)
        forces = state.external_forces
        self._row.set(pull=forces.steady_pull)
        if forces.pushes:
            self._row.set(force=force_limit(forces.slope))
        counters = state.step_control.counters()
        self._row.set(stiffness=counters.stiffness_limit.value, **dict(zip(HELD, counters.held, strict=True)))
        self._row.set_counts(stiffness_limit=LIMITS.index(counters.stiffness_limit.name))
        for g in range(len(counters.rates)):
            self._numbers[self._real.rate[g]] = counters.rates[g]
            self._numbers[self._real.change[g]] = counters.change[g]
            self._numbers[self._real.hardened[g]] = counters.hardened[g]
            self._counts[self._count.unwatched[g]] = counters.unwatched[g]
        for first, own in zip(self._real.own, state.step_control.own_limits(), strict=True):
            self._numbers[first : first + len(own)] = own

    def counters(self, control: StepControl) -> StepCounters:
        """Return the counters of a run as the kernel has advanced them."""

        def numbers(columns: tuple[int, ...]) -> tuple[float, ...]:
            return tuple(self._numbers[list(columns)].tolist())

        return StepCounters(
            control.counters().stiffness_limit,
            HeldBound(*(self._row.number(name) for name in HELD)),
            numbers(self._real.rate),
            tuple(self._counts[list(self._count.unwatched)].tolist()),
            numbers(self._real.change),
            numbers(self._real.hardened),
        )

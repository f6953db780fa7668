"""One run of a batch: fills its place on the device, and attends to it between launches."""

import math
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.batch import Batch
from mpmcli.solver.batch_group import BatchGroup
from mpmcli.solver.batch_layout import ATTEND, BEYOND, COLLAPSED, GOING, HELD, IDLE, LIMITS, LOST, MEASURE, Row
from mpmcli.solver.batch_values import Drives
from mpmcli.solver.external_forces import ExternalForces
from mpmcli.solver.groups import require_inside
from mpmcli.solver.held_bound import HeldBound
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.particles import initial_state, table_of
from mpmcli.solver.plan import members_of
from mpmcli.solver.run import COLLAPSE, Run
from mpmcli.solver.run_values import RunValues
from mpmcli.solver.state import Progress
from mpmcli.solver.state_bounds import Measurement, entries, state_bounds_of
from mpmcli.solver.step_control import StepControl, StepCounters
from mpmcli.stability.limits import force_limit

# Numbers of `Progress` that the kernel changes.
FOLLOWED = ("time", "last_step", "unrelaxed", "speed", "courant", "drift", "owed")
# Particle-steps of a run in one launch: some tenths of a second, after which the host may stop the run.
BUDGET = 2_000_000


class BatchRun(Run):
    """A scene in one place of a batch."""

    def __init__(
        self,
        batch: Batch,
        slot: int,
        scene: Scene,
        particles: list[BodyParticles] | None = None,
        *,
        force: bool = False,
    ) -> None:
        """Fill the place.

        Args:
            slot: number of the place, whose last run has ended.
            particles: one entry per body, in place of the scene's own sampling.
            force: take time.step as it is, above the stable step too.

        Raises:
            InputError: a particle is not in the domain.
        """
        super().__init__(scene, batch.backend, particles, force=force)
        require_inside(scene, self._particles)
        self.batch, self.slot = batch, slot
        self._readers, self._observations = batch.readers, batch.observations
        self._begun = False
        self._numbers, self._counts = batch.numbers[slot], batch.counts[slot]
        self._real, self._count = batch.layout.real, batch.layout.count
        self._row = Row(batch.layout, self._numbers, self._counts)
        self._followed = [getattr(self._real, name) for name in FOLLOWED]
        first_ids = np.concatenate([[0], np.cumsum([len(b.position) for b in self._particles])])
        self.groups = []
        for g, shared in enumerate(batch.kind.members):
            bodies = members_of(scene, shared.name)
            own = [self._particles[i] for i in bodies]
            law = type(shared)([scene.bodies[i].material for i in bodies], scene.dimension)
            count = sum(len(b.position) for b in own)
            group = BatchGroup(batch, g, slot, law, bodies, table_of(law, own), count)
            group.write(*initial_state(law, own, [int(first_ids[i]) for i in bodies], self._origin))
            self.groups.append(group)
            self._counts[self._count.particles[g]] = count
            lost = batch.device.particles.lost
            if lost[slot * len(batch.kind.members) + g] != NOT_LOST:
                lost[slot * len(batch.kind.members) + g] = NOT_LOST
        entries = Drives.of(scene, [group.bodies for group in self.groups])[1]
        self._values = RunValues(batch.values.device, slot, entries, scene.time.end)
        self._tables, self._means = batch.values.tables, list(self._values.means.values())
        self._filled_since = -math.inf
        self._set_constants()
        self._row.set_counts(status=MEASURE)

    @property
    def step_count(self) -> int:
        """Steps taken."""
        return self.state.step_count if self._begun else 0

    @property
    def measure_seconds(self) -> float:
        """Wall time spent so far on measuring the state for the limits."""
        return self.state.step_control.seconds if self._begun else 0.0

    def _set_constants(self) -> None:
        """Store what does not change during the run."""
        scene, h = self.scene, self.spacing
        gravity = scene.domain.gravity_at(0.0)
        for a, n in enumerate(scene.domain.cells):
            self._numbers[self._real.gravity[a]] = gravity[a]
            self._numbers[self._real.extent[a]] = n * h
            self._counts[self._count.cells[a]] = n
        maximum = math.inf if scene.time.step == "auto" else scene.time.step
        self._row.set(
            spacing=h,
            inverse_spacing=1 / h,
            gradient_scale=self.batch.device.grid.scheme.spline.inverse_moment / h,
            safety=scene.time.safety,
            maximum=maximum,
            end=scene.time.end,
            horizon=-math.inf if self._means else math.inf,
            force=math.inf,
        )
        self._row.set_counts(forced=self._forced)

    def _measurement(self, g: int) -> Measurement:
        first = self._real.maxima[g]
        group = self.groups[g]
        columns = slice(first, first + entries(group))
        # Internal variables by themselves are measured on a GPU only.
        return Measurement(lambda: state_bounds_of(group, self._numbers[columns].tolist()), dict)

    def events(self) -> Iterator[tuple[Frame, LedgerRow] | None]:
        """Yield a frame and its ledger row for each output time, as `Solver.frames`; None where the batch must launch.

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """
        yield None
        self._start()
        yield self.frame(0, [])
        count = self.scene.time.frames
        for index in range(1, count + 1):
            target = self.scene.time.end * index / count
            if target <= self.time:
                continue
            before = self.step_count
            yield from self._reach(target)
            yield self.frame(index, self._taken(before))

    def begin(self) -> None:
        """Take the bounds of time 0, where this is the only run of its batch; a second call does nothing."""
        if not self._begun:
            self.batch.launch()
            self._start()

    def advance(self, count: int) -> tuple[int, float]:
        """Take `count` steps as large as the next one, fewer or more where it changes; see `Engine.advance`."""
        self.begin()
        self._push()
        before = self.step_count
        step = min(self.stable_step()[0], self.scene.time.end / self.scene.time.frames)
        for _ in self._reach(self.time + count * step):
            self.batch.launch()
        return self.step_count - before, self._row.number("smallest")

    def wait(self) -> None:
        """Wait until the device has taken every step; each launch waits."""

    def _start(self) -> None:
        """Take the bounds of time 0 from the measurement of the first launch."""
        self.first_step_seconds = self.batch.first_seconds
        control = StepControl(
            self.scene, self.groups, [self._measurement(g) for g in range(len(self.groups))], on_cpu=True
        )
        measures = [
            partial(push, group.first, group.count, self.slot)
            for push, group in zip(self.batch.pushes, self.groups, strict=True)
            if push is not None
        ]
        self.state = Progress(control, ExternalForces(self.scene, self._values, measures))
        self._begun = True
        self._begin()
        self._row.set(
            growth_allowed=control.growth_allowed,
            collapse=COLLAPSE * self.state.first_stable_step,
        )
        self._row.set_counts(longest=control.longest)
        for g, group in enumerate(self.groups):
            self._numbers[self._real.sensitivity[g]] = group.law.sensitivity
            self._numbers[self._real.hardening[g]] = group.law.hardening
        self._push()

    def _reach(self, target: float) -> Iterator[None]:
        """Let the batch launch until the run has reached a time, s."""
        self._row.set(target=target, smallest=math.inf, largest=0.0, largest_courant=0.0)
        self._row.set_counts(arrived=0, limit=0)
        arrived = False
        while not arrived:
            self._row.set_counts(status=GOING, budget=max(1, BUDGET // self.particle_count), steps=0)
            yield None
            self._pull()
            arrived = self._row.count("arrived") == 1
            status = self._row.count("status")
            if status == LOST:
                self._row.set_counts(status=IDLE)
                self._stop(self.last_step, self._lost())
            if status == COLLAPSED:
                self._row.set_counts(status=IDLE)
                self._stop_collapsed(self.stable_step()[0])
            if status == BEYOND:
                self._fill_tables()
            if status == ATTEND:
                due = self.state.step_control.take_counters(self._counters())
                # At a frame all are measured.
                if due and not arrived:
                    self._measure(due)
                self._push()
        self.state.time = target
        self._measure(range(len(self.groups)))
        self._push()

    def _measure(self, due: range | list[int]) -> None:
        """Take the measurement of some groups that the kernel has made after the last step."""
        if not self.state.step_control.measure(due):
            self._stop(self.last_step, self._lost())
        forces = self.state.external_forces
        forces.measure(self.time, self.state.step_control.longest * self.last_step)
        if self.state.step_control.fresh:
            self.state.speed = self.state.step_control.speed

    def _fill_tables(self) -> None:
        """Let the kernel go on from the time that velocities have."""
        since = self.state.velocity_time
        # The same time again: the next kick takes more windows than found room.
        self._row.set(horizon=self._tables.fill(self.slot, self._means, since, coarse=since == self._filled_since))
        self._filled_since = since

    def _lost(self) -> list[int | None]:
        """Return a lost particle of each group, in solver order, None where none is known."""
        count = len(self.groups)
        found = self.batch.device.particles.lost.to_numpy()[self.slot * count :][:count]
        return [None if p == NOT_LOST else int(p) - group.first for p, group in zip(found, self.groups, strict=True)]

    def _counters(self) -> StepCounters:
        def numbers(columns: tuple[int, ...]) -> tuple[float, ...]:
            return tuple(self._numbers[list(columns)].tolist())

        return StepCounters(
            self.state.step_control.counters().stiffness_limit,
            HeldBound(*(self._row.number(name) for name in HELD)),
            numbers(self._real.rate),
            tuple(self._counts[list(self._count.unwatched)].tolist()),
            numbers(self._real.change),
            numbers(self._real.hardened),
        )

    def _pull(self) -> None:
        """Read what the kernel has changed."""
        for name, value in zip(FOLLOWED, self._numbers[self._followed].tolist(), strict=True):
            setattr(self.state, name, value)
        self.state.unrelaxed_steps = self._row.count("unrelaxed_steps")
        self.state.step_count += self._row.count("steps")

    def _push(self) -> None:
        """Write what the host has changed."""
        self._numbers[self._followed] = [getattr(self.state, name) for name in FOLLOWED]
        self._row.set_counts(unrelaxed_steps=self.state.unrelaxed_steps)
        forces = self.state.external_forces
        self._row.set(pull=forces.steady_pull)
        if forces.pushes:
            self._row.set(force=force_limit(forces.slope))
        counters = self.state.step_control.counters()
        self._row.set(stiffness=counters.stiffness_limit.value, **dict(zip(HELD, counters.held, strict=True)))
        self._row.set_counts(stiffness_limit=LIMITS.index(counters.stiffness_limit.name))
        for g in range(len(self.groups)):
            self._numbers[self._real.rate[g]] = counters.rates[g]
            self._numbers[self._real.change[g]] = counters.change[g]
            self._numbers[self._real.hardened[g]] = counters.hardened[g]
            self._counts[self._count.unwatched[g]] = counters.unwatched[g]

    def _taken(self, before: int) -> list[tuple[float, float, str]]:
        """Return the steps since the step `before` as `ledger_row` counts them: the smallest one, and the largest."""
        smallest = self._row.number("smallest"), self._row.number("smallest_courant"), LIMITS[self._row.count("limit")]
        steps = self.step_count - before
        return [smallest] + [(self._row.number("largest"), self._row.number("largest_courant"), "")] * (steps - 1)

    def frames(self, stop: Callable[[], bool] = lambda: False) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield as `Solver.frames`, where this is the only run of its batch.

        Raises:
            UnstableRunError: see `events`.
            KeyboardInterrupt: `stop`, called after each launch, returned True.
        """
        for event in self.events():
            if event is not None:
                yield event
                continue
            self.batch.launch()
            # Frame 0 is always there.
            if self.step_count and stop():
                raise KeyboardInterrupt

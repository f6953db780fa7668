"""What the host of a run and the kernel of its batch tell each other between launches."""

import numpy as np

from mpmcli.solver.batch_layout import HELD, LIMITS, Layout, Row
from mpmcli.solver.held_bound import HeldBound
from mpmcli.solver.state import Progress
from mpmcli.solver.step_control import StepControl, StepCounters
from mpmcli.stability.limits import force_limit

# Numbers of `Progress` that the kernel changes.
FOLLOWED = ("time", "last_step", "unrelaxed", "speed", "courant", "drift", "owed")


class Exchange:
    """The numbers and counts of one run, see `batch_layout`."""

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

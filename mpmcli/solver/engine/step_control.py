"""Follows the state of a run for its time step: when to measure, and the bounds that follow (docs/theory.md, 6.7)."""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import NamedTuple

from mpmcli.materials.law import StateBound
from mpmcli.scene import Scene
from mpmcli.solver.particles.state_bounds import StateBounds
from mpmcli.solver.transfer.particle_update import SMALLEST_J
from mpmcli.stability.limits import Limit, deformation_limit, mode_limit, speed_limit
from mpmcli.stability.transfer_factors import step_inertia

# A bound falls at once, and rises only to the smallest of the last HOLD to 2 HOLD steps, and only where that is RISE
# times what it was: a step that follows the oscillation of a particle, always smaller in the same phase of it, drives
# that oscillation. Lone particles of the neo-Hookean law let go at strains of 5 to 40 % gained up to 27 times their
# energy in 10,000 steps where the bound rose by a thousandth per step, and up to 4 times here.
HOLD, RISE = 128, 1.05


class HeldBound(NamedTuple):
    """The smallest bound of the last HOLD to 2 HOLD steps, as `StepSize.hold` keeps it.

    value: that bound, s; low, low_before: the smallest of this series of HOLD steps, and of the one before it, s.
    steps: number of steps in this series.
    """

    value: float = math.inf
    low: float = math.inf
    low_before: float = math.inf
    steps: float = 0.0


# Most steps between two measurements of the state, and with it of forces. A measurement is due earlier where a
# stiffness may have grown since by more than this share of the margin that time.safety leaves; one that has fallen is
# noticed late. The share is near 1 as every step reads the rate of deformation back.
MOST_UNWATCHED_STEPS, MOST_PUSHED_STEPS, UNWATCHED_SHARE = 256, 64, 0.95


class StepCounters(NamedTuple):
    """What decides on the steps between two measurements.

    Attributes:
        stiffness_limit: the smallest bound by the stiffness of the laws; held: the bound that rises late.
        rates: per group, the largest rate of deformation in the last step, 1/s.
        unwatched: per group, the steps since its last measurement.
        change, hardened: per group, the growth of the logarithm of its stiffness since then, by deformation and by
            hardening.
    """

    stiffness_limit: Limit
    held: HeldBound
    rates: tuple[float, ...]
    unwatched: tuple[int, ...]
    change: tuple[float, ...]
    hardened: tuple[float, ...]


class StepControl:
    """The last measurement of each group of particles, and the bounds on the step that follow from it.

    Attributes:
        seconds: wall time spent so far on measuring.
        longest: most steps between two measurements.
        growth_allowed: growth of the logarithm of a stiffness at which it is measured.
    """

    def __init__(self, scene: Scene, groups: Sequence, measurements: Sequence[Callable[[], StateBounds]]) -> None:
        """Take the first measurement of each group, see `RunGroup`; `measurements` return the last one."""
        self._groups = groups
        self._names = tuple(body.name for body in scene.sources)
        self._spacing = scene.domain.spacing
        self._inertia = step_inertia(scene.solver)
        self._measure = measurements
        self._bounds = [measure() for measure in self._measure]
        # Per group: its rate of deformation after the last step as far as known, and since its last measurement steps
        # and growth of the logarithm of its stiffness: by deformation, and by hardening, which is measured by itself.
        self._rates = [bounds.deformation_rate for bounds in self._bounds]
        self._unwatched = [0] * len(groups)
        self._change = [0.0] * len(groups)
        self._hardened = [0.0] * len(groups)
        self.longest = MOST_PUSHED_STEPS if scene.pushes else MOST_UNWATCHED_STEPS
        # A step of safety times the limit is stable until the stiffness has grown to safety^-2 of what it was.
        self.growth_allowed = -2 * UNWATCHED_SHARE * math.log(scene.time.safety)
        self.seconds = 0.0
        # Per group, whether it has not been measured since the start.
        self._at_start = [True] * len(groups)
        self._limits = [self._limits_of(g, bounds) for g, bounds in enumerate(self._bounds)]
        self._held = HeldBound()
        self._take_limits()

    def begin(self) -> None:
        """Let the first step of a run be as large as the bounds allow."""
        self._held = HeldBound()

    def save(self) -> dict[str, object]:
        """Return what was measured and counted of each group, as plain numbers, lists and dictionaries."""
        return {
            "bounds": [asdict(bounds) for bounds in self._bounds],
            "rates": list(self._rates),
            "unwatched": list(self._unwatched),
            "change": list(self._change),
            "hardened": list(self._hardened),
            "held": list(self._held),
            "at_start": list(self._at_start),
        }

    def load(self, saved: dict) -> None:
        """Take what `save` returned."""
        self._at_start = list(saved["at_start"])
        for g, bounds in enumerate(saved["bounds"]):
            internal = {name: tuple(pair) for name, pair in bounds["bound"]["internal"].items()}
            bound = StateBound(**bounds["bound"] | {"internal": internal})
            self._bounds[g] = StateBounds(**bounds | {"bound": bound})
            self._limits[g] = self._limits_of(g, self._bounds[g])
        self._rates, self._unwatched = list(saved["rates"]), list(saved["unwatched"])
        self._change, self._hardened = list(saved["change"]), list(saved["hardened"])
        self._held = HeldBound(*saved["held"])
        self._take_limits()

    @property
    def speed(self) -> float:
        """Largest speed as last measured, m/s."""
        return max(bounds.speed for bounds in self._bounds)

    @property
    def fresh(self) -> bool:
        """Whether every group was measured after the last step."""
        return max(self._unwatched) == 0

    def limits(self) -> list[Limit]:
        """Return every bound as last measured."""
        return [limit for limits in self._limits for limit in limits] + [self._deformation_limit]

    def own_limits(self) -> list[list[float]]:
        """Return the step that each body of each group allows by its stiffness, and by the speed of its group, s."""
        return [
            [
                min(
                    speed_limit(self._spacing, bounds.speed, 0.0),
                    *(limit.value for limit in limits if limit.body == self._names[place]),
                )
                for place in group.bodies
            ]
            for group, bounds, limits in zip(self._groups, self._bounds, self._limits, strict=True)
        ]

    def limits_now(self) -> list[Limit]:
        """Return every bound by the state as it is, without storing it."""
        states = [measure() for measure in self._measure]
        limits = [limit for g, bounds in enumerate(states) for limit in self._limits_of(g, bounds)]
        return [*limits, _deformation_limit(bounds.deformation_rate for bounds in states)]

    @property
    def nearest(self) -> Limit:
        """The smallest bound on the next step."""
        limit = min(self._stiffness_limit, self._deformation_limit)
        return limit._replace(value=min(limit.value, self._held.value))

    def counters(self) -> StepCounters:
        """Return what decides on the next steps until the next measurement."""
        return StepCounters(
            self._stiffness_limit,
            self._held,
            *map(tuple, (self._rates, self._unwatched, self._change, self._hardened)),
        )

    def take_counters(self, counters: StepCounters) -> list[int]:
        """Continue from counters that a kernel has advanced by some steps; return the groups to measure now.

        Groups that harden are measured after every such series: their bounds count as read back.
        """
        began = time.perf_counter()
        self._held = counters.held
        self._rates[:], self._unwatched[:] = counters.rates, counters.unwatched
        self._change[:], self._hardened[:] = counters.change, counters.hardened
        self._deformation_limit = _deformation_limit(self._rates)
        due = []
        for g, group in enumerate(self._groups):
            if self._unwatched[g] >= self.longest:
                due.append(g)
            elif max(self._change[g], self._hardened[g]) >= self.growth_allowed:
                known = self._measure[g]() if group.law.hardening > 0 else None
                if known is not None and _sound(known):
                    self._take(g, known)
                else:
                    due.append(g)
        self.seconds += time.perf_counter() - began
        return due

    def sound(self) -> bool:
        """Return whether no particle is crushed, inverted or NaN, by a measurement that is not stored."""
        return all(_sound(measure()) for measure in self._measure)

    def measure(self, due: Iterable[int]) -> bool:
        """Measure some groups, and return whether they are sound: none crushed, inverted or NaN."""
        began = time.perf_counter()
        sound = True
        for g in due:
            bounds = self._measure[g]()
            sound = sound and _sound(bounds)
            if sound:
                self._take(g, bounds)
                self._unwatched[g] = 0
        self.seconds += time.perf_counter() - began
        return sound

    def _take(self, g: int, bounds: StateBounds) -> None:
        """Store the bounds of a group's state, and the limits that follow from them."""
        self._bounds[g] = bounds
        self._at_start[g] = False
        self._rates[g] = bounds.deformation_rate
        self._change[g] = self._hardened[g] = 0.0
        self._limits[g] = self._limits_of(g, bounds)
        self._take_limits()

    def _limits_of(self, g: int, bounds: StateBounds) -> list[Limit]:
        """Return the limits that the stiffness of the g-th group sets within these bounds of its state."""
        group, bound = self._groups[g], bounds.bound
        if self._at_start[g]:
            # What starts deformed springs back; later the bound is held through all phases of an oscillation.
            bound = group.law.swung(bound)
        limits = []
        for place, parameters in zip(group.bodies, group.law.members, strict=True):
            modes = group.law.reference_modes if group.total else group.law.modes
            for mode in modes(parameters, bound):
                value, cause = mode_limit(
                    self._spacing, parameters.density, mode.stiffness, mode.viscosity, self._inertia
                )
                limits.append(Limit(value, cause, self._names[place]))
        return limits

    def _take_limits(self) -> None:
        """Store the smallest measured limits of stiffness and of deformation."""
        self._stiffness_limit = min(limit for limits in self._limits for limit in limits)
        self._deformation_limit = _deformation_limit(self._rates)


def _sound(bounds: StateBounds) -> bool:
    """Return whether no particle is crushed, inverted or NaN."""
    return bounds.bound.volume_ratio_min > SMALLEST_J


def _deformation_limit(rates: Iterable[float]) -> Limit:
    return Limit(deformation_limit(max(rates)), "deformation", "")

"""Follows the state of a run for its time step: when to measure, and the bounds that follow (docs/theory.md, 6.7)."""

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from typing import NamedTuple

from mpmcli.materials.law import StateBound
from mpmcli.scene import Scene
from mpmcli.solver.held_bound import HeldBound
from mpmcli.solver.particle_update import SMALLEST_J
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.state_bounds import Measurement, StateBounds
from mpmcli.solver.step_cpu import StepResult
from mpmcli.stability.limits import Limit, deformation_limit, mode_limit
from mpmcli.stability.transfer_factors import step_inertia

# Most steps between two measurements of the state, and with it of forces. A measurement is due earlier where a
# stiffness may have grown since by more than this share of the margin that time.safety leaves; one that has fallen is
# noticed late. The share is near 1 as every step reads the rate of deformation back.
MOST_UNWATCHED_STEPS, MOST_PUSHED_STEPS, UNWATCHED_SHARE = 256, 64, 0.95
# The same on a GPU, where the rate is an estimate, and where only a measurement detects lost particles.
MOST_BLIND_STEPS, BLIND_SHARE = 16, 0.75
# Cells per step below which a sudden stop, which turns speed into a velocity gradient of up to two speeds a cell,
# stays clear of the bound on the deformation in a step.
SLOW = 0.1


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

    def __init__(
        self, scene: Scene, groups: Sequence[ParticleGroup], measurements: Sequence[Measurement], *, on_cpu: bool
    ) -> None:
        """Measure the groups for the first time.

        Args:
            measurements: of each group.
            on_cpu: whether every step reads back the speed and the rates of deformation.
        """
        self._groups = groups
        self._names = tuple(body.name for body in scene.sources)
        self._spacing = scene.domain.spacing
        self._inertia = step_inertia(scene.solver)
        self._measure = measurements
        self._bounds = [measure.state() for measure in self._measure]
        # Per group: its rate of deformation after the last step as far as known, and since its last measurement steps
        # and growth of the logarithm of its stiffness: by deformation, and by hardening, which is measured by itself.
        self._rates = [bounds.deformation_rate for bounds in self._bounds]
        self._unwatched = [0] * len(groups)
        self._change = [0.0] * len(groups)
        self._hardened = [0.0] * len(groups)
        most = MOST_PUSHED_STEPS if scene.pushes else MOST_UNWATCHED_STEPS
        self.longest = most if on_cpu else MOST_BLIND_STEPS
        share = UNWATCHED_SHARE if on_cpu else BLIND_SHARE
        # A step of safety times the limit is stable until the stiffness has grown to safety^-2 of what it was.
        self.growth_allowed = -2 * share * math.log(scene.time.safety)
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

    def limits_now(self) -> list[Limit]:
        """Return every bound by the state as it is, without storing it."""
        states = [measure.state() for measure in self._measure]
        limits = [limit for g, bounds in enumerate(states) for limit in self._limits_of(g, bounds)]
        return [*limits, _deformation_limit(bounds.deformation_rate for bounds in states)]

    @property
    def nearest(self) -> Limit:
        """The smallest bound on the next step."""
        limit = min(self._stiffness_limit, self._deformation_limit)
        return limit._replace(value=min(limit.value, self._held.value))

    def after_step(self, dt: float, courant: float, result: StepResult | None) -> list[int]:
        """Count a step and return the groups to measure now.

        What the step read back is used at once.

        Args:
            dt: the step, s.
            courant: cells that the fastest particle moved.
            result: what it read back, None where that was not read back.
        """
        began = time.perf_counter()
        self._held = self._held.after(min(self._stiffness_limit.value, self._deformation_limit.value))
        if result is not None:
            self._rates[:] = result.deformation_rates
            self._deformation_limit = _deformation_limit(self._rates)
        pending = [0.0] * len(self._groups)
        for g, group in enumerate(self._groups):
            self._unwatched[g] += 1
            strain = dt * self._rates[g]
            sensitivity = group.law.sensitivity
            if result is None:
                # A particle that moves by a fifth of a cell may meet something that deforms it by about as much. Where
                # stiffness does not grow with deformation, only the latter bounds the step, and slow steps deform
                # little.
                strain = max(strain, 0.5 * courant)
                sensitivity = max(sensitivity, 1.0) if courant >= SLOW else sensitivity
            self._change[g] += strain * sensitivity
            # The internal variables do not contain the last step's strain yet.
            pending[g] = strain * group.law.hardening
            self._hardened[g] += pending[g]
        due = self._groups_due(None if result is None else result.state_bounds, pending)
        self.seconds += time.perf_counter() - began
        return due

    def _groups_due(self, known: Sequence[StateBounds | None] | None, pending: Sequence[float]) -> list[int]:
        """Return the groups to measure; what a step has read back is used in place of a measurement.

        Args:
            known: per group what the last step read back; None where steps are not read back.
            pending: per group the growth that the internal variables do not contain yet.
        """
        due = []
        for g in range(len(self._groups)):
            grown = self._change[g] >= self.growth_allowed
            if self._unwatched[g] >= self.longest:
                due.append(g)
            elif grown or self._hardened[g] >= self.growth_allowed:
                if known is not None and known[g] is not None and _sound(known[g]):
                    self._take(g, known[g])
                elif known is None and not grown and 2 * pending[g] <= self.growth_allowed:
                    self._measure_hardening(g, pending[g])
                else:
                    due.append(g)
        return due

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
        known = [
            measure.state() if group.law.hardening > 0 else None
            for group, measure in zip(self._groups, self._measure, strict=True)
        ]
        due = self._groups_due(known, [0.0] * len(known))
        self.seconds += time.perf_counter() - began
        return due

    def sound(self) -> bool:
        """Return whether no particle is crushed, inverted or NaN, by a measurement that is not stored."""
        return all(_sound(measure.state()) for measure in self._measure)

    def measure(self, due: Iterable[int] | None = None) -> bool:
        """Measure some groups, all where None, and return whether they are sound: none crushed, inverted or NaN."""
        began = time.perf_counter()
        sound = True
        for g in range(len(self._groups)) if due is None else due:
            bounds = self._measure[g].state()
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

    def _measure_hardening(self, g: int, pending: float) -> None:
        """Measure only the internal variables of a group; `pending` is the growth that they do not contain yet."""
        bounds = self._bounds[g]
        self._bounds[g] = replace(bounds, bound=replace(bounds.bound, internal=self._measure[g].internal()))
        self._hardened[g] = pending
        self._limits[g] = self._limits_of(g, self._bounds[g])
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

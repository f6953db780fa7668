"""Quantities of a scene that the rules of the check share, each computed once."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mpmcli.check.extent import height_along, spanned_axes, thickness
from mpmcli.check.flight import Arrival, arrivals
from mpmcli.check.scene_limits import SceneLimit, scene_limits, smallest
from mpmcli.check.start import joined, law_of, reachable, starts_of
from mpmcli.materials.law import Law, StateBound
from mpmcli.scene import Body, Scene, SceneBounds

# Lower bound on a thickness, m. A process that runs Taichi flushes smaller numbers to 0.
SMALLEST = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True, eq=False)
class BodyFacts:
    """Quantities of one body.

    Attributes:
        body: body of the scene.
        law: instance of its law for this body only.
        arrival: end of its free flight.
        thickness: smallest extent, m, without axes along which the body spans the domain and slips on the walls.
        height: extent along gravity, m; the largest extent if there is no gravity.
        stiffness, stiffest: largest stiffness of any mode, Pa, at rest and in the stiffest state.
    """

    body: Body
    law: Law
    arrival: Arrival
    thickness: float
    height: float
    stiffness: float
    stiffest: float

    @property
    def name(self) -> str:
        """Name of the body."""
        return self.body.name

    @property
    def wave_speed(self) -> float:
        """sqrt(S / (d density)) in the stiffest state, m/s; the speed of sound sqrt(K / density) of a fluid."""
        return float(np.sqrt(self.stiffest / (self.law.dimension * self.body.material.density)))

    @property
    def own_loss(self) -> float:
        """Rate at which the material itself damps a wave across the body, 1/s: 2 nu k^2, k = pi / thickness.

        The rate of plastic flow is not known before the run, and is taken as infinite.
        """
        if self.law.deformation == "F" and self.law.projects:
            return math.inf
        modes = self.law.modes(self.body.material, StateBound())
        # The viscosity of a mode is twice that of the material.
        viscosity = max(mode.viscosity for mode in modes) / self.body.material.density
        k = math.pi / self.thickness
        # A product overflows to infinity; a power would raise OverflowError.
        return viscosity * k * k if viscosity else 0.0

    @property
    def flows(self) -> bool:
        """Whether the body may deform permanently."""
        return self.law.deformation == "J" or self.law.projects


class SceneFacts:
    """Quantities of a scene; those of the bodies are computed on first use.

    Attributes:
        scene: the scene.
        bounds: largest speed, gravity, height and density that the scene can reach.
        starts: the deformation that each body starts with.
        limits: all bounds on the step.
        bodies: quantities of each body, in the order of the scene.
        binding, binding_at_start: smallest bound throughout, and at the start.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.starts = starts_of(scene)
        self.bounds: SceneBounds = reachable(scene, self.starts)
        self.limits: tuple[SceneLimit, ...] = tuple(scene_limits(scene, self.bounds, self.starts))
        self.binding = smallest(self.limits)
        self.binding_at_start = smallest(self.limits, at_rest=True)

    @cached_property
    def bodies(self) -> tuple[BodyFacts, ...]:
        """Quantities of each body, in the order of the scene."""
        # Gravity that depends on time is taken at the start.
        down = np.nan_to_num(self.scene.domain.gravity_at(0.0))
        g = float(np.linalg.norm(down))
        found = []
        arriving = arrivals(self.scene, self.bounds.speed, pressed=any(start.deformed for start in self.starts))
        for body, arrival, start in zip(self.scene.bodies, arriving, self.starts, strict=True):
            law, form = law_of(body, self.scene.dimension), body.shape.form
            states = (StateBound(), joined(start.bound, law.stiffest(body.material, self.bounds)))
            stiffness, stiffest = (max(mode.stiffness for mode in law.modes(body.material, s)) for s in states)
            height = height_along(form, down / g) if g > 0 else float(np.max(np.ptp(form.bounds(), axis=0)))
            found.append(
                BodyFacts(
                    body,
                    law,
                    arrival,
                    max(thickness(form, spanned_axes(self.scene, form)), SMALLEST),
                    height,
                    stiffness,
                    max(stiffness, stiffest),
                )
            )
        return tuple(found)

    @property
    def step(self) -> float:
        """safety times the smallest bound in any state that the scene can reach, s."""
        return self.scene.time.safety * self.binding.value

    @property
    def step_at_start(self) -> float:
        """safety times the smallest bound at the start, s."""
        return self.scene.time.safety * self.binding_at_start.value

    @property
    def step_expected(self) -> float:
        """Step of most of the run after the first contact, s: `step` where nothing stored or forced drives the scene.

        What a start or a force can give to the fastest particle anywhere lasts a moment or does not happen: then the
        bounds of motion count as at the start.
        """
        if not self.scene.pushes and not any(start.deformed for start in self.starts):
            return self.step
        lasting = [limit.value for limit in self.limits if limit.bound is not None or limit.state == "rest"]
        return self.scene.time.safety * min(lasting)

    def taken(self, step: float) -> float:
        """Return the step of a run in which `step` (s) is stable: at most time.step and the interval of the frames."""
        asked = self.scene.time.step
        return min(step, self.interval, step if asked == "auto" else asked)

    @property
    def interval(self) -> float:
        """Interval between two frames, s."""
        return self.scene.time.end / self.scene.time.frames

    @property
    def first_contact(self) -> float:
        """Time of the first contact of any body, s; until then no material is stiffer than at rest."""
        return min(facts.arrival.time for facts in self.bodies)

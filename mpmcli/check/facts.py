"""Quantities of a scene that the rules of the check share, each computed once, and the free flight of its bodies."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mpmcli.check.geometry import image_shifts, spanned_axes, thickness
from mpmcli.check.scene_limits import SceneLimit, joined, law_of, reachable, scene_limits, starts_of
from mpmcli.materials.law import Law, StateBound
from mpmcli.scene import Body, Scene, SceneBounds
from mpmcli.scene.contact_table import ContactTable
from mpmcli.scene.sampling import moves_unevenly

# Lower bound on a thickness, m. A process that runs Taichi flushes smaller numbers to 0.
SMALLEST = float(np.finfo(np.float64).tiny)
# Distance, in cells, below which two bodies, or a body and a wall, interact through the grid.
CONTACT = 1.0


@dataclass(frozen=True)
class Arrival:
    """End of the free flight of a body; until then it does not deform."""

    # First contact, s; 0 if it is in contact at the start, infinite if there is no contact.
    time: float
    # Largest closing speed, m/s, over the walls and bodies that it meets.
    speed: float
    # Velocity in the first contact after the start, (d,), m/s: relative to a wall, or half of that to a body; empty if
    # there is none in the run.
    impact: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class BodyFacts:
    """Quantities of one body."""

    body: Body
    # For this body only.
    law: Law
    arrival: Arrival
    # Smallest extent, m, without axes along which the body spans the domain and slips on the walls.
    thickness: float
    # Extent along gravity, m; the largest extent if there is no gravity.
    height: float
    # Largest stiffness of any mode, Pa, at rest and in the stiffest state.
    stiffness: float
    stiffest: float

    @property
    def name(self) -> str:
        return self.body.name

    @property
    def wave_speed(self) -> float:
        """sqrt(S / (d density)) in the stiffest state, m/s; the speed of sound sqrt(K / density) of a fluid."""
        return float(np.sqrt(self.stiffest / (self.law.dimension * self.body.material.density)))

    @property
    def own_loss(self) -> float:
        """Rate at which the material damps a wave across it, 1/s: 2 nu k^2, k = pi / thickness; plastic flow: inf."""
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

    `contacts` is how all meet, `bounds` are the largest speed, gravity, height and density that it can reach; `starts`
    the deformation of each body; `binding` is the smallest of the `limits` in any state, and `step` safety times it, s;
    `interval` is between frames, s.
    """

    def __init__(self, scene: Scene) -> None:
        """Compute the bounds of the scene as a whole and the limits on its step, s."""
        self.scene, self.contacts = scene, ContactTable(scene)
        self.starts = starts_of(scene)
        self.deformed = any(start.bound != StateBound() for start in self.starts)
        self.bounds: SceneBounds = reachable(scene, self.starts)
        self.limits: tuple[SceneLimit, ...] = tuple(scene_limits(scene, self.bounds, self.starts))
        # Of two equal limits, the one at rest, which comes first.
        self.binding = min(self.limits, key=lambda limit: limit.value)
        at_rest = (limit for limit in self.limits if limit.state == "rest")
        self.binding_at_start = min(at_rest, key=lambda limit: limit.value)
        self.step = scene.time.safety * self.binding.value
        self.step_at_start = scene.time.safety * self.binding_at_start.value
        self.interval = scene.time.end / scene.time.frames

    @cached_property
    def bodies(self) -> tuple[BodyFacts, ...]:
        """Quantities of each body, in the order of the scene."""
        # Time-dependent gravity is evaluated at the start.
        down = np.nan_to_num(self.scene.domain.gravity_at(0.0))
        g = float(np.linalg.norm(down))
        facts = []
        arriving = arrivals(self.scene, self.bounds.speed, pressed=self.deformed)
        for body, arrival, start in zip(self.scene.bodies, arriving, self.starts, strict=True):
            law, form = law_of(body, self.scene.dimension), body.shape.form
            states = (StateBound(), joined(start.bound, law.stiffest(body.material, self.bounds)))
            stiffness, stiffest = (max(mode.stiffness for mode in law.modes(body.material, s)) for s in states)
            lower, upper = form.bounds()
            height = float((upper - lower) @ np.abs(down / g)) if g > 0 else float(np.max(upper - lower))
            thin = max(thickness(form, spanned_axes(self.scene, form)), SMALLEST)
            facts.append(BodyFacts(body, law, arrival, thin, height, stiffness, max(stiffness, stiffest)))
        return tuple(facts)

    @cached_property
    def flowing(self) -> bool:
        """Whether any body may deform permanently."""
        return any(body.flows for body in self.bodies)

    @property
    def step_expected(self) -> float:
        """Step of most of the run after the first contact, s: `step` where nothing stored or forced drives the scene.

        The largest speed that a start or a force can cause is brief or does not occur; the bounds of motion are then
        those at the start.
        """
        if not self.scene.pushes and not self.deformed:
            return self.step
        lasting = [limit.value for limit in self.limits if limit.bound is not None or limit.state == "rest"]
        return self.scene.time.safety * min(lasting)

    def taken(self, step: float) -> float:
        """Return the step of a run in which `step` (s) is stable: at most time.step and the interval of the frames."""
        asked = self.scene.time.step
        return min(step, self.interval, step if asked == "auto" else asked)


def arrivals(scene: Scene, fastest: float = 0.0, *, pressed: bool = False) -> list[Arrival]:
    """Return, for each body, the contacts of its bounding box with walls, other bodies and their periodic images.

    They follow from the velocities and from gravity; rotation and deformation are ignored. If forces act, gravity or a
    velocity is an expression, or bodies start deformed (`pressed`), all arrive at time 0 at the speed `fastest`, m/s.
    """
    domain = scene.domain
    if not scene.bodies:
        return []
    if pressed or scene.pushes or not domain.steady or any(moves_unevenly(body) for body in scene.bodies):
        return [Arrival(0.0, fastest)] * len(scene.bodies)
    reach = CONTACT * domain.spacing
    gravity = np.array(domain.gravity)
    lower_walls = np.where(domain.periodic, -np.inf, np.array(domain.origin))
    upper_walls = np.where(domain.periodic, np.inf, np.array(domain.upper))
    bounds = [body.shape.form.bounds() for body in scene.bodies]
    lowers, uppers = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    velocities = np.array([body.velocity for body in scene.bodies])
    # Images of all bodies, those themselves first.
    shifts = image_shifts(scene)
    lowers, uppers = (np.concatenate([corners + shift for shift in shifts]) for corners in (lowers, uppers))
    velocities = np.tile(velocities, (len(shifts), 1))
    ended = []
    for i, (lower, upper) in enumerate(bounds):
        falls = [
            _fall(float(gap), float(sign * velocities[i][a]), float(sign * gravity[a]), reach)
            for sign, gaps in ((-1, lower - lower_walls), (1, upper_walls - upper))
            for a, gap in enumerate(gaps)
        ]
        others = np.arange(len(lowers)) % len(bounds) != i
        relative = velocities[i] - velocities[others]
        times = _meetings(lowers[others] - upper - reach, uppers[others] - lower + reach, relative)
        speeds = [speed for time, speed in falls if math.isfinite(time)]
        speeds += np.linalg.norm(relative[np.isfinite(times)], axis=1).tolist()
        ends = np.array([time for time, _ in falls] + times.tolist())
        # A contact from the start, such as a wall along which it slides, is not an impact.
        later = np.where(ends > 0, ends, np.inf)
        first = int(np.argmin(later))
        impact = np.zeros(0)
        if later[first] <= scene.time.end:
            # The axes of the lower walls, then those of the upper ones; then the bodies.
            axis, body = first % len(lower), first - len(falls)
            impact = relative[body] / 2 if body >= 0 else falls[first][1] * np.eye(len(lower))[axis]
        ended.append(Arrival(float(ends.min()), max(speeds, default=0.0), tuple(impact.tolist())))
    return ended


def _fall(gap: float, speed: float, gravity: float, reach: float) -> tuple[float, float]:
    """Return time, s, and speed at which a closing gap is `reach`; for a smaller gap 0, and the speed at closure."""
    if math.isinf(gap):
        return math.inf, 0.0
    left = gap - reach
    if left <= 0:
        # It accelerates over the remaining gap.
        return 0.0, math.sqrt(max(0.0, max(speed, 0.0) ** 2 + 2 * gravity * max(gap, 0.0)))
    square = speed**2 + 2 * gravity * left
    if square < 0 or (speed <= 0 and gravity <= 0):
        return math.inf, 0.0
    arrival = math.sqrt(square)
    # The root of speed t + gravity t^2/2 = left without cancellation.
    time = 2 * left / (speed + arrival) if speed > 0 else (arrival - speed) / gravity
    return time, math.sqrt(max(0.0, speed**2 + 2 * gravity * gap))


def _meetings(low: np.ndarray, high: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return times, (n,), s, at which overlaps begin between displacements `low` and `high`, (n, d), m, inf if none."""
    moving = velocity != 0
    safe = np.where(moving, velocity, 1.0)
    ends = np.sort(np.stack([low / safe, high / safe]), axis=0)
    # Along an axis without relative motion they overlap always or never.
    always = (low <= 0) & (high >= 0)
    enter = np.where(moving, ends[0], np.where(always, -np.inf, np.inf))
    leave = np.where(moving, ends[1], np.where(always, np.inf, -np.inf))
    first, last = np.maximum(0.0, enter.max(axis=1)), leave.min(axis=1)
    return np.where(first <= last, first, np.inf)

"""Bounds on the time step of a scene before the run: at rest, and in the stiffest state (docs/theory.md, 6)."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mpmcli.materials.law import Law, StateBound
from mpmcli.materials.registry import laws
from mpmcli.scene import Body, Scene, SceneBounds, highest_speed, scene_bounds
from mpmcli.scene.bounds import body_places, body_points
from mpmcli.scene.sampling import initial_deformation, initial_motion, moves_unevenly, starts_deformed
from mpmcli.stability.limits import FIX, WHY, collider_limit, deformation_limit, mode_limit, speed_limit
from mpmcli.stability.transfer_factors import step_inertia

# Velocity gradient of an impact, in speeds per cell: one side of a cell stops while matter enters from two nodes.
IMPACT_GRADIENT = 2.0
# A wave that reaches a free surface ejects matter at twice its speed, and jets from a corner are about as fast: 1.6 to
# 2.5 times the speed of the fall in seven of eight scenes, 3 times in one with colliding bodies.
JET = 2.0
# A node at the edge of stressed matter takes up to 6 |tau| dt / (density h) in a step, which at the default step is 4.8
# times the speed sqrt(2 W / density) that the stored energy can give: 1.9 to 4.3 times that in random scenes.
SPRAY = 4.8


@dataclass(frozen=True)
class Start:
    """Bounds of the deformation that a body starts with; `energy` is the largest of a particle, J/m^3 at rest."""

    bound: StateBound = field(default_factory=StateBound)
    energy: float = 0.0


@dataclass(frozen=True)
class SceneLimit:
    """A bound on the time step, s, without safety, for a `body` or ""; `why` and `fix` are sentences with numbers."""

    value: float
    name: str
    body: str
    # "rest", the start of the scene, or "stiffest", the stiffest state that the scene can reach; and that in words.
    state: str
    meaning: str
    why: str
    fix: str
    # None if the limit does not depend on the state of the material.
    bound: StateBound | None = None

    def as_dict(self) -> dict:
        """Return the limit as a dictionary for JSON; `volume_ratio` and `internal` are ranges."""
        J = None if self.bound is None else [self.bound.volume_ratio_min, self.bound.volume_ratio_max]
        internal = {} if self.bound is None else {name: list(ends) for name, ends in self.bound.internal.items()}
        facts = {name: getattr(self, name) for name in ("value", "name", "body", "state", "meaning")}
        return {**facts, "volume_ratio": J, "internal": internal, "why": self.why, "fix": self.fix}


def law_of(body: Body, dimension: int) -> Law:
    """Return an instance of the law of one body, for that body only."""
    return laws()[body.material.law]([body.material], dimension)


def starts_of(scene: Scene) -> list[Start]:
    """Return the start of each body, in the order of the scene."""
    starts = [Start()] * len(scene.bodies)
    for index, body in enumerate(scene.bodies):
        if not starts_deformed(body):
            continue
        deformation = initial_deformation(body, body_places(body, index, scene.domain.spacing), scene.domain)
        if deformation.ndim == 1:
            J, stretch_squared = deformation, deformation**2
        else:
            J = np.linalg.det(deformation)
            # The row sum of |F F^T| that a run measures.
            stretch_squared = np.abs(deformation @ deformation.swapaxes(1, 2)).sum(axis=2).max(axis=1)
        sound = np.isfinite(J) & np.isfinite(stretch_squared)
        if sound.any():
            J, stretch_squared = J[sound], stretch_squared[sound]
            bound = StateBound(float(J.min()), float(J.max()), float(stretch_squared.max()))
            energy = law_of(body, scene.dimension).stored_energy(body.material, deformation[sound])
            starts[index] = Start(bound, float(np.max(energy, initial=0.0, where=np.isfinite(energy))))
    return starts


def reachable(scene: Scene, starts: Sequence[Start]) -> SceneBounds:
    """Return the bounds of a scene, including the speed v^2 = 2 W / density from the energy W stored at the start."""
    bounds, release = scene_bounds(scene), _release_speed(scene, starts)
    return bounds if release == 0 else replace(bounds, speed=math.hypot(bounds.speed, release))


def _release_speed(scene: Scene, starts: Sequence[Start]) -> float:
    """Return the largest speed that the energy stored at the start gives to a particle, m/s."""
    squares = (2 * s.energy / b.material.density for s, b in zip(starts, scene.bodies, strict=True))
    return math.sqrt(max(squares, default=0.0))


def joined(start: StateBound, reached: StateBound) -> StateBound:
    """Return the bound that contains the start of a body and the states that it can reach."""
    return replace(
        reached,
        volume_ratio_min=min(start.volume_ratio_min, reached.volume_ratio_min),
        volume_ratio_max=max(start.volume_ratio_max, reached.volume_ratio_max),
        stretch_squared_max=max(start.stretch_squared_max, reached.stretch_squared_max),
    )


def scene_limits(scene: Scene, bounds: SceneBounds, starts: Sequence[Start] | None = None) -> list[SceneLimit]:
    """Return all limits within `bounds`: of each body at the start and in its stiffest state, then of motion."""
    limits, starts = [], starts or starts_of(scene)
    begun = [*starts, *(Start() for _ in scene.emitters)]
    for body, start in zip(scene.sources, begun, strict=True):
        law = law_of(body, scene.dimension)
        reached = joined(start.bound, law.stiffest(body.material, bounds))
        for state, bound in (("rest", start.bound), ("stiffest", reached)):
            limits += _material_limits(body, law, state, bound, scene)
    return [*limits, *_motion_limits(scene, bounds, _release_speed(scene, starts))]


def _material_limits(body: Body, law: Law, state: str, bound: StateBound, scene: Scene) -> Iterator[SceneLimit]:
    """Yield the smallest limit of each name from the modes of one body in one state."""
    density, spacing, solver = body.material.density, scene.domain.spacing, scene.solver
    inertia = step_inertia(solver)
    smallest: dict[str, tuple[float, float, float]] = {}
    modes = law.reference_modes if solver.solids == "total" else law.modes
    for mode in modes(body.material, law.rebound_bound(bound)):
        value, name = mode_limit(spacing, density, mode.stiffness / law.relief, mode.viscosity, inertia)
        entry = (value, mode.stiffness, mode.viscosity)
        smallest[name] = min(smallest.get(name, entry), entry)
    for name, (value, stiffness, viscosity) in smallest.items():
        if name == "wave":
            numbers = (
                f"its stiffness of {stiffness:.4g} Pa and density of {density:.4g} kg/m^3 make "
                f"{math.sqrt(stiffness / density):.4g} m/s"
            )
            cure = f"a quarter of {_parameter(body, law.stiffness_parameters, 'the stiffness')} or cells twice as wide"
            longer, allow = math.sqrt(inertia), "allows"
        else:
            numbers = (
                f"its viscosity of {viscosity / 2:.4g} Pa s over a density of {density:.4g} kg/m^3 is "
                f"{viscosity / 2 / density:.4g} m^2/s"
            )
            cure = f"half of {_parameter(body, law.viscosity_parameters, 'the viscosity')}, or cells 1.4 times as wide,"
            longer, allow = inertia, "allow"
        why = f'In body "{body.name}" {WHY[name]}: {numbers}, and a cell is {spacing:.4g} m wide'
        if inertia != 1:
            scheme = f'transfer = "{solver.transfer}" with kernel = "{solver.kernel}"'
            why += f"; {scheme} is stable at {longer:.3g} times that step"
        if name == "wave" and law.relief != 1:
            why += f"; its lone particles bear less stress, which allows {math.sqrt(law.relief):.3g} times that step"
        meaning = _state_text(bound, "at rest" if state == "rest" else "as at rest")
        fix = f"{_capital(cure)} {allow} about twice the step."
        yield SceneLimit(value, name, body.name, state, meaning, f"{why}.", fix, bound)


def _motion_limits(scene: Scene, bounds: SceneBounds, release: float) -> list[SceneLimit]:
    """Return the limits set by speeds, velocity gradients and colliders, at the start and reachable in the scene."""
    h = scene.domain.spacing
    cell = f"a cell is {h:.4g} m wide"
    starting = {source.name: highest_speed(source, scene.time.end) for source in scene.sources}
    fastest = max(starting, key=lambda name: starting[name], default="")
    initial, reached = starting.get(fastest, 0.0), bounds.speed
    jets = JET * math.sqrt(max(reached**2 - release**2, 0.0)) + SPRAY * release
    falls = f"fall and initial speeds make {reached:.4g} m/s, jets {JET:g} times that"
    if release > 0:
        falls = f"fall, initial speeds and the energy stored at the start make {reached:.4g} m/s, jets up to"
        falls += f" {SPRAY:g} times that"
    rates = {body.name: _initial_rate(body, scene.dimension) for body in scene.bodies}
    quickest = max(rates, key=lambda name: rates[name], default="")
    rate, impact = rates.get(quickest, 0.0), IMPACT_GRADIENT * reached / h
    limits = [
        _motion_limit(
            speed_limit(h, initial, bounds.gravity),
            ("speed", fastest if initial > 0 else "", "rest", f"starting at {initial:.3g} m/s"),
            f"the fastest particle starts at {initial:.4g} m/s, and {cell}",
        ),
        _motion_limit(
            deformation_limit(rate),
            ("deformation", quickest, "rest", f"starting at {rate:.3g} /s"),
            f'body "{quickest}" deforms at {rate:.4g} /s',
        ),
        _motion_limit(
            speed_limit(h, jets, bounds.gravity),
            ("speed", "", "stiffest", f"jets at {jets:.3g} m/s"),
            f"{falls}, and {cell}",
        ),
        _motion_limit(
            deformation_limit(impact),
            ("deformation", "", "stiffest", f"an impact at {reached:.3g} m/s"),
            f"an impact at {reached:.4g} m/s stops within a cell, a velocity gradient of {impact:.4g} /s",
        ),
    ]
    # Rigid bodies at rest, without material, have no limit.
    limits = [limit for limit in limits if math.isfinite(limit.value)] or ([] if scene.sources else limits[:1])
    speeds = {collider.name: collider.fastest(scene.domain, scene.time.end) for collider in scene.colliders}
    moving = max(speeds, key=lambda name: speeds[name], default="")
    speed = speeds.get(moving, 0.0)
    if speed > 0:
        cause = f'the fastest point of "{moving}" moves at {speed:.4g} m/s, and {cell}'
        state = ("collider", "", "rest", f"moving at {speed:.3g} m/s")
        limits.append(_motion_limit(collider_limit(h, speed), state, cause))
    return limits


def _motion_limit(value: float, state: tuple[str, str, str, str], cause: str) -> SceneLimit:
    """Return a limit, given its name, body, state and the meaning of the state; `cause` ends the sentence why."""
    name = state[0]
    return SceneLimit(value, *state, f"{_capital(WHY[name])}: {cause}.", f"{_capital(FIX[name])}.")


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]


def deformation_rate(C: np.ndarray, *, keeps_J: bool) -> np.ndarray:
    """Return a bound on the rate of change of the stored deformation, (n,), 1/s (docs/theory.md, 6.4).

    `C` are velocity gradients, (n, d, d), 1/s, and `keeps_J` is whether the law stores J rather than F. For F it is the
    largest row sum of |C + C^T| / 2, as a rotation does not deform. J grows by det(I + dt C) = 1 + dt tr C + dt^2 m +
    ..., where m is the sum of the principal minors of order two: |tr C| + sqrt(max(-m, 0)). `solver.state_bounds`
    computes the same on the device.
    """
    if not keeps_J:
        return np.abs(C + C.swapaxes(1, 2)).sum(axis=2).max(axis=1) / 2
    trace = np.trace(C, axis1=1, axis2=2)
    minors = (trace**2 - np.einsum("nij,nji->n", C, C)) / 2
    return np.abs(trace) + np.sqrt(np.maximum(-minors, 0.0))


def _initial_rate(body: Body, dimension: int) -> float:
    if body.velocity_gradient is None and not moves_unevenly(body):
        return 0.0
    _, C = initial_motion(body, body_points(body) if moves_unevenly(body) else np.zeros((1, dimension)))
    rates = deformation_rate(C, keeps_J=law_of(body, dimension).deformation == "J")
    return float(np.max(rates, initial=0.0, where=np.isfinite(rates)))


def _parameter(body: Body, names: tuple[str, ...], otherwise: str) -> str:
    given = Law.first_set(body.material, names)
    return f"{given[0]} = {given[1]:.4g}" if given else otherwise


def _state_text(bound: StateBound, otherwise: str) -> str:
    """Return a state bound as text: the range of J, or the stretch, and those of the internal variables."""
    J = (bound.volume_ratio_min, bound.volume_ratio_max)
    ranges = {} if J == (1.0, 1.0) else {"J": J}
    ranges |= bound.internal
    words = [f"{name} = {low:.3g}" + ("" if low == high else f" to {high:.3g}") for name, (low, high) in ranges.items()]
    if J == (1.0, 1.0) and bound.stretch_squared_max > 1:
        words.insert(0, f"stretched by {math.sqrt(bound.stretch_squared_max):.3g}")
    return ", ".join(words) or otherwise

"""Bounds on the time step of a scene before the run: at rest, and in the stiffest state (docs/theory.md, 6)."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.check.deformation import deformation_rate
from mpmcli.check.start import Start, joined, law_of, release_speed, starts_of
from mpmcli.materials.law import Law, StateBound
from mpmcli.scene import Body, Scene, SceneBounds, highest_speed
from mpmcli.scene.bounds import body_points
from mpmcli.scene.initial import initial_motion, moves_unevenly
from mpmcli.scene.schema import SolverSettings
from mpmcli.stability.limits import FIX, WHY, collider_limit, deformation_limit, mode_limit, speed_limit
from mpmcli.stability.transfer_factors import step_inertia

# Velocity gradient of an impact, in speeds per cell: one side of a cell stops while matter enters from two nodes.
IMPACT_GRADIENT = 2.0
# A wave that reaches a free surface ejects matter at twice its speed, and jets from a corner are about as fast: 1.6 to
# 2.5 times the speed of the fall in seven scenes of eight, 3 times in one with colliding bodies.
JET = 2.0
# A node at the edge of stressed matter takes up to 6 |tau| dt / (density h) in a step, which at the default step is 4.8
# times the speed sqrt(2 W / density) that the stored energy can give: 1.9 to 4.3 times that in random scenes.
SPRAY = 4.8


@dataclass(frozen=True)
class SceneLimit:
    """One bound on the time step of a scene.

    Attributes:
        value: largest stable step, s, without the safety factor.
        name: "wave", "viscosity", "speed", "deformation" or "collider".
        body: name of the body that sets it, "" if there is no single one.
        state: "rest", the start of the scene, or "stiffest", the stiffest state that the scene can reach.
        meaning: the state in words.
        why, fix: one sentence each, with numbers of the scene.
        bound: bounds on the state of the material, None if the limit does not depend on it.
    """

    value: float
    name: str
    body: str
    state: str
    meaning: str
    why: str
    fix: str
    bound: StateBound | None = None

    def as_dict(self) -> dict:
        """Return the limit as a dictionary for JSON; `volume_ratio` and `internal` are ranges."""
        bound = self.bound
        return {
            "value": self.value,
            "name": self.name,
            "body": self.body,
            "state": self.state,
            "meaning": self.meaning,
            "volume_ratio": None if bound is None else [bound.volume_ratio_min, bound.volume_ratio_max],
            "internal": {} if bound is None else {name: list(ends) for name, ends in bound.internal.items()},
            "why": self.why,
            "fix": self.fix,
        }


def scene_limits(scene: Scene, bounds: SceneBounds, starts: Sequence[Start] | None = None) -> list[SceneLimit]:
    """Return all limits: of each body as it starts and in its stiffest state, then those of motion.

    Args:
        scene: whose limits.
        bounds: what it can reach, see `reachable`.
        starts: of the bodies; found if not given.
    """
    found, starts = [], starts or starts_of(scene)
    begun = [*starts, *(Start() for _ in scene.emitters)]
    for body, start in zip(scene.sources, begun, strict=True):
        law = law_of(body, scene.dimension)
        reached = joined(start.bound, law.stiffest(body.material, bounds))
        for state, bound in (("rest", start.bound), ("stiffest", reached)):
            found += _material_limits(body, law, state, bound, scene)
    return [*found, *_motion_limits(scene, bounds, release_speed(scene, starts)), *_collider_limits(scene)]


def _collider_limits(scene: Scene) -> Iterator[SceneLimit]:
    """Yield the limit that the fastest collider sets."""
    h = scene.domain.spacing
    speeds = {collider.name: collider.fastest(scene.domain, scene.time.end) for collider in scene.colliders}
    fastest = max(speeds, key=lambda name: speeds[name], default="")
    if speeds.get(fastest, 0.0) > 0:
        speed, name = speeds[fastest], "collider"
        cause = f'the fastest point of "{fastest}" moves at {speed:.4g} m/s, and a cell is {h:.4g} m wide'
        why, fix = f"{WHY[name][:1].upper()}{WHY[name][1:]}: {cause}.", f"{FIX[name][:1].upper()}{FIX[name][1:]}."
        yield SceneLimit(collider_limit(h, speed), name, "", "rest", f"moving at {speed:.3g} m/s", why, fix)


def _material_limits(body: Body, law: Law, state: str, bound: StateBound, scene: Scene) -> Iterator[SceneLimit]:
    """Yield the smallest limit of each name that the modes of one body set in one state."""
    material, spacing = body.material, scene.domain.spacing
    inertia = step_inertia(scene.solver)
    scheme = _scheme_text(scene.solver, inertia)
    smallest: dict[str, tuple[float, float, float]] = {}
    modes = law.reference_modes if scene.solver.solids == "total" else law.modes
    for mode in modes(material, law.swung(bound)):
        value, name = mode_limit(spacing, material.density, mode.stiffness, mode.viscosity, inertia)
        entry = (value, mode.stiffness, mode.viscosity)
        smallest[name] = min(smallest.get(name, entry), entry)
    for name, (value, stiffness, viscosity) in smallest.items():
        if name == "wave":
            numbers = (
                f"its stiffness of {stiffness:.4g} Pa and density of {material.density:.4g} kg/m^3 make "
                f"{math.sqrt(stiffness / material.density):.4g} m/s, and a cell is {spacing:.4g} m wide"
            )
            cure = f"a quarter of {_parameter(body, law.stiffness_parameters, 'the stiffness')} or cells twice as wide"
        else:
            numbers = (
                f"its viscosity of {viscosity / 2:.4g} Pa s over a density of {material.density:.4g} kg/m^3 is "
                f"{viscosity / 2 / material.density:.4g} m^2/s, and a cell is {spacing:.4g} m wide"
            )
            cure = f"half of {_parameter(body, law.viscosity_parameters, 'the viscosity')}, or cells 1.4 times as wide,"
        yield SceneLimit(
            value,
            name,
            body.name,
            state,
            _state_text(bound, "at rest" if state == "rest" else "as at rest"),
            f'In body "{body.name}" {WHY[name]}: {numbers}{scheme[name]}.',
            f"{cure[:1].upper()}{cure[1:]} allow{'' if name == 'viscosity' else 's'} about twice the step.",
            bound,
        )


def _scheme_text(settings: SolverSettings, inertia: float) -> dict[str, str]:
    """Return a clause on the factor by which transfer and kernel change the limits, "" for the default ones."""
    if inertia == 1:
        return {"wave": "", "viscosity": ""}
    chosen = f'; transfer = "{settings.transfer}" with kernel = "{settings.kernel}" is stable at'
    return {
        "wave": f"{chosen} {math.sqrt(inertia):.3g} times that step",
        "viscosity": f"{chosen} {inertia:.3g} times that step",
    }


def _motion_limits(scene: Scene, bounds: SceneBounds, release: float) -> Iterator[SceneLimit]:
    """Yield the limits set by speeds and velocity gradients, at the start and reachable in the scene."""
    h = scene.domain.spacing
    fastest = max(scene.sources, key=highest_speed)
    initial, reached = highest_speed(fastest), bounds.speed
    jets = JET * math.sqrt(max(reached**2 - release**2, 0.0)) + SPRAY * release
    rates = {body.name: _initial_rate(body, scene.dimension) for body in scene.bodies}
    quickest = max(rates, key=lambda name: rates[name])
    rate = rates[quickest]
    impact = IMPACT_GRADIENT * reached / h
    for value, name, state, body, meaning, cause in (
        (
            speed_limit(h, initial, bounds.gravity),
            "speed",
            "rest",
            fastest.name if initial > 0 else "",
            f"starting at {initial:.3g} m/s",
            f"the fastest particle starts at {initial:.4g} m/s, and a cell is {h:.4g} m wide",
        ),
        (
            deformation_limit(rate),
            "deformation",
            "rest",
            quickest,
            f"starting at {rate:.3g} /s",
            f'body "{quickest}" deforms at {rate:.4g} /s',
        ),
        (
            speed_limit(h, jets, bounds.gravity),
            "speed",
            "stiffest",
            "",
            f"jets at {jets:.3g} m/s",
            _jet_text(reached, release, h),
        ),
        (
            deformation_limit(impact),
            "deformation",
            "stiffest",
            "",
            f"an impact at {reached:.3g} m/s",
            f"an impact at {reached:.4g} m/s stops within a cell, a velocity gradient of {impact:.4g} /s",
        ),
    ):
        if math.isfinite(value):
            why = f"{WHY[name][:1].upper()}{WHY[name][1:]}: {cause}."
            yield SceneLimit(value, name, body, state, meaning, why, f"{FIX[name][:1].upper()}{FIX[name][1:]}.")


def _jet_text(reached: float, release: float, h: float) -> str:
    """Return what makes the fastest jets, and the width of a cell."""
    cause = f"fall and initial speeds make {reached:.4g} m/s, jets {JET:g} times that"
    if release > 0:
        cause = f"fall, initial speeds and the energy stored at the start make {reached:.4g} m/s, jets up to"
        cause += f" {SPRAY:g} times that"
    return f"{cause}, and a cell is {h:.4g} m wide"


def _initial_rate(body: Body, dimension: int) -> float:
    """Return the largest rate of deformation of a body at the start, 1/s."""
    if body.velocity_gradient is None and not moves_unevenly(body):
        return 0.0
    _, C = initial_motion(body, body_points(body) if moves_unevenly(body) else np.zeros((1, dimension)))
    rates = deformation_rate(C, keeps_J=law_of(body, dimension).deformation == "J")
    return float(np.max(rates, initial=0.0, where=np.isfinite(rates)))


def _parameter(body: Body, names: tuple[str, ...], otherwise: str) -> str:
    """Return the first of the named parameters that a body has, with its value, as text."""
    found = Law.first_set(body.material, names)
    return f"{found[0]} = {found[1]:.4g}" if found else otherwise


def _state_text(bound: StateBound, otherwise: str) -> str:
    """Return a state bound as text: the range of J, or the stretch, and those of the internal variables."""
    words = [
        f"{name} = {low:.3g}" + ("" if low == high else f" to {high:.3g}")
        for name, (low, high) in bound.internal.items()
    ]
    J = (bound.volume_ratio_min, bound.volume_ratio_max)
    if J != (1.0, 1.0):
        words.insert(0, f"J = {J[0]:.3g}" + ("" if J[0] == J[1] else f" to {J[1]:.3g}"))
    elif bound.stretch_squared_max > 1:
        words.insert(0, f"stretched by {math.sqrt(bound.stretch_squared_max):.3g}")
    return ", ".join(words) or otherwise


def smallest(limits: Sequence[SceneLimit], *, at_rest: bool = False) -> SceneLimit:
    """Return the smallest limit, in any state or at the start.

    Where two are equal, the one at rest is returned.
    """
    chosen = [limit for limit in limits if limit.state == "rest" or not at_rest]
    return min(chosen, key=lambda limit: limit.value)

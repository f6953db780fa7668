"""The state that bodies start in: how far they are deformed, and the speed at which that energy can be let go."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mpmcli.materials.law import Law, StateBound
from mpmcli.materials.registry import laws
from mpmcli.scene import Body, Scene, SceneBounds, scene_bounds
from mpmcli.scene.bounds import body_places
from mpmcli.scene.initial import initial_deformation


@dataclass(frozen=True)
class Start:
    """The deformation that a body starts with.

    Attributes:
        bound: range of J and of stretches over its particles, as a run measures them.
        energy: largest stored energy of a particle, J/m^3 of volume at rest.
    """

    bound: StateBound = field(default_factory=StateBound)
    energy: float = 0.0

    @property
    def deformed(self) -> bool:
        """Whether any particle is deformed."""
        return self.bound != StateBound()


def law_of(body: Body, dimension: int) -> Law:
    """Return an instance of the law of one body, for that body only."""
    return laws()[body.material.law]([body.material], dimension)


def starts_of(scene: Scene) -> list[Start]:
    """Return the start of each body, in the order of the scene."""
    return [_start_of(body, index, scene) for index, body in enumerate(scene.bodies)]


def _start_of(body: Body, index: int, scene: Scene) -> Start:
    if body.deformation is None and body.initial_pressure is None:
        return Start()
    deformation = initial_deformation(body, body_places(body, index, scene.domain.spacing), scene.domain)
    if deformation.ndim == 1:
        J, stretch_squared = deformation, deformation**2
    else:
        J = np.linalg.det(deformation)
        # The row sum of |F F^T| that a run measures.
        stretch_squared = np.abs(deformation @ deformation.swapaxes(1, 2)).sum(axis=2).max(axis=1)
    sound = np.isfinite(J) & np.isfinite(stretch_squared)
    if not sound.any():
        return Start()
    J, stretch_squared, deformation = J[sound], stretch_squared[sound], deformation[sound]
    bound = StateBound(float(J.min()), float(J.max()), float(stretch_squared.max()))
    energy = law_of(body, scene.dimension).stored_energy(body.material, deformation)
    return Start(bound, float(np.max(energy, initial=0.0, where=np.isfinite(energy))))


def reachable(scene: Scene, starts: Sequence[Start]) -> SceneBounds:
    """Return what the scene can reach, with the speed that the energy stored at the start can give to a particle.

    (1/2) density v^2 = W adds v^2 to the square of the speed that `scene_bounds` gives.
    """
    bounds, release = scene_bounds(scene), release_speed(scene, starts)
    return bounds if release == 0 else replace(bounds, speed=math.hypot(bounds.speed, release))


def release_speed(scene: Scene, starts: Sequence[Start]) -> float:
    """Return the largest speed that the energy stored at the start gives to a particle, m/s."""
    return math.sqrt(max(2 * s.energy / b.material.density for s, b in zip(starts, scene.bodies, strict=True)))


def joined(start: StateBound, reached: StateBound) -> StateBound:
    """Return the bound that contains the start of a body and the states that it can reach."""
    return replace(
        reached,
        volume_ratio_min=min(start.volume_ratio_min, reached.volume_ratio_min),
        volume_ratio_max=max(start.volume_ratio_max, reached.volume_ratio_max),
        stretch_squared_max=max(start.stretch_squared_max, reached.stretch_squared_max),
    )

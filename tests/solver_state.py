"""What tests read from a run: the state of each body in the particles' own order, and its momenta."""

from dataclasses import dataclass

import numpy as np
from pydantic import TypeAdapter
from scenes import scene_of as scene_of

from mpmcli.scene import Scene
from mpmcli.scene.colliders import Collider
from mpmcli.solver.engine.run import Run
from mpmcli.solver.frames.diagnosis import Snapshot, read_group


@dataclass(frozen=True)
class BodyState:
    """One body: x (n, d) relative to the domain's origin, v (n, d), C (n, d, d), J (n) or F (n, d, d), mass (n)."""

    x: np.ndarray
    v: np.ndarray
    C: np.ndarray
    deformation: np.ndarray
    mass: np.ndarray

    def momentum(self) -> np.ndarray:
        """sum m v."""
        return self.mass @ self.v

    def angular_momentum(self, h: float) -> np.ndarray:
        """sum m x cross v + m (h^2/4) axl(C), with axl_k = C_ji - C_ij (docs/theory.md, 9.2)."""
        d = self.x.shape[1]
        found = []
        for i, j in [(0, 1)] if d == 2 else [(1, 2), (2, 0), (0, 1)]:
            orbital = self.x[:, i] * self.v[:, j] - self.x[:, j] * self.v[:, i]
            found.append(self.mass @ (orbital + h * h / 4 * (self.C[:, j, i] - self.C[:, i, j])))
        return np.array(found)

    def kinetic_energy(self, h: float) -> float:
        """sum m (|v|^2 + (h^2/4) |C|^2) / 2."""
        affine = (self.C**2).sum((1, 2)) * h * h / 4
        return float(self.mass @ ((self.v**2).sum(1) + affine) / 2)


def with_colliders(scene: Scene, colliders: list[dict]) -> Scene:
    """Return a scene with colliders that its checks have not seen."""
    tables = TypeAdapter(tuple[Collider, ...])
    made = tables.validate_python(colliders, context={"dimension": scene.dimension, "constants": {}})
    return scene.model_copy(update={"colliders": made})


def masses_of(snapshot: Snapshot) -> np.ndarray:
    """Return the mass of each particle of a group, (n,) float64, kg."""
    masses = snapshot.group.rows[:, 0].astype(np.float64)
    return masses[np.searchsorted(snapshot.group.bodies, snapshot.body)]


def bodies_of(run: Run) -> dict[str, BodyState]:
    """Return the state of every body by name, in float64, particles in the order of their ids."""
    found = {}
    for group in run.groups:
        snapshot = read_group(group)
        mass = masses_of(snapshot)
        for body in group.bodies:
            rows = np.flatnonzero(snapshot.body == body)
            rows = rows[np.argsort(snapshot.id[rows])]
            arrays = (snapshot.x, snapshot.v, snapshot.C, snapshot.deformation, mass)
            found[run.scene.bodies[body].name] = BodyState(*(a[rows].astype(np.float64) for a in arrays))
    return found

"""Puts the particles of a scene on the device, one group for each law."""

import numpy as np

from mpmcli.boundaries.rough_faces import rough_faces
from mpmcli.errors import InputError
from mpmcli.materials.registry import laws
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.backend import Backend
from mpmcli.solver.forces import needs_initial
from mpmcli.solver.particle_friction import slips_in
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.plan import members_of
from mpmcli.solver.state_bounds import floor_of
from mpmcli.solver.volume_average import averages_volume


def build_groups(scene: Scene, backend: Backend, particles: list[BodyParticles]) -> list[ParticleGroup]:
    """Return a group for each law of a scene, in the order of their names.

    Args:
        particles: one entry per body.

    Raises:
        InputError: a particle is not in the domain.
    """
    require_inside(scene, particles)
    origin = np.array(scene.domain.origin)
    first_ids = np.concatenate([[0], np.cumsum([len(b.position) for b in particles])])
    groups = []
    for name in sorted({body.material.law for body in scene.sources}):
        members = members_of(scene, name)
        law = laws()[name]([scene.sources[i].material for i in members], scene.dimension)
        groups.append(
            ParticleGroup(
                law,
                members,
                [particles[i] for i in members],
                [int(first_ids[i]) for i in members],
                origin,
                serial=backend.on_cpu and backend.threads == 1,
                keeps_initial=needs_initial(scene, members),
                total=scene.solver.solids == "total",
                averaged=averages_volume(scene.solver, law),
                slips=slips_in(scene.solver, rough_faces(scene)),
                comes_and_goes=scene.comes_and_goes,
                floor=floor_of(scene, law, members),
            )
        )
    return groups


def require_inside(scene: Scene, particles: list[BodyParticles]) -> None:
    """Refuse particles beyond the domain, or nowhere: the sort would count them in a tile that does not exist.

    Raises:
        InputError: a particle is not in the domain.
    """
    for sample in particles:
        _require_inside(sample, np.array(scene.domain.origin), np.array(scene.domain.upper))


def _require_inside(sample: BodyParticles, lower: np.ndarray, upper: np.ndarray) -> None:
    inside = ((sample.position >= lower) & (sample.position <= upper)).all(axis=1)
    if not inside.all():
        p = int(np.argmin(inside))
        place, low, high = (", ".join(f"{x:.6g}" for x in point) for point in (sample.position[p], lower, upper))
        raise InputError(
            f'particle {p} of body "{sample.name}" lies at ({place}) m, outside the domain from ({low}) to ({high}) m; '
            "every particle must begin inside it."
        )

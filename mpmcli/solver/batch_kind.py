"""What kinds of runs may share kernels and the device."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from mpmcli.boundaries.collider_kind import ColliderKind
from mpmcli.boundaries.moving_faces import moving_faces
from mpmcli.boundaries.rough_faces import rough_faces
from mpmcli.materials.law import Law
from mpmcli.materials.registry import laws
from mpmcli.scene import BodyParticles, Scene
from mpmcli.scene.schema import SolverSettings
from mpmcli.solver.activity import Comings
from mpmcli.solver.batch_values import Drives
from mpmcli.solver.plan import members_of
from mpmcli.solver.sparse_choice import wants_sparse
from mpmcli.solver.volume_relaxation import needs_filling


@dataclass(frozen=True)
class Kind:
    """What is compiled for a run. Everything else is data, and runs of one kind share kernels and the device.

    Attributes:
        dimension: 2 or 3; precision: "f32" or "f64".
        settings: of the solver.
        faces: words of the walls, per axis; rough, moving: (axis, side) of those with friction, and that move.
        flags: of each law in the order of their names, the name and the terms that it has.
        cells: of the domain per axis; particles, bodies: per law. All three are upper bounds.
        keeps_filling: whether nodes keep the volume scattered to them.
        sparse: whether nodes are there where particles are alone, on the CPU, where such runs share nothing.
        colliders: their forms, and which of them move.
        drives: gravity that varies, forces, and motions of colliders.
        comings: what lets particles come and go.
        members: the laws.
    """

    dimension: int
    precision: str
    settings: SolverSettings
    faces: tuple[tuple[str, str], ...]
    rough: tuple[tuple[int, int], ...]
    moving: tuple[tuple[int, int], ...]
    flags: tuple[tuple, ...]
    cells: tuple[int, ...]
    particles: tuple[int, ...]
    bodies: tuple[int, ...]
    keeps_filling: bool
    sparse: bool
    colliders: ColliderKind
    drives: Drives
    comings: Comings
    members: tuple[Law, ...] = field(compare=False, repr=False)

    @staticmethod
    def of(scene: Scene, particles: Sequence[BodyParticles]) -> "Kind":
        """Return the kind of a scene with these particles, one entry per body."""
        names = sorted({body.material.law for body in scene.sources})
        places = [members_of(scene, name) for name in names]
        members = tuple(
            laws()[name]([scene.sources[i].material for i in own], scene.dimension)
            for name, own in zip(names, places, strict=True)
        )
        return Kind(
            scene.dimension,
            scene.solver.precision,
            scene.solver,
            tuple(tuple(pair) for pair in scene.domain.walls.faces(scene.dimension)),
            rough_faces(scene),
            moving_faces(scene),
            tuple((law.name, law.terms) for law in members),
            tuple(scene.domain.cells),
            tuple(sum(len(particles[i].position) for i in own) for own in places),
            tuple(len(own) for own in places),
            needs_filling(scene, members),
            wants_sparse(scene),
            ColliderKind.of(scene),
            Drives.of(scene, places)[0],
            Comings.of(scene, names),
            members,
        )

    def joined(self, other: "Kind") -> "Kind | None":
        """Return the kind that has room for both, None where they need other kernels."""
        if (self.dimension, self.flags) != (other.dimension, other.flags) or self.sparse != other.sparse:
            return None
        room = {
            name: tuple(map(max, getattr(self, name), getattr(other, name)))
            for name in ("cells", "particles", "bodies")
        }
        room["colliders"] = self.colliders.joined(other.colliders)
        if room["colliders"] is None:
            return None
        cells = max(self.comings.cells, other.comings.cells)
        wide, fits = (replace(one, comings=replace(one.comings, cells=cells), **room) for one in (self, other))
        return wide if fits == wide else None

"""The kind of a run, which determines its compiled kernels."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from mpmcli.boundaries.colliders import ColliderKind
from mpmcli.boundaries.walls import MovingFaces, RoughFaces
from mpmcli.materials.law import Law
from mpmcli.scene import Scene
from mpmcli.scene.schema import SolverSettings
from mpmcli.scene.sheets import Sheets
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.drive.forces import Drives
from mpmcli.solver.grid.sparse_grid import wants_sparse
from mpmcli.solver.machine.costs import in_steps, law_objects, members_of, padded_cells, padded_colliders, power_of_two
from mpmcli.solver.particles.inflow import Inflow
from mpmcli.solver.transfer.kept_motion import keeps_motion
from mpmcli.solver.transfer.redistribution import fine_nodes
from mpmcli.solver.transfer.volume import needs_filling


@dataclass(frozen=True)
class CompiledKind:
    """Compile-time properties of a run. Everything else is data; runs of one kind share kernels and the device.

    Attributes:
        dimension: 2 or 3.
        precision: "f32" or "f64".
        settings: settings of the solver.
        faces: conditions of the walls per axis.
        rough, moving: (axis, side) of walls with friction, and of moving walls.
        flags: name and terms of each law, ordered by name.
        cells: upper bound of the cells of the domain per axis.
        particles, bodies: upper bounds of the numbers of particles and bodies per law.
        keeps_filling: whether nodes store the volume scattered to them.
        fine: fine nodes per cell and axis, or 0.
        keeps_motion: whether bodies keep fractions of their motion, see `kept_motion`.
        sparse: whether the grid is sparse (on the CPU; such runs do not share a batch).
        colliders: shapes of the colliders, and which of them move.
        drives: varying gravity, forces, and motions of colliders.
        inflow: emitters and open faces.
        layers: layers of nodes for bodies with their own velocity fields.
        members: the laws, ordered by name.
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
    fine: int
    keeps_motion: bool
    sparse: bool
    colliders: ColliderKind
    drives: Drives
    inflow: Inflow
    layers: Layers
    members: tuple[Law, ...] = field(compare=False, repr=False)

    @staticmethod
    def of(scene: Scene, layers: Layers, counts: Sequence[int], sheets: Sequence[Sheets]) -> "CompiledKind":
        """Return the kind of a scene with as many particles of each source, and these sheets of each emitter."""
        names = scene.laws
        places = [members_of(scene, name) for name in names]
        members = law_objects(scene)
        return CompiledKind(
            scene.dimension,
            scene.solver.precision,
            scene.solver,
            tuple(tuple(pair) for pair in scene.domain.walls.faces(scene.dimension)),
            RoughFaces.in_scene(scene),
            MovingFaces.in_scene(scene),
            tuple((law.name, law.terms) for law in members),
            tuple(scene.domain.cells),
            # Rigid bodies alone have none, but fields have an entry.
            tuple(max(1, sum(counts[i] for i in own)) for own in places),
            tuple(max(1, len(own)) for own in places),
            needs_filling(scene, members, layers),
            fine_nodes(scene, members),
            keeps_motion(scene, members),
            wants_sparse(scene),
            ColliderKind.of(scene),
            Drives.of(scene, places)[0],
            Inflow.of(scene, names, sheets),
            layers,
            members,
        )

    def padded(self) -> "CompiledKind":
        """Return the kind with padded sizes, so that few sizes occur and compiled kernels are reused."""
        sizes = {"cells": self.inflow.cells, "sheets": self.inflow.sheets}
        return replace(
            self,
            cells=self.cells if self.sparse else padded_cells(self.cells),
            particles=tuple(map(in_steps, self.particles)),
            bodies=tuple(map(power_of_two, self.bodies)),
            colliders=padded_colliders(self.colliders),
            inflow=replace(self.inflow, **{name: power_of_two(size) for name, size in sizes.items() if size}),
        )

    def joined(self, other: "CompiledKind") -> "CompiledKind | None":
        """Return the kind with space for both, or None if they need different kernels."""
        if (self.dimension, self.flags) != (other.dimension, other.flags) or self.sparse != other.sparse:
            return None
        room = {
            name: tuple(map(max, getattr(self, name), getattr(other, name)))
            for name in ("cells", "particles", "bodies")
        }
        room["colliders"] = self.colliders.joined(other.colliders)
        if room["colliders"] is None:
            return None
        both = self.inflow, other.inflow
        wide, fits = (replace(one, inflow=one.inflow.with_room_for(*both), **room) for one in (self, other))
        return wide if fits == wide else None

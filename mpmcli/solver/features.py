"""The features that the runs of a batch have: their one list, in the order in which the engine asks them."""

from collections.abc import Iterator, Sequence
from copy import copy

from mpmcli.boundaries.colliders import ColliderMotion, Colliders
from mpmcli.boundaries.feature import Feature
from mpmcli.boundaries.rigid_bodies import RigidBodies
from mpmcli.boundaries.rigid_contact import RigidContact
from mpmcli.boundaries.walls import MovingFaces, RoughFaces
from mpmcli.solver.contact.body_contact import BodyContact
from mpmcli.solver.contact.collider_points import ColliderPoints
from mpmcli.solver.contact.surfaces import BodySurfaces
from mpmcli.solver.contact.total_solids import ParticleContact
from mpmcli.solver.drive.forces import DriveValues, RigidDrive
from mpmcli.solver.engine.compiled_kind import CompiledKind
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.machine.backend import Backend
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.particles.inflow import Emission, Nozzles
from mpmcli.solver.particles.sort import TileOrder
from mpmcli.solver.transfer.splines import PAD


class Features:
    """The features of the runs of a batch, by name; None for one that their kind lacks.

    Attributes:
        period: the periodic axes, see `Grid`.
        friction, moving: coefficients of friction and velocities of the walls of each run.
        colliders, motion: colliders of each run, and the motion that scenes prescribe.
        rigid, rigid_contact: freely moving rigid bodies, and their contact with other objects than material.
        contact: contact of bodies with their own layers of nodes.
        points: contact with colliders at points of their surfaces.
        repulsion: contact of elastic bodies on the grid of their state at rest.
        emission: mouths of emitters.
    """

    def __init__(
        self,
        kind: CompiledKind,
        backend: Backend,
        runs: int,
        grid: Grid,
        groups: Sequence[ParticleArrays],
        orders: Sequence[TileOrder],
        values: DriveValues,
    ) -> None:
        """Allocate the features of a kind for a number of runs."""
        d, on_cpu, total = kind.dimension, backend.on_cpu, kind.settings.solids == "total"
        self.friction, self.moving = RoughFaces(kind.rough, runs), MovingFaces(kind.moving, d, runs)
        self.period = grid.period
        # Their motion notes its work before the loads are reset.
        self.motion = self.colliders = self.rigid = self.rigid_contact = self.contact = self.points = None
        if kind.colliders.count:
            how = {"on_cpu": on_cpu, "at_rest": total, "deterministic": grid.deterministic}
            self.colliders = Colliders(kind.colliders, d, grid.shape, PAD, runs, **how)
            self.colliders.layered, self.colliders.own = kind.layers.separate, int(not kind.layers.shares)
        if kind.colliders.moving:
            self.motion = ColliderMotion(self.colliders, runs)
        if kind.colliders.free:
            self.rigid = RigidBodies(self.colliders, RigidDrive(d, kind.drives, values.device), runs)
            self.rigid_contact = RigidContact(self.rigid, kind.faces, runs)
        if kind.layers.separate:
            how = {"on_cpu": on_cpu, "couples": bool(kind.colliders.free)}
            self.contact = BodyContact(groups, orders, grid, kind.layers, runs, **how)
        if kind.layers.by_points:
            self.colliders.support = grid.scheme.spline.nodes / 2
            fills = any(law.relaxes for law in kind.members)
            how = {"fills": fills, "sparse": grid.sparse}
            self.points = ColliderPoints(self.colliders, grid.node_count, grid.layers, runs, **how)
        self.repulsion = ParticleContact(grid, groups[0], runs) if total and max(kind.bodies) > 1 else None
        self.emission = Emission(kind.inflow, d, runs) if kind.inflow.groups else None
        laws = [kind.members[g] for g in kind.inflow.groups]
        solids = [e for e, law in enumerate(laws) if law.coherent and law.deformation == "F"]
        self.nozzles = Nozzles(self.emission, solids) if solids else None
        for g, group in enumerate(groups if self.emission else ()):
            group.pour_from(self.emission, tuple(e for e, own in self.emission.members if own == g))

    def __iter__(self) -> Iterator[Feature]:
        return (each for each in vars(self).values() if isinstance(each, Feature))

    @property
    def surfaces(self) -> BodySurfaces | None:
        """The surfaces of bodies with their own layers of nodes, and the nodes that layers use."""
        return self.contact and self.contact.surfaces

    def viewed(self, view: object) -> None:
        """Store the features as kernels of a run see them, as `features` of its `RunView`."""
        view.features = copy(self)
        for name, feature in vars(self).items():
            if isinstance(feature, Feature):
                setattr(view.features, name, feature.viewed(view))

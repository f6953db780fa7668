"""Everything that is compiled for a scene: the sort, the box of nodes in use, and the step."""

import math
from collections.abc import Sequence

from mpmcli.boundaries.build_walls import build_walls
from mpmcli.boundaries.moving_faces import MovingFaces, moving_faces
from mpmcli.boundaries.rough_faces import RoughFaces, rough_faces
from mpmcli.scene import Scene
from mpmcli.solver.activity import open_faces
from mpmcli.solver.backend import Backend
from mpmcli.solver.box import build_box_search
from mpmcli.solver.collider_steps import ColliderSteps
from mpmcli.solver.fixed_point import FixedPoint
from mpmcli.solver.forces import Gravity
from mpmcli.solver.grid import Grid, drift_allowed, node_width, tile_edge
from mpmcli.solver.nodes import NodeUpdate
from mpmcli.solver.ordering import SortBuffers, TileOrder
from mpmcli.solver.particle_contact import DRIFT, contact_between
from mpmcli.solver.particle_update import BEYOND, ParticleUpdate
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.period import Period
from mpmcli.solver.sorting import build_sort
from mpmcli.solver.sparse_choice import require_cpu_if_sparse
from mpmcli.solver.splines import PAD
from mpmcli.solver.step_cpu import build_cpu_step
from mpmcli.solver.step_gpu import build_gpu_step
from mpmcli.solver.transfer_scheme import scheme_of
from mpmcli.solver.volume_average import build_averaging
from mpmcli.solver.volume_relaxation import needs_filling


class Kernels:
    """The kernels of a scene, and the grid and the tables that they work on.

    Attributes:
        grid: the nodes.
        orders: the tile order of each group.
        particles: the update of particles, with the record of lost ones.
        contact: the bins of particles of several bodies at rest on grids of their own, None where there are none.
        colliders: those of the scene, None where there are none.
        drift_allowed: cells that a particle may move until particles are sorted again: without atomics only as far as
            its tile's colour allows.
        average: averages volumes over cells before a frame is read; None where no group does.
        step: (dt, kick, relaxed) -> what it read back, a `StepResult`; None on a GPU. Positions move on by dt, s,
            velocities by kick, s: from the middle of the last step to the middle of this one (docs/theory.md, 7.1).
            Volumes relax over the time `relaxed`, s.
    """

    def __init__(self, scene: Scene, backend: Backend, groups: Sequence[ParticleGroup], gravity: Gravity) -> None:
        require_cpu_if_sparse(scene.solver, backend)
        width = node_width(scene.dimension, on_cpu=backend.on_cpu)
        scheme = scheme_of(scene.solver)
        stencil = scheme.spline.nodes
        faces = scene.domain.walls.faces(scene.dimension)
        friction, moving = RoughFaces(rough_faces(scene)), MovingFaces(moving_faces(scene), scene.dimension)
        period = Period(faces, at_once=not backend.on_cpu)
        for data in (friction, moving, period):
            data.write(scene)
        for group in groups:
            group.repeat(period)
        self.grid = Grid(
            scene.dimension,
            scene.domain.spacing,
            scene.domain.cells,
            width,
            scheme,
            tile=tile_edge(stencil, scene.dimension, on_cpu=backend.on_cpu),
            keeps_filling=needs_filling(scene, [group.law for group in groups]),
            averaged=[group.averaged for group in groups],
            period=period,
            walls_move=len(moving.faces) > 0,
            opens=open_faces(faces),
            deterministic=scene.solver.deterministic and not backend.on_cpu,
        )
        if self.grid.deterministic:
            self.grid.fixed = FixedPoint(self.grid, groups, backend.arch)
        walls, images = build_walls(
            faces,
            scene.solver,
            PAD,
            self.grid.cells,
            self.grid.shape,
            scheme.spline.on_node,
            friction,
            moving,
            on_cpu=backend.on_cpu,
        )
        self.colliders = None
        if scene.colliders:
            self.colliders = ColliderSteps(
                scene, self.grid.shape, PAD, backend.arch, deterministic=self.grid.deterministic
            )
        nodes = NodeUpdate(self.grid, images, [walls], self.colliders and self.colliders.colliders)
        self.contact = contact_between(groups, [len(group.bodies) for group in groups], self.grid, backend)
        self.particles = ParticleUpdate(
            self.grid, faces, len(groups), self.contact, friction, moving, watches_box=not backend.on_cpu
        )
        buffers = SortBuffers(groups)
        self.orders = [TileOrder(g, self.grid, buffers, backend.threads, backend.on_cpu) for g in groups]
        self._sorts = [build_sort(order) for order in self.orders]
        self.drift_allowed = drift_allowed(self.grid.tile, stencil) if backend.on_cpu else float(self.grid.tile)
        if self.contact is not None:
            self.drift_allowed = DRIFT
        if self.grid.opens:
            # What passes an open face is retired before it leaves the grid.
            self.drift_allowed = min(self.drift_allowed, BEYOND)
        self._groups = groups if scene.comes_and_goes else ()
        self._find_box = build_box_search(self.grid, self.orders, math.ceil(self.drift_allowed))
        averages = any(group.averaged for group in groups)
        self.average = build_averaging(self.grid, groups, on_cpu=backend.on_cpu) if averages else None
        if backend.on_cpu:
            self.step = build_cpu_step(self.grid, nodes, self.particles, groups, self.orders, gravity)
        else:
            self.step = build_gpu_step(self.grid, nodes, self.particles, groups, gravity)
        self.forget_beyond()

    def sort(self) -> None:
        """Sort the particles of every group by tile, and find the nodes in use."""
        for sort in self._sorts:
            sort.run()
        for group, order in zip(self._groups, self.orders, strict=False):
            group.set_active(int(order.start[order.tiles]))
        if self.contact is not None:
            self.contact.fill_all(self.particles.grid.spacing)
        self._find_box()

    def forget_beyond(self) -> None:
        """Forget what was beyond sums in fixed point."""
        if self.grid.deterministic:
            self.grid.fixed.forget()

    def share_work(self) -> None:
        """Share the work of a sort among threads anew, after its tables were loaded."""
        for sort in self._sorts:
            sort.share_work()

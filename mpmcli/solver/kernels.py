"""Everything that is compiled for a scene: the sort, the box of nodes in use, and the step."""

import math
from collections.abc import Sequence

from mpmcli.boundaries.mirror_images import MirrorImages
from mpmcli.boundaries.rough_faces import RoughFaces, rough_faces
from mpmcli.boundaries.walls import Walls, faces_on_grid
from mpmcli.boundaries.zeroed_walls import ZeroedWalls
from mpmcli.scene import Scene
from mpmcli.solver.backend import Backend
from mpmcli.solver.box import build_box_search
from mpmcli.solver.forces import Gravity
from mpmcli.solver.grid import Grid, drift_allowed, node_width, tile_edge
from mpmcli.solver.nodes import NodeUpdate
from mpmcli.solver.ordering import SortBuffers, TileOrder
from mpmcli.solver.particle_contact import DRIFT, contact_between
from mpmcli.solver.particle_update import ParticleUpdate
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.sorting import build_sort
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
        drift_allowed: cells that a particle may move until particles are sorted again: without atomics only as far as
            its tile's colour allows.
        average: averages volumes over cells before a frame is read; None where no group does.
        step: (dt, kick, relaxed) -> what it read back, a `StepResult`; None on a GPU. Positions move on by dt, s,
            velocities by kick, s: from the middle of the last step to the middle of this one (docs/theory.md, 7.1).
            Volumes relax over the time `relaxed`, s.
    """

    def __init__(self, scene: Scene, backend: Backend, groups: Sequence[ParticleGroup], gravity: Gravity) -> None:
        width = node_width(scene.dimension, on_cpu=backend.on_cpu)
        scheme = scheme_of(scene.solver)
        stencil = scheme.spline.nodes
        self.grid = Grid(
            scene.dimension,
            scene.domain.spacing,
            scene.domain.cells,
            width,
            scheme,
            tile=tile_edge(stencil, scene.dimension, on_cpu=backend.on_cpu),
            keeps_filling=needs_filling(scene, [group.law for group in groups]),
            averaged=[group.averaged for group in groups],
        )
        faces = scene.domain.walls.faces(scene.dimension)
        friction = RoughFaces(rough_faces(scene))
        friction.write(scene)
        if scene.solver.walls == "zeroed":
            images, walls = None, ZeroedWalls(faces, PAD, self.grid.cells, friction)
        else:
            on_grid = faces_on_grid(faces, scene.solver)
            walls = Walls(on_grid, PAD, self.grid.cells, self.grid.shape, friction=friction)
            images = MirrorImages(walls, scheme.spline.on_node)
        nodes = NodeUpdate(self.grid, images, [walls])
        self.contact = contact_between(groups, [len(group.bodies) for group in groups], self.grid, backend)
        self.particles = ParticleUpdate(
            self.grid, faces, len(groups), self.contact, friction, watches_box=not backend.on_cpu
        )
        buffers = SortBuffers(groups)
        self.orders = [TileOrder(g, self.grid, buffers, backend.threads, backend.on_cpu) for g in groups]
        self._sorts = [build_sort(order) for order in self.orders]
        self.drift_allowed = drift_allowed(self.grid.tile, stencil) if backend.on_cpu else float(self.grid.tile)
        if self.contact is not None:
            self.drift_allowed = DRIFT
        self._find_box = build_box_search(self.grid, self.orders, math.ceil(self.drift_allowed))
        averages = any(group.averaged for group in groups)
        self.average = build_averaging(self.grid, groups, on_cpu=backend.on_cpu) if averages else None
        if backend.on_cpu:
            self.step = build_cpu_step(self.grid, nodes, self.particles, groups, self.orders, gravity)
        else:
            self.step = build_gpu_step(self.grid, nodes, self.particles, groups, gravity)

    def sort(self) -> None:
        """Sort the particles of every group by tile, and find the nodes in use."""
        for sort in self._sorts:
            sort.run()
        if self.contact is not None:
            self.contact.fill_all(self.particles.grid.spacing)
        self._find_box()

    def share_work(self) -> None:
        """Share the work of a sort among threads anew, after its tables were loaded."""
        for sort in self._sorts:
            sort.share_work()

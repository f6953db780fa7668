"""Many small runs in one process: what they share on the device, and what kinds of runs may share it."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import taichi as ti

from mpmcli.boundaries.mirror_images import MirrorImages
from mpmcli.boundaries.walls import Walls
from mpmcli.boundaries.zeroed_walls import ZeroedWalls
from mpmcli.materials.law import Law
from mpmcli.materials.registry import laws
from mpmcli.scene import BodyParticles, Scene
from mpmcli.scene.schema import SolverSettings
from mpmcli.solver.backend import Backend
from mpmcli.solver.batch_device import Device
from mpmcli.solver.batch_gpu import build_gpu_launch
from mpmcli.solver.batch_kernel import build_batch_kernel
from mpmcli.solver.batch_layout import Layout
from mpmcli.solver.batch_values import BatchValues, Drives
from mpmcli.solver.external_forces import push_on
from mpmcli.solver.forces import Gravity
from mpmcli.solver.frame_reader import build_frame_reader
from mpmcli.solver.grid import DRIFT, Grid, node_width
from mpmcli.solver.held_bound import HOLD, RISE
from mpmcli.solver.nodes import NodeUpdate
from mpmcli.solver.observe import build_observation
from mpmcli.solver.ordering import SortBuffers, TileOrder
from mpmcli.solver.particle_arrays import CONSTANTS, ParticleArrays
from mpmcli.solver.particle_update import ParticleUpdate
from mpmcli.solver.plan import members_of
from mpmcli.solver.splines import PAD
from mpmcli.solver.transfer_scheme import scheme_of
from mpmcli.solver.volume_relaxation import needs_filling


@dataclass(frozen=True)
class Kind:
    """What is compiled for a run. Everything else is data, and runs of one kind share kernels and the device.

    Attributes:
        dimension: 2 or 3; precision: "f32" or "f64".
        settings: of the solver.
        faces: words of the walls, per axis.
        flags: of each law in the order of their names, the name and the terms that it has.
        cells: of the domain per axis; particles, bodies: per law. All three are upper bounds.
        keeps_filling: whether nodes keep the volume scattered to them.
        drives: gravity that varies, and forces.
        members: the laws.
    """

    dimension: int
    precision: str
    settings: SolverSettings
    faces: tuple[tuple[str, str], ...]
    flags: tuple[tuple, ...]
    cells: tuple[int, ...]
    particles: tuple[int, ...]
    bodies: tuple[int, ...]
    keeps_filling: bool
    drives: Drives
    members: tuple[Law, ...] = field(compare=False, repr=False)

    @staticmethod
    def of(scene: Scene, particles: Sequence[BodyParticles]) -> "Kind":
        """Return the kind of a scene with these particles, one entry per body."""
        names = sorted({body.material.law for body in scene.bodies})
        places = [members_of(scene, name) for name in names]
        members = tuple(
            laws()[name]([scene.bodies[i].material for i in own], scene.dimension)
            for name, own in zip(names, places, strict=True)
        )
        return Kind(
            scene.dimension,
            scene.solver.precision,
            scene.solver,
            tuple(tuple(pair) for pair in scene.domain.walls.faces(scene.dimension)),
            tuple((law.name, law.terms) for law in members),
            tuple(scene.domain.cells),
            tuple(sum(len(particles[i].position) for i in own) for own in places),
            tuple(len(own) for own in places),
            needs_filling(scene, members),
            Drives.of(scene, places)[0],
            members,
        )

    def joined(self, other: "Kind") -> "Kind | None":
        """Return the kind that has room for both, None where they need other kernels."""
        if (self.dimension, self.flags) != (other.dimension, other.flags):
            return None
        room = {
            name: tuple(map(max, getattr(self, name), getattr(other, name)))
            for name in ("cells", "particles", "bodies")
        }
        wide = replace(self, **room)
        return wide if replace(other, **room) == wide else None


class Batch:
    """Room on the device for some runs of one kind, and the kernels that advance them.

    Attributes:
        kind: what was compiled, with the room for each run.
        runs: number of runs.
        device: all of it.
        layout: columns of `numbers`, (runs, k) float64, and `counts`, (runs, l) int32, which the kernel reads and
            changes.
        values: numbers that expressions read.
        readers: of frames, per law, on the CPU; observations: per law, on a GPU.
        pushes: measurements of the forces on each law, None where there are none.
        seconds: wall time of all launches; first_seconds: of the first, which compiles the kernel.
    """

    def __init__(self, kind: Kind, backend: Backend, runs: int = 1) -> None:
        d = kind.dimension
        self.kind, self.runs, self.backend = kind, runs, backend
        on_cpu = backend.on_cpu
        width = node_width(d, on_cpu=on_cpu)
        grid = Grid(d, 1.0, kind.cells, width, scheme_of(kind.settings), runs, keeps_filling=kind.keeps_filling)
        groups = [
            ParticleArrays(
                law,
                d,
                runs * room,
                (runs * bodies, CONSTANTS + len(law.constants(law.members[0]))),
                width if on_cpu else d,
                ti.Layout.AOS if on_cpu else ti.Layout.SOA,
                several=True,
                serial=on_cpu,
                keeps_initial=forces.initial,
            )
            for law, room, bodies, forces in zip(
                kind.members, kind.particles, kind.bodies, kind.drives.forces, strict=True
            )
        ]
        self.values = BatchValues(kind.drives, runs)
        self.pushes = [
            push_on(group, forces, bodies, self.values.device, backend)
            for group, bodies, forces in zip(groups, kind.bodies, kind.drives.forces, strict=True)
        ]
        images = None
        if kind.settings.walls == "zeroed":
            walls = ZeroedWalls(kind.faces, PAD, grid.cells)
        else:
            walls = Walls(kind.faces, PAD, grid.cells, grid.shape, runs)
            images = MirrorImages(walls)
        orders = []
        if on_cpu:
            buffers = SortBuffers(groups, runs)
            orders = [TileOrder(group, grid, buffers, 1, True, runs) for group in groups]
        self.device = Device(
            runs,
            kind.particles,
            backend.threads,
            grid,
            groups,
            orders,
            walls,
            NodeUpdate(grid, images, [walls]),
            ParticleUpdate(grid, runs * len(groups), watches_box=False),
            self.values,
            Gravity(kind.drives.gravity, [0.0] * d, self.values.device),
        )
        self.layout = Layout(d, [len(law.internal) for law in kind.members])
        self.numbers = np.zeros((runs, self.layout.reals))
        self.counts = np.zeros((runs, self.layout.counts), np.int32)
        constants = {"drift_allowed": DRIFT, "hold": HOLD, "rise": RISE, "slack": 1e-6, "infinity": math.inf}
        for name, value in constants.items():
            self.numbers[:, getattr(self.layout.real, name)] = value
        self.readers = [build_frame_reader(group) for group in groups] if on_cpu else []
        self.observations = [] if on_cpu else [build_observation(group) for group in groups]
        self.seconds = self.first_seconds = 0.0
        build = build_batch_kernel if on_cpu else build_gpu_launch
        self._launch = build(self.device, self.layout)

    def launch(self) -> None:
        """Advance every run until its host has to attend to it, or its budget of steps is spent."""
        began = time.perf_counter()
        self._launch(self.numbers, self.counts)
        self.seconds += time.perf_counter() - began
        self.first_seconds = self.first_seconds or self.seconds

"""Many small runs in one process: what they share on the device, and what kinds of runs may share it."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import taichi as ti

from mpmcli.boundaries.build_walls import build_walls
from mpmcli.boundaries.collider_kind import ColliderKind
from mpmcli.boundaries.collider_motion import ColliderMotion
from mpmcli.boundaries.colliders import Colliders
from mpmcli.boundaries.moving_faces import MovingFaces, moving_faces
from mpmcli.boundaries.rough_faces import RoughFaces, rough_faces
from mpmcli.errors import InputError
from mpmcli.materials.law import Law
from mpmcli.materials.registry import laws
from mpmcli.scene import BodyParticles, Scene
from mpmcli.scene.schema import SolverSettings
from mpmcli.solver.activity import Comings, Emission
from mpmcli.solver.backend import Backend
from mpmcli.solver.batch_device import Device
from mpmcli.solver.batch_gpu import build_gpu_launch
from mpmcli.solver.batch_kernel import build_batch_kernel
from mpmcli.solver.batch_layout import MOST_FRAMES, NOTES, Layout
from mpmcli.solver.batch_values import BatchValues, Drives
from mpmcli.solver.external_forces import push_on
from mpmcli.solver.forces import Gravity
from mpmcli.solver.frame_reader import sum_entries
from mpmcli.solver.grid import Grid, drift_allowed, node_width, tile_edge
from mpmcli.solver.held_bound import HOLD, RISE
from mpmcli.solver.nodes import NodeUpdate
from mpmcli.solver.observe import build_observation
from mpmcli.solver.ordering import SortBuffers, TileOrder
from mpmcli.solver.particle_arrays import CONSTANTS, ParticleArrays
from mpmcli.solver.particle_contact import DRIFT, contact_between
from mpmcli.solver.particle_friction import slips_in
from mpmcli.solver.particle_update import ParticleUpdate
from mpmcli.solver.period import Period
from mpmcli.solver.plan import members_of
from mpmcli.solver.splines import PAD
from mpmcli.solver.transfer_scheme import scheme_of
from mpmcli.solver.volume_average import averages_volume
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
            ColliderKind.of(scene),
            Drives.of(scene, places)[0],
            Comings.of(scene, names),
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
        room["colliders"] = self.colliders.joined(other.colliders)
        if room["colliders"] is None:
            return None
        cells = max(self.comings.cells, other.comings.cells)
        wide, fits = (replace(one, comings=replace(one.comings, cells=cells), **room) for one in (self, other))
        return wide if fits == wide else None


class Batch:
    """Room on the device for some runs of one kind, and the kernels that advance them.

    Attributes:
        kind: what was compiled, with the room for each run.
        runs: number of runs.
        device: all of it.
        layout: columns of `numbers`, (runs, k) float64, and `counts`, (runs, l) int32, which the kernel reads and
            changes.
        shown: what particles show at the frames that the last launch recorded, on the CPU: (rows, k), as many rows for
            each run; notes: on each of these frames, (runs, MOST_FRAMES, NOTES and sums of each law), float64.
        values: numbers that expressions read.
        observations: per law, on a GPU.
        pushes: measurements of the forces on each law, None where there are none.
        share_work: (counts), divides particles among threads anew after they were loaded; on the CPU.
        seconds: wall time of all launches; first_seconds: of the first, which compiles the kernel.
    """

    def __init__(self, kind: Kind, backend: Backend, runs: int = 1) -> None:
        d = kind.dimension
        self.kind, self.runs, self.backend = kind, runs, backend
        on_cpu = backend.on_cpu
        if kind.comings.any and not on_cpu:
            raise InputError("a batch on a GPU knows no emitters and no open faces; run these scenes one by one.")
        if kind.settings.deterministic and not on_cpu:
            raise InputError("a batch on a GPU adds in any order; run deterministic scenes one by one.")
        width = node_width(d, on_cpu=on_cpu)
        scheme = scheme_of(kind.settings)
        stencil = scheme.spline.nodes
        tile = tile_edge(stencil, d, on_cpu=on_cpu)
        averaged = [averages_volume(kind.settings, law) for law in kind.members]
        period = Period(kind.faces, runs, at_once=not on_cpu)
        grid = Grid(
            d,
            1.0,
            kind.cells,
            width,
            scheme,
            runs,
            tile=tile,
            keeps_filling=kind.keeps_filling,
            averaged=averaged,
            period=period,
            walls_move=len(kind.moving) > 0,
            opens=kind.comings.opens,
        )
        groups = [
            ParticleArrays(
                law,
                d,
                runs * room,
                (runs * bodies, CONSTANTS + len(law.constants(law.members[0]))),
                # Forces of a batch select the particles of their body.
                several=runs > 1 or bodies > 1 or bool(forces.terms),
                serial=on_cpu and backend.threads == 1,
                keeps_initial=forces.initial,
                total=kind.settings.solids == "total",
                averaged=shares,
                slips=slips_in(kind.settings, kind.rough),
                comes_and_goes=kind.comings.any,
            )
            for law, shares, room, bodies, forces in zip(
                kind.members, averaged, kind.particles, kind.bodies, kind.drives.forces, strict=True
            )
        ]
        self.values = BatchValues(kind.drives, runs)
        self.pushes = [
            push_on(group, forces, bodies, self.values.device, backend)
            for group, bodies, forces in zip(groups, kind.bodies, kind.drives.forces, strict=True)
        ]
        for group in groups:
            group.repeat(period)
        friction, moving = RoughFaces(kind.rough, runs), MovingFaces(kind.moving, d, runs)
        walls, images = build_walls(
            kind.faces, kind.settings, PAD, grid.cells, grid.shape, scheme.spline.on_node, friction, moving, runs
        )
        orders = []
        if on_cpu:
            buffers = SortBuffers(groups, runs)
            sharing = backend.threads if runs == 1 else 1
            orders = [TileOrder(group, grid, buffers, sharing, True, runs) for group in groups]
        contact = contact_between(groups, kind.bodies, grid, backend, runs)
        colliders = motion = None
        if kind.colliders.count:
            colliders = Colliders(kind.colliders, d, grid.shape, PAD, runs, on_cpu=on_cpu)
            motion = ColliderMotion(colliders, runs) if kind.colliders.moving else None
        self.device = Device(
            runs,
            kind.particles,
            backend.threads,
            grid,
            groups,
            orders,
            walls,
            friction,
            moving,
            NodeUpdate(grid, images, [walls], colliders),
            ParticleUpdate(grid, kind.faces, runs * len(groups), contact, friction, moving, watches_box=False),
            self.values,
            Gravity(kind.drives.gravity, [0.0] * d, self.values.device),
            colliders,
            motion,
            Emission(kind.comings, d, runs) if kind.comings.groups else None,
            ti.field(int, shape=(2 * runs, d)) if on_cpu else None,
        )
        self.layout = Layout(d, [len(law.internal) for law in kind.members], len(kind.comings.groups))
        self.numbers = np.zeros((runs, self.layout.reals))
        self.counts = np.zeros((runs, self.layout.counts), np.int32)
        constants = {"drift_allowed": DRIFT if contact else drift_allowed(tile, stencil)}
        constants |= {"hold": HOLD, "rise": RISE, "slack": 1e-6, "infinity": math.inf}
        for name, value in constants.items():
            self.numbers[:, getattr(self.layout.real, name)] = value
        self.observations = [] if on_cpu else [build_observation(group) for group in groups]
        self.seconds = self.first_seconds = 0.0
        self.shown = self._room = np.zeros((runs, 1), groups[0].real)
        if on_cpu:
            loads = kind.colliders.count * colliders.loads if colliders else 0
            self.notes = np.zeros((runs, MOST_FRAMES, len(NOTES) + len(groups) * sum_entries(d) + loads))
        if on_cpu:
            self._launch, self.share_work = build_batch_kernel(self.device, self.layout)
        else:
            self._launch = build_gpu_launch(self.device, self.layout)

    def make_room(self, rows: int, columns: int) -> None:
        """Let each run have so many rows of `shown` from the next launch on."""
        shape = max(rows * self.runs, len(self._room)), max(columns, self._room.shape[1])
        if shape != self._room.shape:
            self._room = np.empty(shape, self._room.dtype)

    def first_row(self, slot: int) -> int:
        """Return the first row of a run in `shown`."""
        return slot * (len(self.shown) // self.runs)

    def launch(self) -> None:
        """Advance every run until its host has to attend to it, or its budget of steps is spent."""
        began = time.perf_counter()
        if self.backend.on_cpu:
            self.shown = self._room
            self.counts[:, self.layout.count.recorded] = 0
            self.counts[:, self.layout.count.row] = [self.first_row(slot) for slot in range(self.runs)]
            self._launch(self.numbers, self.counts, self.shown, self.notes)
        else:
            self._launch(self.numbers, self.counts)
        self.seconds += time.perf_counter() - began
        self.first_seconds = self.first_seconds or self.seconds

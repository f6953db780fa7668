"""Many small runs in one process: what they share on the device."""

import math
import time
from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np
import taichi as ti

from mpmcli.boundaries.build_walls import build_walls
from mpmcli.boundaries.collider_motion import ColliderMotion
from mpmcli.boundaries.colliders import Colliders
from mpmcli.boundaries.moving_faces import MovingFaces
from mpmcli.boundaries.rough_faces import RoughFaces
from mpmcli.errors import InputError, RunError
from mpmcli.solver.activity import Emission
from mpmcli.solver.backend import Backend
from mpmcli.solver.batch_device import Device
from mpmcli.solver.batch_gpu import build_gpu_launch
from mpmcli.solver.batch_kernel import build_batch_kernel
from mpmcli.solver.batch_kind import Kind
from mpmcli.solver.batch_layout import MOST_FRAMES, NOTES, Layout
from mpmcli.solver.batch_values import BatchValues
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
from mpmcli.solver.sparse_choice import require_cpu_if_sparse
from mpmcli.solver.sparse_grid import BlockOrder, SparseGrid, most_blocks, room_for_blocks
from mpmcli.solver.splines import PAD
from mpmcli.solver.tile_reach import tiles_reached
from mpmcli.solver.transfer_scheme import scheme_of
from mpmcli.solver.volume_average import averages_volume

# Room for blocks of a sparse grid, of those that particles reach, when there are more of them than fit.
GROWTH = 2


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
        require_cpu_if_sparse(kind.settings, backend)
        scheme = scheme_of(kind.settings)
        averaged = [averages_volume(kind.settings, law) for law in kind.members]
        period = Period(kind.faces, runs, at_once=not on_cpu)
        grid = self._make_grid(period, room_for_blocks(sum(kind.particles)))
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
            kind.faces,
            kind.settings,
            PAD,
            grid.cells,
            grid.shape,
            scheme.spline.on_node,
            friction,
            moving,
            runs,
            on_cpu=on_cpu,
        )
        self._buffers = SortBuffers(groups, runs) if on_cpu else None
        orders = self._make_orders(groups, grid) if on_cpu else []
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
        constants = {"drift_allowed": DRIFT if contact else drift_allowed(grid.tile, scheme.spline.nodes)}
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

    def _make_grid(self, period: Period, blocks: int) -> Grid:
        """Return the grid; on a sparse one there is room for so many blocks."""
        kind, on_cpu = self.kind, self.backend.on_cpu
        scheme = scheme_of(kind.settings)
        tile = tile_edge(scheme.spline.nodes, kind.dimension, on_cpu=on_cpu)
        sparse = {"blocks": blocks, "threads": self.backend.threads} if kind.sparse and on_cpu else {}
        return (SparseGrid if sparse else Grid)(
            kind.dimension,
            1.0,
            kind.cells,
            node_width(kind.dimension, on_cpu=on_cpu),
            scheme,
            self.runs,
            tile=tile,
            keeps_filling=kind.keeps_filling,
            averaged=[averages_volume(kind.settings, law) for law in kind.members],
            period=period,
            walls_move=len(kind.moving) > 0,
            opens=kind.comings.opens,
            **sparse,
        )

    def _make_orders(self, groups: Sequence[ParticleArrays], grid: Grid) -> list[TileOrder]:
        """Return the tile order of each group."""
        kind = BlockOrder if grid.sparse else TileOrder
        sharing = self.backend.threads if self.runs == 1 else 1
        return [kind(group, grid, self._buffers, sharing, True, self.runs) for group in groups]

    def occupy(self, first_nodes: np.ndarray) -> None:
        """Let a sparse grid have the nodes that particles reach whose stencils begin at these, (n, d) int."""
        grid = self.device.grid
        tiles = tiles_reached(first_nodes, grid.tile, grid.reach)
        if len(tiles) >= grid.tile_count:
            self.grow(len(tiles) + 1)
        self.device.grid.occupy(tiles)

    def grow(self, blocks: int) -> None:
        """Make room for GROWTH times so many blocks of a sparse grid. Their numbers are lost: a sort must follow.

        What the grid had stays allocated until the backend stops.

        Raises:
            RunError: memory, or 32-bit indices, do not suffice for that.
        """
        device = self.device
        room = most_blocks(device.grid)
        if blocks > room:
            raise RunError(
                f"the material has spread over {blocks:,} blocks of the sparse grid, and there is memory for {room:,}; "
                "a larger domain.spacing needs fewer."
            )
        grid = self._make_grid(device.grid.period, min(GROWTH * blocks, room))
        nodes, particles = copy(device.nodes), copy(device.particles)
        nodes.grid = particles.grid = particles.near = grid
        orders = self._make_orders(device.groups, grid)
        self.device = replace(device, grid=grid, orders=orders, nodes=nodes, particles=particles)
        self._launch, self.share_work = build_batch_kernel(self.device, self.layout)

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

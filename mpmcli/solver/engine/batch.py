"""One or several runs in one process, and their shared data on the device."""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from mpmcli.boundaries.mirror_images import MirrorImages
from mpmcli.boundaries.walls import IMAGE_DEPTH, Walls, faces_on_grid
from mpmcli.errors import RunError
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.total_solids import DRIFT, slips_in
from mpmcli.solver.drive.forces import DriveValues, Gravity, HostValues, push_on
from mpmcli.solver.engine.compiled_kind import CompiledKind
from mpmcli.solver.engine.cpu_launch import CpuLaunch
from mpmcli.solver.engine.device import Device
from mpmcli.solver.engine.gpu_launch import GpuLaunch
from mpmcli.solver.engine.kernel_store import StoredLaunch
from mpmcli.solver.engine.run_state import FRAME_NUMBERS, MOST_FRAMES, Layout, RunState
from mpmcli.solver.engine.step_size import StepSize
from mpmcli.solver.features import Features
from mpmcli.solver.frames.reader import sum_entries
from mpmcli.solver.grid.fine_grid import FineBlocks, FineGrid
from mpmcli.solver.grid.fixed_point import FixedPoint
from mpmcli.solver.grid.grid import Grid, drift_allowed, node_width, tile_edge
from mpmcli.solver.grid.period import Period
from mpmcli.solver.grid.sparse_grid import (
    BlockOrder,
    SparseGrid,
    most_blocks,
    room_for_blocks,
    tiles_reached,
)
from mpmcli.solver.machine.backend import Backend
from mpmcli.solver.particles.arrays import CONSTANTS, ParticleArrays
from mpmcli.solver.particles.sort import CellOrder, SortBuffers, TileOrder
from mpmcli.solver.transfer.node_update import NodeUpdate
from mpmcli.solver.transfer.particle_update import OPEN_MARGIN, ParticleUpdate
from mpmcli.solver.transfer.run_sums import scatters_runs
from mpmcli.solver.transfer.splines import PAD, scheme_of
from mpmcli.solver.transfer.volume import averages_volume, levels_volume

# Factor from the required to the allocated blocks when a sparse grid is enlarged.
GROWTH = 2
# Taichi inlines functions and trees of expressions recursively, with about 20 Python calls per level.
RECURSION = 4000


class Batch:
    """Device data for some runs of one kind, and the kernels that advance them.

    Attributes:
        kind: the compiled kind, with the capacity per run.
        runs: number of runs.
        device: the data on the device.
        layout: columns of `numbers`, (runs, k) float64, and `counts`, (runs, l) int32, see `run_state`.
        frame_buffer: on the CPU, particle data of the frames recorded in the last launch, (rows, k), with an equal
            number of rows per run.
        frame_stats: FRAME_NUMBERS, sums of each law and loads of each of these frames, (runs, MOST_FRAMES, k), float64.
        values: numbers for expressions.
        steps: choice of steps on the host.
        cpu, gpu: launcher of steps on the CPU or on a GPU.
        launch_cpu: the kernel of `cpu`, compiled or stored.
        sort_buffers: scratch memory of the sort; None if nothing is sorted.
        profile: if set to a Counter, the phases of the only run are launched one by one on the CPU, and their wall
            times, s, are added by name.
        pushes: measurement of the forces on each law, None without forces.
        seconds: wall time of all launches, s.
        first_seconds: wall time of the first launch, which compiles the kernel, and on a GPU of the first calls of the
            kernels of a step, s.
    """

    def __init__(self, kind: CompiledKind, backend: Backend, runs: int = 1) -> None:
        """Allocate the fields and features of a kind for a number of runs, and make the launcher of the backend."""
        sys.setrecursionlimit(max(sys.getrecursionlimit(), RECURSION))
        d = kind.dimension
        self.kind, self.runs, self.backend = kind, runs, backend
        on_cpu = backend.on_cpu
        # Many small runs on a GPU fit its cache; they are not sorted and use all nodes of their domains.
        sorts = on_cpu or runs == 1 or kind.inflow.any or kind.layers.separate
        scheme = scheme_of(kind.settings, keeps_flip_velocity=kind.keeps_motion)
        period = Period(kind.faces, runs, at_once=not on_cpu)
        deterministic = kind.settings.deterministic and not on_cpu
        grid = self._make_grid(period, room_for_blocks(sum(kind.particles)), deterministic=deterministic)
        groups = self._make_groups(serial=on_cpu and backend.threads == 1)
        self.values = DriveValues(kind.drives, runs, doubles=backend.doubles)
        self.pushes = [
            push_on(group, forces, bodies, self.values.device, backend)
            for group, bodies, forces in zip(groups, kind.bodies, kind.drives.forces, strict=True)
        ]
        for group in groups:
            group.repeat(period)
        if deterministic:
            grid.fixed = FixedPoint(grid, groups, backend.arch)
        self.sort_buffers = SortBuffers(groups, runs) if sorts else None
        orders = self._make_orders(groups, grid) if sorts else []
        features = Features(kind, backend, runs, grid, groups, orders, self.values)
        friction, moving = features.friction, features.moving
        faces = faces_on_grid(kind.faces, kind.settings)
        walls = Walls(faces, PAD, grid.cells, grid.shape, runs * grid.layers, friction, moving)
        walls.shut = 0 if kind.layers.shares else -IMAGE_DEPTH
        images = MirrorImages(walls, scheme.spline.on_node, on_cpu=on_cpu)
        watched = sorts and not on_cpu
        self.device = Device(
            runs,
            kind.particles,
            backend.threads,
            grid,
            groups,
            orders,
            walls,
            NodeUpdate(grid, images, features.colliders, features.points),
            ParticleUpdate(
                grid, kind.faces, runs * len(groups), features.repulsion, friction, moving, watches_box=watched
            ),
            self.values,
            Gravity(kind.drives.gravity, [0.0] * d, self.values.device),
            features,
            ti.field(int, shape=(2 * runs, d)) if on_cpu else None,
            sorts,
            self._drift_allowed(grid, repels=features.repulsion is not None),
        )
        internal = [len(law.internal) for law in kind.members]
        self.layout = Layout(d, internal, len(kind.inflow.groups), kind.bodies)
        self.numbers = np.zeros((runs, self.layout.widths["numbers"]))
        self.counts = np.zeros((runs, self.layout.widths["counts"]), np.int32)
        self.steps = StepSize.of(self.device, self.layout, HostValues(self.values))
        self.seconds = self.first_seconds = 0.0
        self.profile: Counter | None = None
        self.frame_buffer = self._buffer = np.zeros((runs, 1), groups[0].real)
        if on_cpu:
            noted = len(FRAME_NUMBERS) + len(groups) * sum_entries(d) + sum(one.noted for one in features)
            self.frame_stats = np.zeros((runs, MOST_FRAMES, noted))
            self._build_cpu()
        else:
            self.gpu = GpuLaunch(self.device, self.layout, doubles=backend.doubles)

    def _make_groups(self, *, serial: bool) -> list[ParticleArrays]:
        """Allocate the particles of each law; `serial`: see `ParticleArrays`."""
        kind, runs = self.kind, self.runs
        of_laws = zip(kind.members, kind.particles, kind.bodies, kind.drives.forces, strict=True)
        return [
            ParticleArrays(
                law,
                runs * capacity,
                (runs * bodies, CONSTANTS + len(law.constants(law.members[0]))),
                kind.layers,
                # Forces select the particles of their body.
                many_bodies=runs > 1 or bodies > 1 or bool(forces.terms),
                serial=serial,
                keeps_initial=forces.initial,
                total=kind.settings.solids == "total",
                uses_f_bar=averages_volume(kind.settings, law),
                levels=levels_volume(kind.settings, law),
                has_wall_friction=slips_in(kind.settings, kind.rough),
                particle_count_varies=kind.inflow.any,
            )
            for law, capacity, bodies, forces in of_laws
        ]

    def _drift_allowed(self, grid: Grid, *, repels: bool) -> float:
        """Return the largest drift of particles before a sort, cells."""
        if repels:
            return DRIFT
        if self.backend.on_cpu:
            return drift_allowed(grid.tile, grid.scheme.spline.nodes)
        # The nodes in use include a drift of one tile. One cell is reserved for the last step before a sort; particles
        # beyond an open face are retired before they leave the grid.
        return OPEN_MARGIN - 1 if self.kind.inflow.opens else grid.tile - 1.0

    def _make_grid(self, period: Period, blocks: int, *, deterministic: bool = False) -> Grid:
        """Return the grid; a sparse grid is allocated with `blocks` blocks."""
        kind, on_cpu = self.kind, self.backend.on_cpu
        scheme = scheme_of(kind.settings, keeps_flip_velocity=kind.keeps_motion)
        tile = tile_edge(scheme.spline.nodes, kind.dimension, on_cpu=on_cpu)
        sparse = {"blocks": blocks, "threads": self.backend.threads} if kind.sparse and on_cpu else {}
        grid = (SparseGrid if sparse else Grid)(
            kind.cells,
            node_width(kind.dimension, on_cpu=on_cpu),
            scheme,
            self.runs,
            tile=tile,
            keeps_filling=kind.keeps_filling,
            averages=[averages_volume(kind.settings, law) or levels_volume(kind.settings, law) for law in kind.members],
            period=period,
            faces=kind.faces,
            deterministic=deterministic,
            layers=kind.layers.count,
            **sparse,
        )
        grid.has_solids = kind.layers.by_points and kind.keeps_filling
        if kind.fine:
            grid.fine = (FineBlocks if sparse else FineGrid)(grid, kind.fine)
        return grid

    def _make_orders(self, groups: Sequence[ParticleArrays], grid: Grid) -> list[TileOrder]:
        """Return the tile order of each group."""
        by_cells = scatters_runs(grid) and not self.backend.on_cpu
        kind = BlockOrder if grid.sparse else CellOrder if by_cells else TileOrder
        sharing = self.backend.threads if self.runs == 1 else 1
        return [kind(group, grid, self.sort_buffers, sharing, self.runs) for group in groups]

    def occupy(self, first_nodes: np.ndarray) -> None:
        """Number the tiles of a sparse grid reached by particles, given the first nodes of stencils, (n, d) int."""
        grid = self.device.grid
        tiles = tiles_reached(first_nodes, grid.tile, grid.reach)
        if len(tiles) >= grid.tile_count:
            self.grow(len(tiles) + 1)
        self.device.grid.occupy(tiles)

    def grow(self, blocks: int) -> None:
        """Replace a sparse grid by one with GROWTH times `blocks` blocks; a sort, which numbers them, must follow.

        The old grid stays allocated until the backend stops.
        """
        device = self.device
        most = most_blocks(device.grid)
        if blocks > most:
            raise RunError(
                f"the material has spread over {blocks:,} blocks of the sparse grid, but there is memory for {most:,} "
                "only; use a larger domain.spacing."
            )
        grid = self._make_grid(device.grid.period, min(GROWTH * blocks, most))
        nodes, particles = copy(device.nodes), copy(device.particles)
        nodes.grid = particles.grid = particles.near = grid
        features = copy(device.features)
        if nodes.points is not None:
            features.points = nodes.points = nodes.points.on(grid.node_count)
        orders = self._make_orders(device.groups, grid)
        how = {"grid": grid, "orders": orders, "nodes": nodes, "particles": particles, "features": features}
        self.device = replace(device, **how)
        self._build_cpu()

    def _build_cpu(self) -> None:
        self.cpu = CpuLaunch(self.device, self.layout)
        self.launch_cpu = StoredLaunch(self.cpu, self.kind, self.backend)

    def state(self, slot: int | slice) -> RunState:
        """Return the numbers of one or several runs."""
        return RunState(self.layout, self.numbers, self.counts, slot)

    def reserve(self, rows: int, columns: int) -> None:
        """Allocate `rows` rows of `frame_buffer` per run from the next launch on."""
        shape = max(rows * self.runs, len(self._buffer)), max(columns, self._buffer.shape[1])
        if shape != self._buffer.shape:
            self._buffer = np.empty(shape, self._buffer.dtype)

    def first_row(self, slot: int) -> int:
        """Return the first row of a run in `frame_buffer`."""
        return slot * (len(self.frame_buffer) // self.runs)

    def launch(self) -> None:
        """Advance every run until it needs its host or its budget of steps is used up."""
        began = time.perf_counter()
        if self.backend.on_cpu:
            self.frame_buffer = self._buffer
            every = self.state(slice(None))
            every.recorded, every.row = 0, [self.first_row(slot) for slot in range(self.runs)]
            arrays = self.numbers, self.counts, self.frame_buffer, self.frame_stats
            if self.profile is None:
                self.launch_cpu(*arrays)
            else:
                self.cpu.launch_by_phase(*arrays, self.profile)
        else:
            compiled = self.gpu.compile_seconds
            self.gpu(self.numbers, self.counts)
            self.first_seconds += self.gpu.compile_seconds - compiled
        self.seconds += time.perf_counter() - began
        self.first_seconds = self.first_seconds or self.seconds

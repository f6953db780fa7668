"""The data of a batch on the device, and the view of one run in a kernel."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mpmcli.boundaries.feature import Phase, changed
from mpmcli.boundaries.walls import Walls
from mpmcli.quick_taichi import ti
from mpmcli.solver.drive.forces import DriveValues, Gravity
from mpmcli.solver.engine.run_state import Layout, RunState, StepState
from mpmcli.solver.engine.step import step_phases
from mpmcli.solver.features import Features
from mpmcli.solver.frames.reader import show_of
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.particles.loop import Operation
from mpmcli.solver.particles.sort import TileOrder
from mpmcli.solver.particles.state_bounds import NOTHING
from mpmcli.solver.transfer.node_update import NodeUpdate
from mpmcli.solver.transfer.particle_update import NOT_LOST, ParticleUpdate
from mpmcli.solver.transfer.splines import PAD


@dataclass(frozen=True)
class Device:
    """The data of a batch on the device.

    Attributes:
        runs: number of runs.
        capacity: capacity for particles per run and group.
        threads: number of CPU threads.
        grid: the grid.
        groups, orders: particles and tile order of each law, for all runs.
        walls: the walls.
        nodes, particles: updates of nodes and particles.
        values, gravity: numbers for expressions, and varying gravity.
        features: the features that scenes may have or lack.
        stencils: (2 runs, d) int, per run the smallest and largest first node of a stencil per axis at the last sort;
            None on a GPU.
        sorts: whether particles are sorted; several small runs on a GPU instead use all nodes of their domains.
        drift_allowed: largest drift of particles before a sort, cells.
    """

    runs: int
    capacity: Sequence[int]
    threads: int
    grid: Grid
    groups: Sequence[ParticleArrays]
    orders: Sequence[TileOrder]
    walls: Walls
    nodes: NodeUpdate
    particles: ParticleUpdate
    values: DriveValues
    gravity: Gravity
    features: Features
    stencils: ti.Field | None = None
    sorts: bool = True
    drift_allowed: float = 1.0

    @property
    def particle_count_varies(self) -> bool:
        """Whether particles enter or leave during a run."""
        return self.groups[0].particle_count_varies

    @cached_property
    def shows(self) -> tuple[Operation, ...]:
        """What writes the particles of each law to a frame."""
        return tuple(map(show_of, self.groups))

    @cached_property
    def phases(self) -> tuple[Phase, ...]:
        """The phases of a step."""
        pressed, serial = self.features.surfaces is None or self.features.surfaces.shares, self.stencils is not None
        return step_phases(self.groups, self.nodes, self.particles, self.features, pressed=pressed, serial=serial)


class RunView:
    """View of one run in a kernel: its numbers, and copies of the device data with the values of the run.

    Attributes:
        run, step: numbers of the run and of its step.
        w: index of the run.
        grid, nodes, particles: grid of the run, and updates of its nodes and particles.
        features: the features of the run.
        orders, groups: tile order and particles of each law.
    """

    def __init__(
        self,
        device: Device,
        run: RunState,
        step: StepState,
        h: object,
        inverse: object,
        scale: object,
        box: object,
        last: object,
        extent: object,
    ) -> None:
        """Copy the device data.

        Args:
            device: the device data.
            run, step: numbers of the run and of its step.
            h, inverse, scale: spacing, inverse_spacing and gradient_scale of the `Grid`, variables of the kernel like
                the following.
            box: box of the grid.
            last: node of the upper wall per axis.
            extent: size of the domain, m.
        """
        w, fixed, fine = run.w, device.grid.fixed, device.grid.fine
        self.run, self.step, self.w = run, step, w
        self.grid = changed(
            device.grid,
            fixed=None if fixed is None else changed(fixed, run=w),
            fine=None if fine is None else changed(fine, first_node=w * fine.node_count),
            spacing=h,
            inverse_spacing=inverse,
            gradient_scale=scale,
            box=box,
            first_node=w * (device.grid.layers * device.grid.node_count),
            period=device.grid.period.seen_from(w),
            images=changed(device.grid.images, last=last),
        )
        device.features.viewed(self)
        friction, moving, colliders = self.features.friction, self.features.moving, self.features.colliders
        walls = changed(device.walls, last=last, friction=friction, moving=moving)
        walls.first_plane = w * (device.grid.layers * len(walls.separating))
        walls.first_rough = w * (device.grid.layers * len(walls.rough))
        images, points = changed(device.nodes.images, walls=walls), self.features.points
        self.nodes = changed(device.nodes, grid=self.grid, images=images, colliders=colliders, points=points)
        self.particles = changed(
            device.particles,
            grid=self.grid,
            near=self.grid,
            extent=extent,
            first_lost=w * len(device.groups),
            friction=friction,
            moving=moving,
            run=w,
        )
        self.orders = tuple(
            changed(order, grid=self.grid, extent=extent, first_tile=w * (order.bins + 1)) for order in device.orders
        )
        self.groups = tuple(
            group.seen_from(w) if group.is_pushed or group.repeats else group for group in device.groups
        )


class Work:
    """The work of a thread in a phase, with the view of its run.

    Attributes:
        run, step, grid, nodes, particles, features: see `RunView`.
        order, group: tile order and fields of the group of particles.
        phase: the phase, None outside of a step.
        g: index of the group.
        w: index of the run.
        turn: turn of the phase.
        sums: None, or the `RunSums` of the thread.
    """

    sums = None

    def __init__(self, view: RunView, g: int, phase: Phase | None, turn: object) -> None:
        self.run, self.step, self.w = view.run, view.step, view.w
        self.grid, self.nodes, self.particles, self.features = view.grid, view.nodes, view.particles, view.features
        self.g, self.group, self.order = g, view.groups[g], view.orders[g] if view.orders else None
        self.phase, self.turn = phase, turn

    def in_layer(self, layer: object, own: object) -> "Work":
        """Return the work for a layer of nodes, given its number and its box in use, variables of a kernel."""
        if self.grid.layers == 1:
            return self
        view = copy(self)
        view.grid = self.grid.in_layer(layer, own)
        view.nodes = self.nodes.in_layer(view.grid, layer)
        return view


@ti.data_oriented
class RunPhases:
    """Base of the phases of a batch on any device.

    Attributes:
        values: numbers of the step of each run, see `run_state.STEP`.
        members: (index, group) of each law.
        separates: whether bodies have their own velocity fields.
        touches: whether colliders act at points of their surfaces.
        beginning: the features with work at the begin of a step.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        self.device, self.layout, self.dimension = device, layout, device.grid.dimension
        self.members = tuple(enumerate(device.groups))
        self.separates, self.touches = device.features.surfaces is not None, device.features.points is not None
        self.beginning = tuple(feature for feature in device.features if feature.begins)
        self.values = ti.field(float, shape=(device.runs, layout.widths["step"]))

    def state(self, w: object, numbers: object, counts: object) -> RunState:
        """Return the numbers of a run."""
        return RunState(self.layout, numbers, counts, w)

    def step_of(self, w: object) -> StepState:
        """Return the numbers of the step of a run."""
        return StepState(self.layout, self.values, w)

    def step_on_host(self, values: np.ndarray) -> StepState:
        """Return the numbers of the steps of all runs, stored in `values`."""
        return StepState(self.layout, values, slice(None))

    @ti.func
    def begin_step(self, run: ti.template()):
        """Store the numbers of the chosen step, and move colliders to their positions."""
        (step,) = ti.static((self.step_of(run.w),))
        step.dt = ti.cast(run.dt, float)
        step.kick = ti.cast(run.kick, float)
        step.stable = ti.cast(run.stable, float)
        step.relaxed = ti.cast(run.relaxed, float)
        if ti.static(self.device.values.gravity_varies):
            pulled = self.device.gravity.in_step(step.kick, run.w)
            for a in ti.static(range(self.dimension)):
                step.gravity[a] = pulled[a]
        else:
            for a in ti.static(range(self.dimension)):
                step.gravity[a] = step.kick * ti.cast(run.gravity[a], float)
        self.forget_extremes(step, run.w)
        for feature in ti.static(self.beginning):
            feature.begin_step(self, run, step)

    @ti.func
    def layer_count(self, at: ti.template()):
        """Return the number of layers as a run-time value, so that compilers do not unroll loops over layers."""
        count = 1
        if ti.static(self.separates):
            count = self.device.features.surfaces.count[at.w]
        return count

    @ti.func
    def used_by(self, at: ti.template(), layer: int):
        """Return the box in use of a layer, as in `Grid.box`."""
        own = ti.Matrix.zero(int, 2, self.dimension)
        if ti.static(self.separates):
            own = self.device.features.surfaces.used_by(at.w, layer)
        return own

    @ti.func
    def forget_extremes(self, step: ti.template(), w: int):
        """Reset the largest speed and rates of a step of run w, and its number of points on colliders."""
        step.speed_squared, step.broken = 0.0, 0.0
        if ti.static(self.touches):
            self.device.features.points.count[w] = 0
        for g in ti.static(range(len(self.members))):
            # A law may not have particles yet.
            step.rate[g] = 0.0 if ti.static(self.device.particle_count_varies) else NOTHING
            step.volume_change[g] = 0.0

    @ti.func
    def end_step(self, run: ti.template()):
        """Store the rates of a step; return the largest speed of a node, m/s, or -1 if anything was lost."""
        (step,) = ti.static((self.step_of(run.w),))
        speed = ti.sqrt(step.speed_squared)
        if step.broken > 0.0:
            speed = -1.0
        for g in ti.static(range(len(self.members))):
            # The relaxation contributes to the rate of deformation.
            run.rate[g] = ti.cast(step.volume_change[g], ti.f64) / run.dt + ti.cast(step.rate[g], ti.f64)
            if self.device.particles.lost[run.w * ti.static(len(self.members)) + g] != NOT_LOST:
                speed = -1.0
        return ti.cast(speed, ti.f64)

    @ti.func
    def see(self, run: ti.template()):
        """Return, in a tuple, the view of a run."""
        d = ti.static(self.dimension)
        (step,) = ti.static((self.step_of(run.w),))
        last = ti.Vector.zero(int, d)
        extent = ti.Vector.zero(float, d)
        box = ti.Matrix.zero(int, 2, d)
        for a in ti.static(range(d)):
            last[a] = PAD + run.cells[a]
            extent[a] = step.extent[a]
            for i in ti.static(range(2)):
                box[i, a] = self.device.grid.box[run.w * 2 + i, a]
        h, inverse, scale = step.spacing, step.inverse_spacing, step.gradient_scale
        return ti.static((RunView(self.device, run, step, h, inverse, scale, box, last, extent),))

    @ti.func
    def time_of(self, at: ti.template()):
        """Return the number of the step that the body of a phase takes, s."""
        (time,) = ti.static((getattr(at.step, at.phase.duration),))
        return time

    @ti.func
    def takes_place(self, at: ti.template()):
        """Return whether the step carries out a phase."""
        result = True
        if ti.static(at.phase.relaxes or at.phase.shifts):
            result = at.step.relaxed > 0.0
        return result

    @ti.func
    def gravity_of(self, step: ti.template()):
        """Return the change of velocity by gravity in a step, m/s."""
        result = ti.Vector.zero(float, self.dimension)
        for a in ti.static(range(self.dimension)):
            result[a] = step.gravity[a]
        return result

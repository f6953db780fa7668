"""The data of a batch on the device, and the view of one run in a kernel."""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from mpmcli.boundaries.colliders import ColliderMotion, Colliders
from mpmcli.boundaries.feature import Feature
from mpmcli.boundaries.rigid_bodies import RigidBodies
from mpmcli.boundaries.rigid_contact import RigidContact
from mpmcli.boundaries.walls import MovingFaces, RoughFaces, Walls
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.body_contact import BodyContact
from mpmcli.solver.contact.collider_points import ColliderPoints
from mpmcli.solver.contact.surfaces import Obstacles
from mpmcli.solver.drive.forces import DriveValues, Gravity
from mpmcli.solver.engine.run_state import Layout, RunState, StepState
from mpmcli.solver.engine.step import Phase, step_phases
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.particles.inflow import Emission
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
        friction, moving: coefficients of friction and velocities of the walls of each run.
        nodes, particles: updates of nodes and particles.
        colliders, motion: colliders of each run, and their motion; None if there are none.
        rigid, rigid_contact: freely moving rigid bodies, and their contact with other objects than material; None if
            there are none.
        values, gravity: numbers for expressions, and varying gravity.
        emission: mouths of emitters; None if there are none.
        contact: contact of bodies with their own layers of nodes; None if all share one layer.
        points: contact with colliders at points of their surfaces; None if there is none.
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
    friction: RoughFaces
    moving: MovingFaces
    nodes: NodeUpdate
    particles: ParticleUpdate
    values: DriveValues
    gravity: Gravity
    colliders: Colliders | None = None
    motion: ColliderMotion | None = None
    rigid: RigidBodies | None = None
    rigid_contact: RigidContact | None = None
    emission: Emission | None = None
    contact: BodyContact | None = None
    points: ColliderPoints | None = None
    stencils: ti.Field | None = None
    sorts: bool = True
    drift_allowed: float = 1.0

    @property
    def comes_and_goes(self) -> bool:
        """Whether particles enter or leave during a run."""
        return self.groups[0].comes_and_goes

    @property
    def features(self) -> tuple[Feature, ...]:
        """The features of the scene, in the order in which they are written, and their values stored and named."""
        walls, colliders = (self.friction, self.moving, self.grid.period), (self.colliders, self.motion)
        bodies = self.rigid, self.rigid_contact, self.contact, self.points, self.particles.contact
        return tuple(one for one in (*walls, *colliders, *bodies) if one is not None)

    @property
    def phases(self) -> tuple[Phase, ...]:
        """The phases of a step."""
        return step_phases(self.groups, self.nodes, self.contact, serial=self.stencils is not None)


def _changed(thing: object, **attributes: object) -> object:
    result = copy(thing)
    for name, value in attributes.items():
        setattr(result, name, value)
    return result


class RunView:
    """View of one run in a kernel: its numbers, and copies of the device data with the values of the run.

    Attributes:
        run, step: numbers of the run and of its step.
        w: index of the run.
        grid, nodes, particles: grid of the run, and updates of its nodes and particles.
        points: contact at points of the surfaces of colliders, or None.
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
        self.grid = _changed(
            device.grid,
            fixed=None if fixed is None else _changed(fixed, run=w),
            fine=None if fine is None else _changed(fine, first_node=w * fine.node_count),
            spacing=h,
            inverse_spacing=inverse,
            gradient_scale=scale,
            box=box,
            first_node=w * (device.grid.layers * device.grid.node_count),
            period=device.grid.period.seen_from(w),
        )
        friction = _changed(device.friction, first=w * len(device.friction.faces))
        moving = _changed(device.moving, first=w * len(device.moving.faces))
        walls = _changed(device.walls, last=last, friction=friction, moving=moving)
        walls.first_plane = w * (device.grid.layers * len(walls.separating))
        walls.first_rough = w * (device.grid.layers * len(walls.rough))
        images = _changed(device.nodes.images, walls=walls)
        colliders, rigid, points = device.colliders, device.rigid, device.points
        if colliders is not None:
            colliders = _changed(colliders, run=w, spacing=h)
        if rigid is not None:
            rigid = _changed(rigid, run=w, colliders=colliders)
        if points is not None:
            points = points.seen_from(w, colliders)
        shared = {"colliders": colliders, "rigid": rigid, "points": points}
        self.nodes, self.points = _changed(device.nodes, grid=self.grid, images=images, **shared), points
        self.particles = _changed(
            device.particles,
            grid=self.grid,
            near=self.grid,
            extent=extent,
            last=last,
            first_lost=w * len(device.groups),
            friction=friction,
            moving=moving,
            run=w,
        )
        self.orders = tuple(
            _changed(order, grid=self.grid, extent=extent, first_tile=w * (order.bins + 1)) for order in device.orders
        )
        self.groups = tuple(
            group.seen_from(w) if group.is_pushed or group.repeats else group for group in device.groups
        )


class Work:
    """The work of a thread in a phase, with the view of its run.

    Attributes:
        run, step, grid, nodes, particles, points: see `RunView`.
        order, group: tile order and fields of the group of particles.
        item: function for each node or particle.
        g: index of the group.
        w: index of the run.
        turn: turn of the phase.
    """

    def __init__(self, view: RunView, g: int, item: Callable | None, turn: object) -> None:
        self.run, self.step, self.w = view.run, view.step, view.w
        self.grid, self.nodes, self.particles, self.points = view.grid, view.nodes, view.particles, view.points
        self.g, self.group, self.order = g, view.groups[g], view.orders[g] if view.orders else None
        self.item, self.turn = item, turn

    def in_layer(self, layer: object, own: object) -> "Work":
        """Return the work for a layer of nodes, given its number and its box in use, variables of a kernel."""
        if self.grid.layers == 1:
            return self
        view = copy(self)
        view.grid = self.grid.in_layer(layer, own)
        view.nodes = self.nodes.in_layer(view.grid, layer)
        return view

    def obstacles(self) -> Obstacles:
        """Return the walls and colliders of the run."""
        return Obstacles(self.nodes.images.walls, self.nodes.colliders, self.grid.spacing)


@ti.data_oriented
class RunPhases:
    """Base of the phases of a batch on any device.

    Attributes:
        values: numbers of the step of each run, see `run_state.STEP`.
        members: (index, group) of each law.
        moves, rigid: whether colliders move as prescribed, and whether any moves freely.
        separates: whether bodies have their own velocity fields, see `contact.body_contact`.
        touches: whether colliders act at points of their surfaces.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        self.device, self.layout, self.dimension = device, layout, device.grid.dimension
        self.members = tuple(enumerate(device.groups))
        self.moves, self.rigid = device.motion is not None, device.rigid is not None
        self.separates, self.touches = device.contact is not None, device.points is not None
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
        if ti.static(self.moves):
            self.device.values.set_motions(run.w, self.device.motion, run.time, run.time + run.dt)
            self.device.motion.advance(run.w, run.dt)
        if ti.static(self.rigid):
            self.device.rigid.begin(run.w, run.dt, step.kick, self.gravity_of(step))
        self.forget_extremes(step, run.w)
        if ti.static(self.separates):
            self.find_meetings(run)

    @ti.func
    def find_meetings(self, run: ti.template()):
        """Find where bodies may be in contact in a step, with the current positions of colliders."""
        drift = ti.cast(ti.ceil(run.drift), int)
        (view,) = ti.static(self.see(run))
        (obstacles,) = ti.static((Obstacles(view.nodes.images.walls, view.nodes.colliders, view.grid.spacing),))
        self.device.contact.surfaces.find_box(self.device.grid, obstacles, run.w, drift, view.particles.last)

    @ti.func
    def layer_count(self, at: ti.template()):
        """Return the number of layers as a run-time value, so that compilers do not unroll loops over layers."""
        count = 1
        if ti.static(self.separates):
            count = self.device.contact.surfaces.count[at.w]
        return count

    @ti.func
    def used_by(self, at: ti.template(), layer: int):
        """Return the box in use of a layer, as in `Grid.box`."""
        own = ti.Matrix.zero(int, 2, self.dimension)
        if ti.static(self.separates):
            for i, a in ti.static(ti.ndrange(2, self.dimension)):
                own[i, a] = self.device.contact.surfaces.used[(at.w * ti.static(at.grid.layers) + layer) * 2 + i, a]
        return own

    @ti.func
    def near_bodies(self, at: ti.template()):
        """Return, in a tuple, the view of the grid restricted to the box in which bodies may be in contact."""
        box = ti.Matrix.zero(int, 2, self.dimension)
        for i, a in ti.static(ti.ndrange(2, self.dimension)):
            box[i, a] = self.device.contact.surfaces.box[at.w * 2 + i, a]
        return ti.static((at.grid.within(box),))

    @ti.func
    def forget_extremes(self, step: ti.template(), w: int):
        """Reset the largest speed and rates of a step of run w, and its number of points on colliders."""
        step.speed_squared, step.broken = 0.0, 0.0
        if ti.static(self.touches):
            self.device.points.count[w] = 0
        for g in ti.static(range(len(self.members))):
            # A law may not have particles yet.
            step.rate[g] = 0.0 if ti.static(self.device.comes_and_goes) else NOTHING
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
    def move_rigid(self, at: ti.template(), turn: ti.template()):
        """Transfer momentum from nodes to rigid bodies (turn 0), resolve their contact (1), or move them (2)."""
        if ti.static(turn == 0):
            at.nodes.rigid.take(at.w, at.run.dt)
        if ti.static(turn == 1):
            self.device.rigid_contact.resolve(at.w, at.run.dt, at.particles.extent, at.nodes.colliders)
        if ti.static(turn == 2):
            fastest, finite = at.nodes.rigid.move(at.w, at.run.dt)
            ti.atomic_max(at.step.speed_squared, fastest)
            if not finite:
                at.step.broken = 1.0

    @ti.func
    def gravity_of(self, step: ti.template()):
        """Return the change of velocity by gravity in a step, m/s."""
        result = ti.Vector.zero(float, self.dimension)
        for a in ti.static(range(self.dimension)):
            result[a] = step.gravity[a]
        return result

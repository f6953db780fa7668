"""Runs a scene: device state, time steps, and a frame for each output time."""

import math
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import taichi as ti

from mpmcli.boundaries.mirror_images import MirrorImages
from mpmcli.boundaries.walls import Walls
from mpmcli.boundaries.zeroed_walls import ZeroedWalls
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.backend import Backend
from mpmcli.solver.box import build_box_search
from mpmcli.solver.diagnosis import Diagnosis, UnstableRunError, cause_of, diagnose, first_unsound, rate_of_change
from mpmcli.solver.external_forces import ExternalForces
from mpmcli.solver.forces import needs_initial
from mpmcli.solver.grid import DRIFT, PAD, Grid, node_width
from mpmcli.solver.nodes import NodeUpdate
from mpmcli.solver.observe import build_observation
from mpmcli.solver.ordering import SortBuffers, TileOrder, build_sort
from mpmcli.solver.particle_update import NOT_LOST, ParticleUpdate
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.plan import members_of
from mpmcli.solver.snapshot import STRESSES, Snapshot, build_frame, measure, read_group
from mpmcli.solver.step_control import StepControl
from mpmcli.solver.step_cpu import build_cpu_step
from mpmcli.solver.step_gpu import build_gpu_step
from mpmcli.solver.transfer_scheme import scheme_of
from mpmcli.stability.limits import Limit, force_limit, speed_limit
from mpmcli.stability.transfer_factors import affine_moment

# Largest rounding of a stored position, in cells.
POSITION_ERROR = 1e-3
# Cells that a particle of a GPU run may move in a step beyond what was expected.
UNSEEN = 0.05
# A stable step this much smaller than the first one will not recover: the run stops instead of crawling on.
COLLAPSE = 1e-4


class Solver:
    """A scene on a device.

    Attributes:
        scene: what is computed.
        time: s, in double precision; step_count: steps taken.
        particle_count: number of particles.
        laws: names of the laws, in the order of `Frame.material`.
        first_step_seconds: wall time of the first step, which compiles the kernels; 0 before it.
        courant: largest displacement in the last step, cells: that of the fastest node, which no particle
            exceeds; on a GPU an estimate from the last measurement, gravity and forces.
        frame_seconds: wall time spent so far on building frames and ledger rows.
    """

    def __init__(
        self,
        scene: Scene,
        backend: Backend,
        particles: list[BodyParticles] | None = None,
        *,
        force: bool = False,
    ) -> None:
        """Allocate and fill the device.

        Args:
            particles: one entry per body, in place of the scene's own sampling.
            force: take time.step as it is, above the stable step too.

        Raises:
            InputError: a particle is not in the domain.
        """
        self.scene = scene
        self.backend = backend
        self._forced = force and scene.time.step != "auto"
        self.time = 0.0
        self.step_count = 0
        self.first_step_seconds = 0.0
        self.frame_seconds = 0.0
        self.courant = 0.0
        self.spacing = scene.domain.spacing
        self._origin = np.array(scene.domain.origin)
        # Far from zero single precision cannot tell neighbours apart, though the solver, which counts from the
        # origin of the domain, can.
        farthest = float(np.abs([self._origin, scene.domain.upper]).max())
        coarse = farthest * np.finfo(np.float32).eps > POSITION_ERROR * self.spacing
        self._position_type = np.float64 if coarse or backend.precision == "f64" else np.float32
        self._names = tuple(body.name for body in scene.bodies)

        particles = particles or sample_bodies(scene)
        for sample in particles:
            _require_inside(sample, self._origin, np.array(scene.domain.upper))
        self.particle_count = sum(len(b.position) for b in particles)
        first_ids = np.concatenate([[0], np.cumsum([len(b.position) for b in particles])])
        self.laws = tuple(sorted({body.material.law for body in scene.bodies}))
        width = node_width(scene.dimension, on_cpu=backend.on_cpu)
        layout = ti.Layout.AOS if backend.on_cpu else ti.Layout.SOA
        self.groups = []
        for name in self.laws:
            members = members_of(scene, name)
            materials = [scene.bodies[i].material for i in members]
            self.groups.append(
                ParticleGroup(
                    laws()[name](materials, scene.dimension),
                    members,
                    [particles[i] for i in members],
                    [int(first_ids[i]) for i in members],
                    self._origin,
                    width if backend.on_cpu else scene.dimension,
                    layout,
                    keeps_initial=needs_initial(scene, members),
                )
            )
        self._initial = None
        if "initial_position" in scene.output.fields:
            self._initial = np.concatenate([b.position if b.initial is None else b.initial for b in particles])
        self._external_forces = ExternalForces(scene, self.groups, backend)
        self.grid = Grid(scene.dimension, self.spacing, scene.domain.cells, width, scheme_of(scene.solver))
        faces = scene.domain.walls.faces(scene.dimension)
        if scene.solver.walls == "zeroed":
            images, walls = None, ZeroedWalls(faces, PAD, self.grid.cells)
        else:
            walls = Walls(faces, PAD, self.grid.cells, self.grid.shape)
            images = MirrorImages(walls)
        nodes = NodeUpdate(self.grid, images, [walls])
        self._particle_update = ParticleUpdate(self.grid, len(self.groups), watches_box=not backend.on_cpu)
        buffers = SortBuffers(self.groups)
        orders = [TileOrder(g, self.grid, buffers, backend.threads, backend.on_cpu) for g in self.groups]
        self._sorts = [build_sort(order) for order in orders]
        # Without atomics a particle may drift only as far as its tile's colour allows.
        self._drift_allowed = DRIFT if backend.on_cpu else float(self.grid.tile)
        self._find_box = build_box_search(self.grid, orders, math.ceil(self._drift_allowed))
        parts = (self.grid, nodes, self._particle_update, self.groups)
        gravity = self._external_forces.gravity
        if backend.on_cpu:
            self._advance = build_cpu_step(*parts, orders, gravity)
        else:
            self._advance = build_gpu_step(*parts, gravity)
        self._observe = [build_observation(group) for group in self.groups]
        self.last_step = 0.0
        self._drift = math.inf
        self._step_control = StepControl(scene, self.groups, backend)
        self._speed = self._step_control.speed
        self._external_forces.measure(0.0, 0.0)
        # Once more, with the step that says how far ahead the next measurement is.
        self._external_forces.measure(0.0, self._step_control.longest * self.stable_step()[0])
        self._first_stable_step = self.stable_step()[0]

    def limits(self) -> list[Limit]:
        """Return every bound on the next step: of the speed as it is, of the rest as last measured."""
        return [*self._fast_limits(), *self._step_control.limits()]

    def _fast_limits(self) -> list[Limit]:
        speed = Limit(speed_limit(self.spacing, self._speed, self._external_forces.pull(self.time)), "speed", "")
        return (
            [speed, Limit(force_limit(self._external_forces.slope), "force", "")]
            if self._external_forces.pushes
            else [speed]
        )

    @property
    def nearest_limit(self) -> Limit:
        """The smallest bound on the next step."""
        return min(self._step_control.nearest, *self._fast_limits())

    def stable_step(self) -> tuple[float, Limit]:
        """Return the step to take, safety included, and the bound that sets it."""
        limit = self.nearest_limit
        step = self.scene.time.safety * limit.value
        maximum = self.scene.time.step
        if maximum != "auto" and maximum < step:
            return maximum, Limit(maximum, "maximum", "")
        if self._forced:
            return maximum, Limit(maximum, "forced", "")
        return step, limit

    def step(self, dt: float) -> None:
        """Advance by dt (s).

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """
        began = time.perf_counter()
        if self._drift >= self._drift_allowed:
            for sort in self._sorts:
                sort()
            self._find_box()
            self._drift = 0.0
        # Velocities live in the middle of steps: they move on from that of the last one to that of this one, at the
        # start by half a step. A kick longer than dt / safety^2 might be unstable: kick dt <= (dt / safety)^2.
        kick = min(0.5 * (self.last_step + dt), dt / self.scene.time.safety**2)
        pull = self._external_forces.pull(self.time)
        self._external_forces.begin_step(self.time)
        result = self._advance(dt, kick)
        self.time += dt
        self.last_step = dt
        self.step_count += 1
        if self.step_count == 1:
            self.first_step_seconds = time.perf_counter() - began
        if result is not None:
            if not result.speed >= 0:
                self._stop(dt)
            self._speed = result.speed
        else:
            # Not read back: what is known of it is what pulls from outside.
            self._speed += kick * pull
        self.courant = dt * self._speed / self.spacing
        # Whatever else pushes on a GPU is allowed to double the speed; `advance` flags what went further.
        unseen = 2 * self.courant + UNSEEN if result is None else 0.0
        self._drift += max(self.courant, unseen)
        due = self._step_control.after_step(dt, self.courant, result)
        blind = unseen > 0 and self._drift + unseen >= self._drift_allowed
        if blind:
            self.measure_state(dt)
        elif due:
            self.measure_state(dt, due)

    def measure_state(self, dt: float, due: Sequence[int] | None = None) -> None:
        """Measure the device's state, and the limits with it.

        Args:
            dt: the step last taken, s.
            due: the groups to measure, all of them where None.

        Raises:
            UnstableRunError: a particle is lost.
        """
        # On the CPU every step says so itself.
        if not self.backend.on_cpu and self._particle_update.any_lost():
            self._stop(dt)
        if not self._step_control.measure(due):
            # Crushed or inverted by the last step: the next one would have refused to scatter it.
            self._stop(dt)
        self._external_forces.measure(self.time, self._step_control.longest * dt)
        # Otherwise the fastest node of the last step bounds the speeds of all.
        if self._step_control.fresh:
            self._speed = self._step_control.speed

    @property
    def measure_seconds(self) -> float:
        """Wall time spent so far on measuring the state for the limits."""
        return self._step_control.seconds

    def state_was_replaced(self) -> None:
        """Sort and measure particles whose state was set from outside; none of them counts as lost."""
        self._particle_update.lost.fill(NOT_LOST)
        self._drift = math.inf
        self.measure_state(self.last_step)

    def _stop(self, dt: float) -> None:
        for group, lost in zip(self.groups, self._particle_update.lost.to_numpy(), strict=True):
            snapshot = read_group(group)
            p = int(lost) if lost != NOT_LOST else first_unsound(snapshot)
            if p is not None:
                raise UnstableRunError(
                    self._diagnose(snapshot, p, cause_of(snapshot, p, dt, self.scene.domain.size), dt)
                )
        raise AssertionError("a step reported a lost particle and kept no trace of it")

    def _stop_collapsed(self, step: float) -> None:
        """Name the particle that forces the smallest step: the fastest to move or to deform."""
        snapshots = [read_group(group) for group in self.groups]
        haste = [rate_of_change(snapshot, self.spacing) for snapshot in snapshots]
        worst = max(range(len(snapshots)), key=lambda g: haste[g].max())
        p = int(haste[worst].argmax())
        cause = f"allows a step of only {step:.3g} s, where the run began with {self._first_stable_step:.3g} s"
        raise UnstableRunError(self._diagnose(snapshots[worst], p, cause, step))

    def _diagnose(self, snapshot: Snapshot, p: int, cause: str, dt: float) -> Diagnosis:
        return diagnose(
            snapshot,
            p,
            cause,
            self._names,
            self._origin,
            self.step_count,
            self.time,
            dt,
            self.nearest_limit,
            forced=self._forced and dt > self.nearest_limit.value,
        )

    def frames(self, stop: Callable[[], bool] = lambda: False) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the state as it is and then one frame for each output time to come, with its ledger row.

        The time left to the next frame is split into equal steps, so that frames land on their times.

        Args:
            stop: asked after each step whether to end there.

        Raises:
            UnstableRunError: see `step`.
            KeyboardInterrupt: `stop` said so.
        """
        count = self.scene.time.frames
        yield self.frame(0, [])
        for index in range(1, count + 1):
            target = self.scene.time.end * index / count
            if target <= self.time:
                continue
            taken: list[tuple[float, float, str]] = []
            while True:
                largest, limit = self.stable_step()
                if largest < COLLAPSE * self._first_stable_step:
                    self._stop_collapsed(largest)
                left = target - self.time
                splits = max(1, math.ceil(left / largest - 1e-6))
                dt = left / splits
                self.step(dt)
                taken.append((dt, self.courant, limit.name))
                if splits == 1:
                    break
                if stop():
                    raise KeyboardInterrupt
            self.time = target
            self.measure_state(dt)
            yield self.frame(index, taken)

    def frame(self, index: int, taken: list[tuple[float, float, str]]) -> tuple[Frame, LedgerRow]:
        """Return the state as a frame, and the ledger row for the steps (size, Courant number, limit) taken."""
        began = time.perf_counter()
        snapshots = [read_group(group) for group in self.groups]
        stress = any(name in STRESSES for name in self.scene.output.fields)
        seen = [observe(self.last_step, stress=stress) for observe in self._observe]
        frame = build_frame(
            snapshots,
            seen,
            self.scene.output.fields,
            self._origin,
            self._position_type,
            self._initial,
            index,
            self.time,
            self.step_count,
        )
        gravity, moment = self._external_forces.gravity_at(self.time), affine_moment(self.scene.solver)
        sums = measure(snapshots, seen, gravity, self.spacing, self.last_step, moment)
        smallest = min(taken, default=(0.0, 0.0, ""))
        row = LedgerRow(
            time=self.time,
            steps=len(taken),
            step_min=smallest[0],
            step_max=max(taken, default=(0.0,))[0],
            limit=smallest[2],
            courant_max=max((courant for _, courant, _ in taken), default=0.0),
            **sums,
        )
        self.frame_seconds += time.perf_counter() - began
        return frame, row


def _require_inside(sample: BodyParticles, lower: np.ndarray, upper: np.ndarray) -> None:
    """Refuse particles beyond the domain, or nowhere: the sort would count them in a tile that does not exist."""
    inside = ((sample.position >= lower) & (sample.position <= upper)).all(axis=1)
    if not inside.all():
        p = int(np.argmin(inside))
        place, low, high = (", ".join(f"{x:.6g}" for x in point) for point in (sample.position[p], lower, upper))
        raise InputError(
            f'particle {p} of body "{sample.name}" lies at ({place}) m, outside the domain from ({low}) to ({high}) m; '
            "every particle must begin inside it."
        )

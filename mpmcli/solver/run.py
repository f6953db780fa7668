"""What any run has on the host: its limits, its frames, and how it stops when it becomes unstable."""

import time
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.backend import Backend
from mpmcli.solver.collider_steps import collider_bound
from mpmcli.solver.diagnosis import Diagnosis, UnstableRunError, cause_of, diagnose, first_unsound, rate_of_change
from mpmcli.solver.frame_arrays import FrameArrays
from mpmcli.solver.frame_builder import FrameBuilder, Moment
from mpmcli.solver.observe import Observation
from mpmcli.solver.snapshot import Snapshot, fill, read_group
from mpmcli.solver.state import Progress
from mpmcli.solver.sums import NO_STEPS, StepsTaken, Sums
from mpmcli.stability.limits import Limit, force_limit, speed_limit

# Ratio of the stable step to the first one at which a run stops: steps that small do not recover.
COLLAPSE = 1e-4


class Run:
    """A scene on a device, as the host sees it.

    Attributes:
        scene: what is computed.
        state: all that changes.
        groups: the particles, a group for each law; set by the subclass, as is `state`.
        particle_count: number of particles.
        first_step_seconds: wall time of the first step, which compiles the kernels; 0 before it.
        frame_seconds: wall time spent so far on building frames and ledger rows.
    """

    groups: Sequence
    state: Progress
    # Whether there is a state.
    _begun = True
    # What reads frames of each group on a GPU.
    _observations: Sequence[Callable[..., Observation]]

    def __init__(
        self, scene: Scene, backend: Backend, particles: list[BodyParticles] | None = None, *, force: bool = False
    ) -> None:
        """Sample the bodies.

        Args:
            particles: one entry per body, in place of the scene's own sampling.
            force: take time.step as it is, above the stable step too.
        """
        self.scene = scene
        self.backend = backend
        self._forced = force and scene.time.step != "auto"
        self.first_step_seconds = 0.0
        self.frame_seconds = 0.0
        self.spacing = scene.domain.spacing
        self._origin = np.array(scene.domain.origin)
        self._particles = particles or sample_bodies(scene)
        self.particle_count = sum(len(b.position) for b in self._particles)
        self._collider_bound = collider_bound(scene)

    @property
    def laws(self) -> tuple[str, ...]:
        """Names of the laws, in the order of `Frame.material`."""
        return tuple(group.law.name for group in self.groups)

    def _begin(self) -> None:
        """Take the bounds of time 0."""
        self.state.external_forces.measure(0.0, 0.0)
        # Once more, with the step that says how far ahead the next measurement is.
        self.state.external_forces.measure(0.0, self.state.step_control.longest * self.stable_step()[0])
        self.state.first_stable_step = self.stable_step()[0]

    @property
    def time(self) -> float:
        """Time of the state, s, in double precision."""
        return self.state.time

    @property
    def step_count(self) -> int:
        """Steps taken."""
        return self.state.step_count if self._begun else 0

    @property
    def last_step(self) -> float:
        """Size of the last step, s, 0 before the first."""
        return self.state.last_step

    @property
    def courant(self) -> float:
        """Cells that the fastest node moved in the last step, which no particle exceeds; an estimate on a GPU."""
        return self.state.courant

    def limits(self) -> list[Limit]:
        """Return every bound on the next step: of the speed as it is, of the rest as last measured."""
        return [*self._fast_limits(), *self.state.step_control.limits()]

    def _fast_limits(self) -> list[Limit]:
        forces, state = self.state.external_forces, self.state
        ahead = 0.0
        if not self.scene.domain.steady:
            # The next kick ends in the middle of a step that is no longer than the other bounds allow.
            ahead = min(self.scene.time.safety * state.step_control.nearest.value, self.scene.time.end)
        pull = forces.pull(state.velocity_time, state.time + ahead)
        speed = max(state.speed, self.scene.domain.wall_speed)
        limits = [Limit(speed_limit(self.spacing, speed, pull), "speed", "")]
        if forces.pushes:
            limits.append(Limit(force_limit(forces.slope), "force", ""))
        if self.scene.colliders:
            limits.append(Limit(self._collider_bound, "collider", ""))
        return limits

    @property
    def nearest_limit(self) -> Limit:
        """The smallest bound on the next step."""
        return min(self.state.step_control.nearest, *self._fast_limits())

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

    @property
    def measure_seconds(self) -> float:
        """Wall time spent so far on measuring the state for the limits."""
        return self.state.step_control.seconds if self._begun else 0.0

    def _stop(self, dt: float, lost: Sequence[int | None]) -> None:
        """Stop at a lost particle; if none is known, at the first one that is not sound.

        Args:
            dt: the step that lost it, s; lost: per group, a lost particle in solver order, None where none is known.
        """
        for group, known in zip(self.groups, lost, strict=True):
            snapshot = read_group(group)
            p = first_unsound(snapshot) if known is None else known
            if p is not None:
                cause = cause_of(snapshot, p, dt, self.scene.domain)
                raise UnstableRunError(self._diagnose(snapshot, p, cause, dt))
        raise AssertionError("a step reported a lost particle and kept no trace of it")

    def _stop_collapsed(self, step: float) -> None:
        """Stop at the particle that requires the smallest step: the one that moves or deforms fastest."""
        snapshots = [read_group(group) for group in self.groups]
        rates = [rate_of_change(snapshot, self.spacing) for snapshot in snapshots]
        worst = max(range(len(snapshots)), key=lambda g: rates[g].max())
        p = int(rates[worst].argmax())
        cause = f"allows a step of only {step:.3g} s, where the run began with {self.state.first_stable_step:.3g} s"
        raise UnstableRunError(self._diagnose(snapshots[worst], p, cause, step))

    def _diagnose(self, snapshot: Snapshot, p: int, cause: str, dt: float) -> Diagnosis:
        forced = self._forced and dt > self.nearest_limit.value
        return diagnose(
            snapshot, p, cause, self.scene, self.step_count, self.time, dt, self.nearest_limit, forced=forced
        )

    def frame(self, index: int = 0, taken: StepsTaken = NO_STEPS) -> tuple[Frame, LedgerRow]:
        """Return the state as a frame, and the ledger row for the steps taken.

        Raises:
            UnstableRunError: a particle is inverted or not finite.
        """
        began = time.perf_counter()
        columns = self._builder.columns
        arrays = FrameArrays(columns, np.empty((1, self.particle_count, columns.count), self.groups[0].real))
        sums = self._read(arrays) if self.backend.on_cpu else self._observe(arrays)
        moment = Moment(index, self.time, self.step_count, self.last_step, taken, self._loads(), self._blocked)
        (built,) = self._builder.build([moment], arrays, sums)
        self.frame_seconds += time.perf_counter() - began
        return built

    @property
    def _blocked(self) -> int:
        """Particles of emitters that found no room so far."""
        raise NotImplementedError

    @cached_property
    def _builder(self) -> FrameBuilder:
        return FrameBuilder(self.scene, self._particles, self.groups)

    def _forget_particles(self) -> None:
        """Give back the memory of the particles at the start, which are on the device; frames keep what they show."""
        _ = self._builder
        self._particles = []

    def _read(self, arrays: FrameArrays) -> list[Sums]:
        """Fill all rows of a frame on the CPU; return the sums of each group.

        Raises:
            UnstableRunError: see `frame`.
        """
        raise NotImplementedError

    def _loads(self) -> np.ndarray | None:
        """Return what colliders have taken since the last frame, (colliders, k); None where there are none."""
        raise NotImplementedError

    def _observe(self, arrays: FrameArrays) -> list[Sums]:
        """Fill all rows of a frame with numpy, as on a GPU; return the sums of each group."""
        snapshots = [read_group(group) for group in self.groups]
        stress = arrays.columns.first["tau"] >= 0
        seen = [
            observation(self.last_step, group.first, group.count, stress=stress, stored=(s.deformation, s.internal))
            for observation, group, s in zip(self._observations, self.groups, snapshots, strict=True)
        ]
        return fill(arrays, snapshots, seen, by_id=self.scene.solver.deterministic)

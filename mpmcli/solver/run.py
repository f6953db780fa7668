"""What any run has on the host: its limits, its frames, and how it stops when it becomes unstable."""

import time
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.backend import Backend
from mpmcli.solver.diagnosis import Diagnosis, UnstableRunError, cause_of, diagnose, first_unsound, rate_of_change
from mpmcli.solver.frame_arrays import FrameArrays, ParticleConstants
from mpmcli.solver.observe import Observation
from mpmcli.solver.snapshot import Snapshot, fill, read_group
from mpmcli.solver.state import Progress
from mpmcli.solver.sums import Sums, ledger_row, ledger_sums
from mpmcli.solver.volume_error import volume_error
from mpmcli.stability.limits import Limit, force_limit, speed_limit
from mpmcli.stability.transfer_factors import affine_moment

# Largest rounding of a stored position, in cells.
POSITION_ERROR = 1e-3
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
    # What reads frames of each group: on the CPU, and on a GPU.
    _readers: Sequence[Callable[..., Sums]]
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
        # Far from zero single precision cannot tell neighbours apart, though the solver, which counts from the
        # origin of the domain, can.
        farthest = float(np.abs([self._origin, scene.domain.upper]).max())
        coarse = farthest * np.finfo(np.float32).eps > POSITION_ERROR * self.spacing
        self._position_type = np.float64 if coarse or backend.precision == "f64" else np.float32
        self._particles = particles or sample_bodies(scene)
        self.particle_count = sum(len(b.position) for b in self._particles)
        self._initial = None
        if "initial_position" in scene.output.fields:
            initial = [b.position if b.initial is None else b.initial for b in self._particles]
            self._initial = np.concatenate(initial)

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
        return self.state.step_count

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
        limits = [Limit(speed_limit(self.spacing, state.speed, pull), "speed", "")]
        if forces.pushes:
            limits.append(Limit(force_limit(forces.slope), "force", ""))
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
        return self.state.step_control.seconds

    def _stop(self, dt: float, lost: Sequence[int | None]) -> None:
        """Stop at a lost particle; if none is known, at the first one that is not sound.

        Args:
            dt: the step that lost it, s; lost: per group, a lost particle in solver order, None where none is known.
        """
        for group, known in zip(self.groups, lost, strict=True):
            snapshot = read_group(group)
            p = first_unsound(snapshot) if known is None else known
            if p is not None:
                cause = cause_of(snapshot, p, dt, self.scene.domain.size)
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

    def frame(self, index: int, taken: list[tuple[float, float, str]]) -> tuple[Frame, LedgerRow]:
        """Return the state as a frame, and the ledger row for the steps (size, Courant number, limit) taken."""
        began = time.perf_counter()
        names = [name for name in self.scene.output.fields if name not in ("velocity", "initial_position")]
        internal = max(len(group.law.internal) for group in self.groups)
        arrays = FrameArrays(self.particle_count, self.scene.dimension, internal, self.groups[0].real, names)
        if self.backend.on_cpu:
            sums = [self._read(g, arrays) for g in range(len(self.groups))]
        else:
            sums = self._observe(arrays)
        particles = self._constants
        ratios = particles.volume_ratios(arrays)
        gravity, moment = self.state.external_forces.gravity_at(self.time), affine_moment(self.scene.solver)
        fields = particles.fields(arrays, ratios, names)
        if self._initial is not None:
            fields["initial_position"] = self._initial.astype(self._position_type)
        frame = Frame(
            index=index,
            time=self.time,
            step=self.step_count,
            position=(arrays["x"] + self._origin).astype(self._position_type),
            velocity=np.ascontiguousarray(arrays["v"]),
            body=particles.body,
            material=particles.material,
            fields={name: fields[name] for name in self.scene.output.fields if name != "velocity"},
        )
        conserved = ledger_sums(sums, ratios, gravity, self.spacing, self.last_step, moment)
        cells = self.scene.domain.cells
        conserved["volume_error"] = volume_error(
            arrays["x"], ratios * particles.volume, particles.flows, self.spacing, cells
        )
        row = ledger_row(conserved, self.time, taken)
        self.frame_seconds += time.perf_counter() - began
        return frame, row

    @cached_property
    def _constants(self) -> ParticleConstants:
        return ParticleConstants.of(self.groups, [len(b.position) for b in self._particles])

    def _observe(self, arrays: FrameArrays) -> list[Sums]:
        """Fill all rows of a frame with numpy, as on a GPU; return the sums of each group."""
        snapshots = [read_group(group) for group in self.groups]
        stress = arrays.first["tau"] >= 0
        seen = [
            observation(self.last_step, group.first, group.count, stress=stress, stored=(s.deformation, s.internal))
            for observation, group, s in zip(self._observations, self.groups, snapshots, strict=True)
        ]
        return fill(arrays, snapshots, seen)

    def _read(self, g: int, arrays: FrameArrays) -> Sums:
        """Fill the rows of the g-th group on the CPU; see `build_frame_reader`."""
        group = self.groups[g]
        return self._readers[g](self.last_step, group.first, group.count, arrays)

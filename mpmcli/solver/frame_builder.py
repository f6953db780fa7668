"""Builds frames and rows of the ledger from what a device has shown."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mpmcli.frames.frame import STATUS, Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.frame_arrays import FrameArrays, FrameColumns, ParticleConstants
from mpmcli.solver.ordering import ACTIVE, RETIRED, WAITING
from mpmcli.solver.sums import StepsTaken, Sums, ledger_rows, ledger_sums
from mpmcli.solver.volume_error import volume_errors
from mpmcli.stability.transfer_factors import affine_moment

# Largest rounding of a stored position, in cells.
POSITION_ERROR = 1e-3


class Moment(NamedTuple):
    """When a frame is, and what happened since the one before.

    Attributes:
        index: its number; time: s; step: steps so far; last_step: the last of them, s.
        taken: the steps since the frame before.
        loads: impulses, N s, and angular impulses, N m s, that colliders took since then, (colliders, k), or None.
        blocked: particles of emitters that found no room so far.
    """

    index: int
    time: float
    step: int
    last_step: float
    taken: StepsTaken
    loads: np.ndarray | None = None
    blocked: int = 0


class FrameBuilder:
    """Builds the frames of a run.

    Attributes:
        columns: that the frames need.
        before: time of the last frame, s.
    """

    def __init__(self, scene: Scene, particles: Sequence[BodyParticles], groups: Sequence) -> None:
        """Keep what never changes.

        Args:
            groups: the particles of each law, see `ParticleConstants.of`.
        """
        self._scene = scene
        self._constants = ParticleConstants.of(groups, [len(b.position) for b in particles])
        self._names = [name for name in scene.output.fields if name not in ("velocity", "initial_position")]
        internal = max(len(group.law.internal) for group in groups)
        self.columns = FrameColumns(scene.dimension, internal, self._names, comes_and_goes=scene.comes_and_goes)
        self._waits = np.repeat([b.waits for b in particles], [len(b.position) for b in particles])
        self._origin = np.array(scene.domain.origin)
        # Far from zero single precision cannot tell neighbours apart, though the solver, which counts from the
        # origin of the domain, can.
        farthest = float(np.abs([self._origin, scene.domain.upper]).max())
        coarse = farthest * np.finfo(np.float32).eps > POSITION_ERROR * scene.domain.spacing
        self._position_type = np.float64 if coarse or groups[0].real == np.float64 else np.float32
        self.before = 0.0
        self._initial = None
        if "initial_position" in scene.output.fields:
            initial = [b.position if b.initial is None else b.initial for b in particles]
            self._initial = np.concatenate(initial).astype(self._position_type)

    def build(
        self, moments: Sequence[Moment], arrays: FrameArrays, sums: Sequence[Sums]
    ) -> list[tuple[Frame, LedgerRow]]:
        """Return frames with their rows.

        Args:
            moments: T of them; arrays: of the particles at each; sums: of each law at each.
        """
        scene, constants = self._scene, self._constants
        ratios = constants.volume_ratios(arrays)
        fields = constants.fields(arrays, ratios, self._names)
        if self._initial is not None:
            fields["initial_position"] = np.broadcast_to(self._initial, arrays["x"].shape)
        position = (arrays["x"] + self._origin).astype(self._position_type)
        velocity = np.ascontiguousarray(arrays["v"])
        status = arrays["activity"].astype(np.int8) if scene.comes_and_goes else None
        frames = [
            Frame(
                index=moment.index,
                time=moment.time,
                step=moment.step,
                position=position[t],
                velocity=velocity[t],
                body=constants.body,
                material=constants.material,
                fields={name: fields[name][t] for name in scene.output.fields if name != "velocity"}
                | ({} if status is None else {STATUS: status[t]}),
            )
            for t, moment in enumerate(moments)
        ]
        if scene.output.drop_retired:
            frames = [frame.of_present for frame in frames]
        gravity = np.array([scene.domain.gravity_at(moment.time) for moment in moments])
        last_steps = np.array([moment.last_step for moment in moments])
        spacing = scene.domain.spacing
        conserved = ledger_sums(sums, ratios, gravity, spacing, last_steps, affine_moment(scene.solver))
        if status is None:
            conserved["volume_error"] = volume_errors(
                arrays["x"],
                ratios * constants.volume,
                constants.flows,
                spacing,
                scene.domain.cells,
                scene.domain.periodic,
            )
        else:
            conserved |= self._of_active(moments, arrays["x"], ratios, status)
        if scene.colliders:
            conserved["collider_force"], conserved["collider_torque"] = self._collider_loads(moments)
        times, taken = [moment.time for moment in moments], [moment.taken for moment in moments]
        return list(zip(frames, ledger_rows(conserved, times, taken), strict=True))

    def _collider_loads(self, moments: Sequence[Moment]) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean force, N, and torque, N m, on each collider since the frame before, (T, colliders, k)."""
        d = self._scene.dimension
        found = []
        for moment in moments:
            duration, self.before = moment.time - self.before, moment.time
            found.append(moment.loads / duration if duration > 0 else np.zeros_like(moment.loads))
        loads = np.array(found)
        return loads[..., :d], loads[..., d:]

    def _of_active(
        self, moments: Sequence[Moment], x: np.ndarray, ratios: np.ndarray, status: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Return the entries of the ledger that count only particles that take part, and those on the others, (T,).

        Args:
            x: (T, n, d), m; ratios, status: (T, n).
        """
        constants, scene = self._constants, self._scene
        extent = np.array(scene.domain.size)
        names = ("volume_error", "volume_ratio_min", "volume_ratio_max")
        found: dict[str, list] = {name: [] for name in (*names, "emitted", "emitted_mass", "retired", "retired_mass")}
        for place, J, state in zip(x, ratios, status, strict=True):
            active = state == ACTIVE
            # Beyond an open face there are no cells to look at.
            seen = active & ((place >= 0) & (place <= extent)).all(axis=1)
            found["volume_error"] += volume_errors(
                place[None, seen],
                (J * constants.volume)[None, seen],
                constants.flows[seen],
                scene.domain.spacing,
                scene.domain.cells,
                scene.domain.periodic,
            ).tolist()
            found["volume_ratio_min"].append(J[active].min(initial=np.inf) if active.any() else 1.0)
            found["volume_ratio_max"].append(J[active].max(initial=0.0) if active.any() else 1.0)
            for name, own in (("emitted", self._waits & (state != WAITING)), ("retired", state == RETIRED)):
                found[name].append(int(own.sum()))
                found[f"{name}_mass"].append(float(constants.mass[own].sum()))
        found["blocked"] = [moment.blocked for moment in moments]
        return {name: np.array(values) for name, values in found.items()}

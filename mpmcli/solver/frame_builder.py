"""Builds frames and rows of the ledger from what a device has shown."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.frame_arrays import FrameArrays, FrameColumns, ParticleConstants
from mpmcli.solver.sums import StepsTaken, Sums, ledger_rows, ledger_sums
from mpmcli.solver.volume_error import volume_errors
from mpmcli.stability.transfer_factors import affine_moment

# Largest rounding of a stored position, in cells.
POSITION_ERROR = 1e-3


class Moment(NamedTuple):
    """When a frame is: its number, time, s, steps so far, the last of them, s, and those since the frame before."""

    index: int
    time: float
    step: int
    last_step: float
    taken: StepsTaken


class FrameBuilder:
    """Builds the frames of a run.

    Attributes:
        columns: that the frames need.
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
        self.columns = FrameColumns(scene.dimension, internal, self._names)
        self._origin = np.array(scene.domain.origin)
        # Far from zero single precision cannot tell neighbours apart, though the solver, which counts from the
        # origin of the domain, can.
        farthest = float(np.abs([self._origin, scene.domain.upper]).max())
        coarse = farthest * np.finfo(np.float32).eps > POSITION_ERROR * scene.domain.spacing
        self._position_type = np.float64 if coarse or groups[0].real == np.float64 else np.float32
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
        frames = [
            Frame(
                index=moment.index,
                time=moment.time,
                step=moment.step,
                position=position[t],
                velocity=velocity[t],
                body=constants.body,
                material=constants.material,
                fields={name: fields[name][t] for name in scene.output.fields if name != "velocity"},
            )
            for t, moment in enumerate(moments)
        ]
        gravity = np.array([scene.domain.gravity_at(moment.time) for moment in moments])
        last_steps = np.array([moment.last_step for moment in moments])
        spacing = scene.domain.spacing
        conserved = ledger_sums(sums, ratios, gravity, spacing, last_steps, affine_moment(scene.solver))
        conserved["volume_error"] = volume_errors(
            arrays["x"], ratios * constants.volume, constants.flows, spacing, scene.domain.cells
        )
        times, taken = [moment.time for moment in moments], [moment.taken for moment in moments]
        return list(zip(frames, ledger_rows(conserved, times, taken), strict=True))

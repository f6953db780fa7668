"""Checks the motion between two frames: largest displacement, and conservation of momentum away from walls."""

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_ledger import MARGIN
from mpmcli.check.result_state import LOWER_SAFETY, TOUCHED, FrameCheck, extent
from mpmcli.check.scene_limits import deformation_rate
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.stability.limits import DEFORMATION

# On a GPU the Courant number is estimated between measurements, during which an impact may double the speed.
GPU_FACTOR = 2.0


class MotionCheck(FrameCheck):
    """Checks displacements: `largest_ratio` over what the ledger allows, `deformation` in a step, None if unknown."""

    _before: tuple[int, Frame] | None = None
    largest_ratio = 0.0
    deformation: float | None = None

    def check(self, number: int, frame: Frame, row: LedgerRow, sound: np.ndarray | None) -> None:
        """Compare a frame with the one before; `row` is of the steps between, `sound` (n,) of finite values or None."""
        last, before = self._before or (None, frame)
        self._before = (number, frame)
        if "affine" in frame.fields and sound is None and len(frame.position) > 0:
            self._deformation(number, frame, row)
        allowed, n = _reach(self._header, row, frame), len(frame.position)
        if allowed is None or last != number - 1 or len(before.position) != n or n == 0:
            return
        moved = self._header.way(before.position, frame.position)
        squares = np.einsum("ij,ij->i", moved, moved)
        squares = np.where(np.isfinite(squares), squares, 0.0) if sound is not None else squares
        p = int(np.argmax(squares))
        farthest = float(np.sqrt(float(squares[p])))
        ratio = farthest / allowed if allowed > 0 else (np.inf if farthest > 0 else 0.0)
        self.largest_ratio = max(self.largest_ratio, ratio)
        if ratio > 1:
            body = self._body(frame, p)
            what = (
                f'Up to frame {number} particle {p} of body "{body}" moved by {farthest:.4g} m since the one before, '
                f"where {row.steps} steps at a Courant number of {row.courant_max:.3g} reach {allowed:.4g} m"
            )
            self._findings.add("error", "teleported", number, what, TOUCHED, value=ratio, body=body)

    def _deformation(self, number: int, frame: Frame, row: LedgerRow) -> None:
        """Compare the deformation in a step with the bound on the step (docs/theory.md, 6.4)."""
        n, d = frame.position.shape
        C = frame.fields["affine"].reshape(n, d, d)
        rate = deformation_rate(C, keeps_J=False)
        for label, law in enumerate(self._header.laws):
            if law.deformation == "J":
                of_law = frame.material == label
                rate[of_law] = deformation_rate(C[of_law], keeps_J=True)
        p = int(np.argmax(rate))
        deformation = float(rate[p]) * row.step_max
        self.deformation = max(self.deformation or 0.0, deformation)
        if deformation > DEFORMATION * MARGIN:
            severity = "error" if deformation > 1 else "warning"
            body = self._body(frame, p)
            deforms = f"deforms by {deformation:.3g} in a step, {DEFORMATION:g} is safe"
            what = f'In frame {number} particle {p} of body "{body}" {deforms}'
            self._findings.add(severity, "deformation", number, what, LOWER_SAFETY, value=deformation, body=body)


def _reach(header: RunHeader, row: LedgerRow, frame: Frame) -> float | None:
    """Return the largest displacement in a row's steps, m, with shifts and rounding; None: not known."""
    if header.spacing is None or not np.isfinite(row.courant_max):
        return None
    factor = GPU_FACTOR if header.on_gpu else 1.0
    rounding = row.steps * header.step_error + 2 * header.place_error(frame.position.dtype)
    shifts = header.shifts and any(law.name in laws() and laws()[law.name].shifts for law in header.laws)
    shifted = header.shifted(row.steps, frame.step) if shifts else 0.0
    # What an emitter lets in begins where it would be, had it entered when it was due: up to a step before.
    steps = row.steps + bool(row.emitted)
    return factor * steps * row.courant_max * header.spacing * (1 + 1e-3) + shifted + rounding


class MomentumCheck(FrameCheck):
    """Compares the momentum of the ledger with P0 + M g (t - dt/2) while no wall can have acted.

    What colliders took counts as there; velocities are those in the middle of the last step. Along an axis momentum is
    conserved while no particle is near a wall normal to it or one with "stick"; angular momentum without gravity, far
    from all walls, if the transfer conserves it (docs/theory.md, 9.2). `drift` is relative to sqrt(2 M E_kin), a bound
    on sum m |v|; `frames` were compared.
    """

    # A particle acts on nodes up to 1.5 cells away, and the first plane of nodes of a wall is the wall itself.
    MARGIN = 2.0

    drift: float | None = None
    frames = 0

    def __init__(self, header: RunHeader, findings: FrameFindings, first: LedgerRow) -> None:
        super().__init__(header, findings)
        self._first, self._time = first, first.time
        self._steps, self._kinetic = 0, 0.0
        self._colliders = len(header.collider_names)
        known = header.origin is not None and header.gravity is not None and header.sticking is not None
        self._free = np.full(header.dimension, known and not header.driven)
        self._taken = np.zeros(header.dimension)
        # Of the particles from the walls normal to each axis, in the frame before.
        self._distance = np.zeros(header.dimension)

    def check(self, number: int, frame: Frame, row: LedgerRow) -> None:
        """Check the row of a frame; frames must come in order, without gaps."""
        header = self._header
        if not self._free.any() or len(frame.position) == 0:
            return
        if len(row.collider_force) != self._colliders:
            self.lost()
            return
        self._kinetic = max(self._kinetic, row.kinetic)
        self._steps += row.steps
        self._taken += np.sum(row.collider_force, axis=0) * (row.time - self._time)
        self._time = row.time
        if number > 0:
            allowed = _reach(header, row, frame)
            far = np.inf if allowed is None else self.MARGIN * header.spacing + allowed
            touching = ~(self._distance > far)
            self._free &= ~touching
            # A wall with "stick" acts along its tangents too.
            if (touching & np.array(header.sticking)).any():
                self.lost()
        lowest, highest = extent(frame.position)
        self._distance = np.minimum(lowest - header.origin, header.upper - highest)
        self._distance[header.periodic] = np.inf
        if number > 0 and self._free.any():
            self._compare(number, row)

    def lost(self) -> None:
        """Compare no further frames: one could not be read, or is not finite."""
        self._free[:] = False

    def _compare(self, number: int, row: LedgerRow) -> None:
        header, first = self._header, self._first
        scale = float(np.sqrt(2 * row.mass * self._kinetic))
        if scale == 0 or not np.isfinite(scale):
            return
        middle = row.time - (row.step_min + row.step_max) / 4
        expected = np.array(first.linear_momentum) + row.mass * header.gravity * (middle - first.time)
        unknown = row.mass * np.abs(header.gravity) * (row.step_max - row.step_min) / 4
        difference = (np.abs(np.array(row.linear_momentum) + self._taken - expected) - unknown)[self._free].max()
        angular = 0.0
        spins_on = header.keeps_spin and not (header.gravity.any() or self._colliders or header.periodic.any())
        if spins_on and self._free.all():
            turned = np.abs(np.array(row.angular_momentum) - np.array(first.angular_momentum)).max()
            angular = float(turned) / float(np.linalg.norm(header.upper - header.origin))
        drift = float(max(difference, angular, 0.0)) / scale
        self.frames += 1
        self.drift = max(self.drift or 0.0, drift)
        # Rounding may have the same sign in every step.
        if drift > 1e-3 + self._steps * header.epsilon:
            what = (
                f"By frame {number} momentum has drifted by {drift:.3g} of what moves, though no wall was near and "
                f"nothing but gravity{' and colliders' if self._colliders else ''} acted"
            )
            fix = 'Run it with solver.precision = "f64" to see whether it is rounding.'
            self._findings.add("warning", "momentum", number, what, fix, value=drift)

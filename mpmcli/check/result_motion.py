"""Checks the motion between two frames: largest displacement, and conservation of momentum away from walls."""

from dataclasses import dataclass

import numpy as np

from mpmcli.check.deformation import deformation_rate
from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_ledger import LOWER_SAFETY, MARGIN
from mpmcli.check.result_state import TOUCHED, extent
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader
from mpmcli.stability.limits import DEFORMATION

# On a GPU the Courant number is estimated between measurements, during which an impact may double the speed.
GPU_FACTOR = 2.0
# Allowed deviation of a displacement from that of the neighbours: cells, and share of the largest possible
# displacement. The largest deviation in the scenes in configs is 1.2 cells, where 67 were possible.
OUTLIER_CELLS, OUTLIER_PART = 1.0, 0.2
NEIGHBOURS = 3
CANDIDATES = 8


@dataclass(frozen=True)
class _Moment:
    number: int
    frame: Frame


class MotionCheck:
    """Checks the displacements of frames, in order.

    Attributes:
        largest_ratio: largest displacement between two frames over the largest that the ledger allows.
        deformation: largest deformation in a step, from the velocity gradients; None if they are not stored.
    """

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        self._header = header
        self._findings = findings
        self._before: _Moment | None = None
        self.largest_ratio = 0.0
        self.deformation: float | None = None

    def check(self, number: int, frame: Frame, row: LedgerRow, sound: np.ndarray | None) -> None:
        """Compare a frame with the previous one, if that is known.

        Args:
            number: number of the frame.
            frame: the frame.
            row: row of the ledger for the steps between the two.
            sound: which particles have finite values, (n,) bool; None for all.
        """
        before, self._before = self._before, _Moment(number, frame)
        if "affine" in frame.fields and sound is None and len(frame.position) > 0:
            self._deformation(number, frame, row)
        if before is None or before.number + 1 != number or len(before.frame.position) != len(frame.position):
            return
        if len(frame.position) == 0:
            return
        moved = self._header.way(before.frame.position, frame.position)
        squares = np.einsum("ij,ij->i", moved, moved)
        squares = np.where(np.isfinite(squares), squares, 0.0) if sound is not None else squares
        allowed = reach(self._header, row, frame.position.dtype)
        p = int(np.argmax(squares))
        farthest = float(np.sqrt(float(squares[p])))
        if farthest == 0.0:
            self._repeated(number, frame, before.frame, row)
        if allowed is None:
            return
        ratio = farthest / allowed if allowed > 0 else (np.inf if farthest > 0 else 0.0)
        self.largest_ratio = max(self.largest_ratio, ratio)
        if ratio > 1:
            body = self._header.body_name(int(frame.body[p]))
            what = (
                f'Up to frame {number} particle {p} of body "{body}" moved by {farthest:.4g} m since the one before, '
                f"where {row.steps} steps at a Courant number of {row.courant_max:.3g} reach {allowed:.4g} m"
            )
            self._findings.add("error", "teleported", number, what, TOUCHED, value=ratio, body=body)
        elif sound is None:
            self._outlier(number, frame, before.frame, row.time - before.frame.time, allowed)

    def passed(self, number: int, frame: Frame, ratio: float) -> None:
        """Note a frame that was looked at with others (`frame_screen`), and its displacement over the reach."""
        self._before = _Moment(number, frame)
        self.largest_ratio = max(self.largest_ratio, ratio)

    def forget(self) -> None:
        """Forget the previous frame, because a frame could not be read."""
        self._before = None

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
            body = self._header.body_name(int(frame.body[p]))
            what = (
                f'In frame {number} particle {p} of body "{body}" deforms by {deformation:.3g} in a step, '
                f"{DEFORMATION:g} is safe"
            )
            self._findings.add(severity, "deformation", number, what, LOWER_SAFETY, value=deformation, body=body)

    def _repeated(self, number: int, frame: Frame, before: Frame, row: LedgerRow) -> None:
        """Find a frame that is identical to the previous one although particles move."""
        speed = float(np.abs(frame.velocity).max())
        far = speed * (row.time - before.time) > 1e3 * self._header.place_error(frame.position.dtype)
        if far and np.array_equal(frame.velocity, before.velocity):
            what = f"Frame {number} repeats frame {number - 1}, although particles move at {speed:.4g} m/s"
            self._findings.add("error", "repeated-frame", number, what, TOUCHED, value=speed)

    def _outlier(self, number: int, frame: Frame, before: Frame, time: float, allowed: float) -> None:
        """Find a particle whose displacement agrees neither with its velocities nor with its neighbours.

        After a single change of velocity x1 - x0 differs from t (v0 + v1)/2 by at most t |v1 - v0|/2. Bodies that
        bounce several times between two frames differ by more, but so do all of their particles.
        """
        h = self._header.spacing
        if h is None:
            return
        own = self._header.way(before.position, frame.position) - 0.5 * time * (before.velocity + frame.velocity)
        threshold = outlier_threshold(h, allowed)
        squares = np.einsum("ij,ij->i", own, own)
        if squares.max() <= threshold**2:
            return
        change = frame.velocity - before.velocity
        excess = np.sqrt(squares)
        excess -= 0.5 * time * np.sqrt(np.einsum("ij,ij->i", change, change))
        candidates = np.flatnonzero(excess > threshold)
        for p in candidates[np.argsort(excess[candidates])[::-1][:CANDIDATES]].tolist():
            near = np.flatnonzero((np.abs(before.position - before.position[p]) < h).all(1))
            near = near[near != p]
            if len(near) < NEIGHBOURS:
                continue
            # The median is not affected by a second displaced particle nearby.
            apart = float(np.linalg.norm(own[p] - np.median(own[near], axis=0)))
            apart -= 0.5 * time * float(np.linalg.norm(change[p] - np.median(change[near], axis=0)))
            if apart > threshold:
                body = self._header.body_name(int(frame.body[p]))
                what = (
                    f'Up to frame {number} particle {p} of body "{body}" moved since the one before by '
                    f"{apart / h:.3g} cells more than its velocities and its neighbours account for"
                )
                self._findings.add("warning", "displaced", number, what, TOUCHED, value=apart / h, body=body)
                return


def outlier_threshold(spacing: float, allowed: float | np.ndarray) -> float | np.ndarray:
    """Return how far a displacement may be from that of the velocities, m; `allowed` is the largest displacement, m."""
    return OUTLIER_CELLS * spacing + OUTLIER_PART * allowed


def reach(header: RunHeader, row: LedgerRow, stored: np.dtype) -> float | None:
    """Return the largest possible displacement since the previous frame, m: steps times Courant number times h.

    Each step rounds the position, and so does the file, whose type of positions is `stored`. None if the ledger or
    the header lacks a number.
    """
    if header.spacing is None or not np.isfinite(row.courant_max):
        return None
    factor = GPU_FACTOR if header.on_gpu else 1.0
    rounding = row.steps * header.step_error + 2 * header.place_error(stored)
    return factor * row.steps * row.courant_max * header.spacing * (1 + 1e-3) + rounding


class MomentumCheck:
    """Compares the momentum of the ledger with P0 + M g (t - dt/2) while no wall can have acted.

    What colliders took, of which the ledger tells, counts as still there.

    Velocities are those in the middle of the last step, whose length is between the smallest and the largest.
    The momentum along an axis is conserved while no particle is near a wall normal to the axis or a wall with
    "stick". The angular momentum is conserved without gravity and far from all walls, if the transfer conserves it
    (docs/theory.md, 9.2) and the domain does not repeat.

    Attributes:
        drift: largest difference, relative to sqrt(2 M E_kin), a bound on sum m |v|; None if never compared.
        frames: number of frames compared along at least one axis.
    """

    # A particle acts on nodes up to 1.5 cells away, and the first plane of nodes of a wall is the wall itself.
    MARGIN = 2.0

    def __init__(self, header: RunHeader, findings: FrameFindings, first: LedgerRow) -> None:
        self._header = header
        self._findings = findings
        self._first = first
        self._steps = 0
        self._kinetic = 0.0
        self._free = np.ones(header.dimension, bool)
        self._taken = np.zeros(header.dimension)
        self._time = first.time
        self._distance: np.ndarray | None = None
        self.drift: float | None = None
        self.frames = 0

    def check(
        self, number: int, frame: Frame, row: LedgerRow, corners: tuple[np.ndarray, np.ndarray] | None = None
    ) -> None:
        """Check the row of a frame; frames must come in order, without gaps. `corners` are those of `extent`."""
        header = self._header
        known = header.origin is not None and header.gravity is not None and header.sticking is not None
        if not known or header.driven or not self._free.any() or len(frame.position) == 0:
            return
        self._kinetic = max(self._kinetic, row.kinetic)
        self._steps += row.steps
        if header.collider_names and len(row.collider_force) != len(header.collider_names):
            self.lost()
            return
        self._taken += np.sum(row.collider_force, axis=0) * (row.time - self._time)
        self._time = row.time
        allowed = reach(header, row, frame.position.dtype)
        if number > 0:
            near = self.MARGIN * header.spacing
            gone = self._distance is None or allowed is None
            touching = np.ones(header.dimension, bool) if gone else ~(self._distance > near + allowed)
            self._free &= ~touching
            # A wall with "stick" acts along its tangents too.
            if (touching & np.array(header.sticking)).any():
                self._free[:] = False
        lowest, highest = corners or extent(frame.position)
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
        middle = row.time - (row.step_min + row.step_max) / 4
        expected = np.array(first.linear_momentum) + row.mass * header.gravity * (middle - first.time)
        unknown = row.mass * np.abs(header.gravity) * (row.step_max - row.step_min) / 4
        difference = (np.abs(np.array(row.linear_momentum) + self._taken - expected) - unknown)[self._free].max()
        angular = 0.0
        spins_on = header.keeps_spin and not (header.gravity.any() or header.collider_names or header.periodic.any())
        if spins_on and self._free.all():
            turned = np.abs(np.array(row.angular_momentum) - np.array(first.angular_momentum)).max()
            angular = float(turned) / float(np.linalg.norm(header.upper - header.origin))
        if scale == 0 or not np.isfinite(scale):
            return
        drift = float(max(difference, angular, 0.0)) / scale
        self.frames += 1
        self.drift = max(self.drift or 0.0, drift)
        # Rounding may have the same sign in every step.
        if drift > 1e-3 + self._steps * header.epsilon:
            what = (
                f"By frame {number} momentum has drifted by {drift:.3g} of what moves, though no wall was near and "
                f"nothing but gravity{' and colliders' if self._header.collider_names else ''} acted"
            )
            fix = 'Run it with solver.precision = "f64" to see whether it is rounding.'
            self._findings.add("warning", "momentum", number, what, fix, value=drift)

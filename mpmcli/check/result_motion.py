"""Checks the motion between two frames: largest displacement, and conservation of momentum away from walls.

The checks of a frame of a thousand particles take longer than its steps do. So the frames of a run in memory are looked
at together first (`screen`), and those in which nothing can be found are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_entries import KeptEntry
from mpmcli.check.result_ledger import LOWER_SAFETY, MARGIN
from mpmcli.check.result_state import BLOWN_UP, CRUSHED, TOUCHED, FrameCheck, extent
from mpmcli.check.scene_limits import deformation_rate
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.stability.limits import DEFORMATION

# On a GPU the Courant number is estimated between measurements, during which an impact may double the speed.
GPU_FACTOR = 2.0
# Allowed deviation of a displacement from that of the neighbours: cells, and share of the largest possible
# displacement. The largest deviation in the scenes in configs is 1.2 cells, where 67 were possible.
OUTLIER_CELLS, OUTLIER_PART = 1.0, 0.2
NEIGHBOURS = 3
CANDIDATES = 8
# Numbers of an array that are screened at once.
AT_ONCE = 2**18
# Room for the rounding of what single frames compute otherwise.
ROUNDING = 1e-4
# Fields with checks of their own.
CHECKED = ("affine", "mass", "volume_ratio")


class MotionCheck(FrameCheck):
    """Checks displacements: `largest_ratio` over what the ledger allows, `deformation` in a step, None if unknown."""

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        super().__init__(header, findings)
        self._before: tuple[int, Frame] | None = None
        self.largest_ratio = 0.0
        self.deformation: float | None = None

    def check(self, number: int, frame: Frame, row: LedgerRow, sound: np.ndarray | None) -> None:
        """Compare a frame with the one before; `row` is of the steps between, `sound` (n,) of finite values or None."""
        last, before = self._before or (None, frame)
        self._before = (number, frame)
        if "affine" in frame.fields and sound is None and len(frame.position) > 0:
            self._deformation(number, frame, row)
        if last != number - 1 or len(before.position) != len(frame.position) or len(frame.position) == 0:
            return
        moved = self._header.way(before.position, frame.position)
        squares = np.einsum("ij,ij->i", moved, moved)
        squares = np.where(np.isfinite(squares), squares, 0.0) if sound is not None else squares
        allowed = _reach(self._header, row, frame)
        p = int(np.argmax(squares))
        farthest = float(np.sqrt(float(squares[p])))
        if farthest == 0.0:
            self._repeated(number, frame, before, row)
        if allowed is None:
            return
        ratio = farthest / allowed if allowed > 0 else (np.inf if farthest > 0 else 0.0)
        self.largest_ratio = max(self.largest_ratio, ratio)
        if ratio > 1:
            body = self._body(frame, p)
            what = (
                f'Up to frame {number} particle {p} of body "{body}" moved by {farthest:.4g} m since the one before, '
                f"where {row.steps} steps at a Courant number of {row.courant_max:.3g} reach {allowed:.4g} m"
            )
            self._findings.add("error", "teleported", number, what, TOUCHED, value=ratio, body=body)
        elif sound is None:
            self._outlier(number, frame, before, row.time - before.time, allowed)

    def passed(self, number: int, frame: Frame, ratio: float) -> None:
        """Note a frame that was screened with others, and its displacement over the largest allowed."""
        self._before = (number, frame)
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
            body = self._body(frame, p)
            deforms = f"deforms by {deformation:.3g} in a step, {DEFORMATION:g} is safe"
            what = f'In frame {number} particle {p} of body "{body}" {deforms}'
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
        stray = self._header.way(before.position, frame.position) - 0.5 * time * (before.velocity + frame.velocity)
        threshold = _outlier_threshold(h, allowed)
        squares = np.einsum("ij,ij->i", stray, stray)
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
            apart = float(np.linalg.norm(stray[p] - np.median(stray[near], axis=0)))
            apart -= 0.5 * time * float(np.linalg.norm(change[p] - np.median(change[near], axis=0)))
            if apart > threshold:
                body = self._body(frame, p)
                what = (
                    f'Up to frame {number} particle {p} of body "{body}" moved since the one before by '
                    f"{apart / h:.3g} cells more than its velocities and its neighbours account for"
                )
                self._findings.add("warning", "displaced", number, what, TOUCHED, value=apart / h, body=body)
                return


def _outlier_threshold(spacing: float, allowed: float | np.ndarray) -> float | np.ndarray:
    """Return how far a displacement may be from that of the velocities, m; `allowed` is the largest displacement, m."""
    return OUTLIER_CELLS * spacing + OUTLIER_PART * allowed


def _reach(header: RunHeader, row: LedgerRow, frame: Frame) -> float | None:
    """Return the largest displacement in a row's steps, m, with shifts and rounding; None: not known."""
    if header.spacing is None or not np.isfinite(row.courant_max):
        return None
    factor = GPU_FACTOR if header.on_gpu else 1.0
    rounding = row.steps * header.step_error + 2 * header.place_error(frame.position.dtype)
    known, shifted = laws(), 0.0
    if any(law.name in known and known[law.name].shifts for law in header.laws):
        shifted = header.shifted(row.steps, frame.step)
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

    def __init__(self, header: RunHeader, findings: FrameFindings, first: LedgerRow) -> None:
        super().__init__(header, findings)
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
        allowed = _reach(header, row, frame)
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
                f"nothing but gravity{' and colliders' if header.collider_names else ''} acted"
            )
            fix = 'Run it with solver.precision = "f64" to see whether it is rounding.'
            self._findings.add("warning", "momentum", number, what, fix, value=drift)


@dataclass(frozen=True)
class Screened:
    """What was seen of T frames."""

    # Whether no check of the values of a frame, or of the motion up to it, finds anything, (T,) bool.
    quiet: np.ndarray
    # The largest displacement over the largest that the ledger allows, (T,); 0 where a frame is not quiet.
    ratio: np.ndarray
    # Corners of the particles, (T, d), m.
    lowest: np.ndarray
    highest: np.ndarray


def screen(header: RunHeader, entries: Sequence[KeptEntry]) -> Screened | None:
    """Look at all frames of a run; None where they are not alike, particles come and go, or a field is of CHECKED."""
    frames = [entry.frame for entry in entries]
    counts = {len(frame.position) for frame in frames}
    bounded = header.origin is not None and header.spacing is not None and not any(header.open_axes)
    known = bounded and not header.comes_and_goes and not header.drops
    if not known or len(counts) != 1 or 0 in counts or not set(CHECKED).isdisjoint(frames[0].fields):
        return None
    T, d = len(frames), header.dimension
    screened = Screened(np.zeros(T, bool), np.zeros(T), np.empty((T, d)), np.empty((T, d)))
    step = max(1, AT_ONCE // (counts.pop() * d))
    with np.errstate(invalid="ignore", over="ignore"):
        for first in range(0, T, step):
            part = slice(first, min(first + step, T))
            _screen(header, entries[max(0, first - 1) : part.stop], part, screened)
    return screened


def _screen(header: RunHeader, entries: Sequence[KeptEntry], part: slice, screened: Screened) -> None:
    """Look at some frames; the first of `entries` is the one before them, unless they begin with frame 0."""
    frames, rows = [entry.frame for entry in entries], [entry.row for entry in entries]
    new = slice(1 if part.start else 0, None)
    x, v = (np.stack([getattr(frame, name) for frame in frames]) for name in ("position", "velocity"))
    columns = np.ascontiguousarray(x[new].transpose(0, 2, 1))
    lowest, highest = columns.min(axis=2), columns.max(axis=2)
    # Written so that a NaN is not quiet.
    quiet = (lowest > header.origin).all(axis=1) & (highest < header.upper).all(axis=1)
    quiet &= np.isfinite(v[new]).all(axis=(1, 2))
    for name in frames[0].fields:
        values = np.stack([frame.fields[name] for frame in frames[new]])
        if values.dtype.kind == "f":
            quiet &= np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    J = np.array([(row.volume_ratio_min, row.volume_ratio_max) for row in rows[new]])
    quiet &= (J[:, 0] > CRUSHED * (1 + ROUNDING)) & (J[:, 1] < BLOWN_UP * (1 - ROUNDING))
    follows = np.array([b.number == a.number + 1 for a, b in pairwise(entries)], bool)
    allowed = np.array([_reach(header, row, frame) or 0.0 for frame, row in zip(frames[1:], rows[1:], strict=True)])
    moved = header.way(x[:-1], x[1:])
    farthest = np.sqrt(np.einsum("tij,tij->ti", moved, moved).max(axis=1, initial=0.0))
    times = np.array([row.time for row in rows])
    moved -= (0.5 * np.diff(times)).astype(x.dtype)[:, None, None] * (v[:-1] + v[1:])
    stray = np.sqrt(np.einsum("tij,tij->ti", moved, moved).max(axis=1, initial=0.0))
    follows &= (farthest > 0) & (farthest < allowed * (1 - ROUNDING))
    follows &= stray < _outlier_threshold(header.spacing, allowed) * (1 - ROUNDING)
    ratio = np.divide(farthest, allowed, out=np.zeros(len(allowed)), where=follows)
    if not part.start:
        # Nothing is before the first frame.
        follows, ratio = np.append(False, follows), np.append(0.0, ratio)
    screened.lowest[part], screened.highest[part] = lowest, highest
    screened.quiet[part] = quiet & follows
    screened.ratio[part] = np.where(screened.quiet[part], ratio, 0.0)

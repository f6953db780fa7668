"""Agreement of ledger and frames: sums over the stored particles must equal those of the ledger."""

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_state import TOUCHED
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader

# Relative tolerance for quantities stored in single precision.
SINGLE = 1e-5
# Relative tolerance for sums in double precision over the numbers that the ledger sums.
DOUBLE = 1e-9


class AgreementCheck:
    """Compares frames with the ledger, in order; particle masses come from the frames or from the scene.

    Attributes:
        largest: largest relative difference found.
    """

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        self._header = header
        self._findings = findings
        self._masses: np.ndarray | None = None
        self._body: np.ndarray | None = None
        self.largest = 0.0

    def check(self, number: int, frame: Frame, row: LedgerRow, J: np.ndarray | None, steps: int | None) -> None:
        """Check a frame whose values are finite.

        Args:
            J: volume ratio of each particle, (n,), or None if it is not stored.
            steps: number of steps since the previous frame, from the frames; None if that frame is not known.
        """
        if len(frame.position) == 0:
            return
        if steps is not None and steps != row.steps:
            self._differs(number, "steps", steps, row.steps, 1.0)
        present = frame.present
        speed = float(np.sqrt(np.einsum("ij,ij->i", frame.velocity, frame.velocity).max()))
        if present is not None and J is not None:
            J = J[present] if present.any() else np.ones(1)
        self._compare(number, "speed_max", speed, row.speed_max, SINGLE * max(speed, row.speed_max))
        if J is not None and np.isfinite(J).all():
            for name, found in (("volume_ratio_min", float(J.min())), ("volume_ratio_max", float(J.max()))):
                self._compare(number, name, found, getattr(row, name), SINGLE * abs(found))
        self._sums(number, frame, row)

    def _sums(self, number: int, frame: Frame, row: LedgerRow) -> None:
        m = self._masses_of(frame)
        if m is None:
            return
        if frame.present is not None:
            m = m * frame.present
        total = float(m.sum())
        off = abs(total - row.mass) / row.mass if row.mass > 0 else 1.0
        if "mass" in frame.fields:
            self._compare(number, "mass", total, row.mass, SINGLE * row.mass)
        if off > SINGLE:
            return  # the sampling differs from that of the scene, or the mass has a finding of its own
        # Sums are at most as accurate as the masses.
        precision = max(DOUBLE, 10 * off)
        # einsum rather than BLAS, whose threads would compete with other processes that check results.
        momentum = np.array([np.einsum("i,i->", m, column) for column in frame.velocity.T])
        speeds = np.sqrt(np.einsum("ij,ij->i", frame.velocity, frame.velocity))
        moving = float(np.einsum("i,i->", m, speeds))
        for axis, found in enumerate(momentum.tolist()):
            told = row.linear_momentum[axis]
            self._compare(number, f"linear_momentum along {'xyz'[axis]}", found, told, precision * moving)
        self._potential(number, frame, row, m, momentum, precision)

    def _potential(
        self, number: int, frame: Frame, row: LedgerRow, m: np.ndarray, momentum: np.ndarray, precision: float
    ) -> None:
        """Compare the potential, which the ledger evaluates half a step earlier, for all possible last steps."""
        header = self._header
        if header.gravity is None or header.origin is None or not header.gravity.any():
            return
        # The addition of the origin rounds positions once more.
        rounding = 0.0 if not header.origin.any() else float(np.finfo(frame.position.dtype).eps) * header.farthest
        weight = float(m.sum()) * float(np.linalg.norm(header.gravity))
        tolerance = weight * (rounding + precision * float(np.linalg.norm(header.upper - header.origin)))
        moments = [np.einsum("i,i->", m, x - x0) for x, x0 in zip(frame.position.T, header.origin, strict=True)]
        power = 0.5 * float(momentum @ header.gravity)
        found = -float(moments @ header.gravity) + np.array([row.step_min, row.step_max]) * power
        nearest = float(np.clip(row.potential, found.min(), found.max()))
        self._compare(number, "potential", nearest, row.potential, tolerance)

    def _masses_of(self, frame: Frame) -> np.ndarray | None:
        if "mass" in frame.fields:
            return frame.fields["mass"].astype(np.float64)
        if self._body is None or not np.array_equal(self._body, frame.body):
            self._body, self._masses = frame.body, self._header.masses(frame.body)
        return self._masses

    def _compare(self, number: int, name: str, found: float, told: float, tolerance: float) -> None:
        difference = abs(found - told)
        # Below the smallest normal number of single precision nothing is compared.
        if difference > max(tolerance, 1e-37) or not np.isfinite(difference):
            self._differs(number, name, found, told, difference)

    def _differs(self, number: int, name: str, found: float, told: float, difference: float) -> None:
        scale = max(abs(found), abs(told))
        self.largest = max(self.largest, difference / scale if scale > 0 else 0.0)
        what = f"In frame {number} {name} is {found:.9g} by the particles and {told:.9g} by the ledger"
        self._findings.add("error", "ledger", number, what, TOUCHED, value=difference, kind=name)

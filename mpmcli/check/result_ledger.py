"""Checks the ledger of a result: finite numbers, mass, energy, speeds, volumes, steps, and whether the frames agree."""

from collections.abc import Sequence
from dataclasses import fields
from itertools import pairwise
from math import isfinite

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_entries import Entry
from mpmcli.check.result_state import BLOWN_UP, CRUSHED, TOUCHED, FrameCheck
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader
from mpmcli.stability.limits import COURANT

# Growth of energy without a source, relative to the energy turned over (docs/theory.md, 9.3). The scenes in configs
# stay below 2e-4, bodies thrown at a wall at up to five times their speed of sound below 1e-3.
ENERGY_SUSPECT, ENERGY_WRONG = 1e-2, 1e-1
# Rounding of energy in single precision, relative to the total energy.
ENERGY_ROUNDING = 1e-4
# Masses are summed in double precision and never change.
MASS_ERROR = 1e-9
# Volume that liquids and grains fill beyond that of their particles, or lack, as a fraction, in every frame of the last
# quarter: in flight it may be more for a moment.
VOLUME_ERROR, QUARTER = 0.05, 4
# A bound may be exceeded by this factor in an impact; time.safety allows for it.
MARGIN = 1.1
# Smallest accepted ratio of a step to the first one.
COLLAPSE = 1e-2
# Cells per step above which particles leave all nodes that they act on. Impacts near the speed of sound reach 1.7 in
# single steps without a gain of energy: it is the speed of a node, which particles rarely reach.
LEFT_BEHIND = 2.0
LOWER_SAFETY = "Lower time.safety, or refine the domain."
# Relative tolerance of a comparison with the frames: for quantities stored in single precision, and for sums in double
# precision over the numbers that the ledger sums.
SINGLE, DOUBLE = 1e-5, 1e-9

_Rows = list[tuple[int, LedgerRow]]


def check_ledger(entries: Sequence[Entry], header: RunHeader, findings: FrameFindings) -> dict[str, float | None]:
    """Check all rows, and return figures by name, see `ResultCheck`; None if not available."""
    rows: _Rows = []
    for entry in entries:
        broken = _not_finite(entry.row)
        if broken:
            what = f"In frame {entry.number} {broken} of the ledger is not finite"
            findings.add("error", "ledger-not-finite", entry.number, what, LOWER_SAFETY)
        else:
            rows.append((entry.number, entry.row))
    if not rows:
        return {}
    return {
        "mass_change": _mass(rows, findings),
        **_energy(rows, header, findings),
        "courant_max": _courant(rows, findings),
        "speed_max": max(row.speed_max for _, row in rows),
        **_volume(rows, header, findings),
        "volume_error": _volume_error(rows, findings),
        "collider_impulse": _taken(rows),
        **_steps(rows, findings),
    }


def _not_finite(row: LedgerRow) -> str:
    # Nearly always the sum says that all are finite.
    loads = (number for vectors in (row.collider_force, row.collider_torque) for vector in vectors for number in vector)
    several = (*row.linear_momentum, *row.angular_momentum, *loads)
    if isfinite(sum(value for value in (*vars(row).values(), *several) if isinstance(value, float | int))):
        return ""
    for entry in fields(row):
        value = getattr(row, entry.name)
        if value is None or isinstance(value, str):
            continue
        if not np.isfinite(np.array(value, dtype=float)).all():
            return entry.name
    return ""


def _mass(rows: _Rows, findings: FrameFindings) -> float:
    # The median identifies a single deviating row, including the first one.
    # What came in since the start and what left is not counted.
    masses = [row.mass - (row.emitted_mass or 0.0) + (row.retired_mass or 0.0) for _, row in rows]
    usual = float(np.median(masses))
    largest = 0.0
    for (number, row), mass in zip(rows, masses, strict=True):
        scale = max(usual, row.emitted_mass or 0.0)
        change = abs(mass - usual) / scale if scale > 0 else float(mass != usual)
        largest = max(largest, change)
        if change > MASS_ERROR:
            what = f"In frame {number} the mass is {mass:.8g} kg, where the run has {usual:.8g} kg"
            findings.add("error", "mass", number, what, TOUCHED, value=change)
    return largest


def _energy(rows: _Rows, header: RunHeader, findings: FrameFindings) -> dict[str, float | None]:
    """Return growth above the minimum, and loss, of energy over that turned over; None where it is driven."""
    if header.driven or header.moved:
        what = "Colliders that move do work, so that energy is not conserved"
        if header.comes_and_goes:
            what = "Material comes or goes, so that energy and momentum are not conserved"
        elif header.driven:
            what = (
                "Forces, walls that move, or a gravity that depends on time or acts along a periodic axis do work, so "
                "that energy and momentum are not conserved"
            )
        findings.add("note", "driven", None, what, "Nothing needs to be done.")
        return {"energy_growth": None, "energy_lost": None}
    kinetic, potential, elastic = (
        np.array([getattr(row, name) for _, row in rows]) for name in ("kinetic", "potential", "elastic")
    )
    total = kinetic + potential + elastic
    highest, lowest = np.maximum.accumulate, np.minimum.accumulate
    turned = highest(kinetic) + (highest(potential) - lowest(potential)) + (highest(elastic) - lowest(elastic))
    turned += ENERGY_ROUNDING * highest(kinetic + np.abs(potential) + np.abs(elastic))
    turned = np.maximum(turned, np.finfo(np.float64).tiny)
    growth = (total - lowest(total)) / turned
    for (number, _), value in zip(rows, growth.tolist(), strict=True):
        if value > ENERGY_SUSPECT:
            severity = "error" if value > ENERGY_WRONG else "warning"
            what = f"By frame {number} the energy has grown by {value:.3g} of the energy turned over, without a source"
            findings.add(severity, "energy", number, what, LOWER_SAFETY, value=value)
    return {"energy_growth": float(growth.max()), "energy_lost": float((total[0] - total[-1]) / turned[-1])}


def _courant(rows: _Rows, findings: FrameFindings) -> float:
    for number, row in rows:
        if row.courant_max > COURANT * MARGIN:
            severity = "error" if row.courant_max > LEFT_BEHIND else "warning"
            what = f"Before frame {number} something moved {row.courant_max:.3g} cells in a step, {COURANT:g} is safe"
            fix = 'Set time.step = "auto".' if row.limit == "forced" else LOWER_SAFETY
            findings.add(severity, "courant", number, what, fix, value=row.courant_max)
    return max(row.courant_max for _, row in rows)


def _volume(rows: _Rows, header: RunHeader, findings: FrameFindings) -> dict[str, float]:
    coherent = bool(header.laws) and all(law.coherent for law in header.laws)
    fix = "Make the material stiffer, the domain finer, or time.safety lower."
    for number, row in rows:
        low, high = row.volume_ratio_min, row.volume_ratio_max
        if not low > 0:
            what = f"In frame {number} a particle has no volume left: the smallest J is {low:.4g}"
            findings.add("error", "volume", number, what, fix, value=low, kind="ledger")
        elif low < CRUSHED:
            what = f"In frame {number} a particle is crushed: the smallest J is {low:.4g}"
            findings.add("warning", "volume", number, what, fix, value=low, kind="ledger")
        if high > BLOWN_UP and coherent:
            what = f"In frame {number} a particle is blown up: the largest J is {high:.4g}"
            findings.add("warning", "volume", number, what, fix, value=high, kind="ledger high")
    lowest, highest = min(row.volume_ratio_min for _, row in rows), max(row.volume_ratio_max for _, row in rows)
    return {"volume_ratio_min": lowest, "volume_ratio_max": highest}


def _volume_error(rows: _Rows, findings: FrameFindings) -> float:
    """Return the volume error that lasts to the end: the smallest one of the last quarter, 0 where its sign changes."""
    last = rows[-max(len(rows) // QUARTER, 1) :]
    errors = np.array([row.volume_error for _, row in last])
    lasting = float(errors[np.abs(errors).argmin()]) if abs(np.sign(errors).sum()) == len(errors) else 0.0
    if abs(lasting) > VOLUME_ERROR:
        what = (
            f"From frame {last[0][0]} to the end liquids and grains fill {100 * abs(lasting):.3g} % "
            f"{'more' if lasting > 0 else 'less'} than the volume of their particles"
        )
        fix = "Leave volume_correction = true in a fluid, or refine the domain."
        findings.add("note", "volume-error", last[0][0], what, fix, value=lasting)
    return lasting


def _taken(rows: _Rows) -> float | None:
    """Return the momentum that all colliders took, kg m/s; None without any."""
    taken = [
        np.sum(row.collider_force, axis=0) * (row.time - before.time)
        for (_, before), (_, row) in pairwise(rows)
        if row.collider_force
    ]
    return float(np.linalg.norm(np.sum(taken, axis=0))) if taken else None


def _steps(rows: _Rows, findings: FrameFindings) -> dict[str, float | None]:
    stepped = [(number, row) for number, row in rows if row.steps > 0]
    if not stepped:
        return dict.fromkeys(("step_min", "step_max", "step_ratio"))
    first = stepped[0][1].step_max
    for number, row in stepped:
        if row.step_min < COLLAPSE * first:
            what = (
                f"Before frame {number} the step fell to {row.step_min:.3g} s, where the run began with {first:.3g} s, "
                f'by the bound "{row.limit}"'
            )
            fix = "Look for a high speed, stiffness or deformation in this frame."
            findings.add("warning", "step-collapse", number, what, fix, value=row.step_min / first)
    smallest, largest = min(row.step_min for _, row in stepped), max(row.step_max for _, row in stepped)
    return {"step_min": smallest, "step_max": largest, "step_ratio": smallest / first if first > 0 else None}


class AgreementCheck(FrameCheck):
    """Compares sums over particles with the ledger; `largest` is the largest relative difference found."""

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        super().__init__(header, findings)
        self._masses: np.ndarray | None = None
        self._labels: np.ndarray | None = None
        self.largest = 0.0

    def check(self, number: int, frame: Frame, row: LedgerRow, J: np.ndarray | None, steps: int | None) -> None:
        """Check a frame of finite values; `J`, (n,), and `steps` since the frame before are None if not known."""
        if len(frame.position) == 0:
            return
        if steps is not None and steps != row.steps:
            self._differs(number, "steps", steps, row.steps, 1.0)
        present = frame.present
        speeds = np.sqrt(np.einsum("ij,ij->i", frame.velocity, frame.velocity))
        speed = float(speeds.max())
        if present is not None and J is not None:
            J = J[present] if present.any() else np.ones(1)
        self._compare(number, "speed_max", speed, row.speed_max, SINGLE * max(speed, row.speed_max))
        if J is not None and np.isfinite(J).all():
            for name, extreme in (("volume_ratio_min", float(J.min())), ("volume_ratio_max", float(J.max()))):
                self._compare(number, name, extreme, getattr(row, name), SINGLE * abs(extreme))
        m = self._masses_of(frame)
        if m is None:
            return
        if present is not None:
            m = m * present
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
        moving = float(np.einsum("i,i->", m, speeds))
        for axis, along in enumerate(momentum.tolist()):
            told = row.linear_momentum[axis]
            self._compare(number, f"linear_momentum along {'xyz'[axis]}", along, told, precision * moving)
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
        possible = -float(moments @ header.gravity) + np.array([row.step_min, row.step_max]) * power
        nearest = float(np.clip(row.potential, possible.min(), possible.max()))
        self._compare(number, "potential", nearest, row.potential, tolerance)

    def _masses_of(self, frame: Frame) -> np.ndarray | None:
        if "mass" in frame.fields:
            return frame.fields["mass"].astype(np.float64)
        if self._labels is None or not np.array_equal(self._labels, frame.body):
            self._labels, self._masses = frame.body, self._header.masses(frame.body)
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

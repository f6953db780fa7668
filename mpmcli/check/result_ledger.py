"""Checks the ledger of a result: finite numbers, mass, energy, Courant number, volumes and steps."""

from collections.abc import Sequence
from dataclasses import fields
from itertools import pairwise
from math import isfinite, isnan

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_entries import Entry
from mpmcli.check.result_state import BLOWN_UP, CRUSHED, TOUCHED
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


def check_ledger(entries: Sequence[Entry], header: RunHeader, findings: FrameFindings) -> dict[str, float | None]:
    """Check all rows.

    Returns:
        Figures by name: energy_growth, energy_lost, mass_change, courant_max, speed_max, volume_ratio_min,
        volume_ratio_max, volume_error, collider_impulse, step_min, step_max, step_ratio; None if not available.
    """
    rows: list[tuple[int, LedgerRow]] = []
    for entry in entries:
        broken = _not_finite(entry.row)
        if broken:
            what = f"In frame {entry.number} {broken} of the ledger is not finite"
            findings.add("error", "ledger-not-finite", entry.number, what, LOWER_SAFETY)
        else:
            rows.append((entry.number, entry.row))
    if not rows:
        return {}
    figures: dict[str, float | None] = {}
    figures["mass_change"] = _mass(rows, findings)
    figures["energy_growth"], figures["energy_lost"] = _energy(rows, header, findings)
    figures["courant_max"] = _courant(rows, findings)
    figures["speed_max"] = max(row.speed_max for _, row in rows)
    figures["volume_ratio_min"] = min(row.volume_ratio_min for _, row in rows)
    figures["volume_ratio_max"] = max(row.volume_ratio_max for _, row in rows)
    _volume(rows, header, findings)
    figures["volume_error"] = _volume_error(rows, findings)
    figures["collider_impulse"] = _taken(rows)
    figures |= _steps(rows, findings)
    return figures


def _not_finite(row: LedgerRow) -> str:
    # Nearly always the sum says that all are finite.
    loads = (number for vectors in (row.collider_force, row.collider_torque) for vector in vectors for number in vector)
    several = (*row.linear_momentum, *row.angular_momentum, *loads)
    if isfinite(sum(value for value in (*vars(row).values(), *several) if isinstance(value, float | int))):
        return ""
    for entry in fields(row):
        value = getattr(row, entry.name)
        if value is None:
            continue
        # Files written before it was stored have no volume error.
        if entry.name == "volume_error" and isnan(value):
            continue
        if not isinstance(value, str) and not np.isfinite(np.array(value, dtype=float)).all():
            return entry.name
    return ""


def _mass(rows: list[tuple[int, LedgerRow]], findings: FrameFindings) -> float:
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


def _energy(
    rows: list[tuple[int, LedgerRow]], header: RunHeader, findings: FrameFindings
) -> tuple[float | None, float | None]:
    """Return the largest growth of the total energy above its running minimum, and the loss by the end.

    Both are relative to the energy turned over: the largest kinetic energy so far plus the ranges of potential and
    elastic energy, since the zero of a potential is arbitrary. Both are None if forces, or
    colliders that move, drive the scene.
    """
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
        return None, None
    kinetic = np.array([row.kinetic for _, row in rows])
    potential, elastic = (np.array([getattr(row, name) for _, row in rows]) for name in ("potential", "elastic"))
    total = kinetic + potential + elastic
    turned = np.maximum.accumulate(kinetic) + _range_so_far(potential) + _range_so_far(elastic)
    turned += ENERGY_ROUNDING * np.maximum.accumulate(kinetic + np.abs(potential) + np.abs(elastic))
    turned = np.maximum(turned, np.finfo(np.float64).tiny)
    growth = (total - np.minimum.accumulate(total)) / turned
    for (number, _), value in zip(rows, growth.tolist(), strict=True):
        if value > ENERGY_SUSPECT:
            severity = "error" if value > ENERGY_WRONG else "warning"
            what = f"By frame {number} the energy has grown by {value:.3g} of the energy turned over, without a source"
            findings.add(severity, "energy", number, what, LOWER_SAFETY, value=value)
    return float(growth.max()), float((total[0] - total[-1]) / turned[-1])


def _range_so_far(values: np.ndarray) -> np.ndarray:
    return np.maximum.accumulate(values) - np.minimum.accumulate(values)


def _courant(rows: list[tuple[int, LedgerRow]], findings: FrameFindings) -> float:
    for number, row in rows:
        if row.courant_max > COURANT * MARGIN:
            severity = "error" if row.courant_max > LEFT_BEHIND else "warning"
            what = f"Before frame {number} something moved {row.courant_max:.3g} cells in a step, {COURANT:g} is safe"
            fix = 'Set time.step = "auto".' if row.limit == "forced" else LOWER_SAFETY
            findings.add(severity, "courant", number, what, fix, value=row.courant_max)
    return max(row.courant_max for _, row in rows)


def _volume(rows: list[tuple[int, LedgerRow]], header: RunHeader, findings: FrameFindings) -> None:
    coherent = bool(header.laws) and all(law.coherent for law in header.laws)
    for number, row in rows:
        low, high = row.volume_ratio_min, row.volume_ratio_max
        fix = "Make the material stiffer, the domain finer, or time.safety lower."
        if not low > 0:
            what = f"In frame {number} a particle has no volume left: the smallest J is {low:.4g}"
            findings.add("error", "volume", number, what, fix, value=low, kind="ledger")
        elif low < CRUSHED:
            what = f"In frame {number} a particle is crushed: the smallest J is {low:.4g}"
            findings.add("warning", "volume", number, what, fix, value=low, kind="ledger")
        if high > BLOWN_UP and coherent:
            what = f"In frame {number} a particle is blown up: the largest J is {high:.4g}"
            findings.add("warning", "volume", number, what, fix, value=high, kind="ledger high")


def _volume_error(rows: list[tuple[int, LedgerRow]], findings: FrameFindings) -> float | None:
    """Return the volume error that lasts to the end: the smallest one of the last quarter, 0 where its sign changes."""
    last = rows[-max(len(rows) // QUARTER, 1) :]
    errors = np.array([row.volume_error for _, row in last])
    if np.isnan(errors).any():
        return None
    lasting = float(errors[np.abs(errors).argmin()]) if abs(np.sign(errors).sum()) == len(errors) else 0.0
    if abs(lasting) > VOLUME_ERROR:
        what = (
            f"From frame {last[0][0]} to the end liquids and grains fill {100 * abs(lasting):.3g} % "
            f"{'more' if lasting > 0 else 'less'} than the volume of their particles"
        )
        fix = "Leave volume_correction = true in a fluid, or refine the domain."
        findings.add("note", "volume-error", last[0][0], what, fix, value=lasting)
    return lasting


def _taken(rows: list[tuple[int, LedgerRow]]) -> float | None:
    """Return the momentum that all colliders took, kg m/s; None without any."""
    taken = [
        np.sum(row.collider_force, axis=0) * (row.time - before.time)
        for (_, before), (_, row) in pairwise(rows)
        if row.collider_force
    ]
    return float(np.linalg.norm(np.sum(taken, axis=0))) if taken else None


def _steps(rows: list[tuple[int, LedgerRow]], findings: FrameFindings) -> dict[str, float | None]:
    stepped = [(number, row) for number, row in rows if row.steps > 0]
    if not stepped:
        return {"step_min": None, "step_max": None, "step_ratio": None}
    first = stepped[0][1].step_max
    for number, row in stepped:
        if row.step_min < COLLAPSE * first:
            what = (
                f"Before frame {number} the step fell to {row.step_min:.3g} s, where the run began with {first:.3g} s, "
                f'by the bound "{row.limit}"'
            )
            fix = "Look for a high speed, stiffness or deformation in this frame."
            findings.add("warning", "step-collapse", number, what, fix, value=row.step_min / first)
    smallest = min(row.step_min for _, row in stepped)
    return {
        "step_min": smallest,
        "step_max": max(row.step_max for _, row in stepped),
        "step_ratio": smallest / first if first > 0 else None,
    }

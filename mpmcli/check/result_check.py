"""`mpmcli check RESULT`: checks the stability of a run from its ledger and frames, and that it is complete."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isfinite
from numbers import Real
from pathlib import Path

import numpy as np

from mpmcli.check.collider_work import unsure_work, work_of_colliders
from mpmcli.check.finding import Finding, FrameFindings, Verdict, passes
from mpmcli.check.result_contact import ContactCheck
from mpmcli.check.result_entries import RUN_AGAIN, Entry, OpenedResult, check_order, open_entries
from mpmcli.check.result_state import (
    AT_REST,
    BLOWN_UP,
    CRUSHED,
    CrowdCheck,
    MomentumCheck,
    RestCheck,
    StateCheck,
    StretchCheck,
    lowest_potential,
)
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.checksums import first_line
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import PACKED
from mpmcli.plain_json import finite_json
from mpmcli.stability.limits import NODE_COURANT

# Labels of the figures in text.
TOLD = {
    "energy_growth": "energy growth / turned over",
    "energy_lost": "energy lost / turned over",
    "collider_work": "work of colliders, J",
    "mass_change": "mass change",
    "momentum_drift": "momentum drift",
    "collider_impulse": "momentum that colliders took, kg m/s",
    "courant_max": "largest Courant number",
    "speed_max": "largest speed, m/s",
    "volume_ratio_min": "smallest J",
    "volume_ratio_max": "largest J",
    "volume_error": "lasting volume error",
    "contact_overlap": "deepest overlap of surfaces, cells",
    "neighbour_distance": "farthest neighbours, cells",
    "densest_cell": "densest cell / intended",
    "empty_cells": "empty cells inside",
    "step_min": "smallest step, s",
    "step_max": "largest step, s",
}
# Growth of energy without a source, relative to the energy turned over (docs/theory.md, 9.3). The scenes in configs
# whose bodies share one velocity field stay below 2e-4, bodies thrown at a wall at up to five times their speed of
# sound below 1e-3. Where hardly anything moves, it is relative to a share of the energy stored, AT_REST.
ENERGY_SUSPECT, ENERGY_WRONG = 1e-2, 1e-1
# Growth that is allowed in addition if half of it is gone within a BRIEF part of the frames, or in the next one: the
# error of a step in a strong compression, and energy that shifts of particles store until viscosity takes it.
PASSING, BRIEF = 3e-2, 20
# Growth that is allowed in addition after a minimum at which contact holds energy, which is not in the sum. A block of
# jelly of 10 cells that rests on a floor has up to 0.045.
HELD_ENERGY = 6e-2
# Masses are summed in double precision and never change.
MASS_ERROR = 1e-9
# Relative difference between the volume that liquids and grains fill and that of their particles, in every frame of the
# last quarter; in flight it may briefly be larger.
VOLUME_ERROR, QUARTER = 0.05, 4
# A bound may be exceeded by this factor in an impact; time.safety allows for it.
MARGIN = 1.1
# Smallest accepted ratio of a step to the first one.
COLLAPSE = 1e-2
# Cells per step above which particles leave all nodes that they act on. Impacts near the speed of sound reach 1.7 in
# single steps without a gain of energy: it is the speed of a node, which particles rarely reach.
LEFT_BEHIND = 2.0
# Cells by which surfaces may overlap: more than a body driven by a paddle, 0.6.
OVERLAP = 1.0
LOWER_SAFETY = "Lower time.safety, or refine the domain."
HALVE_STEP = "Halve time.safety; if as much remains, the start or a domain that is too coarse causes it, not the step."
# Advice for the rules below on a run whose bodies start deformed.
STRESSED = 'The bodies that start with a "deformation" release their stress at once: compare with a smaller one.'
RELEASED = ("energy", "momentum", "volume-error")
STIFFER = "Make the material stiffer, the domain finer, or time.safety lower."

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class ResultCheck:
    """Result of the check of a run; `path` and `kind` are those of `OpenedResult`, `status` is that of its record.

    `limit` is the bound on the step that was smallest at the first frame with an error or a warning, "" if not known.
    None are figures that are not available: those of TOLD, momentum_frames (compared), step_ratio (smallest over
    first), bytes (of particle data read).
    """

    first_bad_frame: int | None
    limit: str
    findings: tuple[Finding, ...]
    frames: int
    frames_expected: int | None
    particles: int
    figures: dict[str, float | None]
    kind: str
    status: str
    path: Path

    @property
    def verdict(self) -> Verdict:
        """ "unstable" with an error, "suspect" with a warning and no error, otherwise "stable"."""
        if not passes(self.findings):
            return "unstable"
        return "stable" if passes(self.findings, strict=True) else "suspect"

    def passes(self, strict: bool = False) -> bool:
        """Return whether there is no error; with `strict`, no warning either."""
        return passes(self.findings, strict=strict)

    def as_dict(self) -> dict:
        """Return the check as a dictionary for JSON."""
        findings = [finite_json(dict(vars(finding))) for finding in self.findings]
        own = {**vars(self), "findings": findings, "figures": finite_json(self.figures), "path": str(self.path)}
        return {"ok": self.passes(), "verdict": self.verdict, **own}

    def text(self) -> str:
        """Return the check as text: the verdict, the figures, and a line for each finding."""
        bad = "" if self.first_bad_frame is None else f", first bad frame {self.first_bad_frame}"
        limit = f', nearest limit "{self.limit}"' if bad and self.limit else ""
        expected = "" if self.frames_expected is None else f" of {self.frames_expected}"
        told = {"frames": f"{self.frames}{expected}", "particles": str(self.particles), "status": self.status}
        known = {name: value for name, value in self.figures.items() if value is not None}
        told |= {words: f"{known[name]:.4g}" for name, words in TOLD.items() if name in known}
        width = max(map(len, told))
        lines = [f"{self.path}: {self.verdict}{bad}{limit}"]
        lines += [f"  {words:<{width}}  {value}" for words, value in told.items()]
        return "\n".join([*lines, *(finding.line for finding in self.findings)])


def check_result(path: Path, stop: Callable[[], bool] = lambda: False) -> ResultCheck:
    """Check ledger and frames of a result, packed or segments, whose run may continue.

    `stop` is called before each frame. InputError: no such result. KeyboardInterrupt: `stop` returned True.
    """
    findings = FrameFindings()
    opened = open_entries(path, findings)
    check = _check(opened, findings, stop)
    if opened.kind == "segments" and (opened.path / PACKED).exists():
        # The run ended during the check and packed its frames.
        return check_result(opened.path, stop)
    return check


def check_kept(header: RunHeader, frames: Sequence[Frame] | None, ledger: Sequence[LedgerRow]) -> ResultCheck:
    """Check all frames of a finished run in memory, as `check_result` does for files, but without checksums.

    If the frames were not kept, None, only the ledger is checked.
    """
    if frames is None:
        entries = [Entry(k, row.time, row, 0, None) for k, row in enumerate(ledger)]
    else:
        entries = [
            Entry(frame.index, frame.time, row, len(frame.body), lambda frame=frame: frame)
            for frame, row in zip(frames, ledger, strict=True)
        ]
    return _check(OpenedResult(Path(), "memory", header, {"status": "finished"}, entries), FrameFindings())


def _check(opened: OpenedResult, findings: FrameFindings, stop: Callable[[], bool] = lambda: False) -> ResultCheck:
    """Return the check of an opened result: the order of its frames, their particles, and the ledger."""
    check_order(opened, findings)
    # Frames first: of a fault that both have, theirs names the particle.
    kept = bool(opened.entries) and opened.entries[0].read is not None
    figures = _check_frames(opened, findings, stop) if kept else {}
    figures |= check_ledger(opened.entries, opened.header, findings)
    found = findings.found()
    if any(body.deformation is not None for body in opened.header.scene.bodies):
        found = tuple(replace(one, fix=STRESSED) if one.rule in RELEASED else one for one in found)
    first_bad = min((f.frame for f in found if f.severity != "note" and f.frame is not None), default=None)
    return ResultCheck(
        path=opened.path,
        kind=opened.kind,
        status=opened.status,
        findings=found,
        first_bad_frame=first_bad,
        limit="" if first_bad is None else _limit_at(opened, first_bad),
        frames=len(opened.entries) - len(findings.frames_of("unreadable") & {e.number for e in opened.entries}),
        frames_expected=opened.frames_expected,
        particles=opened.entries[0].count if opened.entries else 0,
        figures=figures,
    )


def _check_frames(opened: OpenedResult, findings: FrameFindings, stop: Callable[[], bool]) -> dict[str, float | None]:
    """Read each frame once, and check its values."""
    header = opened.header
    state, stretch, momentum = (kind(header, findings) for kind in (StateCheck, StretchCheck, MomentumCheck))
    crowd, rest = CrowdCheck(header, findings, opened.last), RestCheck(header, findings, opened.last)
    contact = ContactCheck(header, findings)
    size = 0
    for entry in opened.entries:
        if stop():
            raise KeyboardInterrupt
        try:
            frame = entry.read()
        except InputError as error:
            what = f"Frame {entry.number} cannot be read ({first_line(error)})"
            findings.add("error", "unreadable", entry.number, what, RUN_AGAIN)
            momentum.lost()
            continue
        arrays = (frame.position, frame.velocity, frame.body, frame.material, *frame.fields.values())
        size += sum(array.nbytes for array in arrays)
        # Values that are not finite have one finding and must not cause others.
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            if not state.check(frame):
                momentum.lost()
                continue
            momentum.check(frame, entry.row)
            crowd.check(frame)
            rest.check(frame, entry.row)
            contact.check(frame, entry.row)
            if not header.particle_count_varies:
                stretch.check(frame)
    contact.end()
    return {**stretch.figures, **crowd.figures, **momentum.figures, "bytes": size}


def _limit_at(opened: OpenedResult, number: int) -> str:
    """Return the bound that was smallest at a frame: from the ledger, or from the diagnosis of an unstable run."""
    failure = opened.record.get("failure") or {}
    if number > opened.last and failure.get("limit"):
        return str(failure["limit"])
    rows = [entry.row for entry in opened.entries if entry.number <= max(number, 1)]
    return next((row.limit for row in reversed(rows) if row.limit), "")


@dataclass(frozen=True)
class LedgerRule:
    """A rule on each row of a ledger; `bad` and `wrong` take the columns by name, see `_columns`, and return (T,) bool.

    `what` and `fix` are filled in with `number` and the columns of the row; `kind` separates findings of one rule.
    """

    name: str
    column: str  # of the value that is reported
    bad: Callable[[Columns], np.ndarray]
    what: str
    fix: str
    wrong: Callable[[Columns], np.ndarray | bool] = lambda of: False  # a bad row that is an error
    needs: str = ""  # column without which the rule is skipped
    kind: str = ""


RULES = (
    LedgerRule(
        "mass",
        "mass_change",
        lambda of: of["mass_change"] > MASS_ERROR,
        "In frame {number} the mass is {mass:.8g} kg, where the run has {usual_mass:.8g} kg",
        "The file was changed after the run; copy it again or run the scene again.",
        wrong=lambda of: True,
    ),
    LedgerRule(
        "energy",
        "energy_growth",
        lambda of: of["energy_growth"] > ENERGY_SUSPECT + PASSING * (of["energy_lasting"] < of["energy_growth"] / 2),
        "By frame {number} the energy has grown by {energy_growth:.3g} of the energy turned over{without}",
        HALVE_STEP,
        wrong=lambda of: of["energy_growth"] > ENERGY_WRONG,
        needs="energy_growth",
    ),
    LedgerRule(
        "courant",
        "courant_max",
        lambda of: of["courant_max"] > NODE_COURANT * MARGIN,
        f"Before frame {{number}} a node moved {{courant_max:.3g}} cells in a step, {NODE_COURANT:g} is safe",
        "{shorter}",
        wrong=lambda of: of["courant_max"] > LEFT_BEHIND,
    ),
    LedgerRule(
        "overlap",
        "contact_overlap",
        lambda of: of["contact_overlap"] > OVERLAP,
        "Before frame {number} surfaces that met overlapped by {contact_overlap:.3g} cells",
        STIFFER,
        needs="contact_overlap",
    ),
    LedgerRule(
        "volume",
        "volume_ratio_min",
        lambda of: of["volume_ratio_min"] <= 0,
        "In frame {number} a particle has no volume left: the smallest J is {volume_ratio_min:.4g}",
        STIFFER,
        wrong=lambda of: True,
        kind="has no volume left",
    ),
    LedgerRule(
        "volume",
        "volume_ratio_min",
        lambda of: (of["volume_ratio_min"] > 0) & (of["volume_ratio_min"] < CRUSHED),
        "In frame {number} a particle is crushed: the smallest J is {volume_ratio_min:.4g}",
        STIFFER,
        kind="is crushed",
    ),
    LedgerRule(
        "volume",
        "volume_ratio_max",
        lambda of: of["volume_ratio_max"] > BLOWN_UP,
        "In frame {number} a particle is blown up: the largest J is {volume_ratio_max:.4g}",
        STIFFER,
        needs="coherent",
        kind="is blown up",
    ),
    LedgerRule(
        "step-collapse",
        "step_ratio",
        lambda of: of["step_ratio"] < COLLAPSE,
        "Before frame {number} the step fell to {step_min:.3g} s, where the run began with {first_step:.3g} s, by the "
        'bound "{limit}"',
        "Look for a high speed, stiffness or deformation in this frame.",
        needs="step_ratio",
    ),
)
# Why the energy of a run is not conserved.
FORCED = (
    "Forces, walls that move, or a gravity that depends on time or acts along a periodic axis do work, so that energy "
    "and momentum are not conserved"
)
VARIES = "Material comes or goes, so that energy and momentum are not conserved"
UNKNOWN_WORK = "Colliders that move do work on rigid bodies, too, so that the balance of energy is not known"


def check_ledger(entries: Sequence[Entry], header: RunHeader, findings: FrameFindings) -> dict[str, float | None]:
    """Check all rows, and return figures by name, see `ResultCheck`; None if not available."""
    numbers, rows = [], []
    for entry in entries:
        broken = next((name for name, value in vars(entry.row).items() if not _finite(value)), "")
        if broken:
            what = f"In frame {entry.number} {broken} of the ledger is not finite"
            findings.add("error", "ledger-not-finite", entry.number, what, LOWER_SAFETY)
        else:
            numbers.append(entry.number)
            rows.append(entry.row)
    if not rows:
        return {}
    of = _columns(rows, header)
    balanced = "energy_growth" in of
    if not balanced:
        what = VARIES if header.particle_count_varies else FORCED if header.driven else UNKNOWN_WORK
        findings.add("note", "driven", None, what, "Nothing needs to be done.")
    without = " beyond the work of colliders" if header.moved else ", without a source"
    forced = any(row.limit == "forced" for row in rows)
    words = {"without": without, "shorter": 'Set time.step = "auto".' if forced else LOWER_SAFETY}
    for rule in RULES:
        if rule.needs and rule.needs not in of:
            continue
        bad = rule.bad(of)
        wrong = bad & rule.wrong(of)
        for k in np.flatnonzero(bad).tolist():
            here = words | vars(rows[k]) | {name: float(column[k]) for name, column in of.items()}
            what, fix = (text.format(number=numbers[k], **here) for text in (rule.what, rule.fix))
            severity = "error" if wrong[k] else "warning"
            findings.add(severity, rule.name, numbers[k], what, fix, here[rule.column], kind=rule.kind)
    stepped = of["steps"] > 0
    took = [(row.collider_force, row.time - before.time) for before, row in pairwise(rows) if row.collider_force]
    impulse = sum(np.sum(force, axis=0) * time for force, time in took)
    figures = {
        **{name: of[name].max() for name in ("mass_change", "courant_max", "speed_max", "volume_ratio_max")},
        "energy_growth": of["energy_growth"].max() if balanced else None,
        "energy_lost": of["energy_lost"][-1] if balanced else None,
        "collider_work": of["work"][-1] if balanced and header.moved else None,
        "volume_ratio_min": of["volume_ratio_min"].min(),
        "volume_error": _volume_error(numbers, of["volume_error"], findings),
        "collider_impulse": np.linalg.norm(impulse) if took else None,
        "contact_overlap": of["contact_overlap"].max() if "contact_overlap" in of else None,
        "step_min": of["step_min"][stepped].min() if stepped.any() else None,
        "step_max": of["step_max"].max() if stepped.any() else None,
        "step_ratio": np.nanmin(of["step_ratio"]) if stepped.any() else None,
    }
    return {name: None if value is None else float(value) for name, value in figures.items()}


def _columns(rows: Sequence[LedgerRow], header: RunHeader) -> Columns:
    """Return the numbers of a ledger, (T,) by name, and what follows from them.

    Those that are not known are left out: step_ratio before the first step, energy_growth if something else does work,
    coherent unless all material is.
    """
    numeric = [name for name, value in vars(rows[0]).items() if isinstance(value, Real)]
    of = {name: np.array([getattr(row, name) for row in rows]) for name in numeric}
    same = np.ones(len(rows))
    # Mass that has entered or left is not counted. The median identifies a single faulty row, also the first.
    emitted = of.get("emitted_mass", 0.0 * same)
    mass = of["mass"] - emitted - of.get("nozzle_mass", 0.0) + of.get("retired_mass", 0.0)
    of["usual_mass"] = same * np.median(mass)
    scale, change = np.maximum(of["usual_mass"], emitted), np.abs(mass - of["usual_mass"])
    of["mass_change"] = np.divide(change, scale, out=(change > 0).astype(float), where=scale > 0)
    stepped = of["steps"] > 0
    if stepped.any():
        of["first_step"] = same * of["step_max"][stepped][0]
        of["step_ratio"] = np.where(stepped, of["step_min"] / of["first_step"], np.nan)
    if header.laws and all(law.coherent for law in header.laws):
        of["coherent"] = same
    # With rigid bodies that move freely, colliders also do work on these.
    if header.driven or (header.moved and not _knows_work(rows, header)):
        return of
    work = unsure = 0.0 * same
    if header.moved and "collider_work" in of:
        work = np.cumsum(of["collider_work"])
    elif header.moved:
        work, unsure = work_of_colliders(rows, header.colliders), unsure_work(rows, header.colliders)
    energies = of["kinetic"], of["potential"] - of["mass"] * lowest_potential(header), of["elastic"]
    lost, (growth, _, lasting) = energy_change(*energies, work)[1], energy_change(*energies, work + unsure)
    if "contact_work" in of:
        # Contact takes energy up and returns it. All else is known with the work of contact.
        rest, _, stays = energy_change(*energies, work + unsure + np.cumsum(of["contact_work"]))
        growth, lasting = np.maximum(rest, growth - HELD_ENERGY), np.maximum(stays, lasting - HELD_ENERGY)
    return of | {"work": work, "energy_growth": growth, "energy_lasting": lasting, "energy_lost": same * lost}


def _finite(value: object) -> bool:
    if isinstance(value, tuple | list):
        return all(map(_finite, value))
    return value is None or isinstance(value, str) or isfinite(value)


def _knows_work(rows: Sequence[LedgerRow], header: RunHeader) -> bool:
    """Return whether the work of all colliders follows from the ledger."""
    known = header.read_colliders({})
    loaded = all(len(row.collider_force) == len(known) for row in rows)
    return loaded and not any(collider is None or collider.free for collider in known)


def energy_change(
    kinetic: np.ndarray, potential: np.ndarray, elastic: np.ndarray, work: np.ndarray | float = 0.0
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return growth above the minimum so far, (T,), final loss, and growth that lasts, over the energy turned over.

    What lasts, (T,), is that of the smallest energy from then on in a BRIEF part of the frames.
    That is at least the share AT_REST of the energy stored; potential energy is that above the lowest place. The energy
    that `work` has brought so far is not counted.
    """
    total = kinetic + potential + elastic - work
    highest, lowest = np.maximum.accumulate, np.minimum.accumulate
    turned = highest(kinetic) + (highest(potential) - lowest(potential)) + (highest(elastic) - lowest(elastic))
    turned += highest(np.abs(work) + 0.0 * kinetic)
    stored = highest(kinetic + np.abs(potential) + np.abs(elastic))
    turned = np.maximum(np.maximum(turned, AT_REST * stored), np.finfo(np.float64).tiny)
    before, after = lowest(total), total.copy()
    for k in range(1, min(max(1, len(total) // BRIEF), len(total) - 1) + 1):
        after[:-k] = np.minimum(after[:-k], total[k:])
    return (total - before) / turned, float((total[0] - total[-1]) / turned[-1]), (after - before) / turned


def _volume_error(numbers: Sequence[int], errors: np.ndarray, findings: FrameFindings) -> float:
    """Return the volume error that lasts to the end: the smallest of the last quarter, 0 if its sign changes."""
    last = errors[-max(len(errors) // QUARTER, 1) :]
    first = numbers[-len(last)]
    lasting = float(last[np.abs(last).argmin()]) if abs(np.sign(last).sum()) == len(last) else 0.0
    if abs(lasting) > VOLUME_ERROR:
        what = f"From frame {first} to the end liquids and grains fill {100 * abs(lasting):.3g} % "
        what += f"{'more' if lasting > 0 else 'less'} than the volume of their particles"
        fix = "Refine the domain. Of the materials, fluids with volume_correction and sand correct their volume."
        findings.add("note", "volume-error", first, what, fix, value=lasting)
    return lasting

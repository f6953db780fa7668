"""`mpmcli check RESULT`: checks the stability of a run from its ledger and frames, and that it is complete.

The result may be damaged. The balance of energy contains the work of colliders with prescribed motion.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, pairwise
from math import isfinite
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.check.finding import Finding, FrameFindings, Severity, Verdict, passes
from mpmcli.check.result_state import BLOWN_UP, CRUSHED, CrowdCheck, MomentumCheck, StateCheck, StretchCheck
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.checksums import DamageError, first_line
from mpmcli.output.durable import number_of
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import PACKED, sealed_segments
from mpmcli.output.result import open_result, result_place
from mpmcli.output.run_record import DIED, ELSEWHERE, read_record, run_status
from mpmcli.plain_json import finite_json
from mpmcli.scene.colliders import Collider
from mpmcli.scene.expression import evaluate
from mpmcli.stability.limits import COURANT

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
    "contact_gap": "largest gap that acts, cells",
    "neighbour_distance": "farthest neighbours, cells",
    "densest_cell": "densest cell / intended",
    "empty_cells": "empty cells inside",
    "step_min": "smallest step, s",
    "step_max": "largest step, s",
}
# Growth of energy without a source, relative to the energy turned over (docs/theory.md, 9.3). The scenes in configs
# whose bodies share one velocity field stay below 2e-4, bodies thrown at a wall at up to five times their speed of
# sound below 1e-3.
ENERGY_SUSPECT, ENERGY_WRONG = 1e-2, 1e-1
# Growth that is allowed in addition after a minimum at which contact holds energy, which is not in the sum. A block of
# jelly of 10 cells that rests on a floor has up to 0.045.
HELD = 6e-2
# Rounding of energy in single precision, relative to the total energy.
ENERGY_ROUNDING = 1e-4
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


RUN_AGAIN = "Copy the file again from where it was made, or run the scene again."
GO_ON = "mpmcli simulate --resume goes on with it."
WAIT = "Wait for it, or run it again."
# Tolerance of times, relative to the duration of the run.
TIME_ERROR = 1e-9
# Messages on a run that did not finish, by its status.
GOES_ON = "The run has not ended; there are {far}, and "
ENDS: dict[str, tuple[Severity, str, str, str]] = {
    "unstable": ("error", "unstable-run", "After {far} {why}", "Change what the sentence names and run it again."),
    "failed": ("error", "failed-run", "The run failed after {far}{told}", "Run it again."),
    "interrupted": ("warning", "interrupted-run", "The run was interrupted after {far}", GO_ON),
    "stopped": ("warning", "stopped-run", "The run stopped after {far}{told}", GO_ON),
    DIED: ("warning", "died-run", "The run died after {far}: its process has ended without recording it", GO_ON),
    "running": ("warning", "running", GOES_ON + "it goes on", WAIT),
    ELSEWHERE: ("warning", "running", GOES_ON + "whether it continues cannot be determined", WAIT),
}


@dataclass(frozen=True)
class Entry:
    """A frame that is not read yet: its number, time, s, row of the ledger and number of particles."""

    number: int
    time: float
    row: LedgerRow
    count: int
    # Reads the frame; InputError: it is damaged. None if it is not kept.
    read: Callable[[], Frame] | None


@dataclass(frozen=True)
class OpenedResult:
    """The readable part of a result, its frames in the order of the files."""

    path: Path
    # "packed", "segments", "memory", or "none" if nothing can be read.
    kind: str
    header: RunHeader
    # Content of run.json, {} without one.
    record: dict[str, Any]
    entries: list[Entry]

    @property
    def status(self) -> str:
        """Status of the run, see `run_status`."""
        return run_status(_directory(self.path), self.record or None)

    @property
    def frames_expected(self) -> int | None:
        """Number of frames of the whole run, None if it is not known."""
        return self.record.get("frames_expected") or self.header.frames

    @property
    def last(self) -> int:
        """Number of the last frame, -1 without any."""
        return max((entry.number for entry in self.entries), default=-1)


def open_entries(path: Path, findings: FrameFindings) -> OpenedResult:
    """Open the readable part of a result, and report the rest; InputError: `path` is not a result of mpmcli.

    Each segment is opened separately, so that damage to one does not affect the others.
    """
    path = result_place(path)
    segments = sealed_segments(path) if path.is_dir() and not (path / PACKED).exists() else []
    kind, header, entries = "segments" if segments else "none", RunHeader.read({}), []
    for file in segments or [path]:
        first = number_of(file) if segments else 0
        try:
            result = open_result(file)
        except InputError as error:
            if not segments and not _is_damage(path, error):
                raise
            which = f"The segment of frame {first} cannot be read ({{}})" if segments else "No frame can be read: {}"
            findings.add("error", "unreadable", first, which.format(first_line(error)), RUN_AGAIN)
            continue
        header = header if entries else result.header
        numbers = range(first, first + result.frame_count) if segments else result.numbers.tolist()
        columns = zip(numbers, result.times.tolist(), result.ledger, result.particle_counts.tolist(), strict=True)
        entries += [Entry(*facts, partial(result.frame, k)) for k, facts in enumerate(columns)]
        path, kind = (path, kind) if segments else (result.path, result.kind)
    return OpenedResult(path, kind, header, read_record(_directory(path)) or {}, entries)


def _directory(path: Path) -> Path:
    return path if path.is_dir() else path.parent


def _is_damage(path: Path, error: InputError) -> bool:
    """Return whether an unreadable file was written by mpmcli, so that it is damaged rather than of another kind."""
    ours = read_record(_directory(path)) is not None
    if path.is_dir() and not (path / PACKED).exists():
        return ours  # a run that wrote no frame
    # A cause is set if the file could not be read, and none if it is of another kind or version.
    return isinstance(error, DamageError) or (ours and error.__cause__ is not None)


def check_order(opened: OpenedResult, findings: FrameFindings) -> None:
    """Check the times of the frames, that a finished run has all of them, and how the run ended."""
    entries, expected, header = opened.entries, opened.frames_expected, opened.header
    for entry in entries if header.end is not None and header.frames is not None else ():
        planned = header.end * entry.number / (header.frames - 1)
        if not abs(entry.time - planned) <= TIME_ERROR * header.end:
            what = f"Frame {entry.number} is at {entry.time:.6g} s, where the scene has it at {planned:.6g} s"
            findings.add("error", "frame-time", entry.number, what, RUN_AGAIN, value=entry.time)
    # Frames missing at the end of a run that did not finish are reported by its status.
    over = opened.record.get("status") in (None, "finished")
    whole = expected if expected is not None and over else opened.last + 1
    there = {entry.number for entry in entries} | findings.frames_of("unreadable")
    missing = whole - sum(number < whole for number in there)
    if missing and entries:
        first = next(number for number in count() if number not in there)
        named = f"Frame {first} is" if missing == 1 else f"Frame {first} and {missing - 1} more of {whole} are"
        findings.add("error", "missing-frames", first, f"{named} missing", RUN_AGAIN, value=missing)
    if not opened.record:
        what = "No run.json lies beside the frames, so how the run ended is not known"
        findings.add("note", "no-record", None, what, "Keep run.json together with the frames.")
    elif opened.status in ENDS:
        severity, rule, what, fix = ENDS[opened.status]
        message = ((opened.record.get("failure") or {}).get("message") or "").rstrip(".")
        written = opened.last + 1
        far = f"{written} frames" if expected is None else f"{written} of {expected} frames"
        what = what.format(far=far, why=message or "the run became unstable", told=message and f": {message}")
        findings.add(severity, rule, written, what, fix)


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
    crowd = CrowdCheck(header, findings, opened.last)
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
            if not header.particle_count_varies:
                stretch.check(frame)
    return {**stretch.figures, **crowd.figures, **momentum.figures, "bytes": size}


def _limit_at(opened: OpenedResult, number: int) -> str:
    """Return the bound that was smallest at a frame: from the ledger, or from the diagnosis of an unstable run."""
    failure = opened.record.get("failure") or {}
    if number > opened.last and failure.get("limit"):
        return str(failure["limit"])
    rows = [entry.row for entry in opened.entries if entry.number <= max(number, 1)]
    return next((row.limit for row in reversed(rows) if row.limit), "")


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
    numeric = [name for name, value in vars(rows[0]).items() if isinstance(value, Real)]
    of = {name: np.array([getattr(row, name) for row in rows]) for name in numeric}

    def tell(
        rule: str, values: np.ndarray, bad: np.ndarray, wrong: np.ndarray | bool, what: str, fix: str, kind: str = ""
    ) -> None:
        """Add a finding for each row that is bad; it is an error if the row is also wrong."""
        for k in np.flatnonzero(bad).tolist():
            severity, value = "error" if (bad & wrong)[k] else "warning", float(values[k])
            said = what.format(number=numbers[k], value=value, row=rows[k])
            findings.add(severity, rule, numbers[k], said, fix, value, kind=kind or what)

    # Mass that has entered or left is not counted. The median identifies a single faulty row, also the first.
    emitted = of.get("emitted_mass", np.zeros(len(rows)))
    mass = of["mass"] - emitted + of.get("retired_mass", 0.0)
    usual = float(np.median(mass))
    scale, change = np.maximum(usual, emitted), np.abs(mass - usual)
    change = np.divide(change, scale, out=(change > 0).astype(float), where=scale > 0)
    what = f"In frame {{number}} the mass is {{row.mass:.8g}} kg, where the run has {usual:.8g} kg"
    fix = "The file was changed after the run; copy it again or run the scene again."
    tell("mass", change, change > MASS_ERROR, True, what, fix)
    # With rigid bodies that move freely, colliders also do work on these.
    balanced = not header.driven and (not header.moved or _knows_work(rows, header))
    work = unsure = np.zeros(len(rows))
    if balanced and header.moved:
        work, unsure = work_of_colliders(rows, header.colliders), unsure_work(rows, header.colliders)
    energies = of["kinetic"], of["potential"], of["elastic"]
    lost, growth = energy_change(*energies, work)[1], energy_change(*energies, work + unsure)[0]
    if "contact_work" in of:
        # Contact takes energy up and returns it. All else is known with the work of contact.
        rest, _ = energy_change(*energies, work + unsure + np.cumsum(of["contact_work"]))
        growth = np.maximum(rest, growth - HELD)
    if not balanced:
        what = (
            "Forces, walls that move, or a gravity that depends on time or acts along a periodic axis do work, so that "
        )
        what += "energy and momentum are not conserved"
        if header.particle_count_varies:
            what = "Material comes or goes, so that energy and momentum are not conserved"
        elif not header.driven:
            what = "Colliders that move do work on rigid bodies, too, so that the balance of energy is not known"
        findings.add("note", "driven", None, what, "Nothing needs to be done.")
    else:
        what = "By frame {number} the energy has grown by {value:.3g} of the energy turned over, without a source"
        if header.moved:
            what = "By frame {number} the energy has grown by {value:.3g} of the energy turned over beyond the work of "
            what += "colliders"
        tell("energy", growth, growth > ENERGY_SUSPECT, growth > ENERGY_WRONG, what, HALVE_STEP)
    courant, forced = of["courant_max"], any(row.limit == "forced" for row in rows)
    what = f"Before frame {{number}} something moved {{value:.3g}} cells in a step, {COURANT:g} is safe"
    fix = 'Set time.step = "auto".' if forced else LOWER_SAFETY
    tell("courant", courant, courant > COURANT * MARGIN, courant > LEFT_BEHIND, what, fix)
    overlap = of.get("contact_overlap", np.zeros(len(rows)))
    what = "Before frame {number} surfaces that met overlapped by {value:.3g} cells"
    tell("overlap", overlap, overlap > OVERLAP, False, what, STIFFER)
    low, high = of["volume_ratio_min"], of["volume_ratio_max"]
    what = "In frame {number} a particle has no volume left: the smallest J is {value:.4g}"
    tell("volume", low, low <= 0, True, what, STIFFER, "has no volume left")
    what = "In frame {number} a particle is crushed: the smallest J is {value:.4g}"
    tell("volume", low, (low > 0) & (low < CRUSHED), False, what, STIFFER, "is crushed")
    coherent = bool(header.laws) and all(law.coherent for law in header.laws)
    what = "In frame {number} a particle is blown up: the largest J is {value:.4g}"
    tell("volume", high, (high > BLOWN_UP) & coherent, False, what, STIFFER, "is blown up")
    stepped = of["steps"] > 0
    steps: dict[str, float | None] = dict.fromkeys(("step_min", "step_max", "step_ratio"))
    if stepped.any():
        first, smallest = float(of["step_max"][stepped][0]), float(of["step_min"][stepped].min())
        ratio = of["step_min"] / first
        what = "Before frame {number} the step fell to {row.step_min:.3g} s, where the run began with "
        what += f'{first:.3g} s, by the bound "{{row.limit}}"'
        fix = "Look for a high speed, stiffness or deformation in this frame."
        tell("step-collapse", ratio, stepped & (ratio < COLLAPSE), False, what, fix)
        steps = {"step_min": smallest, "step_max": float(of["step_max"].max()), "step_ratio": smallest / first}
    took = [(row.collider_force, row.time - before.time) for before, row in pairwise(rows) if row.collider_force]
    impulse = sum(np.sum(force, axis=0) * time for force, time in took)
    return {
        "mass_change": float(change.max()),
        "energy_growth": float(growth.max()) if balanced else None,
        "energy_lost": lost if balanced else None,
        "collider_work": float(work[-1]) if balanced and header.moved else None,
        "courant_max": float(courant.max()),
        "speed_max": float(of["speed_max"].max()),
        "volume_ratio_min": float(low.min()),
        "volume_ratio_max": float(high.max()),
        "volume_error": _volume_error(numbers, of["volume_error"], findings),
        "collider_impulse": float(np.linalg.norm(impulse)) if took else None,
        **{name: float(of[name].max()) if name in of else None for name in ("contact_overlap", "contact_gap")},
        **steps,
    }


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
) -> tuple[np.ndarray, float]:
    """Return the growth above the minimum so far, (T,), and the final loss, both over the energy turned over.

    The energy that `work` has brought so far is not counted.
    """
    total = kinetic + potential + elastic - work
    highest, lowest = np.maximum.accumulate, np.minimum.accumulate
    turned = highest(kinetic) + (highest(potential) - lowest(potential)) + (highest(elastic) - lowest(elastic))
    turned += highest(np.abs(work) + 0.0 * kinetic)
    turned += ENERGY_ROUNDING * highest(kinetic + np.abs(potential) + np.abs(elastic))
    turned = np.maximum(turned, np.finfo(np.float64).tiny)
    return (total - lowest(total)) / turned, float((total[0] - total[-1]) / turned[-1])


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


# Parts of the time between two frames in which the velocity of a collider is evaluated, and rows evaluated at once.
PARTS, AT_ONCE = 64, 1000


def work_of_colliders(rows: Sequence[LedgerRow], colliders: Sequence[Collider], *, sloped: bool = True) -> np.ndarray:
    """Return the work of colliders on the material up to each frame, (T,), J.

    Rows contain the mean load in the time before a frame. Within this time a load is linear, with the slope of the
    means of the neighbouring rows, or constant, and the velocity is exact at the middles of `PARTS` parts.
    """
    times = np.array([row.time for row in rows])
    spans, work = np.diff(times), np.zeros(len(rows))
    if len(rows) < 2:
        return work
    middles = 0.5 * (times[1:] + times[:-1])
    parts = (np.arange(PARTS) + 0.5) / PARTS - 0.5
    for k, collider in enumerate(colliders):
        if collider.driven:
            loads = np.array([[*row.collider_force[k], *row.collider_torque[k]] for row in rows[1:]])
            slopes = np.gradient(loads, middles, axis=0) if sloped and len(middles) > 1 else np.zeros_like(loads)
            forces = len(collider.motion.velocity)
            for first in range(0, len(middles), AT_ONCE):
                own = slice(first, first + AT_ONCE)
                offsets = parts * spans[own, None]
                t = middles[own, None] + offsets
                rates = [np.broadcast_to(evaluate(tree, {"t": t}), t.shape) for tree in collider.motion.rates]
                turns = np.array([1.0]) if forces == 2 else np.array(collider.motion.axis)
                for load, slope, rate in zip(
                    [*loads[own].T[:forces], loads[own][:, forces:] @ turns],
                    [*slopes[own].T[:forces], slopes[own][:, forces:] @ turns],
                    rates,
                    strict=True,
                ):
                    power = (load[:, None] + slope[:, None] * offsets) * rate
                    work[1:][own] -= power.mean(axis=1) * spans[own]
    return np.cumsum(work)


def unsure_work(rows: Sequence[LedgerRow], colliders: Sequence[Collider]) -> np.ndarray:
    """Return how far the work up to each frame is unsure, (T,), J: as far as it depends on the slopes of the loads.

    These are not known where a collider starts or stops abruptly.
    """
    sure, linear = (work_of_colliders(rows, colliders, sloped=sloped) for sloped in (False, True))
    return np.cumsum(np.abs(np.diff(linear - sure, prepend=0.0)))

"""Stops a run with an unphysical state and reports the particle, its position, the cause and the nearest limit."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NoReturn

import numpy as np

from mpmcli.errors import RunError
from mpmcli.materials.tensors import determinant
from mpmcli.scene import Domain
from mpmcli.solver.particles.state_bounds import SMALLEST_J
from mpmcli.solver.transfer.splines import PAD


@dataclass(frozen=True)
class Snapshot:
    """Host copies of the state of one group, in solver order.

    Attributes:
        x: position relative to the origin of the domain, (n, d), m.
        v: velocity, (n, d), m/s.
        C: affine velocity, (n, d, d), 1/s.
        deformation: J, (n), or F, (n, d, d).
        internal: internal variables of the law, (n, k).
        id, body: (n) int.
        activity: (n) int, see `particles.sort`; None if all particles are always active.
    """

    group: object
    x: np.ndarray
    v: np.ndarray
    C: np.ndarray
    deformation: np.ndarray
    internal: np.ndarray
    id: np.ndarray
    body: np.ndarray
    activity: np.ndarray | None = None

    @cached_property
    def volume_ratio(self) -> np.ndarray:
        """Stored J of each particle, (n,)."""
        return self.deformation if self.deformation.ndim == 1 else determinant(self.deformation)


def read_group(group: object) -> Snapshot:
    return Snapshot(group, **group.read())


@dataclass(frozen=True)
class Diagnosis:
    """Where and why a run stopped.

    Attributes:
        step: number of the step after which the fault was detected.
        time: time, s.
        particle: row of the particle in every frame; None for a rigid body.
        body: name of its body.
        position: last position inside the domain, m.
        cause: the fault of the particle.
        suggestion: a change that may prevent it.
        limit: name of the nearest bound on the step.
        step_size: size of the step, s.
    """

    step: int
    time: float
    particle: int | None
    body: str
    position: tuple[float, ...]
    cause: str
    limit: str
    step_size: float
    suggestion: str

    def sentence(self) -> str:
        place = ", ".join(f"{x:.4g}" for x in self.position)
        which = "rigid body" if self.particle is None else f"particle {self.particle} of body"
        return (
            f"the run became unstable at step {self.step}, t = {self.time:.6g} s: {which} "
            f'"{self.body}" at ({place}) m {self.cause}; the step was {self.step_size:.3g} s, the nearest limit '
            f'"{self.limit}"; {self.suggestion}.'
        )


class UnstableRunError(RunError):
    """The state of a run is no longer physical; frames already written are kept."""

    def __init__(self, diagnosis: Diagnosis) -> None:
        super().__init__(diagnosis.sentence())
        self.diagnosis = diagnosis


# Causes and suggestions.
NOT_FINITE = "has a state that is not finite"
POSE = "has a pose that is not finite"
INVERTED = "was inverted"
CRUSHED = "collapsed to zero volume"
LEFT = "left the domain"
OUTRAN = "moved beyond the nodes in use"
FASTER = "received more momentum in one step than the sums of solver.deterministic can hold"
DENSER = "is at a node with more mass than the sums of solver.deterministic can hold"
STIFFER = "a stiffer material, a finer domain.spacing or a lower time.safety may prevent this"
SUGGESTIONS = {
    NOT_FINITE: "lower time.safety, or check the scene for a number of the wrong magnitude",
    INVERTED: STIFFER,
    CRUSHED: STIFFER,
    LEFT: "check the speeds and forces of the scene, or lower time.safety or time.step",
    FASTER: "check the speeds, forces and materials of the scene, or lower time.safety",
    DENSER: "look for particles that coincide, or omit solver.deterministic",
    OUTRAN: "lower time.step, so that speeds are measured more often",
}
FORCED = 'time.step = "auto" takes stable steps'
OTHERWISE = "check the speeds, forces and materials of the scene"


def first_unsound(snapshot: Snapshot) -> int | None:
    """Return the crushed, inverted or non-finite particle (in solver order) with the smallest id, or None."""
    sound = snapshot.volume_ratio > SMALLEST_J
    for values in (snapshot.x, snapshot.v, snapshot.C):
        sound &= np.isfinite(values).reshape(len(sound), -1).all(1)
    unsound = np.flatnonzero(~sound)
    return int(unsound[snapshot.id[unsound].argmin()]) if len(unsound) else None


def first_beyond(snapshots: Sequence[Snapshot], particle: int | None, place: np.ndarray | None) -> tuple[Snapshot, int]:
    """Return the group and index, in solver order, of the particle with an id, or of the one nearest to `place`, m."""
    if particle is not None:
        found = [(snapshot, np.flatnonzero(snapshot.id == particle)) for snapshot in snapshots]
        return next((snapshot, int(rows[0])) for snapshot, rows in found if len(rows))
    nearest = []
    for g, snapshot in enumerate(snapshots):
        away = ((snapshot.x - place) ** 2).sum(1)
        p = int(np.lexsort((snapshot.id, away))[0])
        nearest.append((float(away[p]), g, p))
    _, g, p = min(nearest)
    return snapshots[g], p


def rate_of_change(snapshot: Snapshot, spacing: float) -> np.ndarray:
    """Return speed / spacing plus the sum of |C| of each particle, (n,), 1/s."""
    speed = np.linalg.norm(snapshot.v.astype(np.float64), axis=1)
    return speed / spacing + np.abs(snapshot.C.astype(np.float64)).sum((1, 2))


def cause_of(snapshot: Snapshot, p: int, dt: float, domain: Domain) -> str:
    """Return the fault of particle p (in solver order) in a step of dt, s."""
    values = (snapshot.x[p], snapshot.v[p], snapshot.C[p], snapshot.deformation[p])
    if not all(np.isfinite(value).all() for value in values):
        return NOT_FINITE
    J = float(snapshot.volume_ratio[p])
    if not J > 0:
        return f"{INVERTED} (J = {J:.3g})"
    if J <= SMALLEST_J:
        return f"{CRUSHED} (J = {J:.3g})"
    speed = float(np.linalg.norm(snapshot.v[p].astype(np.float64)))
    going = snapshot.x[p].astype(np.float64) + dt * snapshot.v[p]
    if (((going < 0) | (going > np.array(domain.size))) & ~np.array(domain.periodic)).any():
        return f"{LEFT} at {speed:.4g} m/s"
    return f"{OUTRAN} at {speed:.4g} m/s"


def stop(run: object, dt: float) -> NoReturn:
    """Stop a `Run` at a rigid body or a lost particle, or if neither is recorded at the first unsound particle.

    `dt` is the step, s.
    """
    if (broken := run.broken_body()) is not None:
        limit, advice = run.nearest_limit, SUGGESTIONS[NOT_FINITE]
        place = tuple(np.array(broken.moments.center).tolist())
        name, cause = broken.name, f"at the start {POSE}"
        raise UnstableRunError(Diagnosis(run.step_count, run.time, None, name, place, cause, limit.name, dt, advice))
    for group, known in zip(run.groups, run.lost(), strict=True):
        snapshot = read_group(group)
        p = first_unsound(snapshot) if known is None else known
        if p is not None:
            _stop_at(run, snapshot, p, cause_of(snapshot, p, dt, run.scene.domain), dt)
    raise AssertionError("a step reported a lost particle, but none was found")


def stop_collapsed(run: object, step: float) -> NoReturn:
    """Stop a run at the fastest moving or deforming particle, which requires the smallest step, s."""
    snapshots = [read_group(group) for group in run.groups]
    rates = [rate_of_change(snapshot, run.spacing) for snapshot in snapshots]
    worst = max(range(len(snapshots)), key=lambda g: rates[g].max())
    first = run.state.first_stable_step
    cause = f"allows a step of only {step:.3g} s, compared with {first:.3g} s at the start of the run"
    _stop_at(run, snapshots[worst], int(rates[worst].argmax()), cause, step)


def require_sums_hold(run: object) -> None:
    """Stop a run if sums in fixed point were exceeded."""
    particle, node = run.grid.fixed.found_beyond(run.slot)
    if particle is not None or node is not None:
        place = None if node is None else (np.array(np.unravel_index(node, run.grid.shape)) - PAD) * run.spacing
        snapshot, p = first_beyond([read_group(group) for group in run.groups], particle, place)
        _stop_at(run, snapshot, p, DENSER if particle is None else FASTER, run.last_step)


def _stop_at(run: object, snapshot: Snapshot, p: int, cause: str, dt: float) -> NoReturn:
    """Stop a run at particle p (in solver order) of a group for this cause, in a step of dt, s."""
    limit = run.nearest_limit
    advice = next((advice for start, advice in SUGGESTIONS.items() if cause.startswith(start)), OTHERWISE)
    if run.forced and dt > limit.value:
        advice = FORCED
    name, found = run.scene.sources[int(snapshot.body[p])].name, int(snapshot.id[p])
    place = tuple((snapshot.x[p].astype(np.float64) + run.scene.domain.origin).tolist())
    raise UnstableRunError(Diagnosis(run.step_count, run.time, found, name, place, cause, limit.name, dt, advice))

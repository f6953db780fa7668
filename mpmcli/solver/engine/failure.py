"""Stops a run whose state is no longer physical: finds the particle, and says what happened to it."""

from typing import NoReturn

import numpy as np

from mpmcli.solver.frames.diagnosis import (
    DENSER,
    FASTER,
    Snapshot,
    UnstableRunError,
    cause_of,
    diagnose,
    first_beyond,
    first_unsound,
    rate_of_change,
    read_group,
)
from mpmcli.solver.transfer.splines import PAD


def stop(run: object, dt: float) -> NoReturn:
    """Stop a `Run` at a lost particle; if none is known, at the first one that is not sound. `dt` is the step, s."""
    for group, known in zip(run.groups, run.lost(), strict=True):
        snapshot = read_group(group)
        p = first_unsound(snapshot) if known is None else known
        if p is not None:
            _stop_at(run, snapshot, p, cause_of(snapshot, p, dt, run.scene.domain), dt)
    raise AssertionError("a step reported a lost particle and kept no trace of it")


def stop_collapsed(run: object, step: float) -> NoReturn:
    """Stop a run at the particle that requires the smallest step, s: the one that moves or deforms fastest."""
    snapshots = [read_group(group) for group in run.groups]
    rates = [rate_of_change(snapshot, run.spacing) for snapshot in snapshots]
    worst = max(range(len(snapshots)), key=lambda g: rates[g].max())
    first = run.state.first_stable_step
    cause = f"allows a step of only {step:.3g} s, where the run began with {first:.3g} s"
    _stop_at(run, snapshots[worst], int(rates[worst].argmax()), cause, step)


def require_room(run: object) -> None:
    """Stop a run where sums in fixed point had no room."""
    particle, node = run.grid.fixed.found_beyond(run.slot)
    if particle is not None or node is not None:
        place = None if node is None else (np.array(np.unravel_index(node, run.grid.shape)) - PAD) * run.spacing
        snapshot, p = first_beyond([read_group(group) for group in run.groups], particle, place)
        _stop_at(run, snapshot, p, DENSER if particle is None else FASTER, run.last_step)


def _stop_at(run: object, snapshot: Snapshot, p: int, cause: str, dt: float) -> NoReturn:
    limit = run.nearest_limit
    forced = run.forced and dt > limit.value
    raise UnstableRunError(diagnose(snapshot, p, cause, run.scene, run.step_count, run.time, dt, limit, forced=forced))

"""Measures how many trajectories of a sweep one worker and all workers compute and store, alternately (A B A B)."""

import tempfile
from collections.abc import Callable
from pathlib import Path

from mpmcli.bench.cases import CASES, BenchCase
from mpmcli.bench.compare import Setting, Worker, start_worker
from mpmcli.bench.sand_block import FRAMES, sand_sweep
from mpmcli.bench.throughput_report import PEER_THREADS, ThroughputReport, ThroughputResult
from mpmcli.dataset.sweep_run import run_sweep
from mpmcli.dataset.sweep_state import SweepSettings, SweepState
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import estimate_particles, parse_scene

# Blocks of each number of workers.
ROUNDS = 2
# Trajectories of the first sweep, which is not measured: it compiles the kernels, and gives the time of a trajectory.
WARM_UP = 4
# Length of a block of the peer, s.
PEER_SECONDS = 2.0


def run_throughput(
    workers: int,
    seconds: float = 20.0,
    progress: Callable[[str], None] | None = None,
    *,
    rounds: int = ROUNDS,
    trajectories: int | None = None,
    frames: int = FRAMES,
    start: Callable[[str, BenchCase, Setting], Worker] = start_worker,
) -> ThroughputReport:
    """Compute and store the sweep of `sand_block` with one worker and with `workers` in turn, and mpm88 between.

    Every block is a sweep of its own, in a temporary directory, by new worker processes; their start does not count.

    Args:
        workers: processes, of one thread each.
        seconds: length of a block, about.
        progress: called with a line of text for each block.
        rounds: blocks of each number of workers.
        trajectories: of each worker in a block, in place of `seconds`.
        frames: of a trajectory, after the first.
        start: makes the process of the peer; tests replace it.

    Raises:
        RunError: the peer could not start or failed, or a sweep could not write.
        InputError: the disk for temporary files is too small.
    """
    tell = progress or (lambda line: None)
    peer_rates: list[float] = []
    blocks: dict[int, list[SweepState]] = {count: [] for count in sorted({1, workers})}
    with start("peer", CASES[0], Setting(PEER_THREADS)) as peer:
        peer.ask("first")
        peer.ask("run 0.3")
        tell(f"first block, not measured: {WARM_UP} trajectories")
        each = _warm_up(frames)
        share = trajectories or max(1, round(seconds / each))
        for round_number in range(rounds):
            answer = peer.ask(f"run {PEER_SECONDS}")
            peer_rates.append(CASES[0].particles * answer["steps"] / answer["seconds"])
            for count, states in blocks.items():
                states.append(_block(count, count * share, frames))
                tell(
                    f"round {round_number + 1} of {rounds}, workers: {count}: "
                    f"{states[-1].per_hour:,.0f} trajectories per hour"
                )
    with tempfile.TemporaryDirectory() as folder:
        base = sand_sweep(Path(folder), 1, frames).base_data
    particles = estimate_particles(parse_scene(base, laws=parameter_models(), source=base["title"]).scene)
    return ThroughputReport(
        results=tuple(_result(count, states, particles) for count, states in blocks.items()),
        peer_rates=tuple(peer_rates),
        particles=particles,
        frames=frames,
        seconds=None if trajectories else seconds,
    )


def _block(
    workers: int, count: int, frames: int, on_progress: Callable[[SweepState], None] | None = None
) -> SweepState:
    """Compute a sweep in a temporary directory, which is removed, and return its last state."""
    with tempfile.TemporaryDirectory() as folder:
        sweep = sand_sweep(Path(folder), count, frames)
        settings = SweepSettings(Path(folder) / "dataset", workers=workers, arch="cpu")
        return run_sweep(sweep, settings, on_progress or (lambda state: None))


def _warm_up(frames: int) -> float:
    """Compile what the sweep needs, and return the time of a trajectory after the first, s."""
    ends: list[tuple[int, float]] = []
    _block(1, WARM_UP, frames, lambda state: ends.append((state.done, state.seconds)))
    (first, begin), (last, end) = ends[0], ends[-1]
    return (end - begin) / max(1, last - first)


def _result(workers: int, states: list[SweepState], particles: int) -> ThroughputResult:
    done = sum(state.done for state in states)
    return ThroughputResult(
        workers=workers,
        per_hour=tuple(state.per_hour for state in states),
        seconds=tuple(state.seconds for state in states),
        trajectories=done,
        accepted=sum(state.accepted for state in states),
        steps=sum(state.particle_steps for state in states) / (particles * done),
    )

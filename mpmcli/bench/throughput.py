"""Throughput of a sweep: trajectories that one worker and all workers compute and store, alternately (A B A B).

The sweep is a block of dry sand thrown in a closed square, the scene of the GNS project's generator: 64 x 64 cells,
1,444 particles, and 350 frames of 2.5 ms.
"""

import statistics
import tempfile
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

from mpmcli.bench.cases import CASES
from mpmcli.bench.peers import Peer
from mpmcli.bench.report import describe_machine, page
from mpmcli.bench.worker import Side
from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.dataset.sweep_run import SweepSettings, SweepState, run_sweep
from mpmcli.materials.registry import parameter_models
from mpmcli.plain_text import text_table

# Trajectories of the first sweep, which compiles the kernels and gives the time of a trajectory. It is not measured.
WARM_UP = 4
# Length of a block of the peer, s.
PEER_SECONDS = 2.0
# Processor time, s, of the GNS project's generator for a trajectory on one core, and the rate of mpm88 on the same
# machine, particle-steps/s, with the particles and cells of the case 2d-64 and two threads. Their product converts the
# time to the present machine.
GENERATOR_SECONDS = 8.4
GENERATOR_PEER_RATE = 6.5e6
PEER_THREADS = 2
# Frames of a trajectory after the first, and the interval between them, s.
FRAMES = 350
INTERVAL = 2.5e-3
SCENE = """\
title = "A block of sand"
[domain]
size = [1.0, 1.0]
cells = [64, 64]
gravity = [0.0, -9.81]
walls = "stick"
[time]
end = {end!r}
frames = {frames}
[[bodies]]
name = "sand"
material = {{ preset = "sand", youngs_modulus = 2.0e6, friction_angle = 30.0 }}
shape = {{ box = {{ min = [0.35, 0.4], max = [0.65, 0.7] }} }}
velocity = [1.0, 0.0]
"""
# The varied parameters change neither the number of particles nor the step.
SWEEP = """\
base = "base.toml"
count = {count}
seed = 1
[vary]
"bodies.sand.material.friction_angle" = {{ uniform = [25, 40] }}
"bodies.sand.velocity.0" = {{ uniform = [-1.0, 1.0] }}
"""


def sand_sweep(directory: Path, count: int, frames: int = FRAMES) -> Sweep:
    """Write a sweep of `count` trajectories and its scene to a directory, and return the sweep."""
    (directory / "base.toml").write_text(SCENE.format(end=frames * INTERVAL, frames=frames), encoding="utf-8")
    path = directory / "sweep.toml"
    path.write_text(SWEEP.format(count=count), encoding="utf-8")
    return load_sweep(path, laws=parameter_models())


def run_throughput(
    workers: int, seconds: float, blocks: int, tell: Callable[[str], None], *, frames: int = FRAMES
) -> dict:
    """Run a sweep with one worker and one with all workers, alternately, and return a record for JSON.

    This is repeated `blocks` times; mpm88 is measured before each repetition. A sweep takes about `seconds` s. `tell`
    receives progress messages. RunError: mpm88 or a sweep failed.
    """
    found: dict[int, list[SweepState]] = {count: [] for count in sorted({1, workers})}
    with closing(Side("mpm88", partial(Peer, CASES[0], PEER_THREADS), by_processor=False)) as peer:
        peer.measure(0.3)
        peer.blocks.clear()
        tell(f"first block, not measured: {WARM_UP} trajectories")
        # This sweep compiles the kernels. The time of a trajectory is measured from the end of the first one.
        ends: list[tuple[int, float]] = []
        _block(1, WARM_UP, frames, lambda state: ends.append((state.done, state.seconds)))
        (first, begin), (last, end) = ends[0], ends[-1]
        share = max(1, round(seconds / ((end - begin) / max(1, last - first))))
        for number in range(blocks):
            peer.measure(PEER_SECONDS)
            for count, states in found.items():
                states.append(_block(count, count * share, frames))
                tell(f"round {number + 1} of {blocks}, workers: {count}: {states[-1].per_hour:,.0f} per hour")
        rate = 1e9 / peer.cost
    # Estimated time of the generator for a trajectory on one core of this machine.
    generator = GENERATOR_SECONDS * GENERATOR_PEER_RATE / rate
    facts = {"frames": frames, "peer_particle_steps_per_s": rate, "generator_s": generator}
    results = [_result(count, states, generator) for count, states in found.items()]
    return {"machine": describe_machine(), **facts, "results": results}


def _block(
    workers: int, count: int, frames: int, on_progress: Callable[[SweepState], None] = lambda state: None
) -> SweepState:
    """Compute a sweep in a temporary directory, which is removed, and return its last state."""
    with tempfile.TemporaryDirectory() as folder:
        sweep = sand_sweep(Path(folder), count, frames)
        return run_sweep(sweep, SweepSettings(Path(folder) / "dataset", workers=workers, arch="cpu"), on_progress)


def _result(workers: int, states: list[SweepState], generator: float) -> dict:
    """Return the results for one number of workers; ratios are to one generator process per worker."""
    rates = [state.per_hour for state in states]
    return {
        "workers": workers,
        "trajectories_per_hour": statistics.median(rates),
        "trajectories_per_hour_blocks": rates,
        "ratio": statistics.median(rates) * generator / 3600 / workers,
        "ratio_blocks": [rate * generator / 3600 / workers for rate in rates],
        "trajectories": sum(state.done for state in states),
        "accepted": sum(state.accepted for state in states),
    }


def throughput_table(record: dict) -> str:
    """Return the record of the sweeps as text: one line per number of workers, then the meaning of the columns."""
    rows = []
    for row in record["results"]:
        low, high = min(row["ratio_blocks"]), max(row["ratio_blocks"])
        each = f"{3600 * row['workers'] / row['trajectories_per_hour']:.2f}"
        cells = [f"{row['workers']}", f"{row['accepted']:,} of {row['trajectories']:,}", each]
        rows.append([*cells, f"{row['trajectories_per_hour']:,.0f}", f"{row['ratio']:.1f} ({low:.1f} to {high:.1f})"])
    head = ["workers", "accepted", "s per core", "per hour", "ratio"]
    notes = (
        "per hour: trajectories computed and stored, after every worker has ended a task; median of the blocks.",
        f"ratio: to the GNS project's generator on each core, {record['generator_s']:.1f} s per trajectory. It took",
        f"{GENERATOR_SECONDS} s where mpm88 at 2d-64 on {PEER_THREADS} threads reached {GENERATOR_PEER_RATE / 1e6:.1f}",
        f"million particle-steps/s; here mpm88 reaches {record['peer_particle_steps_per_s'] / 1e6:.2f}.",
    )
    what = f"cpu, a block of sand: 1,444 particles, 64 x 64 cells, {record['frames']} frames"
    return page(record["machine"], what, text_table(head, rows, left=set()), notes)

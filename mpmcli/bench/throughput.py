"""How many trajectories of a sweep one worker and all workers compute and store, alternately (A B A B).

The sweep is a block of dry sand thrown about in a closed square, the scene of the GNS project's generator: 64 x 64
cells, 1,444 particles, and 350 frames of 2.5 ms.
"""

import statistics
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from mpmcli.bench.cases import CASES
from mpmcli.bench.report import PRECISION, describe_machine, page, rows_text, span
from mpmcli.bench.side import BenchOptions, Setting
from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.dataset.sweep_run import SweepSettings, SweepState, run_sweep
from mpmcli.materials.registry import parameter_models
from mpmcli.plain_text import counted
from mpmcli.scene import estimate_particles, parse_scene

# Blocks of each number of workers.
ROUNDS = 2
# Trajectories of the first sweep, which is not measured: it compiles the kernels, and gives the time of a trajectory.
WARM_UP = 4
# Length of a block of the peer, s.
PEER_SECONDS = 2.0
# The generator of the GNS project takes this processor time, s, for a trajectory on one core, measured on a machine
# where mpm88, with the particles and cells of the case 2d-64 and on two threads, made so many particle-steps/s. Their
# product carries the time over to the present machine.
GENERATOR_SECONDS = 8.4
GENERATOR_PEER_RATE = 6.5e6
PEER_THREADS = 2
# Frames of a trajectory after the first, and the time between two of them, s.
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
# What is drawn changes neither the number of particles nor the step.
SWEEP = """\
base = "base.toml"
count = {count}
seed = 1
[vary]
"bodies.sand.material.friction_angle" = {{ uniform = [25, 40] }}
"bodies.sand.velocity.0" = {{ uniform = [-1.0, 1.0] }}
"""


def sand_sweep(directory: Path, count: int, frames: int = FRAMES) -> Sweep:
    """Write the sweep of so many trajectories and its scene to a directory, and return it."""
    (directory / "base.toml").write_text(SCENE.format(end=frames * INTERVAL, frames=frames), encoding="utf-8")
    path = directory / "sweep.toml"
    path.write_text(SWEEP.format(count=count), encoding="utf-8")
    return load_sweep(path, laws=parameter_models())


def throughput_table(record: dict) -> str:
    """Return the record of the sweeps as text: one line per number of workers, then what the columns mean."""
    columns = [
        ("workers", lambda row: f"{row['workers']}"),
        ("trajectories", lambda row: f"{row['trajectories']:,}"),
        ("steps of each", lambda row: f"{row['steps']:,.0f}"),
        ("per hour", lambda row: f"{row['trajectories_per_hour']:,.0f}"),
        ("range", lambda row: "{:,.0f}-{:,.0f}".format(*span(row["trajectories_per_hour_blocks"]))),
        ("s per core", lambda row: f"{3600 * row['workers'] / row['trajectories_per_hour']:.2f}"),
        ("ratio", lambda row: f"{row['ratio']:.1f}"),
        ("range", lambda row: f"{row['ratio_min']:.1f}-{row['ratio_max']:.1f}"),
    ]
    notes = (
        "per hour: trajectories computed and stored, median of the blocks, once every worker has ended a task.",
        "s per core: time of a trajectory on each core.",
        "ratio: to the GNS project's generator, one process on each core, with"
        f" {record['generator_s']:.1f} s for a trajectory. It took {GENERATOR_SECONDS} s",
        f"where mpm88 at 2d-64 on {PEER_THREADS} threads made {GENERATOR_PEER_RATE / 1e6:.1f} million"
        f" particle-steps/s; here mpm88 makes {record['peer_particle_steps_per_s'] / 1e6:.2f}.",
    )
    refused = [
        f"with {counted(row['workers'], 'worker')} {row['trajectories'] - row['accepted']} of "
        f"{counted(row['trajectories'], 'trajectory')} were not accepted."
        for row in record["results"]
        if row["accepted"] < row["trajectories"]
    ]
    machine, frames = record["machine"], counted(record["frames"], "frame")
    scene = f"A block of sand: {record['particles']:,} particles, 64 x 64 cells, {frames}."
    top = f"{machine['processor']}, cpu, {PRECISION}, taichi {machine['taichi']}\n{scene}"
    return page(top, [rows_text(record["results"], columns, left=set())], notes, refused)


def throughput_record(
    results: Sequence[dict], peer_rates: Sequence[float], particles: int, frames: int, seconds: float | None
) -> dict:
    """Return sweeps for JSON; ratios are to a generator process for each worker, by mpm88's `peer_rates`."""
    peer_rate = statistics.median(peer_rates)
    # What the generator would take for a trajectory on one core of this machine.
    generator = GENERATOR_SECONDS * GENERATOR_PEER_RATE / peer_rate
    rows = []
    for result in results:
        low, high = span(result["trajectories_per_hour_blocks"])
        rates = {"ratio": result["trajectories_per_hour"], "ratio_min": low, "ratio_max": high}
        rows.append(result | {key: rate * generator / 3600 / result["workers"] for key, rate in rates.items()})
    return {
        "machine": describe_machine(),
        "particles": particles,
        "frames": frames,
        "block_s": seconds,
        "peer_name": "mpm88",
        "peer_case": "2d-64",
        "peer_threads": PEER_THREADS,
        "peer_particle_steps_per_s": peer_rate,
        "peer_particle_steps_per_s_blocks": list(peer_rates),
        "generator_s": generator,
        "results": rows,
    }


def run_throughput(options: BenchOptions, *, trajectories: int | None = None, frames: int = FRAMES) -> dict:
    """Compute sweeps with one worker and all in turn, mpm88 between; RunError: the peer or a sweep failed."""
    tell, case = options.progress, CASES[0]
    peer_rates: list[float] = []
    blocks: dict[int, list[SweepState]] = {count: [] for count in sorted({1, *options.threads})}
    with options.start("peer", case, Setting(PEER_THREADS)) as peer:
        peer.ask("first")
        peer.ask("run 0.3")
        tell(f"first block, not measured: {WARM_UP} trajectories")
        each = _warm_up(frames)
        share = trajectories or max(1, round(options.seconds / each))
        for number in range(options.blocks):
            answer = peer.ask(f"run {PEER_SECONDS}")
            peer_rates.append(case.particles * answer["steps"] / answer["seconds"])
            for count, states in blocks.items():
                states.append(_block(count, count * share, frames))
                rate = f"{states[-1].per_hour:,.0f} trajectories per hour"
                tell(f"round {number + 1} of {options.blocks}, workers: {count}: {rate}")
    with tempfile.TemporaryDirectory() as folder:
        base = sand_sweep(Path(folder), 1, frames).base_data
    particles = estimate_particles(parse_scene(base, laws=parameter_models(), source=base["title"]).scene)
    results = [_result(count, states, particles) for count, states in blocks.items()]
    return throughput_record(results, peer_rates, particles, frames, None if trajectories else options.seconds)


def _block(
    workers: int, count: int, frames: int, on_progress: Callable[[SweepState], None] = lambda state: None
) -> SweepState:
    """Compute a sweep in a temporary directory, which is removed, and return its last state."""
    with tempfile.TemporaryDirectory() as folder:
        sweep = sand_sweep(Path(folder), count, frames)
        return run_sweep(sweep, SweepSettings(Path(folder) / "dataset", workers=workers, arch="cpu"), on_progress)


def _warm_up(frames: int) -> float:
    """Compile what the sweep needs, and return the time of a trajectory after the first, s."""
    ends: list[tuple[int, float]] = []
    _block(1, WARM_UP, frames, lambda state: ends.append((state.done, state.seconds)))
    (first, begin), (last, end) = ends[0], ends[-1]
    return (end - begin) / max(1, last - first)


def _result(workers: int, states: list[SweepState], particles: int) -> dict:
    """Return what the blocks of one number of workers tell, for JSON; steps: mean number of a trajectory."""
    done = sum(state.done for state in states)
    rates = [state.per_hour for state in states]
    return {
        "workers": workers,
        "trajectories_per_hour": statistics.median(rates),
        "trajectories_per_hour_blocks": rates,
        "blocks_s": [state.seconds for state in states],
        "trajectories": done,
        "accepted": sum(state.accepted for state in states),
        "steps": sum(state.particle_steps for state in states) / (particles * done),
    }

"""Many small runs at once: the block of sand of `mpmcli bench --dataset`, with frames, but not stored."""

import time
import tomllib
from collections.abc import Sequence

from page_section import markdown_table

from gpu_parts.parts import Setup, Task
from gpu_parts.report import measured

# Runs at once; a trajectory has 350 frames, of which these are computed.
COUNTS = (1, 32, 256, 1024)
FRAMES, TRAJECTORY = 70, 350
# Angles of friction, degrees.
SMALLEST, LARGEST = 25.0, 40.0


def tasks(setup: Setup) -> Sequence[Task]:
    """Return a task for each number of runs."""
    counts, frames = setup.sized((2,), (1, 8), COUNTS), setup.sized(1, 5, FRAMES)
    return [Task(f"{count:,} at once", lambda left, n=count: together(n, frames, setup.arch)) for count in counts]


def together(count: int, frames: int, arch: str) -> dict:
    """Compute some runs at once, after a short pass that compiles."""
    from mpmcli.simulation.recording import Recording
    from mpmcli.simulation.runner import Runner

    runner = Runner(arch, None, most_runs=count)
    began = time.perf_counter()
    list(runner.run_all(scenes(count, 1)))
    compiled = time.perf_counter() - began
    began = time.perf_counter()
    outcomes = [outcome for _, outcome in runner.run_all(scenes(count, frames))]
    seconds = time.perf_counter() - began
    recordings = [outcome for outcome in outcomes if isinstance(outcome, Recording)]
    if not recordings:
        raise outcomes[0]
    work = sum(recording.steps * recording.particles for recording in recordings)
    return {
        "runs": count,
        "completed": len(recordings),
        "stable": sum(recording.verdict == "stable" for recording in recordings),
        "frames": frames,
        "particles": recordings[0].particles,
        "steps": recordings[0].steps,
        "first_pass_s": compiled,
        "seconds": seconds,
        "particle_steps_per_s": work / seconds,
        "trajectories_per_hour": 3600 * len(recordings) / seconds * frames / TRAJECTORY,
    }


def scenes(count: int, frames: int) -> list:
    """Return blocks of sand with angles of friction from 25 to 40 degrees."""
    from mpmcli.bench.throughput import INTERVAL, SCENE
    from mpmcli.materials.registry import parameter_models
    from mpmcli.scene import parse_scene

    found = []
    for place in range(count):
        data = tomllib.loads(SCENE.format(end=frames * INTERVAL, frames=frames))
        data["bodies"][0]["material"]["friction_angle"] = SMALLEST + (LARGEST - SMALLEST) * (place + 0.5) / count
        found.append(parse_scene(data, laws=parameter_models(), source=data["title"]).scene)
    return found


def section(rows: dict[str, dict]) -> str:
    """Return a line for each number of runs."""
    cells = [
        [
            key,
            f"{row['completed']:,}, {row['stable']:,} stable",
            f"{row['frames']} of {TRAJECTORY}",
            f"{row['steps']:,}",
            f"{row['first_pass_s']:.1f} + {row['seconds']:.1f}",
            f"{row['particle_steps_per_s'] / 1e6:,.4g}",
            f"{row['trajectories_per_hour']:,.0f}",
        ]
        for key, row in measured(rows).items()
    ]
    head = [
        "runs",
        "completed",
        "frames",
        "steps of each",
        "first pass + measured, s",
        "M particle-steps/s",
        "trajectories/h",
    ]
    return markdown_table(head, cells, {3, 5, 6})

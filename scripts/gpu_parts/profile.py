"""The time that each launch on the device takes, by Taichi's profiler, which ends a process on Vulkan.

`python -m gpu_parts.profile ARCH WHO DIMENSION PARTICLES CELLS STEP` prints it as JSON.
"""

import json
import os
import subprocess
import sys

from page_section import markdown_table

# Steps that are profiled, after some that compile and sort.
STEPS, FIRST = 40, 10
# Launches that take longest, of which a row tells.
MOST = 12
# Share of a step from which the report has a launch.
SHOWN = 0.02


def profile(arch: str, who: str, dimension: int, particles: int, cells: int, step: float) -> dict:
    """Return the launches of some steps that take longest, by a process of its own.

    Raises:
        RuntimeError: it failed.
    """
    arguments = [arch, who, *map(str, (dimension, particles, cells, step))]
    done = subprocess.run([sys.executable, "-m", "gpu_parts.profile", *arguments], capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"status {done.returncode}: {done.stderr.strip()[-600:]}")
    return json.loads(done.stdout.splitlines()[-1])


def measure(arch: str, who: str, dimension: int, particles: int, cells: int, step: float) -> dict:
    """Take the steps in this process and return what the profiler counted, per step."""
    os.environ["TI_KERNEL_PROFILER"] = "1"
    from taichi.profiler.kernel_profiler import get_default_kernel_profiler

    from mpmcli.bench.cases import BenchCase
    from mpmcli.bench.ours import falling_block

    case = BenchCase(dimension=dimension, cells=cells, particles=particles, step=step)
    run = falling_block(case, who, threads=1, precision="f32", arch=arch)
    profiler = get_default_kernel_profiler()
    run.advance(FIRST)
    run.sync()
    profiler.clear_info()
    run.advance(STEPS)
    run.sync()
    profiler.query_info("")
    launches = [
        {"name": one.name, "launches": one.counter / STEPS, "us": 1e3 * one.total_time / STEPS}
        for one in profiler._statistical_results.values()
    ]
    launches.sort(key=lambda one: -one["us"])
    return {"us": sum(one["us"] for one in launches), "launches": launches[:MOST]}


def section(rows: dict[str, dict]) -> str:
    """Return the launches of all profiles, those that take longest first, with their share of the time of a step."""
    cells = [
        [key, f"`{one['name']}`", f"{one['launches']:g}", f"{one['us']:.1f}", f"{one['us'] / row['us']:.0%}"]
        for key, row in rows.items()
        for one in row["launches"]
        if one["us"] >= SHOWN * row["us"]
    ]
    return markdown_table(["run", "launch", "per step", "us per step", "share"], cells, {2, 3, 4})


if __name__ == "__main__":
    ARCH, WHO, DIMENSION, PARTICLES, CELLS, STEP = sys.argv[1:]
    print(json.dumps(measure(ARCH, WHO, int(DIMENSION), int(PARTICLES), int(CELLS), float(STEP))))

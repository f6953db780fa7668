"""Measures steps of a scene on a device, and prints a line of JSON: one process for each measurement of scripts/gpu."""

import argparse
import ast
import importlib
import json
import os
import re
import time
from collections.abc import Callable

from mpmcli.bench.cases import CASES, BenchCase
from mpmcli.bench.ours import falling_block
from mpmcli.materials.registry import parameter_models
from mpmcli.quick_taichi import ti
from mpmcli.scene import BodyParticles, Scene, load_scene, parse_scene, sample_bodies
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import Run, frames_of_all
from mpmcli.solver.machine.backend import choose_backend, start


def main() -> None:
    """Print what is measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", help="a case of mpmcli bench, or a scene file: its time.end is that of two frames")
    parser.add_argument("--arch", default="cuda")
    parser.add_argument("--runs", type=int, default=1, help="runs that advance together")
    parser.add_argument("--steps", type=int, default=500, help="of each of the two frames of a case")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="in a scene file")
    parser.add_argument("--optimisation", choices=("few", "most", "all"))
    parser.add_argument("--constant", action="append", default=[], metavar="MODULE.NAME=VALUE", help="in mpmcli.solver")
    options = parser.parse_args()
    for setting in options.constant:
        name, _, value = setting.partition("=")
        module, _, constant = name.rpartition(".")
        setattr(importlib.import_module(f"mpmcli.solver.{module}"), constant, ast.literal_eval(value))
    print(json.dumps(measured(options)))


def measured(options: argparse.Namespace) -> dict:
    """Return what compiling took, s, and a step between the first frame and the second, ms.

    `host_ms` is the time in which the host asks for launches; on CUDA those before run meanwhile. `kernels` has each
    launch by the name of its kernel, the number of its variant and its own, if the environment variable
    TI_KERNEL_PROFILER is 1; then a step takes longer.
    """
    backend = start(choose_backend(options.arch, 1, compile_cache=False, optimisation=options.optimisation))
    scene, particles = scene_of(options)
    particles = particles or sample_bodies(scene)
    batch = Batch(Resolved(scene, particles).kind.padded(), backend, options.runs)
    runs = {slot: Run(batch, slot, scene, particles, force=True) for slot in range(options.runs)}
    call, spent, marks, profiled = batch.gpu._call, [0.0], [], os.environ.get("TI_KERNEL_PROFILER") == "1"

    def timed(kernel: Callable, *arguments: int) -> None:
        began = time.perf_counter()
        call(kernel, *arguments)
        spent[0] += time.perf_counter() - began

    batch.gpu._call = timed
    for slot, event in frames_of_all(runs):
        if isinstance(event, Exception):
            raise event
        if slot == 0 and event is not None:
            marks.append((time.perf_counter(), spent[0], runs[0].step_count))
            if profiled and len(marks) == 2:
                ti.profiler.clear_kernel_profiler_info()
    seconds, host, steps = (after - before for before, after in zip(marks[-2], marks[-1], strict=True))
    found = {
        "particles": runs[0].particle_count,
        "runs": options.runs,
        "steps": steps,
        "step_ms": 1e3 * seconds / steps,
    }
    found |= {"host_ms": 1e3 * host / steps, "compile_s": batch.first_seconds, "kernels": {}}
    if profiled:
        # Only if the profiler runs, or the process ends here.
        for record in ti.lang.impl.get_runtime().prog.get_kernel_profiler_records():
            name = re.sub(r"_c\d+_(\d+)(_kernel)?_(\d+)_.*", r" \1.\3", record.name)
            found["kernels"][name] = found["kernels"].get(name, 0.0) + record.kernel_time / steps
    return found


def scene_of(options: argparse.Namespace) -> tuple[Scene, list[BodyParticles] | None]:
    """Return the scene with two frames after the first, and the particles of a case."""
    case: BenchCase | None = next((case for case in CASES if case.name == options.scene), None)
    if case is None:
        settings = [*options.set, "time.frames=2"]
        return load_scene(options.scene, settings, laws=parameter_models()).scene, None
    data, particles = falling_block(case)
    data["time"] |= {"end": 2 * options.steps * case.step, "frames": 2}
    return parse_scene(data, laws=parameter_models(), source=data["title"]).scene, particles


if __name__ == "__main__":
    main()

"""Speed at several sizes: fluid, solid, fluid with sums in fixed point, and the examples of the taichi package."""

import statistics
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass

from page_section import markdown_table

from gpu_parts import profile
from gpu_parts.parts import Setup, Task
from gpu_parts.report import measured
from mpmcli.bench.cases import BenchCase
from mpmcli.bench.side import Setting, Worker, start_worker
from mpmcli.errors import RunError
from mpmcli.solver.machine.device_memory import free_memory

# Blocks of each contestant, and their length, s; the first one is not measured.
BLOCKS, SECONDS = 3, 0.7
# Contestants whose launches are timed.
PROFILED = ("ours", "solid")
# Share of the free memory of the device that a run may take, and bytes of a particle that the plan does not know.
SHARE, PEER_BYTES = 0.9, 80
# Bytes of a particle on the host: its initial state in double precision, and a copy.
HOST_BYTES = 250


@dataclass(frozen=True)
class Size:
    """A size, and who computes it, in turn.

    Attributes:
        cells: along each edge, a power of two, as mpm3d needs; the block fills 0.4 of it.
        step: s, in proportion to the cells, as the examples have it.
    """

    dimension: int
    particles: int
    cells: int
    step: float
    who: tuple[str, ...]

    @property
    def key(self) -> str:
        """Name of the row."""
        return f"{self.dimension}D {self.particles:,}"

    @property
    def case(self) -> BenchCase:
        """The size as the benchmark knows it."""
        return BenchCase(dimension=self.dimension, cells=self.cells, particles=self.particles, step=self.step)


TINY = (Size(3, 300, 16, 8e-4, ("ours", "peer")),)
SMALL = (
    Size(3, 10_000, 32, 4e-4, ("ours", "solid", "deterministic", "peer")),
    Size(2, 10_000, 128, 2e-4, ("ours", "peer")),
)
FULL = (
    Size(3, 1_000_000, 128, 8e-5, ("ours", "solid", "deterministic", "peer")),
    Size(3, 8_000_000, 256, 4e-5, ("ours", "solid", "peer")),
    Size(3, 100_000, 64, 2e-4, ("ours", "solid", "deterministic", "peer")),
    Size(2, 1_000_000, 1024, 2.5e-5, ("ours", "peer")),
    Size(3, 10_000_000, 256, 4e-5, ("ours", "solid", "deterministic", "peer")),
    Size(2, 100_000, 256, 1e-4, ("ours", "peer")),
)


def tasks(setup: Setup) -> Sequence[Task]:
    """Return a task for each size, and after the first one where its time goes."""
    sizes = setup.sized(TINY, SMALL, FULL)
    seconds = setup.sized(0.1, 0.4, SECONDS)
    first, *others = [Task(size.key, lambda left, s=size: compare(s, setup.arch, seconds)) for size in sizes]
    profiled = [who for who in sizes[0].who if who in PROFILED and setup.arch != "vulkan"]
    return [first, *(profiling(sizes[0], who, setup.arch) for who in profiled), *others]


def profiling(size: Size, who: str, arch: str) -> Task:
    """Return the task that profiles a contestant."""
    numbers = (size.dimension, size.particles, size.cells, size.step)
    return Task(f"profile {size.key} {who}", lambda left: profile.profile(arch, who, *numbers))


def compare(size: Size, arch: str, seconds: float) -> dict:
    """Measure the contestants of a size in turn, each in a process of its own; they compile side by side."""
    if reason := no_room(size, arch):
        return {"skipped": reason}
    rows: dict[str, dict] = {who: {"rates": []} for who in size.who}
    with ExitStack() as stack, ThreadPoolExecutor(len(size.who)) as pool:
        starting = {who: pool.submit(start, who, size, arch) for who in size.who}
        workers: dict[str, Worker] = {}
        for who, started in starting.items():
            try:
                workers[who], found = started.result()
                stack.enter_context(workers[who])
                rows[who] |= found
            except RunError as error:
                rows[who]["error"] = str(error)
        ask_all(pool, workers, rows, "first", lambda answer: {"first_step_s": answer["seconds"]})
        for block in range(BLOCKS + 1):
            for who in list(workers):
                length = seconds if block else 0.3 * seconds
                ask_all(pool, {who: workers[who]}, rows, f"run {length}", lambda answer: {"block": answer})
                answer = rows[who].pop("block", None)
                if answer is None:
                    del workers[who]
                elif block:
                    rows[who]["rates"].append(size.particles * answer["steps"] / answer["seconds"])
        ask_all(pool, workers, rows, "finish", lambda answer: answer)
    return {"cells": size.cells, "contestants": rows}


def ask_all(
    pool: ThreadPoolExecutor,
    workers: dict[str, Worker],
    rows: dict[str, dict],
    command: str,
    found: Callable[[dict], dict],
) -> None:
    """Ask contestants at once, and put into their rows what was found, or why one failed; that one is dropped."""
    asked = {who: pool.submit(worker.ask, command) for who, worker in workers.items()}
    for who, answer in asked.items():
        try:
            rows[who] |= found(answer.result())
        except RunError as error:
            rows[who]["error"] = str(error)
            del workers[who]


def start(who: str, size: Size, arch: str) -> tuple[Worker, dict]:
    """Start a contestant, and return it with what it takes on the device, where it has that to itself.

    Raises:
        RunError: it could not start.
    """
    alone = len(size.who) == 1
    before = free_memory(arch) if alone else None
    worker = start_worker(who, size.case, Setting(1, arch=arch))
    after = free_memory(arch) if alone else None
    return worker, {
        "planned_bytes_per_particle": worker.ready["bytes_per_particle"],
        "device_bytes": None if before is None or after is None else before - after,
        "start_s": worker.start_seconds,
    }


def no_room(size: Size, arch: str) -> str:
    """Return why a size cannot be computed, "" where it can, as far as is known before."""
    import psutil

    from mpmcli.bench.ours import scene_of
    from mpmcli.materials.registry import parameter_models
    from mpmcli.plain_text import size_text
    from mpmcli.scene import parse_scene
    from mpmcli.solver.machine.backend import choose_backend
    from mpmcli.solver.machine.plan import make_plan

    need = 0
    for who in size.who:
        grid_and_state = PEER_BYTES * size.particles + 16 * size.cells**size.dimension
        if who != "peer":
            data = scene_of(size.case, "f32", who)
            scene = parse_scene(data, laws=parameter_models(), source=data["title"]).scene
            plan = make_plan(scene, choose_backend(arch))
            grid_and_state = plan.bytes_per_particle * size.particles + plan.grid_bytes
        need += grid_and_state
    own, memory = free_memory(arch), psutil.virtual_memory()
    host = HOST_BYTES * size.particles * len(size.who) + (0 if own is not None else need)
    if own is not None and need > SHARE * own:
        return f"it needs {size_text(need)} on the device, where {size_text(own)} are free."
    # Some machines get their memory as it is used: what is there counts, not what is free.
    if host > SHARE * memory.total:
        return f"it needs {size_text(host)} of the machine, which has {size_text(memory.total)}."
    return ""


def section(rows: dict[str, dict]) -> str:
    """Return a line for each contestant, with its ratio to the example of the taichi package."""
    head = ["size", "cells", "who", "M particle-steps/s", "range", "times the example"]
    head += ["bytes/particle: planned, measured", "start + first step, s", "sound"]
    compared = {key: row for key, row in measured(rows).items() if "contestants" in row}
    profiles = {key: row for key, row in measured(rows).items() if "launches" in row}
    cells = []
    for key, row in compared.items():
        peer = row["contestants"].get("peer", {}).get("rates")
        for who, found in row["contestants"].items():
            cells.append([key, f"{row['cells']}", name_of(who, key), *figures(found, key, peer)])
    tables = [markdown_table(head, cells, {1, 3}), *([profile.section(profiles)] if profiles else [])]
    return "\n\n".join(tables)


def name_of(who: str, key: str) -> str:
    """Return the name of a contestant for people."""
    return {
        "ours": "fluid",
        "solid": "neo-Hookean solid",
        "deterministic": "fluid, deterministic",
        "peer": "`mpm3d`" if key.startswith("3D") else "`mpm88`",
    }[who]


def figures(found: dict, key: str, peer: list[float] | None) -> list[str]:
    """Return the figures of a contestant."""
    if "error" in found or not found.get("rates"):
        return ["-", found.get("error", "no block ended"), "-", "-", "-", "-"]
    rates, particles = found["rates"], int(key.split()[1].replace(",", ""))
    planned, taken = found["planned_bytes_per_particle"], found["device_bytes"]
    return [
        f"{statistics.median(rates) / 1e6:,.4g}",
        f"{min(rates) / 1e6:,.4g} to {max(rates) / 1e6:,.4g}",
        f"{statistics.median(rates) / statistics.median(peer):.2f}" if peer else "-",
        f"{planned or '-'}, {f'{taken / particles:.0f}' if taken is not None else '-'}",
        f"{found['start_s']:.1f} + {found['first_step_s']:.1f}",
        "yes" if found["sound"] else "**no**",
    ]

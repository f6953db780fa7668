"""What a device can do, whatever runs on it: bandwidth, launches, and reads and additions at scattered places."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.bench.report import describe_machine
from mpmcli.plain_text import counted, text_table

if TYPE_CHECKING:
    from mpmcli.solver.backend import Backend
    from mpmcli.solver.device_speed import DeviceKernels

# Numbers of 4 bytes in a table that no cache holds, and in one that the last cache of a processor or a GPU holds.
LARGE, SMALL = 1 << 25, 1 << 21
# The same where a loop may be no longer: a driver need not start more than 65,535 groups of threads, of 128 each.
LARGEST_ON_VULKAN = 1 << 22
# Measurements of each figure, of which the best one counts.
TRIES = 3
# Launches between two waits for the device.
LAUNCHES = 100

# Names of figures in the table, and their units.
ROWS = (
    ("copy", "copy_gb_per_s", "GB/s"),
    *((f"read, {order}", f"read_{order}_g_per_s", "1e9/s") for order in ("random", "sorted")),
    *((f"atomic add, {order}", f"atomic_add_{order}_g_per_s", "1e9/s") for order in ("random", "sorted", "same")),
    *((f"plain add, {order}", f"plain_add_{order}_g_per_s", "1e9/s") for order in ("random", "sorted", "same")),
)


@dataclass(frozen=True)
class DeviceReport:
    """What `measure_device` found, on which machine."""

    found: dict
    machine: dict = field(default_factory=describe_machine)

    def as_dict(self) -> dict:
        """Return everything measured, ready for JSON."""
        return {"machine": self.machine, "device": self.found}

    def table(self) -> str:
        """Return the report as text: rates of both tables, then launches."""
        found = self.found
        tables = [*found["tables"].values()]
        head = ("", *(f"{table['bytes'] / 2**20:.3g} MiB" for table in tables), "")
        rows = [
            (name, *(f"{table[key]:.3g}" for table in tables), unit) for name, key, unit in ROWS if key in tables[0]
        ]
        loops = ", ".join(f"{counted(int(count), 'loop')} {us:.1f}" for count, us in found["launch_us"].items())
        lines = [
            f"{self.machine['processor']}, {found['arch']}, {counted(found['threads'], 'thread')}, "
            f"taichi {self.machine['taichi']}",
            "",
            text_table(head, rows, left={0, len(head) - 1}),
            "",
            f"Launch of a kernel, us: {loops}; with a number from the host {found['launch_with_argument_us']:.1f}; and",
            f"waiting for it {found['launch_and_wait_us']:.1f}.",
            *(
                [f"Copy by the C library on one thread: {found['memcpy_gb_per_s']:.3g} GB/s, read and written."]
                if "memcpy_gb_per_s" in found
                else []
            ),
            "sorted: eight neighbours at each place; same: all at one place; plain: load, add, store, on one thread.",
        ]
        return "\n".join(lines)


def measure_device(backend: "Backend", seconds: float = 0.05, large: int = LARGE, small: int = SMALL) -> dict:
    """Measure the device of a backend that was started, and return the figures, ready for JSON.

    Rates are the best of TRIES measurements, of at least `seconds` each. A launch is one of a kernel of 1 to 4 loops of
    1,024 iterations; many follow each other before the host waits, except for `launch_and_wait_us`. The additions are
    atomic f32 additions, as P2G makes on a GPU: at random places, eight neighbours at each place (sorted particles of a
    cell), and all at one place. On the CPU `plain_add_*` is load, add and store on one thread.

    Args:
        backend: that runs.
        seconds: length of a measurement.
        large, small: numbers in the tables, powers of two; Vulkan takes at most LARGEST_ON_VULKAN.

    Returns:
        Of each table its bytes, GB/s of a copy (read and written), and rates in 1e9/s; of launches their time, us.
        All of its memory is given back.
    """
    from mpmcli.solver.device_speed import build_device_kernels

    if backend.arch == "vulkan":
        large = min(large, LARGEST_ON_VULKAN)
    tables, launches = {}, {}
    for name, places in (("large", large), ("small", small)):
        kernels = build_device_kernels(places, on_cpu=backend.on_cpu)
        try:
            tables[name] = _measure_table(kernels, places, seconds)
            if not launches:
                launches = _measure_launches(kernels, seconds)
        finally:
            kernels.free()
    found = {"arch": backend.arch, "threads": backend.threads, **launches, "tables": tables}
    if backend.on_cpu:
        found["memcpy_gb_per_s"] = _memcpy(large, seconds)
    return found


def best_seconds(run: Callable[[], object], wait: Callable[[], object], seconds: float, at_once: int = 1) -> float:
    """Return the least time of one call, s, of TRIES series of at least `seconds`; the first call does not count.

    Args:
        run: what is called; wait: called after each `at_once` calls, and within the time.
    """
    run()
    wait()
    found = []
    for _ in range(TRIES):
        calls, elapsed, start = 0, 0.0, time.perf_counter()
        while not calls or elapsed < seconds:
            for _ in range(at_once):
                run()
            wait()
            calls += at_once
            elapsed = time.perf_counter() - start
        found.append(elapsed / calls)
    return min(found)


def _measure_table(kernels: "DeviceKernels", places: int, seconds: float) -> dict:
    from mpmcli.solver.device_speed import EQUAL, RANDOM, SORTED

    def rate(run: Callable[[], None]) -> float:
        return places / best_seconds(run, kernels.wait, seconds) / 1e9

    found = {"bytes": 4 * places, "copy_gb_per_s": 8 * rate(kernels.copy)}
    for name, order in (("random", RANDOM), ("sorted", SORTED), ("same", EQUAL)):
        kernels.fill(order)
        if order != EQUAL:
            found[f"read_{name}_g_per_s"] = rate(kernels.read)
        found[f"atomic_add_{name}_g_per_s"] = rate(kernels.add)
        if kernels.add_plainly:
            found[f"plain_add_{name}_g_per_s"] = rate(kernels.add_plainly)
    return found


def _measure_launches(kernels: "DeviceKernels", seconds: float) -> dict:
    series = {
        count: best_seconds(launch, kernels.wait, seconds, LAUNCHES) for count, launch in kernels.launches.items()
    }
    each = statistics.linear_regression(list(series), list(series.values())).slope
    alone = best_seconds(kernels.launches[1], kernels.wait, seconds)
    argued = best_seconds(lambda: kernels.launch_with_argument(0.0), kernels.wait, seconds, LAUNCHES)
    return {
        "launch_us": {f"{count}": 1e6 * value for count, value in series.items()},
        "launch_us_per_loop": 1e6 * each,
        "launch_with_argument_us": 1e6 * argued,
        "launch_and_wait_us": 1e6 * alone,
    }


def _memcpy(places: int, seconds: float) -> float:
    """Return the bandwidth of a copy by the C library on one thread, read and written, GB/s."""
    table = np.ones(places, dtype=np.float32)
    other = np.empty_like(table)
    return 8 * places / best_seconds(lambda: np.copyto(other, table), lambda: None, seconds) / 1e9

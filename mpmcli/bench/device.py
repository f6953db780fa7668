"""What a device can do, whatever runs on it: bandwidth, launches, and reads and additions at scattered places."""

import statistics
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.bench.report import describe_machine, page, rows_text
from mpmcli.plain_text import counted

if TYPE_CHECKING:
    from mpmcli.solver.machine.backend import Backend
    from mpmcli.solver.machine.device_speed import DeviceKernels

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


def device_record(found: dict) -> dict:
    """Return what `measure_device` found, and on which machine, for JSON."""
    return {"machine": describe_machine(), "device": found}


def device_table(record: dict) -> str:
    """Return the record of a device as text: rates of both tables, then launches."""
    found, machine = record["device"], record["machine"]
    threads = counted(found["threads"], "thread")
    tables = [*found["tables"].values()]
    columns = [
        ("", lambda row: row[0]),
        *((f"{table['bytes'] / 2**20:.3g} MiB", lambda row, t=table: f"{t[row[1]]:.3g}") for table in tables),
        ("", lambda row: row[2]),
    ]
    rates = rows_text([row for row in ROWS if row[1] in tables[0]], columns, left={0, len(columns) - 1})
    loops = ", ".join(f"{counted(int(count), 'loop')} {us:.1f}" for count, us in found["launch_us"].items())
    notes = [
        f"Launch of a kernel, us: {loops}; with a number from the host {found['launch_with_argument_us']:.1f}; and",
        f"waiting for it {found['launch_and_wait_us']:.1f}.",
        "sorted: eight neighbours at each place; same: all at one place; plain: load, add, store, on one thread.",
    ]
    if "memcpy_gb_per_s" in found:
        copied = f"{found['memcpy_gb_per_s']:.3g} GB/s"
        notes.insert(2, f"Copy by the C library on one thread: {copied}, read and written.")
    return page(f"{machine['processor']}, {found['arch']}, {threads}, taichi {machine['taichi']}", [rates], notes)


def measure_device(backend: "Backend", seconds: float = 0.05, large: int = LARGE, small: int = SMALL) -> dict:
    """Measure a started backend for JSON: the best of TRIES rates, and launches of kernels of 1 to 4 short loops.

    Tables have `large` and `small` numbers, powers of two. Additions are atomic in f32, at random places, eight
    neighbours at each (sorted) and all at one; on the CPU `plain_add_*` is load, add and store on one thread.
    """
    from mpmcli.solver.machine.device_speed import build_device_kernels

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
    """Return the least time of a call, s, in TRIES series of `seconds`, each `at_once` calls and a `wait`."""
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
    from mpmcli.solver.machine.device_speed import EQUAL, RANDOM, SORTED

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
    def microseconds(launch: Callable[[], None], at_once: int = LAUNCHES) -> float:
        return 1e6 * best_seconds(launch, kernels.wait, seconds, at_once)

    series = {count: microseconds(launch) for count, launch in kernels.launches.items()}
    return {
        "launch_us": {f"{count}": value for count, value in series.items()},
        "launch_us_per_loop": statistics.linear_regression(list(series), list(series.values())).slope,
        "launch_with_argument_us": microseconds(lambda: kernels.launch_with_argument(0.0)),
        "launch_and_wait_us": microseconds(kernels.launches[1], at_once=1),
    }


def _memcpy(places: int, seconds: float) -> float:
    """Return the bandwidth of a copy by the C library on one thread, read and written, GB/s."""
    table = np.ones(places, dtype=np.float32)
    other = np.empty_like(table)
    return 8 * places / best_seconds(lambda: np.copyto(other, table), lambda: None, seconds) / 1e9

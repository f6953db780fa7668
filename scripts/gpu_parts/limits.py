"""What bounds any kernel on the device: bandwidth, atomic additions, launches."""

import time
from collections.abc import Callable, Sequence

import taichi as ti
from page_section import markdown_table

from gpu_parts.parts import Setup, Task
from gpu_parts.report import measured
from mpmcli.solver.machine.backend import start_backend

# Launches of a block, and blocks, of which the fastest counts.
LAUNCHES, BLOCKS = 200, 5
PATTERNS = ("random", "sorted", "same address")
# Neighbouring threads that add to one address where addresses are sorted: particles of a cell.
RUN = 8
LOOPS = (1, 4, 16)


def tasks(setup: Setup) -> Sequence[Task]:
    """Return bandwidth, launches, then atomics, where software Vulkan takes longest."""
    start_backend(setup.arch)
    adds = [
        Task(f"{'i32' if whole else 'f32'} adds, {pattern}", lambda left, p=pattern, w=whole: adding(setup, p, w))
        for whole in (False, True)
        for pattern in PATTERNS
    ]
    return (
        Task("copy", lambda left: copying(setup)),
        Task("launch", lambda left: launching(setup)),
        *(Task(f"launch, {count} loops", lambda left, c=count: looping(setup, c)) for count in LOOPS),
        *adds,
    )


def fastest(launch: Callable[[], None], launches: int) -> float:
    """Return the time of one of several launches in a row, s, of the fastest of several blocks, the first left out."""
    times = []
    for _ in range(BLOCKS + 1):
        ti.sync()
        began = time.perf_counter()
        for _ in range(launches):
            launch()
        ti.sync()
        times.append((time.perf_counter() - began) / launches)
    return min(times[1:])


def copying(setup: Setup) -> dict:
    """Copy a field to another."""
    count = setup.sized(2**12, 2**22, 2**28)
    source, target = ti.field(ti.f32, shape=count), ti.field(ti.f32, shape=count)

    @ti.kernel
    def fill():
        for i in range(count):
            source[i] = i % 97

    @ti.kernel
    def copy():
        for i in range(count):
            target[i] = source[i]

    fill()
    seconds = fastest(copy, setup.sized(2, 5, 20))
    return {"bytes": 8 * count, "seconds": seconds, "gb_per_s": 8 * count / seconds / 1e9, "right": target[96] == 96.0}


def adding(setup: Setup, pattern: str, whole: bool) -> dict:
    """Add to a table by atomics; the table of a grid of 256^3 nodes is as large."""
    count, size = setup.sized((2**12, 2**8), (2**18, 2**16), (2**26, 2**24))
    table = ti.field(ti.i32 if whole else ti.f32, shape=size)

    @ti.func
    def place(i: int):
        result = 0
        if ti.static(pattern == "random"):
            # Murmur's finaliser mixes the bits.
            mixed = ti.cast(i, ti.u32)
            mixed = (mixed ^ (mixed >> 16)) * ti.u32(0x85EBCA6B)
            mixed = (mixed ^ (mixed >> 13)) * ti.u32(0xC2B2AE35)
            result = ti.cast((mixed ^ (mixed >> 16)) & ti.u32(size - 1), ti.i32)
        elif ti.static(pattern == "sorted"):
            result = i // RUN & (size - 1)
        return result

    @ti.kernel
    def add():
        for i in range(count):
            table[place(i)] += 1

    launches = setup.sized(2, 2, 5)
    seconds = fastest(add, launches)
    total = int(table.to_numpy().astype("float64").sum())
    # In single precision one address stops at 2^24, where 1 is half a unit in the last place.
    expected = (BLOCKS + 1) * launches * count
    right = total == (expected if whole or pattern != "same address" else min(expected, 2**24))
    return {"adds": count, "seconds": seconds, "g_per_s": count / seconds / 1e9, "right": right}


def launching(setup: Setup) -> dict:
    """Launch kernels of one small task: without arguments, with three, and with a result that the host waits for."""
    number = ti.field(ti.f32, shape=())

    @ti.kernel
    def empty():
        number[None] = 1.0

    @ti.kernel
    def given(a: ti.f32, b: ti.f32, c: ti.f32):
        number[None] = a + b + c

    @ti.kernel
    def answered() -> ti.f32:
        return number[None]

    launches = setup.sized(5, LAUNCHES, LAUNCHES)
    return {
        "empty_us": 1e6 * fastest(empty, launches),
        "three_arguments_us": 1e6 * fastest(lambda: given(1.0, 2.0, 3.0), launches),
        "read_back_us": 1e6 * fastest(answered, launches),
    }


def looping(setup: Setup, loops: int) -> dict:
    """Launch a kernel of several parallel loops, each a launch on the device, and the same with bounds in a field."""
    number, bound = ti.field(ti.f32, shape=1024), ti.field(ti.i32, shape=())
    bound[None] = 1024

    @ti.kernel
    def fixed():
        for _k in ti.static(range(loops)):
            for i in range(1024):
                number[i] += 1.0

    @ti.kernel
    def read():
        for _k in ti.static(range(loops)):
            for i in range(bound[None]):
                number[i] += 1.0

    launches = setup.sized(5, LAUNCHES, LAUNCHES)
    return {"fixed_us": 1e6 * fastest(fixed, launches), "bounds_read_us": 1e6 * fastest(read, launches)}


def section(rows: dict[str, dict]) -> str:
    """Return a line for each measurement."""
    return markdown_table(["what", "figure"], [[key, told(row)] for key, row in measured(rows).items()], set())


def told(row: dict) -> str:
    """Return the figures of a row."""
    wrong = "" if row.get("right", True) else ", **wrong result**"
    if "gb_per_s" in row:
        return f"{row['gb_per_s']:,.4g} GB/s, read and written{wrong}"
    if "g_per_s" in row:
        return f"{row['g_per_s']:.3g} G/s{wrong}"
    if "fixed_us" in row:
        return f"{row['fixed_us']:.1f} us; with bounds that a field holds {row['bounds_read_us']:.1f} us"
    empty, given, answered = row["empty_us"], row["three_arguments_us"], row["read_back_us"]
    return f"{empty:.1f} us; with three arguments {given:.1f} us; with a result that is read back {answered:.1f} us"

"""Speed against the number of particles: falling blocks of 1e4 to 1e7 particles, ours, in C, and the peer's."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack

from mpmcli.bench.cases import EDGE, BenchCase
from mpmcli.bench.compare import Setting, Side, start_worker
from mpmcli.bench.costs import Start
from mpmcli.bench.scaling_report import ScalingReport, ScalingResult
from mpmcli.errors import RunError
from mpmcli.plain_text import counted

COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 10_000_000)
PER_CELL = 4
# The step is this time, s, over the cells of an edge: sound, at 20 m/s, crosses a fifth of a cell.
CROSSING = 0.01
BLOCKS = 3
# The next size takes at most so many times as long as the last one: most is compilation, then the work grows by 3.
GROWTH = 1.5
# Share of the free memory that a size may take.
SHARE_OF_MEMORY = 0.8
# Memory of a process without particles, bytes.
BASE_MEMORY = 200e6


def case_of(dimension: int, particles: int) -> BenchCase:
    """Return the block of so many particles, PER_CELL in each cell."""
    cells = round((particles / PER_CELL) ** (1 / dimension) / EDGE)
    return BenchCase(dimension, cells, particles, CROSSING / cells)


def peer_case_of(dimension: int, particles: int) -> BenchCase:
    """Return the block of the peer nearest to so many particles: mpm3d needs a power of two as number of cells."""
    if dimension == 2:
        return case_of(dimension, particles)
    cells = 2 ** round(math.log2((particles / PER_CELL) ** (1 / dimension) / EDGE))
    return BenchCase(dimension, cells, round(PER_CELL * (EDGE * cells) ** dimension), CROSSING / cells)


def run_scaling(
    dimensions: Sequence[int] = (2, 3),
    threads: Sequence[int] = (1, 2),
    seconds: float = 1.0,
    progress: Callable[[str], None] = lambda line: None,
    *,
    budget: float = math.inf,
    counts: Sequence[int] = COUNTS,
    blocks: int = BLOCKS,
    yardstick: bool = False,
    peer: bool = True,
    start: Start = start_worker,
    clock: Callable[[], float] = time.monotonic,
    free_memory: Callable[[], int] | None = None,
) -> ScalingReport:
    """Measure each size, from the smallest to the largest, and return the report.

    Args:
        dimensions: of the blocks.
        threads: numbers of threads of the processor.
        seconds: length of one block.
        progress: called with a line of text for each size.
        budget: wall time, s; a size that would not end within it is left out.
        counts: numbers of particles.
        blocks: measured blocks of each contestant, in turn.
        yardstick: whether the yardstick in C is measured.
        peer: whether the example of the taichi package is measured, on the nearest grid that suits it.
        start, clock, free_memory: tests replace them.

    A contestant that cannot start, or fails, is left out; the report gives the reason.
    """
    who = ("ours", *(["yardstick"] if yardstick else []), *(["peer"] if peer else []))
    end, free_memory = clock() + budget, free_memory or _free_memory
    # Of each dimension and number of threads: time and memory that its last size took.
    last: dict[tuple[int, int], tuple[float, float]] = {}
    results: list[ScalingResult] = []
    flaws: list[str] = []
    for particles, previous in zip(sorted(counts), (None, *sorted(counts)), strict=False):
        for dimension in dimensions:
            for count in threads:
                where = f"{dimension}d, {particles:,} particles, {counted(count, 'thread')}"
                spent, memory = last.get((dimension, count), (0.0, 0.0))
                growth = particles / previous if previous else 1.0
                if clock() + GROWTH * spent > end:
                    flaws.append(f"{where}: left out, since the time would not suffice.")
                    continue
                if growth * memory > SHARE_OF_MEMORY * free_memory():
                    flaws.append(f"{where}: left out, since the memory would not suffice.")
                    continue
                began = clock()
                found = list(_measure(who, dimension, particles, count, seconds, blocks, start, flaws))
                results += found
                taken = sum(max(0.0, result.measured.peak_memory - BASE_MEMORY) for result in found)
                last[dimension, count] = clock() - began, taken
                told = ", ".join(f"{result.label} {result.nanoseconds:.1f}" for result in found)
                progress(f"{where}: ns per particle-step: {told}")
    return ScalingReport(tuple(results), tuple(flaws), seconds)


def _measure(
    who: Sequence[str],
    dimension: int,
    particles: int,
    threads: int,
    seconds: float,
    blocks: int,
    start: Start,
    flaws: list[str],
) -> Iterator[ScalingResult]:
    """Measure all contestants at one size."""
    with ExitStack() as stack:
        sides = []
        for name in who:
            case = peer_case_of(dimension, particles) if name == "peer" else case_of(dimension, particles)
            side = Side(name, case)
            if _lasts(flaws, side, lambda side=side: side.begin(stack, Setting(threads), start, seconds)):
                sides.append(side)
        for _ in range(blocks):
            sides = [side for side in sides if _lasts(flaws, side, lambda side=side: side.measure(seconds))]
        for side in sides:
            yield ScalingResult(side.who, side.case, threads, side.finish())


def _lasts(flaws: list[str], side: Side, act: Callable[[], None]) -> bool:
    try:
        act()
    except RunError as error:
        flaws.append(f"{side.who}, {side.case.dimension}d, {side.case.particles:,} particles: {error}")
        return False
    return True


def _free_memory() -> int:
    import psutil

    return psutil.virtual_memory().available

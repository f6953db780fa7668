"""The falling block of mpmcli, of the examples of the taichi package and in C: at some sizes, and against the size."""

import math
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from operator import itemgetter

import psutil

from mpmcli.bench.cases import EDGE, BenchCase
from mpmcli.bench.report import REASON, head, heading, number, page, picked, ratios_of, rows_text, span
from mpmcli.bench.side import BenchOptions, Setting, Side, Turns
from mpmcli.errors import RunError
from mpmcli.plain_text import counted, text_table

# Duration of the first block of the comparison, s, which is not measured: the remaining kernels compile.
WARM_UP = 0.3
# Of a step that results from the division of an interval into equal steps.
ROUND_OFF = 1e-6
# What JSON has of each contestant, of the comparison and of the scaling.
FIGURES = (
    "particle_steps_per_s particle_steps_per_s_min particle_steps_per_s_max particle_steps_per_s_blocks "
    "start_s compile_s peak_memory_bytes device_bytes_per_particle threads smallest_step_s sound"
)
SCALING_FIGURES = (
    "who label dimension cells particles step_s threads threads_used ns_per_particle_step ns_per_particle_step_blocks "
    "peak_memory_bytes sound"
)
IN_C = "C: the yardstick, million particle-steps per second; slower: times that mpmcli is slower than it."
# Of the sizes of the scaling: numbers of particles, those in a cell, and measured blocks.
COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 10_000_000)
PER_CELL = 4
SCALING_BLOCKS = 3
# The step is this time, s, over the cells of an edge: sound, at 20 m/s, crosses a fifth of a cell.
CROSSING = 0.01
# The next size takes at most so many times as long as the last one: most is compilation, then the work grows by 3.
GROWTH = 1.5
# Share of the free memory that a size may take.
SHARE_OF_MEMORY = 0.8
# Memory of a process without particles, bytes.
BASE_MEMORY = 200e6


def bench_table(record: dict) -> str:
    """Return the record of the comparison as text: one line per case, then what the columns mean."""
    cases, threads = record["cases"], record["threads"]
    columns = [
        ("case", lambda row: row["case"]),
        ("particles", lambda row: f"{row['particles']:,}"),
        ("threads", lambda row: f"{row['ours']['threads']} / {row['peer']['threads']}"),
        ("M steps/s", lambda row: _rate(row["ours"])),
        ("peer", lambda row: row["peer_name"]),
        ("peer's", lambda row: _rate(row["peer"])),
        ("ratio", lambda row: f"{row['ratio']:.2f}"),
        ("range", lambda row: f"{row['ratio_min']:.2f}-{row['ratio_max']:.2f}"),
    ]
    notes = [
        "M steps/s: million particle-steps per second, median of the blocks.",
        "threads: ours / the peer's; mpmcli takes one for each 2,500 particles.",
        "ratio: ours over the peer's; range: of neighbouring blocks.",
    ]
    if any(row["yardstick"] for row in cases):
        columns.append(("C", lambda row: _rate(row["yardstick"])))
        columns.append(("slower", lambda row: number(row["times_slower_than_yardstick"], ".2f")))
        notes.append(IN_C)
    columns += [
        ("start+compile s", lambda row: _both(row, lambda side: f"{side['start_s']:.1f}+{side['compile_s']:.1f}")),
        ("memory MB", lambda row: _both(row, lambda side: f"{side['peak_memory_bytes'] / 1e6:.0f}")),
    ]
    if len(threads) > 1:
        columns.append(("speed-up", lambda row: f"{row['speed_up']:.2f}"))
        columns.append(("efficiency", lambda row: f"{row['efficiency']:.0%}"))
        notes.append("speed-up, efficiency: ours over ours with the fewest threads, and for each thread.")
    notes.append("start+compile, memory: ours / the peer's, with no kernel cached on disk.")
    for name in dict.fromkeys(name for row in cases for name in row["others"]):
        columns.append((name, lambda row, name=name: _rate(row["others"].get(name))))
    for row in cases:
        if (held := row["ours"]["device_bytes_per_particle"]) is not None:
            notes.append(f"Device memory at {row['case']}: {held} bytes per particle.")
    table = rows_text(cases, columns if cases else columns[:1], left={0, 4})
    return page(heading(record, threads), [table], notes, _warnings(cases))


def _warnings(cases: list[dict]) -> Iterator[str]:
    for row in cases:
        smallest, step = row["ours"]["smallest_step_s"], row["step_s"]
        if smallest < (1 - ROUND_OFF) * step:
            yield (
                f"at {row['case']} mpmcli's own limits asked for steps down to {smallest:.3g} s, "
                f"below the {step:.3g} s of {row['peer_name']}."
            )
    for row in cases:
        sides = {"mpmcli": row["ours"], row["peer_name"]: row["peer"], "C": row["yardstick"], **row["others"]}
        broken = [name for name, side in sides.items() if side and not side["sound"]]
        yield from (f"{name} broke down at {row['case']} {REASON}." for name in broken)


def _rate(side: dict | None) -> str:
    return f"{side['particle_steps_per_s'] / 1e6:.2f}" if side else ""


def _both(row: dict, cell: Callable[[dict], str]) -> str:
    return f"{cell(row['ours'])} / {cell(row['peer'])}"


def bench_record(cases: Sequence[dict[str, dict]], options: BenchOptions) -> dict:
    """Return the comparison for JSON, from the figures by contestant of each case and number of threads."""
    settings = {"threads": list(options.threads), "arch": options.arch}
    return head(options, **settings) | {"cases": [_case_dict(sides, cases) for sides in cases]}


def _case_dict(sides: dict[str, dict], cases: Sequence[dict[str, dict]]) -> dict:
    """Return all contestants at one case and their ratios; blocks k of all were measured one after the other."""
    ours, peer, yardstick = sides["ours"], sides["peer"], sides.get("yardstick")
    low, high = span(ratios_of(peer, ours))
    others = {name: _side_dict(side) for name, side in sides.items() if name not in ("ours", "peer", "yardstick")}
    rate, same = ours["particle_steps_per_s"], [one["ours"] for one in cases if one["ours"]["case"] == ours["case"]]
    fewest = min(same, key=itemgetter("threads"))
    speed_up = rate / fewest["particle_steps_per_s"] if len(same) > 1 else None
    return {
        **picked(ours, "case threads dimension cells particles step_s peer_name"),
        "ours": _side_dict(ours),
        "peer": _side_dict(peer),
        "ratio": rate / peer["particle_steps_per_s"],
        "ratio_min": low,
        "ratio_max": high,
        "yardstick": _side_dict(yardstick) if yardstick else None,
        "times_slower_than_yardstick": yardstick["particle_steps_per_s"] / rate if yardstick else None,
        "others": others,
        "speed_up": speed_up,
        "efficiency": speed_up * fewest["threads"] / ours["threads"] if speed_up else None,
    }


def _side_dict(side: dict) -> dict:
    return picked(side | {"threads": side["threads_used"]}, FIGURES)


def run_bench(cases: Iterable[BenchCase], options: BenchOptions) -> dict:
    """Measure every case, all sides in turn (A B C A B C), and return the record; RunError: ours or the peer failed."""
    return bench_record([_run_case(case, count, options) for case in cases for count in options.threads], options)


def _run_case(case: BenchCase, threads: int, options: BenchOptions) -> dict[str, dict]:
    where, tell = f"{case.name}, {counted(threads, 'thread')}", options.progress
    tell(f"{where}: {case.particles:,} particles, {case.cells}^{case.dimension} cells, against {case.peer}")
    names = ["ours", "peer", *(["yardstick"] if options.yardstick else [])]
    if options.peers:
        names += case.other_peers
    sides = []
    with ExitStack() as stack:
        for name in names:
            side = Side(name, case, Setting(threads, arch=options.arch))
            try:
                begin_block(side, stack, options, min(WARM_UP, options.seconds))
            except RunError as error:
                if name in ("ours", "peer"):
                    raise
                tell(f"{where}: {name} is left out. {error}")
            else:
                sides.append(side)
        for block in range(options.blocks):
            for side in sides:
                side.measure(f"run {options.seconds}")
            last = " against ".join(f"{1e-6 / side.costs[-1]:.2f}" for side in sides)
            tell(f"{where}: block {block + 1} of {options.blocks}, {last} million particle-steps/s")
        return {side.who: side.finish() for side in sides}


def begin_block(side: Side, stack: ExitStack, options: BenchOptions, warm_up: float) -> None:
    """Start a block, and step for `warm_up` seconds, not measured; RunError: it cannot, or has other particles."""
    name = {"ours": "mpmcli", "peer": side.case.peer}.get(side.who, side.who)
    side.begin(stack, options.start, side.case.particles, f"{name} runs {{}}: they would not solve the same problem.")
    side.worker.ask(f"run {warm_up}")


def scaling_table(record: dict) -> str:
    """Return the record of the scaling as text: a table for each dimension and number of threads."""
    rows = record["scaling"]
    settings = sorted({(row["dimension"], row["threads"]) for row in rows})
    notes = (
        "ns per particle and step, median of the blocks. C: the yardstick; slower: times that mpmcli is slower.",
        "exponent: of the time of a step in the number of particles; 1 is linear.",
    )
    broken = [
        f"{row['label']} broke down at {row['particles']:,} particles in {row['dimension']}D."
        for row in rows
        if not row["sound"]
    ]
    top = heading(record, sorted({threads for _, threads in settings}) or [1])
    return page(top, [_scaling_table(record, *each) for each in settings], notes, [*record["flaws"], *broken])


def _scaling_table(record: dict, dimension: int, threads: int) -> str:
    def chosen(key: str) -> list[dict]:
        return [row for row in record[key] if (row["dimension"], row["threads"]) == (dimension, threads)]

    found = {(row["label"], row["particles"]): row for row in chosen("scaling")}
    labels = list(dict.fromkeys(label for label, _ in found))
    lines = []
    for particles in sorted({count for _, count in found}):
        beside = [found.get((label, particles)) for label in labels]
        ours, in_c = found.get(("mpmcli", particles)), found.get(("C", particles))
        ratio = f"{ours['ns_per_particle_step'] / in_c['ns_per_particle_step']:.2f}" if ours and in_c else ""
        cells = next(row["cells"] for row in beside if row)
        each = [f"{row['ns_per_particle_step']:.1f}" if row else "" for row in beside]
        lines.append((f"{particles:,}", f"{cells}", *each, ratio))
    exponents = {row["label"]: f"{row['exponent']:.3f}" for row in chosen("exponents")}
    lines.append(("exponent", "", *(exponents.get(label, "") for label in labels), ""))
    return f"{dimension}D, threads: {threads}\n" + text_table(("particles", "cells", *labels, "slower"), lines, set())


def scaling_record(figures: Sequence[dict], flaws: list[str], options: BenchOptions) -> dict:
    """Return the scaling for JSON, from the figures in the order they were measured."""
    rows = [picked(one, SCALING_FIGURES) for one in figures]
    return head(options) | {"scaling": rows, "exponents": _exponents(rows), "flaws": flaws}


def _exponents(rows: list[dict]) -> list[dict]:
    """Return the exponent of the time of a step in the number of particles, of each contestant and setting."""
    keys = ("who", "label", "dimension", "threads")
    found = []
    for dimension, threads in sorted({(row["dimension"], row["threads"]) for row in rows}):
        for who in ("ours", "yardstick", "peer"):
            line = [row for row in rows if (row["dimension"], row["threads"], row["who"]) == (dimension, threads, who)]
            points = [(row["particles"], row["ns_per_particle_step"]) for row in line]
            if len(dict(points)) > 1:
                found.append({key: line[0][key] for key in keys} | {"exponent": fitted_exponent(points)})
    return found


def fitted_exponent(points: list[tuple[int, float]]) -> float:
    """Return the exponent of a step's time in particles, by least squares, of points (particles, time of each)."""
    logarithms = [(math.log(count), math.log(count * each)) for count, each in points]
    return statistics.linear_regression(*zip(*logarithms, strict=True)).slope


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
    dimensions: Sequence[int],
    options: BenchOptions,
    *,
    budget: float = math.inf,
    counts: Sequence[int] = COUNTS,
    clock: Callable[[], float] = time.monotonic,
    free_memory: Callable[[], int] = lambda: psutil.virtual_memory().available,
) -> dict:
    """Measure each size, `counts` ascending; sizes beyond `budget` s or memory, and failures, are in the record."""
    end = clock() + budget
    # Of each dimension and number of threads: time and memory that its last size took.
    last: dict[tuple[int, int], tuple[float, float]] = {}
    results: list[dict] = []
    flaws: list[str] = []
    for particles, previous in zip(sorted(counts), (None, *sorted(counts)), strict=False):
        growth = particles / previous if previous else 1.0
        for dimension in dimensions:
            for threads in options.threads:
                where = f"{dimension}d, {particles:,} particles, {counted(threads, 'thread')}"
                spent, memory = last.get((dimension, threads), (0.0, 0.0))
                if clock() + GROWTH * spent > end:
                    flaws.append(f"{where}: left out, since the time would not suffice.")
                    continue
                if growth * memory > SHARE_OF_MEMORY * free_memory():
                    flaws.append(f"{where}: left out, since the memory would not suffice.")
                    continue
                began = clock()
                found = _measure(dimension, particles, threads, options, flaws)
                results += found
                taken = sum(max(0.0, one["peak_memory_bytes"] - BASE_MEMORY) for one in found)
                last[dimension, threads] = clock() - began, taken
                told = ", ".join(f"{one['label']} {one['ns_per_particle_step']:.1f}" for one in found)
                options.progress(f"{where}: ns per particle-step: {told}")
    return scaling_record(results, flaws, options)


def _measure(dimension: int, particles: int, threads: int, options: BenchOptions, flaws: list[str]) -> list[dict]:
    sides = []
    for name in ("ours", *(["yardstick"] if options.yardstick else []), *(["peer"] if options.peers else [])):
        case = peer_case_of(dimension, particles) if name == "peer" else case_of(dimension, particles)
        flaw = f"{name}, {dimension}d, {case.particles:,} particles:"
        sides.append(Side(name, case, Setting(threads), flaw=flaw))
    turns = Turns(sides, flaws)
    with ExitStack() as stack:
        turns.take(lambda side: begin_block(side, stack, options, options.seconds))
        for _ in range(options.blocks):
            turns.take(lambda side: side.measure(f"run {options.seconds}"))
        return turns.take(Side.finish)

"""The falling block of mpmcli, of the examples of the taichi package and in C."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from operator import itemgetter

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.report import REASON, head, heading, number, page, picked, ratios_of, rows_text, span
from mpmcli.bench.side import BenchOptions, Setting, Side
from mpmcli.errors import RunError
from mpmcli.plain_text import counted

# Duration of the first block of the comparison, s, which is not measured: the remaining kernels compile.
WARM_UP = 0.3
# Of a step that results from the division of an interval into equal steps.
ROUND_OFF = 1e-6
# What JSON has of each contestant, of the comparison and of the scaling.
FIGURES = (
    "particle_steps_per_s particle_steps_per_s_min particle_steps_per_s_max particle_steps_per_s_blocks "
    "start_s compile_s peak_memory_bytes device_bytes_per_particle threads smallest_step_s sound"
)
IN_C = "C: the yardstick, million particle-steps per second; slower: times that mpmcli is slower than it."


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

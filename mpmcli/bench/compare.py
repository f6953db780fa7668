"""The falling block in mpmcli, in the example of the taichi package, and in C."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from functools import partial

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.ours import block_of_ours
from mpmcli.bench.peers import Peer, Yardstick, has_compiler
from mpmcli.bench.report import describe_machine, page
from mpmcli.bench.worker import Side, run_block
from mpmcli.errors import RunError
from mpmcli.plain_text import counted, text_table

# Duration of the first block, s, in which the remaining kernels compile. It is not measured.
WARM_UP = 0.3
IN_C = "C"
FRAME_NUMBERS = (
    "M steps/s: million particle-steps per second, median of the blocks; on one thread by processor time.",
    "threads: of mpmcli, at most one per 2,500 particles, and of the peer. C: the yardstick.",
    "ratio: speed over the peer's, and its range over blocks; slower: time over that of C; start, compile: mpmcli, s.",
)


def run_bench(
    cases: Iterable[BenchCase],
    threads: Sequence[int],
    arch: str,
    seconds: float,
    blocks: int,
    tell: Callable[[str], None],
) -> dict:
    """Measure every case on each number of threads, all sides in turn (A B C A B C), and return the record.

    Raises RunError if a side cannot run, or has a different number of particles.
    """
    rows = []
    for case in cases:
        for count in threads:
            tell(f"{case.name}, {counted(count, 'thread')}: {case.particles:,} particles, against {case.peer}")
            rows.append(_run_case(case, count, arch, seconds, blocks))
    return {"machine": describe_machine(), "arch": arch, "block_s": seconds, "cases": rows}


def _run_case(case: BenchCase, threads: int, arch: str, seconds: float, blocks: int) -> dict:
    """Return the costs of all sides of a case, and the ratio of peer to mpmcli, measured in turn block by block."""
    makes = {"mpmcli": partial(block_of_ours, case, threads, arch), case.peer: partial(Peer, case, threads, arch)}
    if arch == "cpu" and has_compiler():
        makes[IN_C] = partial(Yardstick, case, threads)
    by_processor = threads == 1 and arch == "cpu"
    with ExitStack() as stack:
        sides = [
            stack.enter_context(closing(Side(name, make, by_processor=by_processor))) for name, make in makes.items()
        ]
        for side in sides:
            if side.particles != case.particles:
                raise RunError(f"{side.name} runs {side.particles} particles instead of {case.particles}.")
            side.ask(run_block, min(WARM_UP, seconds))
        for _ in range(blocks):
            for side in sides:
                side.measure(seconds)
        ours, peer, *_ = sides
        ratios = [theirs / own for own, theirs in zip(ours.blocks, peer.blocks, strict=True)]
        return {
            "case": case.name,
            "particles": case.particles,
            "step_s": case.step,
            "peer": case.peer,
            "ratio": statistics.median(ratios),
            "ratio_blocks": ratios,
            "sides": {side.name: side.facts() for side in sides},
        }


def bench_table(record: dict) -> str:
    """Return the record as text: one line per case and number of threads, then the meaning of the columns."""
    rows, notes = [], list(FRAME_NUMBERS)
    for case in record["cases"]:
        sides = case["sides"]
        ours, peer, in_c = sides["mpmcli"], sides[case["peer"]], sides.get(IN_C)
        low, high = min(case["ratio_blocks"]), max(case["ratio_blocks"])
        row = [case["case"], case["peer"], f"{case['particles']:,}", f"{ours['threads']} / {peer['threads']}"]
        row += [_rate(ours), _rate(peer), f"{case['ratio']:.1f} ({low:.1f} to {high:.1f})"]
        slower = f"{ours['ns_per_particle_step'] / in_c['ns_per_particle_step']:.2f}" if in_c else ""
        rows.append([*row, _rate(in_c), slower, f"{ours['start_s']:.1f}", f"{ours['compile_s']:.1f}"])
        broken = [name for name, side in sides.items() if not side["sound"]]
        notes += [f"Warning: at {case['case']} {name} lost a particle, or took different steps." for name in broken]
    head = ["case", "peer", "particles", "threads", "M steps/s", "peer's", "ratio", "C", "slower", "start", "compile"]
    return page(record["machine"], record["arch"], text_table(head, rows, left={0, 1}), notes)


def _rate(side: dict | None) -> str:
    return f"{1e3 / side['ns_per_particle_step']:.2f}" if side else ""

"""Time of the phases of a step for each law, and in C: sort, P2G, grid, G2P, volumes, and measuring the state."""

import statistics
from collections.abc import Callable, Iterable
from contextlib import closing
from functools import partial
from operator import methodcaller

from mpmcli.bench.cases import EDGE, BenchCase
from mpmcli.bench.ours import ProfiledColumn
from mpmcli.bench.peers import Yardstick, has_compiler
from mpmcli.bench.report import describe_machine, page
from mpmcli.bench.worker import Side, run_block
from mpmcli.materials.registry import laws
from mpmcli.plain_text import text_table

# Columns of the table by the names of the phases in the solver and in C; all other phases count as grid.
COLUMN_OF = {name: name for name in ("sort", "p2g", "g2p", "measure")}
COLUMN_OF |= {"scatter": "p2g", "advance": "g2p", "average": "volumes", "relax": "volumes"}
IN_C = "fluid in C"
COLUMNS = ("sort", "p2g", "grid", "g2p", "volumes", "measure", "rest", "total")
# Start of the measured interval, s. The wave of the impact, at about 25 m/s, is then inside the column, which shears
# and spreads; no part of it is at rest.
SETTLING = 0.05
FRAME_NUMBERS = (
    "ns per particle and step: median of the blocks, wall time. Each phase is launched separately; the kernel of",
    "mpmcli simulate calls the same functions without launches between them. P2G and G2P include the law.",
    "grid: clearing and update of the nodes; volumes: relaxation or averaging of volumes; measure: quantities for",
    "the limits of steps; rest: launches, and work of the host between them.",
)


def run_profile(
    cases: Iterable[BenchCase], threads: int, seconds: float, blocks: int, tell: Callable[[str], None]
) -> dict:
    """Measure the phases of all laws, and of the fluid in C, in sequence; return the record."""
    rows = []
    for case in cases:
        makes = {law: partial(ProfiledColumn, law, case, threads) for law in sorted(laws())}
        if has_compiler():
            block = BenchCase(case.dimension, case.cells, round((2 * EDGE * case.cells) ** case.dimension), case.step)
            makes[IN_C] = partial(Yardstick, block, threads)
        for name, make in makes.items():
            tell(f"{case.name}: {name}")
            with closing(Side(name, make, by_processor=False)) as side:
                if name != IN_C:
                    side.ask(methodcaller("advance", round(SETTLING / case.step)))
                side.ask(run_block, 0.1)
                rows.append({"case": case.name, "name": name, **_measured(side, seconds, blocks)})
    return {"machine": describe_machine(), "threads": threads, "block_s": seconds, "profile": rows}


def _measured(side: Side, seconds: float, blocks: int) -> dict:
    """Return the number of particles and the medians of the columns, ns per particle and step."""
    phases = methodcaller("phases")
    side.ask(phases)
    found: list[dict[str, float]] = []
    for _ in range(blocks):
        share = 1e9 / side.particles / side.measure(seconds)
        columns = dict.fromkeys(COLUMNS, 0.0)
        for name, spent in side.ask(phases).items():
            if name != "frame":
                columns[COLUMN_OF.get(name, "grid")] += share * spent
        columns["rest"] = side.blocks[-1] - sum(columns.values())
        found.append(columns | {"total": side.blocks[-1]})
    medians = {name: statistics.median(one[name] for one in found) for name in COLUMNS}
    return {"particles": side.particles, "ns_per_particle_step": medians}


def profile_table(record: dict) -> str:
    """Return the record as text: one line per case and law."""
    rows = [
        [row["case"], row["name"], f"{row['particles']:,}", *(f"{row['ns_per_particle_step'][k]:.1f}" for k in COLUMNS)]
        for row in record["profile"]
    ]
    table = text_table(["case", "law", "particles", *COLUMNS], rows, left={0, 1})
    return page(record["machine"], f"cpu, threads: {record['threads']}", table, FRAME_NUMBERS)

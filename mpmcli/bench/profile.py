"""What the phases of a step take, for each law, and in C: sort, P2G, grid, G2P, volumes, and measuring the state."""

import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import ExitStack

from mpmcli.bench.cases import EDGE, BenchCase
from mpmcli.bench.column import SETTLING, column_of
from mpmcli.bench.ours import Ours
from mpmcli.bench.report import head, heading, number, page, rows_text
from mpmcli.bench.side import BenchOptions, Setting, Side, Turns
from mpmcli.materials.registry import laws

# In the order of a table; what neither of two has is left empty.
PHASES = ("sort", "p2g", "grid", "g2p", "volumes", "measure")
IN_C = "fluid in C"
# Before the name of a law, in the name of a contestant.
PROFILE = "profile:"


# Phases of a step, and what is done beside it, by their names in the solver; all others are of the grid.
COLUMN_OF = {
    "scatter": "p2g",
    "advance": "g2p",
    "average": "volumes",
    "relax": "volumes",
    "sort": "sort",
    "measure": "measure",
}


class ProfiledColumn(Ours):
    """The column of a law, whose phases are launched one by one, and timed."""

    def __init__(self, law: str, case: BenchCase, *, precision: str, **options: int | str) -> None:
        super().__init__(column_of(law, case, precision), case.step, precision=precision, **options)
        self.run.batch.profile = Counter()

    def phases(self) -> dict[str, float]:
        """Return the time in each of PHASES since the last call, s."""
        found = dict.fromkeys(PHASES, 0.0)
        for name, seconds in self.run.batch.profile.items():
            if name != "frame":
                found[COLUMN_OF.get(name, "grid")] += seconds
        self.run.batch.profile.clear()
        return found


def profile_table(record: dict) -> str:
    """Return the record of the phases as text: one line per law and case."""

    def phase(name: str) -> tuple:
        return name, lambda row: number(row["ns_per_particle_step"].get(name), ".1f")

    columns = [
        ("case", lambda row: row["case"]),
        ("law", lambda row: row["name"]),
        ("particles", lambda row: f"{row['particles']:,}"),
        *map(phase, (*PHASES, "rest", "total")),
    ]
    notes = (
        "ns per particle and step, median of the blocks, of steps whose phases are launched one by one: the",
        "kernel of mpmcli simulate has the same functions without launches between them. P2G and G2P contain",
        "the law. grid: clearing, and the update of nodes; volumes: their relaxation, or average; measure: for",
        "the limits of steps; rest: launches, and what the host does between them.",
    )
    table = rows_text(record["profile"], columns, left={0, 1})
    return page(heading(record, [record["threads"]]), [table], notes, record["flaws"])


def profile_record(figures: Sequence[dict], flaws: list[str], options: BenchOptions) -> dict:
    """Return the phases of every law, and of the block in C, at every case, for JSON."""
    rows = [_result_dict(one) for one in figures]
    return head(options, threads=options.threads[0]) | {"profile": rows, "flaws": flaws}


def _result_dict(one: dict) -> dict:
    """Return the phases, the total, and the rest, which is the total less all phases; ns of each block, and medians."""
    blocks = one["phases"] | {"total": one["ns_per_particle_step_blocks"]}
    rests = [total - sum(parts) for *parts, total in zip(*blocks.values(), strict=True)]
    medians = {name: statistics.median(spent) for name, spent in (one["phases"] | {"rest": rests}).items()}
    return {
        "case": one["case"],
        "name": IN_C if one["who"] == "yardstick" else one["who"].removeprefix(PROFILE),
        "particles": one["particles"],
        "ns_per_particle_step": medians | {"total": one["ns_per_particle_step"]},
        "ns_per_particle_step_blocks": blocks,
    }


def run_profile(cases: Iterable[BenchCase], options: BenchOptions, *, names: Sequence[str] | None = None) -> dict:
    """Measure the phases of each law, one after the other, and return the record.

    A law that cannot start, or fails, is left out; the record gives the reason. The options have one number of threads;
    `names` are by default those of every law of the package. The block in C has as many particles per cell.
    """
    figures: list[dict] = []
    flaws: list[str] = []
    setting = Setting(options.threads[0])
    for case in cases:
        sides = [Side(f"{PROFILE}{law}", case, setting, law) for law in (sorted(laws()) if names is None else names)]
        for side in sides:
            side.clock = "seconds"
        if options.yardstick:
            # It measures the phases of one thread by processor time.
            sides.append(Side("yardstick", block_of(case), setting, IN_C))
        for side in sides:
            options.progress(f"{case.name}: {side.name}")
            figures += Turns([side], flaws).take(lambda one: _measure(one, options))
    return profile_record(figures, flaws, options)


def block_of(case: BenchCase) -> BenchCase:
    """Return the block of the yardstick with the cells and the particles per cell of a column."""
    d = case.dimension
    return BenchCase(d, case.cells, round(2**d * (EDGE * case.cells) ** d), case.step)


def _measure(side: Side, options: BenchOptions) -> dict:
    """Start, step to where the column flows, and measure."""
    with ExitStack() as stack:
        side.begin(stack, options.start)
        if side.who.startswith(PROFILE):
            side.worker.ask(f"skip {round(SETTLING / side.case.step)}")
        side.worker.ask(f"run {options.seconds}")
        side.worker.ask("phases")
        phases: dict[str, list[float]] = {}
        for _ in range(options.blocks):
            steps = side.measure(f"run {options.seconds}")["steps"]
            for phase, spent in side.worker.ask("phases").items():
                phases.setdefault(phase, []).append(1e9 * spent / steps / side.particles)
        return side.finish(phases=phases)

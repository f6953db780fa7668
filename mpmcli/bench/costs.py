"""Measures the cost of laws: a process for each law and each mix, measured in turn (A B C ... A B C ...)."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import TypeVar

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.compare import BLOCKS, Setting, Worker, start_worker
from mpmcli.bench.cost_report import CostReport, CostResult, name_of
from mpmcli.bench.materials import MATERIAL_CASES, MIXES, steps_of
from mpmcli.errors import RunError
from mpmcli.materials.registry import laws

# The laws of a column, by place; a place without a name is empty.
Contender = tuple[str, ...]
T = TypeVar("T")
Start = Callable[[str, BenchCase, Setting], Worker]


def run_costs(
    cases: Iterable[BenchCase] = MATERIAL_CASES,
    threads: int = 1,
    seconds: float = 1.0,
    progress: Callable[[str], None] | None = None,
    *,
    names: Sequence[str] | None = None,
    mixes: Sequence[Contender] = MIXES,
    blocks: int = BLOCKS,
    precision: str = "f32",
    start: Start = start_worker,
) -> CostReport:
    """Measure every law, mixes of two laws, and each half of a mix alone, and return the report.

    Args:
        cases: of mpmcli.bench.materials.
        threads: of the processor, for all.
        seconds: length of one block, which repeats the same steps from the same state. Processor time is measured with
            one thread, wall time with several.
        progress: called with a line of text for each law that starts and each round of blocks.
        names: laws to measure; by default every law of the package.
        mixes: pairs of laws to measure in one scene.
        blocks: measured blocks of each law and mix.
        precision: "f32" or "f64".
        start: makes the process of a law, or of a mix with commas between its laws; tests replace it.

    A law that cannot start, or fails, is left out; the report gives the reason.
    """
    setting = Setting(threads, precision)
    # The processor time of one thread excludes the time taken by other processes.
    clock = "processor_seconds" if threads == 1 else "seconds"
    tell = progress or (lambda line: None)
    singles = sorted(laws()) if names is None else names
    contenders = [*((name,) for name in singles)]
    for first, second in mixes:
        contenders += [part for part in ((first, ""), ("", second)) if part not in contenders]
        contenders.append((first, second))
    results: list[CostResult] = []
    flaws: list[str] = []
    for case in cases:
        tell(f"{case.name}: {case.particles:,} particles, {case.cells}^{case.dimension} cells")
        with ExitStack() as stack:
            columns = [_Column(case, contender, clock) for contender in contenders]
            columns = lasting(columns, lambda column: column.begin(stack, setting, start, tell), flaws)
            for block in range(blocks):
                columns = lasting(columns, lambda column: column.measure(seconds), flaws)
                last = ", ".join(f"{column.name} {1e9 * column.costs[-1]:.0f}" for column in columns)
                tell(f"{case.name}: block {block + 1} of {blocks}, ns: {last}")
            lasting(columns, lambda column: results.append(column.finish()), flaws)
    return CostReport(tuple(results), tuple(flaws), threads=threads, precision=precision, seconds=seconds)


class _Column:
    """One law, or a mix, at one case, and the process that runs it."""

    worker: Worker
    first_seconds: float

    def __init__(self, case: BenchCase, names: Contender, clock: str) -> None:
        self.case, self.names, self.name, self.clock = case, names, name_of(names), clock
        self.particles = case.particles * sum(map(bool, names)) // len(names)
        self.costs: list[float] = []
        self.watch_shares: list[float] = []

    def begin(self, stack: ExitStack, setting: Setting, start: Start, tell: Callable[[str], None]) -> None:
        """Start, compile, and step to the state that is measured."""
        self.worker = stack.enter_context(start(",".join(self.names), self.case, setting))
        count = self.worker.ready["particles"]
        if count != self.particles:
            raise RunError(f"It has {count} particles instead of {self.particles}.")
        self.first_seconds = self.worker.ask("first")["seconds"]
        self.worker.ask(f"keep {steps_of(self.case)[0]}")
        tell(f"{self.case.name}: {self.name} is ready")

    def measure(self, seconds: float) -> None:
        """Measure one block."""
        answer = self.worker.ask(f"repeat {steps_of(self.case)[1]} {seconds}")
        self.costs.append(answer[self.clock] / answer["steps"] / self.particles)
        self.watch_shares.append(answer["watch_seconds"] / answer["seconds"])

    def finish(self) -> CostResult:
        """Return the result, and end the process."""
        flowing = self.worker.ask("flowing")["share"]
        end = self.worker.ask("finish")
        return CostResult(
            self.case,
            self.names,
            costs=tuple(self.costs),
            compile_seconds=max(0.0, self.first_seconds - self.particles * statistics.median(self.costs)),
            bytes_per_particle=self.worker.ready["bytes_per_particle"],
            flowing=flowing,
            watch_share=statistics.median(self.watch_shares),
            smallest_step=end["smallest_step"],
            sound=end["sound"],
        )


def lasting(columns: list[T], act: Callable[[T], object], flaws: list[str]) -> list[T]:
    """Apply `act` to each column in turn, and return those for which it did not fail."""
    kept = []
    for column in columns:
        try:
            act(column)
        except RunError as error:
            flaws.append(f"{column.name} at {column.case.name} could not be measured. {error}")
        else:
            kept.append(column)
    return kept

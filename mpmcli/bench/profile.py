"""What the phases of a step take, for each law, and in C: sort, P2G, grid, G2P, volumes, and measuring the state."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from mpmcli.bench.cases import EDGE, BenchCase
from mpmcli.bench.compare import BLOCKS, Setting, Worker, start_worker
from mpmcli.bench.costs import Start, lasting
from mpmcli.bench.materials import MATERIAL_CASES, steps_of
from mpmcli.bench.profiled_column import PROFILE
from mpmcli.bench.report import describe_machine, heading
from mpmcli.materials.registry import laws
from mpmcli.plain_text import text_table

# In the order of a table; what neither of two has is left empty.
PHASES = ("sort", "p2g", "grid", "g2p", "volumes", "measure")
IN_C = "fluid in C"


@dataclass(frozen=True)
class ProfileResult:
    """The phases of one law, or of the yardstick, at one case.

    Attributes:
        name: the law, or IN_C.
        particles: number of them.
        phases: ns per particle and step of each phase and block.
        total: the same of whole steps, with launches and what the host does between them.
    """

    case: BenchCase
    name: str
    particles: int
    phases: dict[str, tuple[float, ...]]
    total: tuple[float, ...]

    @property
    def rest(self) -> float:
        """Total less all phases, median of the blocks, ns."""
        return statistics.median(
            whole - sum(parts) for whole, *parts in zip(self.total, *self.phases.values(), strict=True)
        )

    def as_dict(self) -> dict:
        """Return it for JSON."""
        return {
            "case": self.case.name,
            "name": self.name,
            "particles": self.particles,
            "ns_per_particle_step": {phase: statistics.median(found) for phase, found in self.phases.items()}
            | {"rest": self.rest, "total": statistics.median(self.total)},
            "ns_per_particle_step_blocks": {phase: list(found) for phase, found in self.phases.items()}
            | {"total": list(self.total)},
        }


@dataclass(frozen=True)
class ProfileReport:
    """Every law at every case; `flaws` says what could not be measured."""

    results: tuple[ProfileResult, ...]
    flaws: tuple[str, ...]
    threads: int
    seconds: float
    machine: dict = field(default_factory=describe_machine)

    def as_dict(self) -> dict:
        """Return everything measured, ready for JSON."""
        return {
            "machine": self.machine,
            "threads": self.threads,
            "precision": "f32",
            "block_s": self.seconds,
            "profile": [result.as_dict() for result in self.results],
            "flaws": list(self.flaws),
        }

    def table(self) -> str:
        """Return the report as text: one line per law and case."""
        head = ("case", "law", "particles", *PHASES, "rest", "total")
        rows = []
        for result in self.results:
            found = result.as_dict()["ns_per_particle_step"]
            cells = [f"{found[name]:.1f}" if name in found else "" for name in (*PHASES, "rest", "total")]
            rows.append((result.case.name, result.name, f"{result.particles:,}", *cells))
        notes = [
            "ns per particle and step, median of the blocks, of steps whose phases are launched one by one: the",
            "kernel of mpmcli simulate has the same functions without launches between them. P2G and G2P contain",
            "the law. grid: clearing, and the update of nodes; volumes: their relaxation, or average; measure: for",
            "the limits of steps; rest: launches, and what the host does between them.",
            *(f"Beware: {flaw}" for flaw in self.flaws),
        ]
        title = heading(self.machine, "cpu", [self.threads], "f32")
        return "\n".join([title, "", text_table(head, rows, left={0, 1}), "", *notes])


def run_profile(
    cases: Iterable[BenchCase] = MATERIAL_CASES,
    threads: int = 1,
    seconds: float = 1.0,
    progress: Callable[[str], None] = lambda line: None,
    *,
    names: Sequence[str] | None = None,
    blocks: int = BLOCKS,
    yardstick: bool = False,
    start: Start = start_worker,
) -> ProfileReport:
    """Measure the phases of each law, one after the other, and return the report.

    Args:
        cases: of mpmcli.bench.materials.
        threads: of the processor; times are wall times.
        seconds: length of one block.
        progress: called with a line of text for each law.
        names: laws to measure; by default every law of the package.
        blocks: measured blocks of each law.
        yardstick: whether the block in C, with as many particles per cell, is measured too.
        start: makes the process of a law; tests replace it.

    A law that cannot start, or fails, is left out; the report gives the reason.
    """
    results: list[ProfileResult] = []
    flaws: list[str] = []
    for case in cases:
        contenders = [_Profile(case, name, f"{PROFILE}{name}") for name in (sorted(laws()) if names is None else names)]
        if yardstick:
            contenders.append(_Profile(block_of(case), IN_C, "yardstick"))
        for contender in contenders:
            progress(f"{case.name}: {contender.name}")
            lasting(
                [contender],
                lambda one: results.append(one.measure(Setting(threads), seconds, blocks, start)),
                flaws,
            )
    return ProfileReport(tuple(results), tuple(flaws), threads, seconds)


def block_of(case: BenchCase) -> BenchCase:
    """Return the block of the yardstick with the cells and the particles per cell of a column."""
    d = case.dimension
    return BenchCase(d, case.cells, round(2**d * (EDGE * case.cells) ** d), case.step)


class _Profile:
    """One law at one case."""

    def __init__(self, case: BenchCase, name: str, who: str) -> None:
        self.case, self.name, self.who = case, name, who

    def measure(self, setting: Setting, seconds: float, blocks: int, start: Start) -> ProfileResult:
        """Start, step to where the column flows, and measure."""
        phases: dict[str, list[float]] = {}
        total: list[float] = []
        with ExitStack() as stack:
            worker: Worker = stack.enter_context(start(self.who, self.case, setting))
            particles = worker.ready["particles"]
            worker.ask("first")
            # As the phases: the yardstick measures those of one thread by processor time.
            clock = "processor_seconds" if self.who == "yardstick" and setting.threads == 1 else "seconds"
            if self.who.startswith(PROFILE):
                worker.ask(f"keep {steps_of(self.case)[0]}")
            worker.ask(f"run {seconds}")
            worker.ask("phases")
            for _ in range(blocks):
                found = worker.ask(f"run {seconds}")
                scale = 1e9 / found["steps"] / particles
                total.append(scale * found[clock])
                for phase, spent in worker.ask("phases").items():
                    phases.setdefault(phase, []).append(scale * spent)
            worker.ask("finish")
        return ProfileResult(
            self.case, self.name, particles, {name: tuple(found) for name, found in phases.items()}, tuple(total)
        )

"""The report of `mpmcli bench --scaling`, as text tables and as a dictionary for JSON."""

import math
import statistics
from dataclasses import dataclass, field

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.report import ContestantResult, describe_machine, heading
from mpmcli.plain_text import text_table


@dataclass(frozen=True)
class ScalingResult:
    """One contestant at one size.

    Attributes:
        who: "ours", "yardstick" or "peer".
        case: its size; a peer's may differ from the others'.
        threads: of the processor, that it might use.
        measured: its blocks.
    """

    who: str
    case: BenchCase
    threads: int
    measured: ContestantResult

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        return {"ours": "mpmcli", "yardstick": "C", "peer": self.case.peer}[self.who]

    @property
    def nanoseconds(self) -> float:
        """Median of the blocks, ns per particle and step."""
        return 1e9 / self.measured.rate

    def as_dict(self) -> dict:
        """Return it for JSON."""
        return {
            "who": self.who,
            "label": self.label,
            "dimension": self.case.dimension,
            "cells": self.case.cells,
            "particles": self.case.particles,
            "step_s": self.case.step,
            "threads": self.threads,
            "threads_used": self.measured.threads,
            "ns_per_particle_step": self.nanoseconds,
            "ns_per_particle_step_blocks": [1e9 / rate for rate in self.measured.rates],
            "peak_memory_bytes": self.measured.peak_memory,
            "sound": self.measured.sound,
        }


@dataclass(frozen=True)
class ScalingReport:
    """Every size of one run of the benchmark.

    Attributes:
        results: in the order they ran.
        flaws: what was left out, and why.
        seconds: length of one block, s.
        machine: see `describe_machine`.
    """

    results: tuple[ScalingResult, ...]
    flaws: tuple[str, ...]
    seconds: float
    machine: dict = field(default_factory=describe_machine)

    @property
    def settings(self) -> list[tuple[int, int]]:
        """Dimension and number of threads of each table."""
        return sorted({(result.case.dimension, result.threads) for result in self.results})

    def exponents(self) -> list[dict]:
        """Return the exponent of the time of a step in the number of particles, of each contestant and setting."""
        found = []
        for dimension, threads in self.settings:
            for who in ("ours", "yardstick", "peer"):
                own = [result for result in self._of(dimension, threads) if result.who == who]
                if len({result.case.particles for result in own}) > 1:
                    exponent = fitted_exponent([(result.case.particles, result.nanoseconds) for result in own])
                    facts = {"who": who, "label": own[0].label, "dimension": dimension, "threads": threads}
                    found.append(facts | {"exponent": exponent})
        return found

    def as_dict(self) -> dict:
        """Return everything measured, ready for JSON."""
        return {
            "machine": self.machine,
            "precision": "f32",
            "block_s": self.seconds,
            "scaling": [result.as_dict() for result in self.results],
            "exponents": self.exponents(),
            "flaws": list(self.flaws),
        }

    def table(self) -> str:
        """Return the report as text: a table for each dimension and number of threads."""
        parts = [self._table(dimension, threads) for dimension, threads in self.settings]
        threads = sorted({result.threads for result in self.results}) or [1]
        notes = [
            "ns per particle and step, median of the blocks. C: the yardstick; slower: times that mpmcli is slower.",
            "exponent: of the time of a step in the number of particles; 1 is linear.",
            *(f"Beware: {flaw}" for flaw in self.flaws),
            *(
                f"Beware: {result.label} broke down at {result.case.particles:,} particles in {result.case.dimension}D."
                for result in self.results
                if not result.measured.sound
            ),
        ]
        return "\n\n".join([heading(self.machine, "cpu", threads, "f32"), *parts, "\n".join(notes)])

    def _of(self, dimension: int, threads: int) -> list[ScalingResult]:
        return [result for result in self.results if (result.case.dimension, result.threads) == (dimension, threads)]

    def _table(self, dimension: int, threads: int) -> str:
        own = self._of(dimension, threads)
        labels = list(dict.fromkeys(result.label for result in own))
        found = {(result.label, result.case.particles): result for result in own}
        rows = []
        for particles in sorted({result.case.particles for result in own}):
            beside = [found.get((label, particles)) for label in labels]
            ours, in_c = found.get(("mpmcli", particles)), found.get(("C", particles))
            ratio = f"{ours.nanoseconds / in_c.nanoseconds:.2f}" if ours and in_c else ""
            cells = next(result.case.cells for result in beside if result)
            rows.append(
                (f"{particles:,}", f"{cells}", *(f"{one.nanoseconds:.1f}" if one else "" for one in beside), ratio)
            )
        exponent = {
            entry["label"]: f"{entry['exponent']:.3f}"
            for entry in self.exponents()
            if (entry["dimension"], entry["threads"]) == (dimension, threads)
        }
        rows.append(("exponent", "", *(exponent.get(label, "") for label in labels), ""))
        head = ("particles", "cells", *labels, "slower")
        return f"{dimension}D, threads: {threads}\n" + text_table(head, rows, left=set())


def fitted_exponent(points: list[tuple[int, float]]) -> float:
    """Return the slope of the logarithm of a step's time over that of the number of particles, by least squares.

    Args:
        points: number of particles, and time per particle and step.
    """
    logarithms = [(math.log(count), math.log(count * each)) for count, each in points]
    return statistics.linear_regression(*zip(*logarithms, strict=True)).slope

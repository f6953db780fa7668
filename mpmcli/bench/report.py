"""The report of a comparison, as a text table and as a dictionary for JSON."""

import importlib.metadata
import os
import platform
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mpmcli import __version__
from mpmcli.bench.cases import BenchCase
from mpmcli.plain_text import counted, text_table

# Of a step that results from the division of an interval into equal steps.
ROUND_OFF = 1e-6


@dataclass(frozen=True)
class ContestantResult:
    """One contestant at one case.

    Attributes:
        rates: particle-steps/s of each measured block, in order.
        start_seconds: from the start of the process until it could step.
        compile_seconds: time of the first step beyond that of a usual one, without a cache on disk.
        peak_memory: largest resident memory of its process, bytes.
        bytes_per_particle: device memory per particle, None where it is not known.
        threads: of the processor, that it used.
        smallest_step: smallest time step that was taken, s.
        sound: whether every particle was in the domain at the end.
    """

    rates: tuple[float, ...]
    start_seconds: float
    compile_seconds: float
    peak_memory: int
    bytes_per_particle: int | None
    threads: int
    smallest_step: float
    sound: bool

    @property
    def rate(self) -> float:
        """Median of the blocks, particle-steps/s."""
        return statistics.median(self.rates)

    def as_dict(self) -> dict:
        """Return it with SI units in the names."""
        return {
            "particle_steps_per_s": self.rate,
            "particle_steps_per_s_min": min(self.rates),
            "particle_steps_per_s_max": max(self.rates),
            "particle_steps_per_s_blocks": list(self.rates),
            "start_s": self.start_seconds,
            "compile_s": self.compile_seconds,
            "peak_memory_bytes": self.peak_memory,
            "device_bytes_per_particle": self.bytes_per_particle,
            "threads": self.threads,
            "smallest_step_s": self.smallest_step,
            "sound": self.sound,
        }


@dataclass(frozen=True)
class CaseResult:
    """All contestants at one case; blocks k of all were measured one after the other.

    Attributes:
        case: its sizes.
        threads: of the processor, that each might use.
        ours, peer, yardstick: the contestants; the yardstick in C is None where it was not measured.
        others: further examples of the taichi package, by name.
    """

    case: BenchCase
    threads: int
    ours: ContestantResult
    peer: ContestantResult
    yardstick: ContestantResult | None = None
    others: dict[str, ContestantResult] = field(default_factory=dict)

    @property
    def ratio(self) -> float:
        """Our median rate over the peer's."""
        return self.ours.rate / self.peer.rate

    @property
    def ratio_range(self) -> tuple[float, float]:
        """Smallest and largest ratio of neighbouring blocks."""
        ratios = [a / b for a, b in zip(self.ours.rates, self.peer.rates, strict=True)]
        return min(ratios), max(ratios)

    @property
    def times_slower(self) -> float | None:
        """The median rate of the yardstick over ours."""
        return self.yardstick.rate / self.ours.rate if self.yardstick else None

    def as_dict(self) -> dict:
        """Return case, all sides and their ratios."""
        case = self.case
        return {
            "case": case.name,
            "threads": self.threads,
            "dimension": case.dimension,
            "cells": case.cells,
            "particles": case.particles,
            "step_s": case.step,
            "peer_name": case.peer,
            "ours": self.ours.as_dict(),
            "peer": self.peer.as_dict(),
            "ratio": self.ratio,
            "ratio_min": self.ratio_range[0],
            "ratio_max": self.ratio_range[1],
            "yardstick": self.yardstick.as_dict() if self.yardstick else None,
            "times_slower_than_yardstick": self.times_slower,
            "others": {name: side.as_dict() for name, side in self.others.items()},
        }


def describe_machine() -> dict:
    """Return processor, system and versions."""
    return {
        "processor": _processor_name(),
        "logical_processors": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "taichi": importlib.metadata.version("taichi"),
        "mpmcli": __version__,
    }


def _processor_name() -> str:
    described = Path("/proc/cpuinfo")
    if described.exists():
        for line in described.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def heading(machine: dict, arch: str, threads: Sequence[int], precision: str) -> str:
    """Return the line above a table: machine, numbers of threads and precision."""
    numbers = ", ".join(map(str, threads[:-1])) + " and " * (len(threads) > 1) + counted(threads[-1], "thread")
    return f"{machine['processor']}, {arch}, {numbers}, {precision}, taichi {machine['taichi']}"


@dataclass(frozen=True)
class BenchReport:
    """Every case of one run of the benchmark, and its settings.

    Attributes:
        results: one per case and number of threads, in the order they ran.
        threads: numbers of them that each contestant may use; precision, arch: of all.
        seconds: length of one block, s.
        machine: see `describe_machine`.
    """

    results: tuple[CaseResult, ...]
    threads: tuple[int, ...]
    precision: str
    arch: str
    seconds: float
    machine: dict = field(default_factory=describe_machine)

    def speed_up(self, result: CaseResult) -> float | None:
        """Return our rate over that with the fewest threads in the same case; None with one number of threads."""
        first = min((other for other in self.results if other.case == result.case), key=lambda other: other.threads)
        return result.ours.rate / first.ours.rate if len(self.threads) > 1 else None

    def efficiency(self, result: CaseResult) -> float | None:
        """Return the speed-up over the ratio of the numbers of threads that each might use."""
        speed_up = self.speed_up(result)
        return speed_up * min(self.threads) / result.threads if speed_up else None

    def as_dict(self) -> dict:
        """Return everything measured, ready for JSON."""
        return {
            "machine": self.machine,
            "threads": list(self.threads),
            "precision": self.precision,
            "arch": self.arch,
            "block_s": self.seconds,
            "cases": [
                result.as_dict() | {"speed_up": self.speed_up(result), "efficiency": self.efficiency(result)}
                for result in self.results
            ],
        }

    def table(self) -> str:
        """Return the report as text: one line per case, then what the columns mean."""
        with_yardstick = any(result.yardstick for result in self.results)
        columns = [_row(result, with_yardstick=with_yardstick) for result in self.results]
        if len(self.threads) > 1:
            for result, cells in zip(self.results, columns, strict=True):
                cells |= {"speed-up": f"{self.speed_up(result):.2f}", "efficiency": f"{self.efficiency(result):.0%}"}
        for name in dict.fromkeys(name for result in self.results for name in result.others):
            for result, cells in zip(self.results, columns, strict=True):
                cells[name] = f"{result.others[name].rate / 1e6:.2f}" if name in result.others else ""
        head = tuple(columns[0]) if columns else ("case",)
        table = text_table(head, [tuple(cells.values()) for cells in columns], left={0, 4})
        title = heading(self.machine, self.arch, self.threads, self.precision)
        in_c = [
            "C: the yardstick, million particle-steps per second; slower: times that mpmcli is slower than it.",
        ] * with_yardstick
        several = [
            "speed-up, efficiency: ours over ours with the fewest threads, and for each thread.",
        ] * (len(self.threads) > 1)
        notes = [
            "M steps/s: million particle-steps per second, median of the blocks.",
            "threads: ours / the peer's; mpmcli takes one for each 2,500 particles.",
            "ratio: ours over the peer's; range: of neighbouring blocks.",
            *in_c,
            *several,
            "start+compile, memory: ours / the peer's, with no kernel cached on disk.",
        ]
        held = [
            f"Device memory at {result.case.name}: {result.ours.bytes_per_particle} bytes per particle."
            for result in self.results
            if result.ours.bytes_per_particle is not None
        ]
        smaller = [
            f"Beware: at {result.case.name} mpmcli's own limits asked for steps down to"
            f" {result.ours.smallest_step:.3g} s, below the {result.case.step:.3g} s of {result.case.peer}."
            for result in self.results
            if result.ours.smallest_step < (1 - ROUND_OFF) * result.case.step
        ]
        broken = [
            f"Beware: {who} broke down at {result.case.name} (a particle left the box or is not a number)."
            for result in self.results
            for who, side in {"mpmcli": result.ours, result.case.peer: result.peer, "C": result.yardstick}.items()
            | result.others.items()
            if side and not side.sound
        ]
        return "\n".join([title, "", table, "", *notes, *held, *smaller, *broken])


def _row(result: CaseResult, *, with_yardstick: bool) -> dict[str, str]:
    """Return the cells of a line, by column, with those of the yardstick if the table has them."""
    ours, peer, yardstick, (low, high) = result.ours, result.peer, result.yardstick, result.ratio_range
    in_c = {"C": "", "slower": ""} if with_yardstick else {}
    if yardstick:
        in_c = {"C": f"{yardstick.rate / 1e6:.2f}", "slower": f"{result.times_slower:.2f}"}
    return {
        "case": result.case.name,
        "particles": f"{result.case.particles:,}",
        "threads": f"{ours.threads} / {peer.threads}",
        "M steps/s": f"{ours.rate / 1e6:.2f}",
        "peer": result.case.peer,
        "peer's": f"{peer.rate / 1e6:.2f}",
        "ratio": f"{result.ratio:.2f}",
        "range": f"{low:.2f}-{high:.2f}",
        **in_c,
        "start+compile s": " / ".join(f"{side.start_seconds:.1f}+{side.compile_seconds:.1f}" for side in (ours, peer)),
        "memory MB": f"{ours.peak_memory / 1e6:.0f} / {peer.peak_memory / 1e6:.0f}",
    }

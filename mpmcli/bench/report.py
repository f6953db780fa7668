"""The report of a comparison, as a text table and as a dictionary for JSON."""

import importlib.metadata
import os
import platform
import statistics
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
    """Both contestants at one case; blocks k of both were measured one after the other."""

    case: BenchCase
    ours: ContestantResult
    peer: ContestantResult

    @property
    def ratio(self) -> float:
        """Our median rate over the peer's."""
        return self.ours.rate / self.peer.rate

    @property
    def ratio_range(self) -> tuple[float, float]:
        """Smallest and largest ratio of neighbouring blocks."""
        ratios = [a / b for a, b in zip(self.ours.rates, self.peer.rates, strict=True)]
        return min(ratios), max(ratios)

    def as_dict(self) -> dict:
        """Return case, both sides and their ratio."""
        case = self.case
        return {
            "case": case.name,
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


def heading(machine: dict, arch: str, threads: int, precision: str) -> str:
    """Return the line above a table: machine, threads and precision."""
    return f"{machine['processor']}, {arch}, {counted(threads, 'thread')}, {precision}, taichi {machine['taichi']}"


@dataclass(frozen=True)
class BenchReport:
    """Every case of one run of the benchmark, and its settings.

    Attributes:
        results: one per case, in the order they ran.
        threads: that each contestant may use; precision, arch: of both.
        seconds: length of one block, s.
        machine: see `describe_machine`.
    """

    results: tuple[CaseResult, ...]
    threads: int
    precision: str
    arch: str
    seconds: float
    machine: dict = field(default_factory=describe_machine)

    def as_dict(self) -> dict:
        """Return everything measured, ready for JSON."""
        return {
            "machine": self.machine,
            "threads": self.threads,
            "precision": self.precision,
            "arch": self.arch,
            "block_s": self.seconds,
            "cases": [result.as_dict() for result in self.results],
        }

    def table(self) -> str:
        """Return the report as text: one line per case, then what the columns mean."""
        head = (
            "case",
            "particles",
            "threads",
            "M steps/s",
            "peer",
            "peer's",
            "ratio",
            "range",
            "start+compile s",
            "memory MB",
        )
        table = text_table(head, [_row(result) for result in self.results], left={0, 4})
        title = heading(self.machine, self.arch, self.threads, self.precision)
        notes = [
            "M steps/s: million particle-steps per second, median of the blocks.",
            "threads: ours / the peer's; mpmcli takes one for each 2,500 particles.",
            "ratio: ours over the peer's; range: of neighbouring blocks.",
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
            for who, side in (("mpmcli", result.ours), (result.case.peer, result.peer))
            if not side.sound
        ]
        return "\n".join([title, "", table, "", *notes, *held, *smaller, *broken])


def _row(result: CaseResult) -> tuple[str, ...]:
    ours, peer, (low, high) = result.ours, result.peer, result.ratio_range
    return (
        result.case.name,
        f"{result.case.particles:,}",
        f"{ours.threads} / {peer.threads}",
        f"{ours.rate / 1e6:.2f}",
        result.case.peer,
        f"{peer.rate / 1e6:.2f}",
        f"{result.ratio:.2f}",
        f"{low:.2f}-{high:.2f}",
        " / ".join(f"{side.start_seconds:.1f}+{side.compile_seconds:.1f}" for side in (ours, peer)),
        f"{ours.peak_memory / 1e6:.0f} / {peer.peak_memory / 1e6:.0f}",
    )

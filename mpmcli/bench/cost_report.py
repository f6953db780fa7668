"""The cost of laws, as text tables and as a dictionary for JSON."""

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.report import describe_machine, heading
from mpmcli.plain_text import text_table

# (law, reference law, largest ratio of their costs).
TARGETS = (("fixed_corotated", "neo_hookean", 2.0), ("sand", "fluid", 5.0), ("snow", "fluid", 5.0))
# Largest ratio of the cost of a scene with two laws to the sum of its parts.
MIX_TARGET = 1.05
# Laws that every law is compared with.
MEASURES = ("fluid", "neo_hookean")


def name_of(names: Sequence[str]) -> str:
    """Return the name of the laws of a column, by place, such as "fluid + sand" or "half of sand"."""
    return ("" if all(names) else "half of ") + " + ".join(filter(None, names))


@dataclass(frozen=True)
class CostResult:
    """One law, or several in one scene, or a part of such a scene, at one case.

    Attributes:
        case: sizes and step.
        names: of the laws, by place, each with an equal share of the column; "" where the place is empty.
        costs: s per particle and step of each measured block, in order.
        compile_seconds: time of the first step beyond that of a usual one, without a cache on disk.
        bytes_per_particle: device memory, sort buffers included, of a particle of the law that takes most.
        flowing: share of the particles whose state the last step projected: those in plastic flow, or torn.
        watch_share: share of the time that went into measuring the state, for the limits of the next steps.
        smallest_step: smallest time step that was taken, s.
        sound: whether every particle was in the domain at the end.
    """

    case: BenchCase
    names: tuple[str, ...]
    costs: tuple[float, ...]
    compile_seconds: float
    bytes_per_particle: int
    flowing: float
    watch_share: float
    smallest_step: float
    sound: bool

    @property
    def name(self) -> str:
        """The laws, like "fluid + sand"."""
        return name_of(self.names)

    @property
    def laws(self) -> list[str]:
        """The laws there are."""
        return [*filter(None, self.names)]

    @property
    def parts(self) -> tuple[tuple[str, ...], ...]:
        """The names of the same scene with one law left in it, for each of several laws."""
        if len(self.laws) < 2:
            return ()
        places = range(len(self.names))
        return tuple(tuple(name if i == place else "" for i, name in enumerate(self.names)) for place in places)

    @property
    def particles(self) -> int:
        """The number of particles."""
        return self.case.particles * len(self.laws) // len(self.names)

    @property
    def nanoseconds(self) -> float:
        """Median of the blocks, ns per particle and step."""
        return 1e9 * statistics.median(self.costs)

    def as_dict(self) -> dict:
        """Return it with SI units in the names, but for the cost, which is in ns."""
        return {
            "case": self.case.name,
            "laws": self.laws,
            "share_of_column": len(self.laws) / len(self.names),
            "particles": self.particles,
            "step_s": self.case.step,
            "ns_per_particle_step": self.nanoseconds,
            "ns_per_particle_step_blocks": [1e9 * cost for cost in self.costs],
            "compile_s": self.compile_seconds,
            "device_bytes_per_particle": self.bytes_per_particle,
            "flowing": self.flowing,
            "watch_share": self.watch_share,
            "smallest_step_s": self.smallest_step,
            "sound": self.sound,
        }


@dataclass(frozen=True)
class Ratio:
    """A cost over another, or over the mean of several.

    Attributes:
        value: of the medians.
        low, high: of the blocks of each round, which were measured right beside each other.
    """

    value: float
    low: float
    high: float


def ratio_of(result: CostResult, *parts: CostResult) -> Ratio:
    """Return the cost of a result over the mean of its parts, which is their sum with an equal share of particles."""
    rounds = [
        cost / statistics.fmean(beside)
        for cost, *beside in zip(result.costs, *(part.costs for part in parts), strict=True)
    ]
    return Ratio(result.nanoseconds / statistics.fmean(p.nanoseconds for p in parts), min(rounds), max(rounds))


@dataclass(frozen=True)
class Target:
    """An upper bound of the ratio of two costs.

    Attributes:
        case: name of the case.
        text: the two costs.
        ratio: the measured ratio.
        limit: the bound.
    """

    case: str
    text: str
    ratio: Ratio
    limit: float

    @property
    def met(self) -> bool:
        """Whether the ratio is within the bound."""
        return self.ratio.value <= self.limit

    def as_dict(self) -> dict:
        """Return it as a dictionary for JSON."""
        found = {"ratio": self.ratio.value, "ratio_min": self.ratio.low, "ratio_max": self.ratio.high}
        return {"case": self.case, "target": self.text, **found, "limit": self.limit, "met": self.met}

    def sentence(self) -> str:
        """Return the ratio and the bound as a sentence."""
        verdict = "" if self.met else ", MISSED"
        return f"{self.case}: {self.text}: {self.ratio.value:.3f}, should be at most {self.limit:g}{verdict}."


@dataclass(frozen=True)
class CostReport:
    """Every law and every mix of one run of the benchmark.

    Attributes:
        results: laws and then mixes of each case.
        flaws: a sentence for each law that could not be measured.
        threads, precision: as all used them.
        seconds: length of one block, s.
        machine: see `describe_machine`.
    """

    results: tuple[CostResult, ...]
    flaws: tuple[str, ...]
    threads: int
    precision: str
    seconds: float
    machine: dict = field(default_factory=describe_machine)

    @property
    def clock(self) -> str:
        """The clock of the measurements."""
        return "processor time" if self.threads == 1 else "wall time"

    def of(self, result: CostResult, *others: Sequence[str]) -> Ratio | None:
        """Return the ratio of a cost to the mean of others at the same case, or None if those were not measured."""
        found = {other.names: other for other in self.results if other.case == result.case}
        if not others or not all(names in found for names in others):
            return None
        return ratio_of(result, *(found[names] for names in others))

    @property
    def targets(self) -> tuple[Target, ...]:
        """The bounds of the costs that were measured."""
        return tuple(self._targets())

    def _targets(self) -> Iterator[Target]:
        for result in self.results:
            if result.names == ("fluid",):
                others = [r for r in self.results if r.case == result.case and len(r.names) == 1 and r is not result]
                if others:
                    cheapest = min(others, key=lambda other: other.nanoseconds)
                    text = f"fluid over the next cheapest, {cheapest.name}"
                    yield Target(result.case.name, text, ratio_of(result, cheapest), 1.0)
            for law, measure, limit in TARGETS:
                if result.names == (law,) and (ratio := self.of(result, (measure,))):
                    yield Target(result.case.name, f"{law} over {measure}", ratio, limit)
            if ratio := self.of(result, *result.parts):
                yield Target(result.case.name, f"{result.name} over the sum of its parts", ratio, MIX_TARGET)

    def as_dict(self) -> dict:
        """Return everything measured, ready for JSON."""
        return {
            "machine": self.machine,
            "threads": self.threads,
            "precision": self.precision,
            "arch": "cpu",
            "block_s": self.seconds,
            "clock": self.clock,
            "results": [self._result_dict(result) for result in self.results],
            "targets": [target.as_dict() for target in self.targets],
            "flaws": list(self.flaws),
        }

    def _result_dict(self, result: CostResult) -> dict:
        if len(result.names) > 1:
            ratios = {"over_sum_of_parts": self.of(result, *result.parts)}
        else:
            ratios = {f"over_{name}": self.of(result, (name,)) for name in MEASURES}
        return result.as_dict() | {key: ratio.value if ratio else None for key, ratio in ratios.items()}

    def table(self) -> str:
        """Return the report as text: laws, mixes, targets, and what the columns mean."""
        head = ("case", "law", "ns", "range", "/ fluid", "/ neo_hookean", "bytes", "compile s", "flowing", "watch")
        rows = [
            (
                *_cost_cells(result),
                *(_times(self.of(result, (name,))) for name in MEASURES),
                str(result.bytes_per_particle),
                f"{result.compile_seconds:.1f}",
                f"{100 * result.flowing:.0f} %",
                f"{100 * result.watch_share:.1f} %",
            )
            for result in self.results
            if len(result.names) == 1
        ]
        parts = [text_table(head, rows, left={0, 1})]
        mixes = [
            (*_cost_cells(result), _times(self.of(result, *result.parts)), f"{result.compile_seconds:.1f}")
            for result in self.results
            if len(result.names) > 1
        ]
        if mixes:
            parts.append(
                text_table(
                    ("case", "two laws, and each alone", "ns", "range", "/ sum", "compile s"), mixes, left={0, 1}
                )
            )
        parts.append("\n".join(target.sentence() for target in self.targets))
        notes = [
            f"ns: {self.clock} per particle and step, median of the blocks; range: of the blocks.",
            "sum: what the same scene costs with only the one law's half of the column, plus with only the other's.",
            "bytes: on the device per particle, sort buffers included; compile: with no kernel cached on disk.",
            "flowing: particles in plastic flow, or torn, at the end of what was measured.",
            "watch: share of the time that went into measuring the state, which the next steps follow.",
        ]
        return "\n\n".join(
            filter(None, [heading(self.machine, "cpu", [self.threads], self.precision), *parts, "\n".join(notes)])
        ) + "".join(f"\nBeware: {warning}" for warning in [*self._warnings(), *self.flaws])

    def _warnings(self) -> Iterator[str]:
        for result in self.results:
            where = f"{result.name} at {result.case.name}"
            if result.smallest_step < result.case.step:
                yield (
                    f"the limits of {where} asked for steps down to {result.smallest_step:.3g} s, "
                    f"below the {result.case.step:.3g} s of the others."
                )
            if not result.sound:
                yield f"{where} broke down (a particle left the box or is not a number)."


def _cost_cells(result: CostResult) -> tuple[str, ...]:
    low, high = 1e9 * min(result.costs), 1e9 * max(result.costs)
    return result.case.name, result.name, f"{result.nanoseconds:.1f}", f"{low:.1f}-{high:.1f}"


def _times(ratio: Ratio | None) -> str:
    return "" if ratio is None else f"{ratio.value:.2f}"

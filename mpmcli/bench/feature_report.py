"""The cost of features, as a text table and as a dictionary for JSON."""

import statistics
from collections.abc import Iterator
from dataclasses import dataclass, field

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.cost_report import Ratio
from mpmcli.bench.features import Feature
from mpmcli.bench.report import describe_machine, heading
from mpmcli.plain_text import text_table


@dataclass(frozen=True)
class FeatureResult:
    """One scene at one case and one number of threads.

    Attributes:
        case: sizes and step; threads: of the processor.
        feature: the scene.
        particles: their number.
        costs: s per particle and step of each measured block, in order.
        smallest_step: smallest time step that was taken, s.
        sound: whether every particle was in the domain at the end.
    """

    case: BenchCase
    threads: int
    feature: Feature
    particles: int
    costs: tuple[float, ...]
    smallest_step: float
    sound: bool

    @property
    def nanoseconds(self) -> float:
        """Median of the blocks, ns per particle and step."""
        return 1e9 * statistics.median(self.costs)


@dataclass(frozen=True)
class FeatureReport:
    """Every scene of one run of the benchmark.

    Attributes:
        results: in the order of features, for each number of threads of each case.
        flaws: a sentence for each scene that could not be measured.
        precision: as all used it.
        seconds: length of one block of the plain scene, s.
        machine: see `describe_machine`.
    """

    results: tuple[FeatureResult, ...]
    flaws: tuple[str, ...]
    precision: str
    seconds: float
    machine: dict = field(default_factory=describe_machine)

    def base_of(self, result: FeatureResult) -> FeatureResult | None:
        """Return the same scene without its feature, None where that was not measured."""
        key = (result.case, result.threads, result.feature.base)
        return next((r for r in self.results if (r.case, r.threads, r.feature.name) == key), None)

    def ratio(self, result: FeatureResult) -> Ratio | None:
        """Return the cost of a scene over that without its feature: median and quartiles of neighbouring blocks."""
        if (base := self.base_of(result)) is None:
            return None
        rounds = [cost / beside for cost, beside in zip(result.costs, base.costs, strict=True)]
        low, _, high = statistics.quantiles(rounds, method="inclusive") if len(rounds) > 1 else 3 * rounds
        return Ratio(statistics.median(rounds), low, high)

    def as_dict(self) -> dict:
        """Return everything measured, ready for JSON."""
        return {
            "machine": self.machine,
            "precision": self.precision,
            "arch": "cpu",
            "block_s": self.seconds,
            "features": [self._result_dict(result) for result in self.results],
            "flaws": list(self.flaws),
        }

    def _result_dict(self, result: FeatureResult) -> dict:
        ratio, limit, base = self.ratio(result), result.feature.limit, self.base_of(result)
        return {
            "case": result.case.name,
            "threads": result.threads,
            "feature": result.feature.name,
            "over": result.feature.base,
            "particles": result.particles,
            "step_s": result.case.step,
            "clock": "processor time" if result.threads == 1 else "wall time",
            "ns_per_particle_step": result.nanoseconds,
            "ns_per_particle_step_blocks": [1e9 * cost for cost in result.costs],
            "ratio": ratio.value if ratio else None,
            "ratio_quartiles": [ratio.low, ratio.high] if ratio else None,
            "ratio_fastest": min(result.costs) / min(base.costs) if base else None,
            "limit": limit,
            "met": ratio.value <= limit if ratio and limit else None,
            "smallest_step_s": result.smallest_step,
            "sound": result.sound,
        }

    def table(self) -> str:
        """Return the report as text: scenes, their ratios, and what the columns mean."""
        head = ("case", "threads", "scene", "over", "ns", "ratio", "quartiles", "fastest", "at most", "")
        rows = []
        for found in self.as_dict()["features"]:
            low, high = found["ratio_quartiles"] or (0.0, 0.0)
            known = found["ratio"] is not None
            rows.append(
                (
                    found["case"],
                    str(found["threads"]),
                    found["feature"],
                    found["over"] or "",
                    f"{found['ns_per_particle_step']:.1f}",
                    f"{found['ratio']:.3f}" if known else "",
                    f"{low:.3f}-{high:.3f}" if known else "",
                    f"{found['ratio_fastest']:.3f}" if known else "",
                    f"{found['limit']:.2f}" if found["limit"] else "",
                    "MISSED" if found["met"] is False else "",
                )
            )
        notes = (
            "ns: per particle and step, median of the blocks; processor time on one thread, wall time on several.\n"
            "ratio: of blocks measured in the same round, median; fastest: of the fastest block of each.\n"
            "The plain scene is there twice: its ratio shows the noise."
        )
        threads = sorted({result.threads for result in self.results}) or [1]
        top = heading(self.machine, "cpu", threads, self.precision)
        warnings = "".join(f"\nBeware: {warning}" for warning in [*self._warnings(), *self.flaws])
        return f"{top}\n\n{text_table(head, rows, left={0, 2, 3})}\n\n{notes}{warnings}"

    def _warnings(self) -> Iterator[str]:
        for result in self.results:
            where = f'"{result.feature.name}" at {result.case.name}'
            # The first step that a run of a batch takes is the step that the time is divided by.
            if result.smallest_step < 0.99 * result.case.step:
                yield f"{where} took steps down to {result.smallest_step:.3g} s instead of {result.case.step:.3g} s."
            if not result.sound:
                yield f"{where} broke down (a particle left the box or is not a number)."

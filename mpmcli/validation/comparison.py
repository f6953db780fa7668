"""Comparison of settings: the cheapest one for an error of 1 %, and each one against the default."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from mpmcli.validation.case import Case
from mpmcli.validation.convergence import ROUND_OFF, Cost, Point, cost_to_reach
from mpmcli.validation.matrix import Run, label_of
from mpmcli.validation.run_result import RunResult
from mpmcli.validation.setting import Setting
from mpmcli.validation.verdict import Results

# Target error of the cheapest setting.
TARGET = 0.01
# Smallest relative saving of time over the default setting that counts, given the noise of timings.
MARGIN = 0.1


def series_of(case: Case, results: Results) -> dict[Setting, list[tuple[Run, RunResult]]]:
    """Return the runs of a case by setting, each list from coarse to fine."""
    series: dict[Setting, list[tuple[Run, RunResult]]] = {}
    for run, result in results.items():
        if run.case == case.name:
            series.setdefault(run.setting, []).append((run, result))
    return {setting: sorted(runs, key=lambda entry: entry[0].n) for setting, runs in series.items()}


def points_of(case: Case, runs: Sequence[tuple[Run, RunResult]]) -> list[Point]:
    """Return error and cost of the finished runs of a setting."""
    name = case.measures[0].name
    return [
        Point(run.n, result.error(name), result.seconds, result.particle_steps)
        for run, result in runs
        if result.finished
    ]


@dataclass(frozen=True)
class Cheapest:
    """The setting that reaches the target error in the least time, and its cost."""

    setting: Setting
    cost: Cost

    @property
    def label(self) -> str:
        """Label of the setting."""
        return label_of(self.setting)


def cheapest(case: Case, results: Results, target: float = TARGET) -> Cheapest | None:
    """Return the setting that reaches the target error in the least time; None if none does or the error has a unit.

    The default setting is preferred if another one saves less than MARGIN of its time.
    """
    if case.measures[0].unit:
        return None
    found = [
        Cheapest(setting, cost)
        for setting, runs in series_of(case, results).items()
        if (cost := cost_to_reach(points_of(case, runs), target)) is not None
    ]
    if not found:
        return None
    best = min(found, key=lambda entry: entry.cost.seconds)
    for entry in found:
        if entry.setting == Setting() and entry.cost.seconds * (1 - MARGIN) <= best.cost.seconds:
            return entry
    return best


@dataclass(frozen=True)
class Ratios:
    """Ratios by the name of the case."""

    of_case: dict[str, float]

    @property
    def mean(self) -> float:
        """Geometric mean."""
        return _mean(list(self.of_case.values()))

    @property
    def low(self) -> float:
        """Smallest ratio."""
        return min(self.of_case.values())

    @property
    def high(self) -> float:
        """Largest ratio."""
        return max(self.of_case.values())


@dataclass(frozen=True)
class Compared:
    """Ratios of a setting to the default one over all cases; a ratio below 1 is an improvement.

    Attributes:
        setting: the setting compared.
        error: ratios of errors at equal resolution.
        seconds: ratios of times at equal resolution.
        to_equal: ratios of the times to the smallest error that both reach.
        failed: number of runs that did not finish.
        runs: number of runs.
    """

    setting: Setting
    error: Ratios | None
    seconds: Ratios | None
    to_equal: Ratios | None
    failed: int
    runs: int

    @property
    def label(self) -> str:
        """Label of the setting."""
        return label_of(self.setting)


def compare_settings(cases: Sequence[Case], results: Results) -> list[Compared]:
    """Compare every setting with the default one, case by case."""
    settings = dict.fromkeys(run.setting for run in results if run.setting != Setting())
    return [_compare(setting, cases, results) for setting in settings]


def _compare(setting: Setting, cases: Sequence[Case], results: Results) -> Compared:
    errors, seconds, equals = {}, {}, {}
    for case in cases:
        series = series_of(case, results)
        usual, other = (points_of(case, series.get(key, [])) for key in (Setting(), setting))
        # Ratios of round-off errors are meaningless.
        usual, other = ([point for point in points if point.error > ROUND_OFF] for points in (usual, other))
        by_n = {point.n: point for point in usual}
        pairs = [(point, by_n[point.n]) for point in other if point.n in by_n]
        if not pairs:
            continue
        errors[case.name] = _mean([a.error / b.error for a, b in pairs])
        timed = [a.seconds / b.seconds for a, b in pairs if min(a.seconds, b.seconds) > 0]
        if timed:
            seconds[case.name] = _mean(timed)
        target = max(min(point.error for point in points) for points in (usual, other))
        a, b = cost_to_reach(other, target), cost_to_reach(usual, target)
        if a and b and min(a.seconds, b.seconds) > 0:
            equals[case.name] = a.seconds / b.seconds
    mine = [result for run, result in results.items() if run.setting == setting]
    failed = sum(not result.finished for result in mine)
    ratios = [Ratios(found) if found else None for found in (errors, seconds, equals)]
    return Compared(setting, *ratios, failed=failed, runs=len(mine))


def _mean(values: Sequence[float]) -> float:
    return math.exp(sum(map(math.log, values)) / len(values))

"""Comparison of settings: the cheapest one for an error of 1 %, each one against the default, and what that says."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from mpmcli.validation.case import Case, Setting
from mpmcli.validation.runs import Results, Run, RunResult
from mpmcli.validation.verdict import ROUND_OFF, SINGLE

# Target error of the cheapest setting.
TARGET = 0.01
# Smallest relative saving of time over the default setting that counts, given the noise of timings.
MARGIN = 0.1
# A setting replaces the default one if the mean ratio of times at equal error is below FASTER and no ratio of errors
# at equal resolution exceeds WORSE.
FASTER, WORSE = 0.9, 2.0
# Replaces a zero error in logarithms.
NOTHING = 1e-18


@dataclass(frozen=True)
class Cost:
    """The cost of reaching a given error at an interpolated resolution, `at_most` so much if all runs are better."""

    n: float
    seconds: float
    particle_steps: float
    at_most: bool = False


@dataclass(frozen=True)
class Point:
    """One run of a setting: resolution, error and cost."""

    n: int
    error: float
    seconds: float
    particle_steps: float


def cost_to_reach(points: Sequence[Point], target: float) -> Cost | None:
    """Return the cost at which the error falls to `target` in runs from coarse to fine; None if it stays above.

    The logarithms of n, cost and error are interpolated linearly, since errors and costs are powers of n.
    """
    for i, point in enumerate(points):
        if point.error > target:
            continue
        if i == 0:
            return Cost(point.n, point.seconds, point.particle_steps, at_most=point.error < target)
        before = points[i - 1]
        fall = math.log(before.error / max(point.error, NOTHING))
        share = math.log(before.error / target) / fall
        return Cost(
            _between(before.n, point.n, share),
            _between(before.seconds, point.seconds, share),
            _between(before.particle_steps, point.particle_steps, share),
        )
    return None


def _between(a: float, b: float, share: float) -> float:
    """Interpolate logarithmically, or linearly if a cost is zero."""
    return a * (b / a) ** share if min(a, b) > 0 else a + share * (b - a)


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


def cheapest(case: Case, results: Results, target: float = TARGET) -> Cheapest | None:
    """Return the setting that reaches the target error in the least time; None if none does or the error has a unit.

    The default setting is preferred if another one saves less than MARGIN of its time.
    """
    if case.measures[0].unit:
        return None
    reached = [
        Cheapest(setting, cost)
        for setting, runs in series_of(case, results).items()
        if (cost := cost_to_reach(points_of(case, runs), target)) is not None
    ]
    if not reached:
        return None
    best = min(reached, key=lambda entry: entry.cost.seconds)
    for entry in reached:
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
    """Ratios of a setting to the default one over all cases, below 1 for an improvement, and its failed runs.

    Errors and times are those at equal resolution; `to_equal` are times to the smallest error that both reach.
    """

    setting: Setting
    error: Ratios | None
    seconds: Ratios | None
    to_equal: Ratios | None
    failed: int
    runs: int


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
    ratios = [Ratios(of_case) if of_case else None for of_case in (errors, seconds, equals)]
    return Compared(setting, *ratios, failed=failed, runs=len(mine))


def _mean(values: Sequence[float]) -> float:
    return math.exp(sum(map(math.log, values)) / len(values))


def takes_its_place(entry: Compared) -> bool:
    """Return whether a setting should replace the default one."""
    if entry.error is None or entry.to_equal is None or entry.failed:
        return False
    return entry.to_equal.mean < FASTER and entry.error.high <= WORSE


def reason(entry: Compared) -> str:
    """Return one sentence with the ratios for or against a setting."""
    if entry.error is None or entry.to_equal is None:
        return f"**{entry.setting.label}**: no case tells."
    worst = max(entry.error.of_case, key=entry.error.of_case.__getitem__)
    gain = f"**{entry.setting.label}**: {entry.to_equal.mean:.2g} of the time"
    bad = f"{entry.error.high:.2g} times as far off in its worst case, {worst}"
    if entry.failed:
        return f"{gain}, but {entry.failed} of {entry.runs} runs failed."
    if entry.setting == SINGLE:
        return f"{gain}, and {bad}: scenes take it, as nothing is lost. Here it would blur the orders of small errors."
    if takes_its_place(entry):
        return f"{gain}, and {bad}: it should be the default."
    return f"{gain}, but {bad}." if entry.to_equal.mean < FASTER else f"{gain}; {bad}."


def outcome(compared: Sequence[Compared]) -> str:
    """Return the rule of replacement and the settings that satisfy it, as text of the report."""
    better = [entry.setting.label for entry in compared if entry.setting != SINGLE and takes_its_place(entry)]
    rule = (
        f"A setting would take the place of the default one if it came to an equal error in less than {FASTER:g} of "
        f"the time, in the mean over the cases, and were at most {WORSE:g} times as far off at equal n in any of them."
    )
    return f"{rule} {'These do: ' + ', '.join(better) + '.' if better else 'None does.'}"

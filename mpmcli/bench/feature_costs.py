"""Measures the cost of features: a process for each scene, measured in turn (A B C ... A B C ...)."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.compare import Setting, Worker, start_worker
from mpmcli.bench.costs import Start, lasting
from mpmcli.bench.feature_report import FeatureReport, FeatureResult
from mpmcli.bench.features import FEATURE_CASES, FEATURES, SETTLING, Feature

# Rounds, and the length of a block, s: many short blocks, so that those of a round run beside the same other processes.
ROUNDS, BLOCK = 15, 0.5


def run_features(
    cases: Iterable[BenchCase] = FEATURE_CASES,
    threads: Sequence[int] = (1, 2),
    seconds: float = BLOCK,
    progress: Callable[[str], None] = lambda line: None,
    *,
    features: Sequence[Feature] = FEATURES,
    rounds: int = ROUNDS,
    precision: str = "f32",
    start: Start = start_worker,
) -> FeatureReport:
    """Measure every scene at each number of threads, and return the report.

    Args:
        cases: of mpmcli.bench.features.
        threads: numbers of threads of the processor.
        seconds: length of a block of the first scene; the blocks of all have as many steps.
        progress: called with a line of text for each scene that starts and each round.
        features: scenes to measure.
        rounds: measured blocks of each scene.
        precision: "f32" or "f64".
        start: makes the process of a scene; tests replace it.

    A scene that cannot start, or fails, is left out; the report gives the reason.
    """
    results: list[FeatureResult] = []
    flaws: list[str] = []
    for case in cases:
        for count in threads:
            where = f"{case.name}, {count} thread{'s' * (count > 1)}"
            with ExitStack() as stack:
                scenes = []
                for feature in features:
                    found = _Scene(case, feature, Setting(count, precision))
                    scenes += lasting([found], lambda scene, stack=stack: scene.begin(stack, start), flaws)
                    progress(f"{where}: {feature.name} is ready")
                # Each block takes as many steps, so that all scenes are at the same time.
                steps = max(1, round(seconds / scenes[0].step_seconds)) if scenes else 0
                for block in range(rounds):
                    scenes = lasting(scenes, lambda scene, steps=steps: scene.measure(steps), flaws)
                    last = ", ".join(f"{scene.feature.name} {1e9 * scene.costs[-1]:.1f}" for scene in scenes)
                    progress(f"{where}: round {block + 1} of {rounds}, ns: {last}")
                lasting(scenes, lambda scene: results.append(scene.finish()), flaws)
    return FeatureReport(tuple(results), tuple(flaws), precision, seconds)


class _Scene:
    """One scene, and the process that runs it."""

    worker: Worker
    step_seconds: float

    def __init__(self, case: BenchCase, feature: Feature, setting: Setting) -> None:
        self.case, self.feature, self.setting, self.name = case, feature, setting, f'"{feature.name}"'
        self.costs: list[float] = []

    def begin(self, stack: ExitStack, start: Start) -> None:
        """Start, compile, and step to the time from which costs are measured."""
        self.worker = stack.enter_context(start(self.feature.name, self.case, self.setting))
        self.worker.ask("first")
        answer = self.worker.ask(f"repeat {round(SETTLING / self.case.step)} 0")
        self.step_seconds = answer["seconds"] / answer["steps"]

    def measure(self, steps: int) -> None:
        """Measure one block."""
        answer = self.worker.ask(f"repeat {steps} 0")
        # The processor time of one thread excludes the time taken by other processes.
        clock = "processor_seconds" if self.setting.threads == 1 else "seconds"
        self.costs.append(answer[clock] / answer["steps"] / self.worker.ready["particles"])

    def finish(self) -> FeatureResult:
        """Return the result, and end the process."""
        end = self.worker.ask("finish")
        return FeatureResult(
            self.case,
            self.setting.threads,
            self.feature,
            particles=self.worker.ready["particles"],
            costs=tuple(self.costs),
            smallest_step=end["smallest_step"],
            sound=end["sound"],
        )

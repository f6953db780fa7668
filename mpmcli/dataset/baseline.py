"""The solver as a predictor: trajectories computed again on coarser grids, at their largest steps, with the time taken.

A rollout on a grid r times coarser has the particles of the trajectory, and the frames that it is compared on.
"""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.dataset.certify import SAME_PLACE, with_same_particles
from mpmcli.dataset.dataset import Dataset, Trajectory
from mpmcli.dataset.score import COLUMNS, Rollout, Score, score_rollouts
from mpmcli.error_bars.siblings import LeftOut, Reach, coarser, tables_of
from mpmcli.errors import InputError, MpmcliError
from mpmcli.materials.registry import parameter_models
from mpmcli.output.durable import sealed, writing
from mpmcli.plain_text import plain_number, text_table
from mpmcli.plot.style import LIGHT_SERIES, THEMES, drawing, svg
from mpmcli.scene import Scene, parse_scene, sample_bodies
from mpmcli.scene.problem import listed
from mpmcli.simulation.engine import Arch
from mpmcli.simulation.runner import Runner

# Spacings over that of the dataset; the first has the time of the dataset's own grid.
RATIOS = (1.0, 2.0, 3.0, 4.0)
# Trajectories that are computed again, where no rollouts name them.
COUNT = 4
SIZE = (640, 420)


def chosen(dataset: Dataset) -> list[int]:
    """Return the numbers of the first COUNT trajectories to test with, of the first split of several that has any."""
    return next(list(numbers[:COUNT]) for split in ("test", "valid", "train") if (numbers := dataset.splits[split]))


def compare(
    dataset: Dataset,
    numbers: Sequence[int],
    predicted: Sequence[Rollout],
    arch: Arch = "auto",
    watch: Callable[[int], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> "Comparison":
    """Score the solver on grids RATIOS times as coarse, beside predicted rollouts.

    Args:
        numbers: trajectories that the solver computes again, on the frames of their rollout, or all frames.
        predicted: rollouts of these trajectories, or none.
        arch: backend of the solver.
        watch: called with the number of runs that are done.
        stop: asked whether to end.

    Raises:
        InputError: the scene of a trajectory cannot be computed again.
        KeyboardInterrupt: `stop` returned True.
    """
    runner, done = Runner(arch), 0
    frames = {number: np.arange(dataset[number].frame_count) for number in numbers}
    frames |= {one.number: one.frames for one in predicted}
    found = {"rollouts": list(predicted)} if predicted else {}
    for ratio in RATIOS:
        for number in numbers:
            rollout = _rollout(dataset, number, frames[number], ratio, runner, stop)
            if rollout is not None:
                found.setdefault(f"spacing x {ratio:g}", []).append(rollout)
            watch(done := done + 1)
    if not found:
        raise InputError(f"{dataset.path}: none of the trajectories {listed(map(str, numbers))} reaches its end again.")
    return Comparison({name: score_rollouts(dataset, own) for name, own in found.items()})


def _rollout(
    dataset: Dataset, number: int, frames: np.ndarray, ratio: float, runner: Runner, stop: Callable[[], bool]
) -> Rollout | None:
    """Return a trajectory on a coarser grid; None: none fits, or its run did not reach the end."""
    trajectory = dataset[number]
    scene = _scene_of(dataset.path, trajectory)
    particles, tables = sample_bodies(scene), tables_of(scene)
    if scene.emitters or not particles or trajectory.header.drops:
        raise InputError(f"trajectory {number} has emitters, no particles, or frames without some of its particles.")
    start = np.concatenate([body.position for body in particles])
    x = trajectory.position
    if start.shape != x[0].shape or np.abs(start - x[0]).max() > SAME_PLACE * scene.domain.spacing:
        raise InputError(f"trajectory {number} starts elsewhere than its scene says: it cannot be computed again.")
    if ratio > 1:
        low, high = x.min((0, 1)), x.max((0, 1))
        if any(collider.free for collider in scene.colliders):
            # Rigid bodies may come near all walls.
            low, high = np.array(scene.domain.origin), np.array(scene.domain.upper)
        sibling = coarser(tables, Reach(low, high, (x[0].min(0) + x[0].max(0)) / 2), ratio)
        if isinstance(sibling, LeftOut):
            return None
        tables = with_same_particles(sibling).tables
    tables["time"]["step"] = "auto"
    coarse = parse_scene(tables, laws=parameter_models(), directory=dataset.path).scene
    try:
        # The first run may compile, and the machine may be busy.
        runs = [runner.run(coarse, stop, particles=particles) for _ in range(2)]
    except MpmcliError as error:
        raise InputError(f"trajectory {number} cannot be computed on a grid {ratio:g} times coarser: {error}") from None
    if len(runs[-1].frames) < len(x):
        return None
    positions = np.stack([runs[-1].frames[k].position for k in frames]).astype(float)
    return Rollout(number, positions, frames, min(run.seconds for run in runs))


def _scene_of(directory: Path, trajectory: Trajectory) -> Scene:
    """Return the scene of a trajectory from its header; InputError: it cannot be read here."""
    text = trajectory.header.stored.get("scene", "")
    source = f"the scene of trajectory {trajectory.number}"
    return parse_scene(tomllib.loads(text), laws=parameter_models(), source=source, directory=directory).scene


@dataclass(frozen=True)
class Comparison:
    """Scores by the name of what predicts."""

    scores: Mapping[str, Score]

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {name: one.as_dict() for name, one in self.scores.items()}

    def text(self) -> str:
        """Return a table with a row for each predictor: seconds, and the scores of all rows."""
        names = [name for name in COLUMNS if name != "outside_data"]
        rows = [
            (name, "-" if one.seconds is None else plain_number(one.seconds), *map(plain_number, _last(one, names)))
            for name, one in self.scores.items()
        ]
        first = next(iter(self.scores.values()))
        head = f"{first.path}: means over all {max(first.horizons)} rows of trajectories {first.numbers}"
        return f"{head}\n\n{text_table(('predictor', 'seconds', *names), rows, {0})}"

    def draw(self, path: Path) -> None:
        """Write a figure of the root of the mean square over the seconds of a rollout, as SVG; RunError: it failed."""
        with drawing(SIZE, THEMES["light"]) as figure:
            axes = figure.subplots()
            for name, one in self.scores.items():
                error = _last(one, ["mse"])[0] ** 0.5
                if one.seconds is not None and error > 0:
                    axes.plot(one.seconds, error, "o", color=LIGHT_SERIES[name == "rollouts"])
                    axes.annotate(name, (one.seconds, error), (5, 5), textcoords="offset points")
            axes.set(xscale="log", yscale="log", xlabel="seconds per rollout", ylabel="root mean square error, m")
            axes.margins(0.2)
            with writing(path), sealed(path, unique=True) as unsealed:
                unsealed.write_bytes(svg(figure))


def _last(one: Score, names: Sequence[str]) -> list[float]:
    """Return scores of all rows."""
    row = one.horizons[max(one.horizons)]
    return [row[name] for name in names]

"""Rehearses a sweep: draws and checks every trajectory, and forecasts time and disk space, without a dataset."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from mpmcli.check.facts import SceneFacts
from mpmcli.check.forecast import expected_steps
from mpmcli.check.scene_check import check_scene
from mpmcli.cores import available_cores
from mpmcli.dataset.compute import LOOK_AHEAD
from mpmcli.dataset.draw import draw
from mpmcli.dataset.folder import Folder
from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.sweep_folder import shard_size, trajectory_bytes
from mpmcli.dataset.sweep_state import SweepSettings
from mpmcli.errors import InputError
from mpmcli.materials.registry import load_plugins
from mpmcli.plain_text import counted, duration_text, size_text, text_table
from mpmcli.scene import Scene, estimate_particles
from mpmcli.simulation.runner import Runner

# Seconds of the run that measures the time of a particle-step.
PROBE_SECONDS = 1.0
# Rows of the table.
MOST_ROWS = 20
MOST_FAULTS = 10


@dataclass(frozen=True)
class Rehearsed:
    """One trajectory.

    Attributes:
        number, split: of the trajectory; values: drawn, by key.
        particles, steps: expected; bytes: without compression.
        fault: why it cannot be computed, "" where it can.
    """

    number: int
    split: str
    values: dict[str, Any]
    particles: int
    steps: int
    bytes: int
    fault: str


@dataclass(frozen=True)
class Rehearsal:
    """All trajectories of a part of a sweep.

    Attributes:
        trajectories: in order.
        rate: particle-steps per second of one worker, measured; 0 where no trajectory can be computed.
        workers: that the time is forecast for.
    """

    trajectories: tuple[Rehearsed, ...]
    rate: float
    workers: int

    @property
    def passes(self) -> bool:
        """Whether every trajectory can be computed."""
        return not any(one.fault for one in self.trajectories)

    @property
    def bytes(self) -> int:
        """Bytes of the dataset without compression."""
        return sum(one.bytes for one in self.trajectories)

    @property
    def seconds(self) -> float | None:
        """Expected wall time, None where it is not known."""
        work = sum(one.particles * one.steps for one in self.trajectories)
        return work / self.rate / self.workers if self.rate else None

    def as_dict(self) -> dict:
        """Return it as JSON can hold it."""
        return {
            "ok": self.passes,
            "trajectories": [vars(one) for one in self.trajectories],
            "bytes": self.bytes,
            "seconds": self.seconds,
            "workers": self.workers,
            "particle_steps_per_s": self.rate,
        }

    def text(self) -> str:
        """Return it as text: the first draws, what cannot be computed, and the forecast."""
        shown = self.trajectories[:MOST_ROWS]
        keys = list(dict.fromkeys(key for one in shown for key in one.values))
        rows = [
            (
                str(one.number),
                one.split,
                *(_short(one.values.get(key)) for key in keys),
                f"{one.particles:,}",
                f"{one.steps:,}",
            )
            for one in shown
        ]
        names = [key.removeprefix("bodies.") for key in keys]
        lines = [text_table(("number", "split", *names, "particles", "steps"), rows, {1})]
        if len(self.trajectories) > MOST_ROWS:
            lines.append(f"and {len(self.trajectories) - MOST_ROWS} more; --json lists all")
        faults = [one for one in self.trajectories if one.fault]
        lines += [f"error: trajectory {one.number}: {one.fault}" for one in faults[:MOST_FAULTS]]
        if len(faults) > MOST_FAULTS:
            lines.append(f"error: {len(faults) - MOST_FAULTS} more cannot be computed; --json tells why")
        time_text = "" if self.seconds is None else f", about {duration_text(self.seconds)}"
        total = counted(len(self.trajectories), "trajectory")
        lines.append(f"{total}: {size_text(self.bytes)}{time_text} with {counted(self.workers, 'worker')}")
        return "\n".join(lines)


def rehearse(sweep: Sweep, settings: SweepSettings, stop: Callable[[], bool] = lambda: False) -> Rehearsal:
    """Draw and check the trajectories of a part, and measure the time of a particle-step on the first sound one.

    Raises:
        InputError: no trajectory can be drawn.
        KeyboardInterrupt: `stop` returned True.
    """
    laws = load_plugins(settings.plugins)
    folder = Folder(settings.directory, sweep.count, shard_size(sweep, settings), settings.part)
    found, sound, first = [], None, []
    for number in (n for shard in folder.shards for n in folder.numbers(shard)):
        if stop():
            raise KeyboardInterrupt
        try:
            drawn = draw(sweep, number)
        except InputError as error:
            found.append(Rehearsed(number, sweep.split_of(number), {}, 0, 0, 0, str(error)))
            continue
        try:
            loaded = drawn.scene(laws)
            errors = [finding for finding in check_scene(loaded).findings if finding.severity == "error"]
            fault = errors[0].what if errors else ""
            particles = estimate_particles(loaded.scene)
            steps, size = expected_steps(SceneFacts(loaded.scene)), trajectory_bytes(loaded.scene, particles)
            sound = loaded.scene if sound is None and not fault else sound
            if number < LOOK_AHEAD and not fault:
                first.append(loaded.scene)
        except InputError as error:
            fault, particles, steps, size = str(error), 0, 0, 0
        found.append(Rehearsed(number, drawn.split, drawn.values, particles, steps, size, fault))
    rate = 0.0 if sound is None else _rate(sound, first, settings)
    return Rehearsal(tuple(found), rate, settings.workers or available_cores())


def _rate(scene: Scene, first: Sequence[Scene], settings: SweepSettings) -> float:
    """Return the particle-steps per second of one worker, frames included, compilation not.

    The kernels have room for the first scenes, as those of a worker have, which then finds them compiled in most cases.
    """
    runner = Runner(settings.arch, settings.threads)
    with suppress(InputError):
        runner.expect(first)
    interval = scene.time.end / scene.time.frames
    # The first run compiles the kernels.
    frames, seconds, steps = 1, 0.0, 0
    runner.run(_cut(scene, interval, frames))
    while seconds < PROBE_SECONDS and frames <= scene.time.frames:
        began = time.perf_counter()
        recording = runner.run(_cut(scene, interval, frames))
        seconds, steps = time.perf_counter() - began, recording.steps
        frames *= 2
    return recording.particles * steps / seconds


def _cut(scene: Scene, interval: float, frames: int) -> Scene:
    """Return the scene up to one of its frames."""
    return scene.model_copy(update={"time": scene.time.model_copy(update={"end": frames * interval, "frames": frames})})


def _short(value: Any) -> str:
    """Write a drawn value with few digits; of placed bodies their number."""
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return str(len(value))
    if isinstance(value, list):
        return ", ".join(map(_short, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)

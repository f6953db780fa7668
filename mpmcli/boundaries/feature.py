"""A feature of the runs of a batch, and the phases of a step: what the engine asks of walls, colliders and the like.

A step carries out the phases of the engine and of all features, in the order of STAGES.
"""

from collections.abc import Callable, MutableMapping
from copy import copy
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene

# Particles are shifted, in steps that relax volumes; particles scatter; volumes relax; bodies in contact push each
# other; walls find what presses on them; momentum becomes velocity; colliders and rigid bodies push at points of their
# surfaces; loads are added up; rigid bodies move; particles gather.
Stage = Literal["shift", "scatter", "relax", "exchange", "walls", "update", "points", "loads", "move", "gather"]
STAGES = get_args(Stage)


@dataclass(frozen=True)
class Phase:
    """A loop of a step; the next phase starts when it is finished.

    Attributes:
        name: name of the phase and of its body.
        over: the items of the loop: nodes in use ("nodes"), nodes on the planes of faces ("planes"), rows of nodes
            ("rows"), the particles of a group ("particles"), rows of nodes per collider ("loads"), or runs
            ("runs").
        stage: its place in the step; phases of a stage keep the order in which they are listed.
        group: index of the group of particles.
        adds: whether particles add to nodes; without atomics this is done colour by colour of pencils.
        turns: number of repetitions, with `turn` counting from 0.
        rounds: number of times that all turns are repeated.
        body: function of one node or particle on any device, body(at, node or particle, time), or an `Operation` on
            particles (`solver.particles.loop`).
        time: the number of the step that a body takes: "kick" for nodes and "dt" for particles if none is named, and
            in a shift "relaxed".
        relaxes: whether only steps that relax volumes carry it out, as those of a shift.
        most: the number of the step, one per group, that keeps the largest value of an operation; "" if none does.
        wanted: function of the first node of a row on a dense grid on the CPU, which returns whether the row has work:
            wanted(at, node). Such phases have work in layer 0 alone.
        part, item: for phases with a division of work of their own, functions of a part of all items on the CPU,
            part(phases, at), and of one item on a GPU, item(phases, at). A phase without functions is a method of
            `CpuPhases` and of `GpuPhases`.
        words: the phase in words, with the name of the law of its group as {}; "" if few steps have it.
    """

    name: str
    over: Literal["nodes", "planes", "rows", "particles", "loads", "runs"]
    stage: Stage
    group: int = 0
    adds: bool = False
    turns: int = 1
    rounds: int = 1
    body: Any = None
    time: Literal["", "dt", "kick", "relaxed"] = ""
    relaxes: bool = False
    most: Literal["", "rate", "volume_change"] = ""
    wanted: Callable | None = None
    part: Callable | None = None
    item: Callable | None = None
    words: str = ""

    @property
    def shifts(self) -> bool:
        """Whether the phase belongs to the shift of particles."""
        return self.stage == "shift"

    @property
    def duration(self) -> str:
        """The name of the number of a step that a body takes."""
        return self.time or ("relaxed" if self.shifts else "kick" if self.over == "nodes" else "dt")


class Feature:
    """A feature of the runs of a batch on the device; a scene without it has none.

    Attributes:
        begins: whether `begin_step` does anything.
        noted: number of values of a run in a frame, see `note`, `read` and `tell`.
    """

    begins, noted = False, 0

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the constants of a run, and its state at time 0."""

    def saved(self) -> dict[str, ti.Field]:
        """Return the fields that persist between steps, by name."""
        return {}

    def phases(self, *, serial: bool) -> tuple[Phase, ...]:
        """Return the phases of a step; `serial` is whether loops that list particles run on one thread, as on a CPU."""
        return ()

    @ti.func
    def begin_step(self, phases: ti.template(), run: ti.template(), step: ti.template()):
        """Begin a step of a run: `phases` are `RunPhases`, `run` and `step` its numbers."""

    def viewed(self, _view: object) -> "Feature":
        """Return the feature as kernels of a run see it; `features` of the `RunView` has those before it."""
        return self

    def fastest(self, _run: int) -> float:
        """Return the largest speed that the feature gives to anything in a run, m/s."""
        return 0.0

    def broken(self, _run: int) -> int | None:
        """Return the index of the first collider of a run whose pose is not finite, or None."""
        return None

    @ti.func
    def note(self, run: int, frame: int, column: int, frame_stats: ti.template()):
        """Store the values of a run in frame_stats[run, frame], from a column on, and reset them; on the CPU."""

    def read(self, _run: int) -> np.ndarray:
        """Return the values of a run, (noted,), and reset them; on a GPU."""
        return np.zeros(0)

    def tell(self, values: np.ndarray, run: int, found: MutableMapping[str, np.ndarray]) -> None:
        """Add the values of some frames of a run, (frames, noted), to those found, see `Moment.loads`."""


def changed(thing: object, **attributes: object) -> object:
    """Return a copy of an object with other values of some attributes."""
    result = copy(thing)
    for name, value in attributes.items():
        setattr(result, name, value)
    return result

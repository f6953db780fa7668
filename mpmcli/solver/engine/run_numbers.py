"""Where the host and the kernel of a batch find the numbers of a run: columns of two arrays with a row per run."""

from collections.abc import Iterable, Sequence
from types import SimpleNamespace

import numpy as np

from mpmcli.solver.particles.state_bounds import ENTRIES

# Status of a run: free, or waiting for the host; to be measured; advancing; measured, as a bound on its step requires,
# at its target, or with no room for frames left; with lost particles; with a stable step that collapsed; before a kick
# that ends beyond its time tables; before a sort after which particles reach more blocks of nodes than fit.
IDLE, MEASURE, GOING, ATTEND, LOST, COLLAPSED, BEYOND, CROWDED = range(8)
# Bounds on the step by their code; of equal ones the lower code counts, as in a comparison of `Limit`s.
LIMITS = ("", "collider", "deformation", "force", "forced", "maximum", "speed", "viscosity", "wave")

# Columns of a `HeldBound`, in its order.
HELD = ("held", "low", "low_before", "held_steps")
# Columns of the numbers, float64. `due` is when the next sheet of an emitter enters, `slowest` the least bound on the
# speed that counts; `given` is a step that the host asks for, 0 where the kernel chooses it; `step` is the one under
# way, of which `splits` end at the target, and `deformation` the bound by deformation. `drift_allowed` and what
# follows in its line are constants: a literal in a kernel has the precision of particles.
REALS = (
    *("time", "target", "last_step", "unrelaxed", "speed", "courant", "drift", "owed", "stiffness"),
    *HELD,
    *("smallest", "smallest_courant", "largest", "largest_courant"),
    *("growth_allowed", "safety", "maximum", "pull", "force", "collider", "collapse", "horizon", "end"),
    *("spacing", "inverse_spacing", "gradient_scale", "wall_speed"),
    *("drift_allowed", "hold", "rise", "slack", "infinity"),
    *("due", "slowest", "given"),
    *("step", "splits", "deformation"),
)
# Columns of the counts, int32. `records` is 1 where the kernel records frames, the next being `frame` of `frames`;
# `recorded` is the number of those of this launch, for at most `room` of which `shown` has rows, from `row` on;
# `affine`, `gradient`, `tau` and `activity` are columns there. `blocked` is
# the number of particles that found no room; `step_limit` is the bound of the step under way, and `frame_is_noted` 1
# after a frame was recorded and before the next step.
COUNTS = (
    *("status", "arrived", "steps", "unrelaxed_steps", "budget", "limit", "stiffness_limit", "forced", "longest"),
    *("records", "frame", "frames", "recorded", "room", "row", "affine", "gradient", "tau", "activity"),
    *("blocked", "step_limit", "frame_is_noted"),
)
# Columns of the notes on a recorded frame, float64, before the sums of each group.
NOTES = ("time", "last_step", "smallest", "smallest_courant", "largest", "largest_courant", "limit", "steps", "blocked")
# Most frames that a launch records of a run.
MOST_FRAMES = 128


def _columns(first: int, names: Iterable[str]) -> dict[str, int]:
    return {name: first + i for i, name in enumerate(names)}


def _blocks(first: int, widths: Sequence[int]) -> tuple[tuple[int, ...], int]:
    """Return the first column of each block, and the column after the last."""
    starts = [first]
    for width in widths:
        starts.append(starts[-1] + width)
    return tuple(starts[:-1]), starts[-1]


class Layout:
    """Columns of a batch of runs in d dimensions with some laws.

    Attributes:
        bodies: of each law.
        real: column of each number by name: those of REALS; `gravity` and `extent`, per axis; `rate`, `change`,
            `hardened`, `sensitivity`, `hardening` and (the first of) `maxima`, per group; (the first of) `own`, per
            group, the bounds that each body sets itself; `due_of`, `period` and `until`, per emitter.
        count: column of each count by name: those of COUNTS; `cells`, per axis; `particles`, those that take part,
            `capacity`, all of them, and `unwatched`, per group; `entered`, `sheets` and `waits`, per emitter.
        reals, counts: number of columns.
    """

    def __init__(self, dimension: int, internal: Sequence[int], emitters: int = 0, bodies: Sequence[int] = ()) -> None:
        """Assign columns; `internal` are the numbers of internal variables of the laws, `bodies` of bodies."""
        columns: dict[str, object] = _columns(0, REALS)
        end, groups = len(REALS), [1] * len(internal)
        for name in ("gravity", "extent"):
            columns[name], end = _blocks(end, [1] * dimension)
        for name in ("rate", "change", "hardened", "sensitivity", "hardening"):
            columns[name], end = _blocks(end, groups)
        for name in ("due_of", "period", "until"):
            columns[name], end = _blocks(end, [1] * emitters)
        self.bodies = tuple(bodies)
        columns["own"], end = _blocks(end, self.bodies)
        columns["maxima"], self.reals = _blocks(end, [ENTRIES + 2 * n for n in internal])
        self.real = SimpleNamespace(**columns)
        columns = _columns(0, COUNTS)
        columns["cells"], end = _blocks(len(COUNTS), [1] * dimension)
        for name in ("particles", "capacity", "unwatched"):
            columns[name], end = _blocks(end, groups)
        for name in ("entered", "sheets", "waits"):
            columns[name], end = _blocks(end, [1] * emitters)
        self.counts = end
        self.count = SimpleNamespace(**columns)


class Row:
    """The numbers and counts of one run by their names in REALS and COUNTS."""

    def __init__(self, layout: Layout, numbers: np.ndarray, counts: np.ndarray) -> None:
        self._real, self._count = layout.real, layout.count
        self._numbers, self._counts = numbers, counts

    def set(self, **values: float) -> None:
        """Set numbers."""
        for name, value in values.items():
            self._numbers[getattr(self._real, name)] = value

    def set_counts(self, **values: int) -> None:
        """Set counts."""
        for name, value in values.items():
            self._counts[getattr(self._count, name)] = value

    def number(self, name: str) -> float:
        """Return a number."""
        return float(self._numbers[getattr(self._real, name)])

    def count(self, name: str) -> int:
        """Return a count."""
        return int(self._counts[getattr(self._count, name)])

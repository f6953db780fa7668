"""When the sheets of emitters enter, as the host counts them for a `Solver`; `batch_emission` does the same."""

import math
from collections.abc import Callable, Sequence

from mpmcli.scene import Scene
from mpmcli.scene.sheets import Sheets
from mpmcli.solver.activity import PATIENCE


class Schedule:
    """The sheets of all emitters of a run.

    A sheet enters at the first step after it was due; the next one is due a period after it was. Particles whose cell
    of the lattice is occupied stay out. Where these are half of the sheet or more, it tries again after a share of the
    period, and all that follow are due later by as much.

    Attributes:
        due: when the next sheet of each emitter is, s; period: s between sheets; until: none is due from then on, s.
        sheets: of each emitter in all; entered: those that have; waits: 1 where the next one found no place.
        blocked: particles so far that stayed out, and those of sheets that had to wait.
    """

    STATE = ("due", "entered", "waits", "blocked")

    def __init__(self, scene: Scene, sheets: Sequence[Sheets]) -> None:
        self.period = [one.period for one in sheets]
        self.until = [min(scene.time.end, math.inf if e.end is None else e.end) for e in scene.emitters]
        self.sheets = [one.count for one in sheets]
        self._sizes = [len(one.places) for one in sheets]
        self._start = [one.start for one in sheets]
        self.begin()

    def begin(self) -> None:
        """Begin a run."""
        self.due, self.blocked = list(self._start), 0
        self.entered, self.waits = [0] * len(self.due), [0] * len(self.due)

    @property
    def next(self) -> float:
        """When the next sheet of any emitter is due, s; infinite where none is left."""
        return min((self.due[e] for e in range(len(self.due)) if self._is_left(e)), default=math.inf)

    def _is_left(self, e: int) -> bool:
        return self.entered[e] < self.sheets[e] and self.due[e] < self.until[e]

    def enter(
        self, time: float, occupied: Callable[[int, float], int], enter: Callable[[int, int, float], None]
    ) -> None:
        """Let all sheets enter that are due at a time, s, and find room.

        Args:
            occupied: (emitter, s since it was due) -> particles of the next sheet that find no room.
            enter: (emitter, number of the sheet, s since it was due), lets the others enter.
        """
        for e, period in enumerate(self.period):
            while self._is_left(e) and self.due[e] <= time:
                late = time - self.due[e]
                blocked = occupied(e, late)
                if 2 * blocked >= self._sizes[e]:
                    self.due[e] = time + PATIENCE * period
                    self.blocked += self._sizes[e] * (1 - self.waits[e])
                    self.waits[e] = 1
                else:
                    self.blocked += blocked
                    enter(e, self.entered[e], late)
                    self.entered[e] += 1
                    self.waits[e] = 0
                    self.due[e] += period

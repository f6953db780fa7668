"""Takes checkpoints of a run as often as costs a small share of its time."""

import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from mpmcli.errors import RunError
from mpmcli.output.checkpoints import Checkpoint, write_checkpoint
from mpmcli.output.store import SegmentStore
from mpmcli.solver.engine.run import Run

# Share of the wall time that checkpoints may take, and the least time between two, s.
SHARE, LEAST = 0.008, 5.0
# Before the first one: seconds to compile what reads the device, and bytes written in a second.
FIRST, RATE = 1.0, 3e8


class Checkpointer:
    """Takes checkpoints of one run; `seconds` of wall time spent so far, and number `taken`."""

    def __init__(
        self,
        directory: Path,
        run: Run,
        store: SegmentStore,
        backend: Mapping[str, object],
        *,
        size: int,
        forced: bool,
        every: float | None = None,
    ) -> None:
        """Begin; `size` is of the particles, bytes, `every` s between two, None: at a cost of SHARE of the time."""
        self._directory, self._run, self._store = directory, run, store
        self._backend = {name: str(backend[name]) for name in ("arch", "precision")}
        self._forced, self._every = forced, every
        self._cost = FIRST + size / RATE
        self._last = time.monotonic()
        self.seconds, self.taken = 0.0, 0

    def due(self) -> bool:
        """Return whether the next one is."""
        wait = max(LEAST, self._cost / SHARE) if self._every is None else self._every
        return time.monotonic() - self._last >= wait

    def take(self) -> None:
        """Seal waiting frames, else RunError, and then the state; where the disk is full, go on without."""
        began = time.monotonic()
        self._store.seal()
        sealed = time.monotonic()
        with suppress(OSError, RunError):
            saved = self._run.save()
            numbers = saved.numbers
            point = Checkpoint(
                frame=int(numbers["frames"][0]),
                step=int(numbers["step_count"]),
                time=float(numbers["time"]),
                backend=self._backend,
                forced=self._forced,
                numbers=numbers,
                arrays=saved.arrays,
            )
            write_checkpoint(self._directory, point, saved.arrays.nbytes)
            self.taken += 1
        self._last = time.monotonic()
        self._cost = self._last - sealed
        self.seconds += self._last - began

"""Wall time of the parts of a run."""

import time


class Stopwatch:
    """Adds up the wall time of parts of a run that `began`, in place, in the `timings` of a `RunSummary`."""

    def __init__(self, timings: dict[str, float], began: float) -> None:
        self._timings = timings
        self._began = began
        self._key = ""
        # Entry and start of each with block that is under way, the innermost last.
        self._open: list[tuple[str, float]] = []
        self._booked: dict[str, float] = {}
        timings.update(start_s=time.perf_counter() - began, compile_s=0.0, solve_s=0.0, output_s=0.0, wall_s=0.0)

    def adding(self, key: str) -> "Stopwatch":
        """Add the time of a with block to an entry, and of a block in it to that block's entry alone."""
        self._key = key
        return self

    def __enter__(self) -> None:
        now = time.perf_counter()
        self._add_innermost(now)
        self._open.append((self._key, now))

    def __exit__(self, *_: object) -> None:
        now = time.perf_counter()
        self._add_innermost(now)
        self._open.pop()
        if self._open:
            self._open[-1] = self._open[-1][0], now
        self._timings["wall_s"] = now - self._began

    def _add_innermost(self, now: float) -> None:
        if self._open:
            key, since = self._open[-1]
            self._timings[key] += now - since

    def book(self, total: float, key: str) -> None:
        """Move seconds that the solver has spent so far on something else from solve_s to another entry."""
        seconds = total - self._booked.get(key, 0.0)
        self._booked[key] = total
        self._timings["solve_s"] -= seconds
        self._timings[key] += seconds

    def stop(self) -> None:
        """Set the total."""
        self._timings["wall_s"] = time.perf_counter() - self._began

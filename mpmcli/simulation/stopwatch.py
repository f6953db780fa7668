"""Wall time of the parts of a run."""

import time


class Stopwatch:
    """Adds up the wall time of the parts of a run.

    Args:
        timings: seconds by name, see `RunSummary`; kept up to date in place.
        began: `time.perf_counter` at the start of the run.
    """

    def __init__(self, timings: dict[str, float], began: float) -> None:
        self._timings = timings
        self._began = began
        self._key = ""
        self._booked: dict[str, float] = {}
        timings.update(start_s=time.perf_counter() - began, compile_s=0.0, solve_s=0.0, output_s=0.0, wall_s=0.0)

    def adding(self, key: str) -> "Stopwatch":
        """Add the time of a with block to an entry."""
        self._key = key
        return self

    def __enter__(self) -> None:
        self._since = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        now = time.perf_counter()
        self._timings[self._key] += now - self._since
        self._timings["wall_s"] = now - self._began

    def book(self, total: float, key: str) -> None:
        """Move seconds that the solver has spent so far on something else from solve_s to another entry."""
        seconds = total - self._booked.get(key, 0.0)
        self._booked[key] = total
        self._timings["solve_s"] -= seconds
        self._timings[key] += seconds

    def stop(self) -> None:
        """Set the total."""
        self._timings["wall_s"] = time.perf_counter() - self._began

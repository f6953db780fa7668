"""Progress of a long command on stderr: a bar on a terminal, else plain lines."""

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class ProgressBar:
    """A progress bar with messages above it; use it as a context around the work.

    Args:
        total: final count.
        unit: what is counted, in the plural ("frames").
        quiet: print nothing.
        pause: least time between two plain lines of `show`, s.
        steady: whether all units take about the same time. Then the bar shows the time left, else the time elapsed.
    """

    def __init__(self, total: int, unit: str, *, quiet: bool, pause: float = 5.0, steady: bool = True) -> None:
        self._total = total
        self._unit = unit
        self._quiet = quiet
        self._pause = pause
        self._console = Console(stderr=True)
        self._bar = Progress(
            BarColumn(),
            TextColumn(f"{{task.completed:.0f}}/{total} {unit}"),
            TimeRemainingColumn() if steady else TimeElapsedColumn(),
            TextColumn("{task.description}", markup=False),
            console=self._console,
            transient=True,
        )
        self._task: TaskID | None = None
        self._spoke = time.perf_counter()

    @property
    def drawn(self) -> bool:
        """Whether a bar is drawn; else `show` prints plain lines."""
        return self._task is not None

    def __enter__(self) -> "ProgressBar":
        if not self._quiet and self._console.is_terminal and not self._console.is_dumb_terminal:
            self._task = self._bar.add_task("", total=self._total)
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.drawn:
            self._bar.stop()

    def show(self, done: int, text: str = "", more: str = "") -> None:
        """Show the count and the current unit; `more` appears in plain lines only."""
        if self._task is not None:
            self._bar.update(self._task, completed=done, description=text)
        elif time.perf_counter() - self._spoke >= self._pause:
            self._spoke = time.perf_counter()
            said = text + more
            self.say(f"{done}/{self._total} {self._unit}" + (f": {said}" if said else ""))

    def say(self, line: str, *, whole: bool = False) -> None:
        """Print a line; a terminal gets it broken between words, unless it is to be copied `whole`."""
        if self._quiet:
            return
        try:
            self._console.print(line, markup=False, highlight=False, soft_wrap=whole or not self._console.is_terminal)
        except (OSError, SystemExit):
            # stderr is closed (rich exits on a broken pipe). The work continues.
            self._quiet = True

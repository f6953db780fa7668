"""Progress of a run for people, on stderr: a bar on a terminal, a plain line now and then elsewhere."""

import time
from collections.abc import Sequence
from contextlib import suppress
from types import TracebackType
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from mpmcli.solver.run import RunSummary
from mpmcli.stability.ledger import LedgerRow

# Seconds between two plain lines.
PAUSE = 5.0


class Progress:
    """Follows one run; use it as a context around `run_scene`.

    Args:
        end: simulated time of the run, s.
        frames: frames that it will store.
        quiet: print nothing.
    """

    def __init__(self, end: float, frames: int, *, quiet: bool) -> None:
        self._end = end
        self._frames = frames
        self._quiet = quiet
        self._console = Console(stderr=True)
        self._bar: Bar | None = None
        self._task: Any = None
        self._spoke = time.perf_counter()
        self._told = False

    def notes(self, notes: Sequence[str]) -> None:
        """Print what was chosen for the user."""
        for note in notes:
            self._say(note)

    def __enter__(self) -> "Progress":
        if not self._quiet and self._console.is_terminal:
            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.completed:.0f}/{task.total:.0f} frames  {task.fields[rate]}"),
                TimeRemainingColumn(),
                console=self._console,
                transient=True,
            )
            self._task = self._bar.add_task("compiling", total=self._frames, rate="")
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self, row: LedgerRow, summary: RunSummary) -> None:
        """Show one more stored frame."""
        if not self._told:
            self._told = True
            self._introduce(summary)
        if summary.frames < 2:
            return  # the kernels compile in the first step
        rate = f"{summary.rate / 1e6:.1f} M particle-steps/s"
        if self._bar is not None:
            self._bar.update(
                self._task,
                completed=summary.frames,
                rate=rate,
                description=f"t = {row.time:.4g} of {self._end:.4g} s",
            )
            return
        now = time.perf_counter()
        if now - self._spoke >= PAUSE:
            self._spoke = now
            taken = summary.timings["solve_s"] + summary.timings["output_s"]
            left = taken * (self._frames - summary.frames) / (summary.frames - 1)
            self._say(
                f"t = {row.time:.4g} of {self._end:.4g} s, {summary.frames}/{self._frames} frames, "
                f"step {row.step_min:.3g} s ({row.limit}), {rate}, {left:.0f} s left"
            )

    def close(self, summary: RunSummary) -> None:
        """Say how the run went and where its result is; why it ended early even when quiet."""
        if summary.message:
            with suppress(OSError):
                click.echo(f"error: {summary.message}", err=True)
        timings = summary.timings
        rate = f", {summary.rate / 1e6:.1f} M particle-steps/s" if summary.rate else ""
        self._say(
            f"{summary.status}: {summary.frames} of {self._frames} frames, {summary.steps} steps in "
            f"{timings['wall_s']:.1f} s{rate}"
        )
        self._say(
            f"seconds: start {timings['start_s']:.1f}, compile {timings['compile_s']:.1f}, "
            f"solve {timings['solve_s']:.1f}, output {timings['output_s']:.1f}"
        )
        if summary.first is not None and summary.last is not None and summary.frames > 1:
            first, last = summary.first, summary.last
            self._say(
                f"energy: {first.energy:.5g} -> {last.energy:.5g} J (kinetic {last.kinetic:.4g}, elastic "
                f"{last.elastic:.4g}, potential {last.potential:.4g})"
            )
            self._say(f"volume ratio J at the end: {last.volume_ratio_min:.4g} to {last.volume_ratio_max:.4g}")
        if summary.path is not None:
            self._say(f"result: {summary.path}", whole=True)

    def _introduce(self, summary: RunSummary) -> None:
        backend, plan = summary.backend, summary.plan
        threads = f", {backend['threads']} threads" if backend["arch"] == "cpu" else ""
        self._say(
            f"{summary.particles} particles on {backend['arch']}{threads}, {backend['precision']}; "
            f"{plan.device_bytes / 1e6:.3g} MB on the device "
            f"({plan.bytes_per_particle} B per particle, {plan.bytes_per_node} B per node)"
        )

    def _say(self, line: str, *, whole: bool = False) -> None:
        if not self._quiet:
            # A terminal gets its lines broken between words, but a path that can be copied.
            whole = whole or not self._console.is_terminal
            try:
                self._console.print(line, markup=False, highlight=False, soft_wrap=whole)
            except (OSError, SystemExit):
                # Nobody reads along any more (rich exits on a broken pipe): no reason to end the run.
                self._quiet = True

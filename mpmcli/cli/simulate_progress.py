"""Progress of a run for people: its frames, and at the end how it went."""

from collections.abc import Sequence
from contextlib import suppress
from types import TracebackType

import click

from mpmcli.cli.progress_bar import ProgressBar
from mpmcli.frames.ledger import LedgerRow
from mpmcli.simulation.run import RunSummary


class SimulateProgress:
    """Follows one run; use it as a context around `run_scene`.

    Args:
        end: simulated time of the run, s.
        frames: frames that it will store.
        quiet: print nothing.
    """

    def __init__(self, end: float, frames: int, *, quiet: bool) -> None:
        self._end = end
        self._frames = frames
        self._bar = ProgressBar(frames, "frames", quiet=quiet)
        self._told = False

    def notes(self, notes: Sequence[str]) -> None:
        """Print what was chosen for the user."""
        for note in notes:
            self._bar.say(note)

    def __enter__(self) -> "SimulateProgress":
        self._bar.__enter__()
        if self._bar.drawn:
            self._bar.show(0, "compiling")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.__exit__(kind, error, trace)

    def advance(self, row: LedgerRow, summary: RunSummary) -> None:
        """Show one more stored frame."""
        if not self._told:
            self._told = True
            self._introduce(summary)
        if summary.frames < 2:
            return  # the kernels compile in the first step
        taken = summary.timings["solve_s"] + summary.timings["output_s"]
        left = taken * (self._frames - summary.frames) / (summary.frames - 1)
        self._bar.show(
            summary.frames,
            f"t = {row.time:.4g} of {self._end:.4g} s, {summary.rate / 1e6:.1f} M particle-steps/s",
            f", step {row.step_min:.3g} s ({row.limit}), {left:.0f} s left",
        )

    def close(self, summary: RunSummary) -> None:
        """Say how the run went and where its result is; why it ended early even when quiet."""
        if summary.message:
            with suppress(OSError):
                click.echo(f"error: {summary.message}", err=True)
        timings = summary.timings
        rate = f", {summary.rate / 1e6:.1f} M particle-steps/s" if summary.rate else ""
        self._bar.say(
            f"{summary.status}: {summary.frames} of {self._frames} frames, {summary.steps} steps in "
            f"{timings['wall_s']:.1f} s{rate}"
        )
        self._bar.say(
            f"seconds: start {timings['start_s']:.1f}, compile {timings['compile_s']:.1f}, "
            f"solve {timings['solve_s']:.1f}, output {timings['output_s']:.1f}"
        )
        if summary.first is not None and summary.last is not None and summary.frames > 1:
            first, last = summary.first, summary.last
            self._bar.say(
                f"energy: {first.energy:.5g} -> {last.energy:.5g} J (kinetic {last.kinetic:.4g}, elastic "
                f"{last.elastic:.4g}, potential {last.potential:.4g})"
            )
            self._bar.say(f"volume ratio J at the end: {last.volume_ratio_min:.4g} to {last.volume_ratio_max:.4g}")
        if summary.path is not None:
            self._bar.say(f"result: {summary.path}", whole=True)

    def _introduce(self, summary: RunSummary) -> None:
        backend, plan = summary.backend, summary.plan
        threads = f", {backend['threads']} threads" if backend["arch"] == "cpu" else ""
        self._bar.say(
            f"{summary.particles} particles on {backend['arch']}{threads}, {backend['precision']}; "
            f"{plan.device_bytes / 1e6:.3g} MB on the device "
            f"({plan.bytes_per_particle} B per particle, {plan.bytes_per_node} B per node)"
        )

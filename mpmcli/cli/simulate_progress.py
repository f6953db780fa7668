"""Progress of a run on stderr."""

from contextlib import suppress
from types import TracebackType

from mpmcli.cli.progress_bar import ProgressBar
from mpmcli.cli.streams import print_note
from mpmcli.frames.ledger import LedgerRow
from mpmcli.plain_text import counted
from mpmcli.simulation.summary import RunSummary


class SimulateProgress:
    """Follows one run; use it as a context around `simulate`.

    Args:
        end: simulated time of the run, s.
        frames: number of frames to store.
        quiet: print nothing.
    """

    def __init__(self, end: float, frames: int, *, quiet: bool) -> None:
        self._end = end
        self._frames = frames
        self._bar = ProgressBar(frames, "frames", quiet=quiet)

    def __enter__(self) -> "SimulateProgress":
        self._bar.__enter__()
        if self._bar.drawn:
            self._bar.show(0, "compiling")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.__exit__(kind, error, trace)

    def start(self, summary: RunSummary) -> None:
        """Print automatic choices, warnings of the check, and the size of the run."""
        for note in summary.notes:
            self._bar.say(note)
        backend, plan = summary.backend, summary.plan
        threads = f", {counted(backend['threads'], 'thread')}" if backend["arch"] == "cpu" else ""
        self._bar.say(
            f"{counted(summary.particles, 'particle')} on {backend['arch']}{threads}, {backend['precision']}; "
            f"{plan.device_bytes / 1e6:.3g} MB on the device "
            f"({plan.bytes_per_particle} B per particle, {plan.bytes_per_node} B per node)"
        )

    def advance(self, row: LedgerRow, summary: RunSummary) -> None:
        """Show one more stored frame."""
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
        """Print why the run ended early, even when quiet."""
        if summary.message:
            with suppress(OSError):
                print_note(f"error: {summary.message}")

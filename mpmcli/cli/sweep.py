"""`mpmcli sweep`."""

import math
import time
from pathlib import Path

import click

from mpmcli.cli.interrupt import interrupt_came, interrupted_code, interrupts_wait
from mpmcli.cli.limit_types import Duration
from mpmcli.cli.options import json_option, plugin_option, quiet_option
from mpmcli.cli.streams import print_json, print_text

# Time in which the workers end, and this process, s.
RESERVE = 5.0


class Part(click.ParamType):
    """A part of the work, `i/n`."""

    name = "i/n"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        first, slash, parts = str(value).partition("/")
        if not (slash and first.isdecimal() and parts.isdecimal() and 1 <= int(first) <= int(parts)):
            self.fail(f"{value} is no part; give 1/2 for the first of two", param, ctx)
        return int(first), int(parts)


@click.command("sweep")
@click.argument("sweep", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="DATASET",
    help="Where the dataset goes; datasets/<name of the sweep> by default.",
)
@click.option("--count", type=click.IntRange(min=1), help="Number of trajectories, in place of that of the file.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes on this machine; one on each core by default.")
@click.option("--scheduler", metavar="ADDRESS", default="", help="Use the workers of a running Dask scheduler.")
@click.option(
    "--shard", "part", type=Part(), default=(1, 1), help="Compute the i-th of n parts; mpmcli dataset merge joins them."
)
@click.option("--resume", is_flag=True, help="Go on with the dataset in the directory.")
@click.option("--dry-run", is_flag=True, help="List the draws, check each scene, and forecast time and disk space.")
@click.option(
    "--arch",
    type=click.Choice(["auto", "cpu", "cuda", "vulkan", "metal"]),
    default="auto",
    show_default=True,
    help="Where each worker computes; auto takes CUDA or Metal where they are, and else the CPU.",
)
@click.option(
    "--max-time",
    type=Duration(),
    help="End the sweep before this wall time, to go on with --resume: 2h, 90m, 45s, 1h30m or 1:30:00.",
)
@plugin_option
@quiet_option
@json_option
def command(
    sweep: Path,
    output: Path | None,
    count: int | None,
    workers: int | None,
    scheduler: str,
    part: tuple[int, int],
    resume: bool,
    dry_run: bool,
    arch: str,
    max_time: float | None,
    plugins: tuple[Path, ...],
    quiet: bool,
    as_json: bool,
) -> int:
    """Compute the trajectories of SWEEP, a TOML file, and store them as a dataset for learners.

    An interrupted or killed sweep goes on with --resume. Trajectories that are not stable are computed again with
    half the step, up to twice, and then left out; the exit code is 1 if there are any.
    """
    from mpmcli.cli.progress_bar import ProgressBar
    from mpmcli.dataset.rehearsal import rehearse
    from mpmcli.dataset.report import status_of
    from mpmcli.dataset.sweep_file import load_sweep
    from mpmcli.dataset.sweep_folder import discard_beginning
    from mpmcli.dataset.sweep_run import run_sweep
    from mpmcli.dataset.sweep_state import SweepSettings, SweepState
    from mpmcli.materials.registry import load_plugins
    from mpmcli.plain_text import duration_text

    end = math.inf if max_time is None else time.monotonic() + max_time - RESERVE
    loaded = load_sweep(sweep, laws=load_plugins(plugins), count=count)
    directory = output or Path("datasets") / sweep.stem
    settings = SweepSettings(directory, workers, scheduler, part, resume, arch, plugins=plugins)
    if dry_run:
        rehearsal = rehearse(loaded, settings)
        print_json(rehearsal.as_dict()) if as_json else print_text(rehearsal.text())
        return 0 if rehearsal.passes else 1
    made = [path for path in (directory, *directory.parents) if not path.exists()][::-1]
    with ProgressBar(loaded.count, "trajectories", quiet=quiet) as bar, interrupts_wait():

        def show(state: SweepState) -> None:
            left = (state.expected - state.done) / state.per_hour * 3600
            bar.show(
                state.done,
                f"{state.done - state.accepted} left out, {state.per_hour:,.0f} per hour",
                f", {duration_text(left)} left",
            )

        state = run_sweep(loaded, settings, show, lambda: interrupt_came() or time.monotonic() > end)
    if interrupt_came() and not state.done and not resume:
        discard_beginning(directory, made)
        raise KeyboardInterrupt
    stopped = state.status == "interrupted" and not interrupt_came()
    if stopped:
        state.status = "stopped"
        click.echo("error: the sweep stopped before its --max-time; --resume goes on with it", err=True)
    status = status_of(directory)
    if as_json:
        print_json({**state.as_dict(), "dataset": status.as_dict()})
    elif not quiet:
        rate = f", {state.per_hour:,.0f} per hour" if state.done > state.kept else ""
        print_text(f"{state.status}: {state.done} of {state.expected} trajectories{rate}\n{status.text()}")
    if state.status == "interrupted":
        return interrupted_code()
    return 0 if state.accepted == state.done and not stopped else 1

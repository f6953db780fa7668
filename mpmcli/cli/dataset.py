"""`mpmcli sweep`, `mpmcli dataset`, `mpmcli export` and `mpmcli score`."""

import math
import time
from pathlib import Path
from typing import Any

import click

from mpmcli.cli import options
from mpmcli.cli.interrupt import interrupt_came, interrupted_code, interrupts_wait
from mpmcli.cli.options import COUNT, PATH, json_option, quiet_option
from mpmcli.cli.streams import print_answer, print_json, print_note, print_text
from mpmcli.dataset.formats import FORMATS

# Time in which the workers of a sweep and this process end, s.
RESERVE = 5.0


@click.command("sweep", epilog="Example: mpmcli sweep drops.toml --count 8 -o datasets/drops")
@click.argument("sweep", type=PATH)
@options.output_option("Directory of the dataset; datasets/<name of the sweep> by default.", "DATASET", "directory")
@click.option("--count", type=COUNT, help="Number of trajectories, in place of that of the file.")
@click.option("--workers", type=COUNT, help="Processes on this machine; by default as many as cores have threads for.")
@click.option(
    "--threads",
    type=COUNT,
    default=1,
    show_default=True,
    help="CPU threads of each worker, for trajectories of 20,000 particles and more; smaller ones take one.",
)
@click.option("--scheduler", metavar="ADDRESS", default="", help="Use the workers of a running Dask scheduler.")
@click.option(
    "--shard",
    "part",
    type=options.part,
    metavar="I/N",
    default="1/1",
    help="Compute the i-th of n parts; mpmcli dataset merge joins them.",
)
@options.set_option
@click.option("--overwrite", is_flag=True, help="Replace the dataset in the directory.")
@click.option("--resume", is_flag=True, help="Continue the dataset in the directory.")
@click.option("--dry-run", is_flag=True, help="List the draws, check each scene, and forecast time and disk space.")
@options.arch_option("Backend of each worker")
@options.time_option("End the sweep before this wall time; --resume continues it: 2h, 90m, 45s, 1h30m or 1:30:00.")
@options.plugin_option
@quiet_option
@json_option
def sweep_command(
    sweep: Path,
    count: int | None,
    overrides: tuple[str, ...],
    dry_run: bool,
    max_time: float | None,
    quiet: bool,
    as_json: bool,
    **given: Any,
) -> int:
    """Compute the trajectories of SWEEP, a TOML file, and store them as a dataset.

    --resume continues an interrupted or killed sweep. Trajectories that are not stable are computed again with half the
    step, up to twice, and then left out; the exit code is 1 if there are any. --set replaces keys of the base scene for
    all trajectories.
    """
    from mpmcli.cli.progress import ProgressBar
    from mpmcli.dataset.report import status_of
    from mpmcli.dataset.sweep_file import load_sweep
    from mpmcli.dataset.sweep_run import SweepSettings, SweepState, discard_beginning, rehearse, run_sweep
    from mpmcli.materials.registry import load_plugins
    from mpmcli.plain_text import duration_text

    end = math.inf if max_time is None else time.monotonic() + max_time - RESERVE
    loaded = load_sweep(sweep, laws=load_plugins(given["plugins"]), count=count, overrides=overrides)
    directory = given["directory"] = given["directory"] or Path("datasets") / sweep.stem
    settings = SweepSettings(**given)
    if dry_run:
        rehearsal = rehearse(loaded, settings)
        print_answer(rehearsal, as_json)
        return 0 if rehearsal.passes else 1
    made = [path for path in (directory, *directory.parents) if not path.exists()][::-1]
    with ProgressBar(loaded.count, "trajectories", quiet=quiet) as bar, interrupts_wait():

        def show(state: SweepState) -> None:
            text, more = f"{state.done - state.accepted} left out", ""
            text += f", {state.certified} certified" * bool(state.certified)
            text += f", images of {state.imaged}" * bool(state.imaged)
            if state.steady and state.done < state.expected:
                text += f", {state.per_hour:,.0f} per hour"
                more = f", {duration_text((state.expected - state.done) / state.per_hour * 3600)} left"
            bar.show(state.done, text, more)

        state = run_sweep(loaded, settings, show, lambda: interrupt_came() or time.monotonic() > end)
    if interrupt_came() and not state.done and not settings.resume:
        discard_beginning(loaded, directory, made)
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


@click.group("dataset")
def dataset_command() -> None:
    """Inspect, verify and merge datasets of `mpmcli sweep`, and audit exports."""


@dataset_command.command("status", epilog="Example: mpmcli dataset status datasets/drops")
@click.argument("dataset", type=PATH)
@json_option
def status(dataset: Path, as_json: bool) -> None:
    """Count the trajectories of DATASET by verdict and split, and give the reasons for exclusions."""
    from mpmcli.dataset.report import status_of

    print_answer(status_of(dataset), as_json)


@dataset_command.command("verify", epilog="Example: mpmcli dataset verify datasets/drops")
@click.argument("dataset", type=PATH)
@quiet_option
@json_option
def verify(dataset: Path, quiet: bool, as_json: bool) -> int:
    """Read all of DATASET and compare every checksum and count with its manifest, or an export with its checksums.

    The exit code is 1 if there are differences or missing files.
    """
    from mpmcli.cli.progress import ProgressBar
    from mpmcli.dataset.export import is_export, verify_export
    from mpmcli.dataset.report import status_of, verify

    if is_export(dataset):
        verification = verify_export(dataset)
    else:
        total = len({row.file for row in status_of(dataset).rows if row.file})
        with ProgressBar(total, "files", quiet=quiet) as bar:
            verification = verify(dataset, lambda done, total: bar.show(done))
    print_answer(verification, as_json)
    return 1 if verification.faults else 0


@dataset_command.command("audit", epilog="Example: mpmcli dataset audit exports/drops")
@click.argument("export", type=PATH)
@json_option
def audit_export(export: Path, as_json: bool) -> int:
    """Judge the files of EXPORT, of mpmcli or others, by rules: gravity, dt, bounds, frames, statistics, leakage ...

    The exit code is 1 if a rule has a finding. Rules whose facts are absent are skipped.
    """
    from mpmcli.dataset.audit import audit

    audited = audit(export)
    print_answer(audited, as_json)
    return 1 if audited.findings else 0


@dataset_command.command("card", epilog="Example: mpmcli dataset card datasets/drops")
@click.argument("dataset", type=PATH)
def card(dataset: Path) -> None:
    """Write README.md of DATASET again, with the picture montage.png if it exists."""
    from mpmcli.dataset.report import status_of, write_card

    status_of(dataset)
    print_text(str(write_card(dataset)))


@dataset_command.command("merge", epilog="Example: mpmcli dataset merge parts/1 parts/2 -o datasets/drops")
@click.argument("parts", type=PATH, nargs=-1, required=True)
@click.option("-o", "--output", type=PATH, metavar="DATASET", required=True)
@json_option
def merge(parts: tuple[Path, ...], output: Path, as_json: bool) -> None:
    """Join PARTS, made by `mpmcli sweep --shard`, into one dataset. The parts are not changed."""
    from mpmcli.dataset.merge import merge

    print_answer(merge(parts, output), as_json)


@click.command("export", epilog="Example: mpmcli export datasets/drops --to gns -o exports/drops")
@click.argument("dataset", type=PATH)
@click.option(
    "--to",
    "form",
    type=options.Word([*FORMATS]),
    required=True,
    help="\b\n" + "\n".join(f"{name}: {what}" for name, (_, what) in FORMATS.items()),
)
@click.option("-o", "--output", "directory", type=PATH, required=True, metavar="DIR", help="Output directory.")
@click.option("--trajectory", type=click.IntRange(min=0), metavar="N", help="Only the trajectory with this number.")
@click.option("--stride", type=COUNT, default=1, show_default=True, metavar="K", help="Keep every K-th frame.")
@click.option(
    "--max-particles",
    type=COUNT,
    metavar="M",
    help="Keep at most M particles of each trajectory, the same ones in all frames: of each body its share, at random.",
)
@options.choice_option(
    "--present",
    ["any", "always"],
    "any",
    "always: where particles come or go, only those that are there in all exported frames.",
)
@options.choice_option(
    "--walls",
    ["none", "colliders", "all"],
    "none",
    "Add particles on the surfaces of colliders; all: on the walls of the domain as well.",
)
@click.option(
    "--wall-spacing",
    type=click.FloatRange(min=0, min_open=True),
    metavar="M",
    help="Distance between particles on walls, m; that of the others at the start by default.",
)
@click.option(
    "--features",
    metavar="NAMES",
    callback=lambda _context, _option, text: text and tuple(name for name in text.split(",") if name != "none"),
    help="Material parameters that particles of a GNS export have, with commas, or none; needed if several differ.",
)
@click.option("--overwrite", is_flag=True, help="Replace an earlier export in the output directory.")
@quiet_option
@json_option
def export_command(dataset: Path, quiet: bool, as_json: bool, **given: Any) -> None:
    """Write DATASET, a directory of trajectories or the result of one run, for training code or a viewer.

    metadata.json contains bounds, spacings, and the statistics of displacements that training code uses for
    normalisation. The directory appears when it is complete.
    """
    from mpmcli.cli.progress import ProgressBar
    from mpmcli.dataset.dataset import open_dataset
    from mpmcli.dataset.export import ExportSettings, export

    opened, settings = open_dataset(dataset), ExportSettings(**given)
    total = len(opened) if settings.trajectory is None else 1
    with ProgressBar(total, "trajectories", quiet=quiet) as bar, interrupts_wait():

        def watch(done: int) -> None:
            if interrupt_came():
                raise KeyboardInterrupt
            bar.show(done)

        summary = export(opened, settings, watch)
    if not quiet:
        for note in summary.notes:
            print_note(f"note: {note}")
    print_answer(summary, as_json, quiet=quiet)


@click.command("score", epilog="Example: mpmcli score datasets/drops --rollouts rollouts.npz")
@click.argument("dataset", type=PATH)
@click.option("--rollouts", type=PATH, metavar="FILE", help="Predicted positions, .npz or HDF5.")
@click.option("--baseline", is_flag=True, help="Score the solver beside them, on coarser grids, with its seconds.")
@options.output_option("With --baseline, a figure of error against seconds, .svg.", "FILE", "figure")
@options.arch_option("Backend of the solver")
@quiet_option
@json_option
def score_command(
    dataset: Path, rollouts: Path | None, baseline: bool, figure: Path | None, arch: Any, quiet: bool, as_json: bool
) -> None:
    """Score predicted trajectories against those of DATASET, or of the result of one run, by horizon.

    FILE has an array (frames, particles, d), m, for each trajectory, named by its number. With --baseline alone the
    solver computes the first trajectories of the test split again.
    """
    from mpmcli.dataset.dataset import open_dataset
    from mpmcli.dataset.score import read_rollouts, score_rollouts

    if rollouts is None and not baseline:
        raise click.UsageError("there is nothing to score: give --rollouts FILE, --baseline, or both.")
    if figure is not None and (not baseline or figure.suffix != ".svg" or figure.exists()):
        raise click.UsageError(f"-o {figure} has to be a new file for the figure of --baseline, such as score.svg.")
    opened = open_dataset(dataset)
    predicted = read_rollouts(rollouts, opened) if rollouts else []
    if not baseline:
        print_answer(score_rollouts(opened, predicted), as_json)
        return
    from mpmcli.cli.progress import ProgressBar
    from mpmcli.dataset.baseline import RATIOS, chosen, compare
    from mpmcli.render.picture_file import require_writable

    if figure:
        require_writable(figure)
    numbers = [one.number for one in predicted] or chosen(opened)
    with ProgressBar(len(RATIOS) * len(numbers), "runs", quiet=quiet) as bar:
        compared = compare(opened, numbers, predicted, arch, bar.show, lambda: bool(interrupt_came()))
    if figure:
        compared.draw(figure)
    print_answer(compared, as_json, quiet=quiet)

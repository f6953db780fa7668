"""`mpmcli export`."""

from pathlib import Path

import click

from mpmcli.cli.interrupt import interrupt_came, interrupts_wait
from mpmcli.cli.options import json_option, quiet_option
from mpmcli.cli.streams import print_json, print_note, print_text


@click.command("export")
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option(
    "--to",
    "form",
    type=click.Choice(["lagrangebench", "gns", "npz", "vtkhdf"]),
    required=True,
    help="For the learners LagrangeBench or GNS, for numpy, or for ParaView and every command that reads results.",
)
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Where it goes.")
@click.option("--trajectory", type=click.IntRange(min=0), metavar="N", help="Only the trajectory with this number.")
@click.option(
    "--stride", type=click.IntRange(min=1), default=1, show_default=True, metavar="K", help="Keep every K-th frame."
)
@click.option(
    "--max-particles",
    type=click.IntRange(min=1),
    metavar="M",
    help="Keep at most M particles of each trajectory, the same ones in all frames: of each body its share, at random.",
)
@click.option(
    "--walls",
    type=click.Choice(["none", "colliders", "all"]),
    default="none",
    show_default=True,
    help="Add particles on the surfaces of colliders; all: on the walls of the domain as well.",
)
@click.option(
    "--wall-spacing",
    type=click.FloatRange(min=0, min_open=True),
    metavar="M",
    help="Distance between particles on walls, m; that of the others at the start by default.",
)
@click.option("--overwrite", is_flag=True, help="Replace an earlier export in the output directory.")
@quiet_option
@json_option
def command(
    dataset: Path,
    form: str,
    output: Path,
    trajectory: int | None,
    stride: int,
    max_particles: int | None,
    walls: str,
    wall_spacing: float | None,
    overwrite: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Write DATASET, a directory of trajectories or the result of one run, in the format of a learner or a viewer.

    Beside the data lies metadata.json with bounds, spacings, and the statistics of displacements that learners
    normalise with. The directory appears when it is complete.
    """
    from mpmcli.cli.progress_bar import ProgressBar
    from mpmcli.dataset.dataset import open_dataset
    from mpmcli.dataset.export import ExportSettings, export

    opened = open_dataset(dataset)
    settings = ExportSettings(form, output, trajectory, stride, max_particles, overwrite, walls, wall_spacing)
    with ProgressBar(len(opened) if trajectory is None else 1, "trajectories", quiet=quiet) as bar, interrupts_wait():

        def watch(done: int) -> None:
            if interrupt_came():
                raise KeyboardInterrupt
            bar.show(done)

        summary = export(opened, settings, watch)
    if not quiet:
        for note in summary.notes:
            print_note(f"note: {note}")
    if as_json:
        print_json(summary.as_dict())
    elif not quiet:
        print_text(summary.text())

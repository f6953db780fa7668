"""`mpmcli dataset`."""

from pathlib import Path

import click

from mpmcli.cli.options import json_option, quiet_option
from mpmcli.cli.streams import print_json, print_note, print_text


@click.group("dataset")
def command() -> None:
    """Look after datasets that `mpmcli sweep` has made."""


@command.command("status")
@click.argument("dataset", type=click.Path(path_type=Path))
@json_option
def status(dataset: Path, as_json: bool) -> None:
    """Count the trajectories of DATASET by verdict and split, and say why some were left out."""
    from mpmcli.dataset.report import status_of

    found = status_of(dataset)
    print_json(found.as_dict()) if as_json else print_text(found.text())


@command.command("verify")
@click.argument("dataset", type=click.Path(path_type=Path))
@quiet_option
@json_option
def verify(dataset: Path, quiet: bool, as_json: bool) -> int:
    """Read all of DATASET, and compare every checksum and count with its manifest; or an export with its checksums.

    The exit code is 1 if anything differs or is missing.
    """
    from mpmcli.cli.progress_bar import ProgressBar
    from mpmcli.dataset.export_directory import is_export, verify_export
    from mpmcli.dataset.report import status_of, verify

    if is_export(dataset):
        found = verify_export(dataset)
        print_json(found.as_dict()) if as_json else print_text(found.text())
        return 1 if found.faults else 0
    total = len({row.file for row in status_of(dataset).rows if row.file})
    with ProgressBar(total, "files", quiet=quiet) as bar:
        found = verify(dataset, lambda done, total: bar.show(done))
    print_json(found.as_dict()) if as_json else print_text(found.text())
    return 1 if found.faults else 0


@command.command("card")
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option("--montage", metavar="CxR", default="4x4", show_default=True, help="Trajectories of the picture.")
def card(dataset: Path, montage: str) -> None:
    """Write README.md of DATASET again, with a picture of some trajectories, montage.png, where one can be drawn.

    The text is the one that a finished sweep has, without the picture, on its own.
    """
    from mpmcli.dataset.card import write_card
    from mpmcli.dataset.montage import write_montage
    from mpmcli.dataset.report import status_of
    from mpmcli.errors import InputError

    status_of(dataset)
    try:
        write_montage(dataset, montage)
    except InputError as error:
        print_note(f"note: the card has no new picture: {error}")
    print_text(str(write_card(dataset)))


@command.command("merge")
@click.argument("parts", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="DATASET", required=True)
@json_option
def merge(parts: tuple[Path, ...], output: Path, as_json: bool) -> None:
    """Join PARTS, made by `mpmcli sweep --shard`, into one dataset. The parts stay as they are."""
    from mpmcli.dataset.merge import merge

    found = merge(parts, output)
    print_json(found.as_dict()) if as_json else print_text(found.text())

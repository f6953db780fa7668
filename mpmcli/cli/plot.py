"""`mpmcli plot`."""

import logging
from pathlib import Path

import click

from mpmcli.cli.options import json_option, quiet_option
from mpmcli.cli.streams import print_json, print_note, print_text
from mpmcli.render.settings import parse_size

DEFAULT = "ledger.png"
# Prefix of the digest in a picture of this command.
MARK = "plot "
# Pixels along each side: smaller text is illegible, and larger pictures are taken for a typing error.
SIZE_MIN, SIZE_MAX = 300, 8_000
WIDEST = 3


@click.command("plot")
@click.argument("result", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="OUT.png",
    help=f"The picture; {DEFAULT} in the directory of the result by default.",
)
@click.option("--theme", type=click.Choice(["light", "dark"]), default="light", show_default=True, help="Colours.")
@click.option("--size", default="1200x900", show_default=True, metavar="WxH", help="Pixels; text grows with them.")
@click.option("--overwrite", is_flag=True, help="Replace a file that this command did not make.")
@quiet_option
@json_option
def command(
    result: Path, output: Path | None, theme: str, size: str, overwrite: bool, quiet: bool, as_json: bool
) -> None:
    """Draw the ledger of RESULT: its directory, particles.vtkhdf or particles.pvd, also while it is being written.

    Energies, the momentum that walls and forces gave, the time step and what bounds it, Courant number, volumes, the
    largest speed, and how far the particles reach.
    """
    from mpmcli.errors import InputError
    from mpmcli.output import open_result
    from mpmcli.plot.history import read_history
    from mpmcli.plot.ledger_figure import ledger_picture
    from mpmcli.render.files.picture_file import digest_of, settings_digest, write_picture

    # Without a home directory it warns about its cache.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    width_height = _size(size)
    opened = open_result(result)
    path = output or (opened.path if opened.path.is_dir() else opened.path.parent) / DEFAULT
    if path.suffix.lower() != ".png":
        raise InputError(f"{path} would be no picture of this command: give a name that ends in .png.")
    found = digest_of(path)
    if found is not None and not found.startswith(MARK) and not overwrite:
        raise InputError(f"{path} is there and was not made by mpmcli plot: give another name, or --overwrite.")
    history = read_history(opened)
    for note in history.notes:
        if not quiet:
            print_note(note)
    picture, panels = ledger_picture(history, width_height, theme)  # type: ignore[arg-type]
    write_picture(path, picture, MARK + settings_digest({"theme": theme, "size": width_height}))
    if as_json:
        facts = {"path": str(path), "size": width_height, "theme": theme, "frames": opened.frame_count}
        print_json({**facts, "panels": panels, "notes": history.notes})
    elif not quiet:
        print_text(str(path))


def _size(text: str) -> tuple[int, int]:
    from mpmcli.errors import InputError

    width, height = parse_size(text)
    if height is None or min(width, height) < SIZE_MIN or max(width, height) > SIZE_MAX:
        raise InputError(
            f"--size {text} is not possible: each side of this picture has {SIZE_MIN} to {SIZE_MAX} pixels."
        )
    if not height <= width <= WIDEST * height:
        raise InputError(
            f"--size {text} leaves no room for the panels: give a width of one to {WIDEST} times the height."
        )
    return width, height

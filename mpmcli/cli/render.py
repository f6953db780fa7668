"""`mpmcli render`."""

import logging
from pathlib import Path

import click

from mpmcli.cli.interrupt import interrupt_came, interrupts_wait
from mpmcli.cli.options import json_option, quiet_option
from mpmcli.cli.streams import print_json, print_note, print_text
from mpmcli.render.settings import COLLIDERS, MODES
from mpmcli.render.theme import THEMES


@click.command("render")
@click.argument("result", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="OUT",
    help="A .png for one picture, or a directory; by default the directory render beside the result.",
)
@click.option("--mode", type=click.Choice(MODES), default="dots", show_default=True, help="How particles are drawn.")
@click.option(
    "--frame",
    "frames",
    metavar="N|first|last|all|A:B:S",
    help="Which frames; the last one by default, all of them for a film or a montage.",
)
@click.option(
    "--color-by",
    "color",
    metavar="NAME",
    help="speed, material, body, density, pressure, J, stress, id or a stored field, stress.xy for a component.",
)
@click.option("--clim", metavar="LOW,HIGH", help="Limits of the colours; those of the whole result by default.")
@click.option("--cmap", metavar="NAME", help="A colour map of matplotlib.")
@click.option("--size", metavar="WxH", help="Pixels; 1280x720 by default.")
@click.option(
    "--camera",
    default="iso",
    show_default=True,
    metavar="iso|front|side|top|x,y,z,x,y,z",
    help="Of 3D scenes: by name, or where it stands and what it looks at, m.",
)
@click.option(
    "--theme", type=click.Choice(list(THEMES)), default="light", show_default=True, help="Colours around the particles."
)
@click.option(
    "--colliders",
    type=click.Choice(COLLIDERS),
    default="solid",
    show_default=True,
    help="How colliders are drawn; clear: in 3D their far sides only, which hide nothing.",
)
@click.option("--movie", type=click.Path(path_type=Path), metavar="FILE", help="Make a film: .mp4 or .gif.")
@click.option("--fps", type=float, help="Frames of the film per second, 30 by default.")
@click.option("--montage", metavar="CxR", help="One picture of evenly spaced frames, in C columns and R rows.")
@click.option(
    "--save-surface",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="With --mode surface: write the surfaces for other tools, .vtp and .obj.",
)
@click.option("--workers", type=click.IntRange(min=1), help="Processes that render; as many as cores by default.")
@click.option("--overwrite", is_flag=True, help="Render again what is there, and replace files that others made.")
@quiet_option
@json_option
def command(
    result: Path,
    output: Path | None,
    mode: str,
    frames: str | None,
    color: str | None,
    clim: str | None,
    cmap: str | None,
    size: str | None,
    camera: str,
    theme: str,
    colliders: str,
    movie: Path | None,
    fps: float | None,
    montage: str | None,
    save_surface: Path | None,
    workers: int | None,
    overwrite: bool,
    quiet: bool,
    as_json: bool,
) -> int:
    """Draw frames of a RESULT without a screen: pictures, a film (--movie) or a montage.

    RESULT may be a dataset: its montage shows evenly spaced trajectories at one frame, the middle one or --frame, and
    goes to montage.png in the dataset.

    RESULT is a directory, particles.vtkhdf or particles.pvd, of a run that has ended or goes on. A picture that is
    there and still right is not made again. The path of each picture, or that of the film, and the directory of the
    surfaces are printed on stdout.
    """
    from mpmcli.cli.progress_bar import ProgressBar
    from mpmcli.dataset.dataset import is_dataset
    from mpmcli.dataset.montage import plan_montage
    from mpmcli.output import open_result
    from mpmcli.plain_text import counted
    from mpmcli.render.request import Request, plan_render

    # Without a home directory it warns about its cache.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    request = Request(
        output,
        mode,
        frames,
        color,
        clim,
        cmap,
        size,
        camera,
        theme,
        movie,
        fps,
        montage,
        save_surface,
        colliders,
        overwrite,
    )
    plan = plan_montage(result, request) if is_dataset(result) else plan_render(open_result(result), request)
    with ProgressBar(plan.due, "frames", quiet=quiet) as bar, interrupts_wait():
        done = plan.carry_out(workers, watch=bar.show, stop=interrupt_came)
    for warning in done.warnings:
        print_note(f"warning: {warning}")
    if as_json:
        print_json(done.as_dict())
    elif not quiet:
        kept = len(done.pictures) - done.made
        there = f", {kept} {'was' if kept == 1 else 'were'} there already" if kept else ""
        print_note(f"{counted(done.made, 'picture')} made{there}")
        print_text("\n".join(map(str, done.paths)))
    return 0

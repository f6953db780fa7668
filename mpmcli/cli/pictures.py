"""`mpmcli render` and `mpmcli plot`."""

import logging
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from mpmcli.cli.interrupt import interrupt_came, interrupts_wait
from mpmcli.cli.options import COUNT, PATH, SCENE, choice_option, json_option, output_option, quiet_option
from mpmcli.cli.streams import print_json, print_note, print_text
from mpmcli.errors import InputError
from mpmcli.render.settings import COLLIDERS, MODES, THEMES, parse_size

# plot: the default file, and the prefix of the digest in a picture of this command.
LEDGER = "ledger.png"
MARK = "plot "
# plot: limits of the pixels along each side, because smaller text is illegible and larger pictures are probably a
# typing error; and the largest ratio of width to height.
SIZE_MIN, SIZE_MAX = 300, 8_000
WIDEST = 3


@click.command("render", epilog="Example: mpmcli render results/drop --mode surface --movie drop.mp4")
@click.argument("result", type=SCENE)
@output_option("A .png for one picture, or a directory; by default the directory render next to the result.", "OUT")
@choice_option("--mode", MODES, "dots", "Style of particles.")
@click.option(
    "--frame",
    "frames",
    metavar="N|first|last|all|A:B:S",
    help="Frames to draw; the last one by default, all for a film or a montage.",
)
@click.option(
    "--color-by",
    "color",
    metavar="NAME",
    help="speed, material, body, density, pressure, J, stress, id or a stored field, stress.xy for a component.",
)
@click.option("--clim", metavar="LOW,HIGH", help="Limits of the colours; those of the whole result by default.")
@click.option("--cmap", metavar="NAME", help="A colour map of matplotlib.")
@click.option("--size", metavar="WxH", help="Pixels; by default those within 1280x720 that the scene needs.")
@click.option(
    "--camera",
    default="iso",
    show_default=True,
    metavar="iso|front|side|top|x,y,z,x,y,z",
    help="Camera of 3D scenes: a name, or its position and target, m.",
)
@click.option(
    "--cameras",
    is_flag=False,
    flag_value="",
    metavar="[FILE]",
    help="Write images for training of the cameras of the scene, or of a file with [[cameras]].",
)
@click.option(
    "--what",
    metavar="NAMES",
    help="With --cameras: some of rgb, depth, mask, flow, normal, with commas; all but normal by default.",
)
@choice_option("--theme", list(THEMES), "light", "Colours of background and text.")
@choice_option(
    "--colliders",
    COLLIDERS,
    "auto",
    "Style of colliders; clear: in 3D only their far sides, which hide nothing; auto: hollow ones are cut open.",
)
@click.option("--movie", type=PATH, metavar="FILE", help="Make a film: .mp4 or .gif.")
@click.option("--fps", type=float, help="Frames of the film per second; by default those of real time, or 30.")
@click.option("--montage", metavar="CxR", help="One picture of evenly spaced frames, in C columns and R rows.")
@click.option(
    "--save-surface",
    type=PATH,
    metavar="DIR",
    help="With --mode surface: write the surfaces for other tools, .vtp and .obj.",
)
@click.option("--workers", type=COUNT, help="Number of processes; one per core by default.")
@click.option("--overwrite", is_flag=True, help="Render existing pictures again, and replace files of other programs.")
@quiet_option
@json_option
def render_command(
    result: Path,
    workers: int | None,
    quiet: bool,
    as_json: bool,
    cameras: str | None,
    what: str | None,
    **asked: Any,
) -> int:
    """Draw frames of a RESULT without a screen: pictures, a film (--movie) or a montage.

    RESULT may be a scene (.toml): its start is drawn, with velocities, forces on bodies and held parts, into
    <name of the scene>.png.

    RESULT may be a dataset: its montage shows evenly spaced trajectories at one frame, the middle one or --frame, and
    is written to montage.png in the dataset.

    With --cameras, images for training are written to the directory cameras: for each camera and frame colours, depth,
    masks and flow, and the matrices of the cameras.

    RESULT is a directory, or particles.vtkhdf, of a run that has ended or is running. Existing pictures that are up to
    date are not drawn again. The path of each picture, or that of the film, and the directory of the surfaces are
    printed on stdout.
    """
    from mpmcli.cli.progress import ProgressBar
    from mpmcli.dataset.dataset import is_dataset
    from mpmcli.dataset.montage import plan_montage
    from mpmcli.materials.registry import parameter_models
    from mpmcli.output import open_result
    from mpmcli.plain_text import counted
    from mpmcli.render.render_scene import result_of_start
    from mpmcli.render.request import Request, plan_render
    from mpmcli.scene import load_scene

    # Without a home directory it warns about its cache.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    request = Request(**asked)
    if what is not None and cameras is None:
        raise InputError("--what names the images of --cameras: give that, too.")
    if cameras is not None:
        return _images(open_result(result), request, Path(cameras) if cameras else None, what, workers, quiet, as_json)
    with ExitStack() as stack:
        if result.suffix == ".toml":
            of_results = {"--frame": request.frames, "--movie": request.movie, "--montage": request.montage}
            for option in (option for option, value in of_results.items() if value):
                raise InputError(f"{option} is for results, and of {result} the start is drawn; leave it out.")
            scene = load_scene(result, laws=parameter_models()).scene
            start, arrows = stack.enter_context(result_of_start(scene))
            color = request.color or ("material" if request.mode == "dots" else None)
            output = request.output or Path(f"{result.stem}.png")
            plan = plan_render(start, replace(request, output=output, color=color, arrows=arrows))
        else:
            plan = plan_montage(result, request) if is_dataset(result) else plan_render(open_result(result), request)
        bar = stack.enter_context(ProgressBar(plan.due, "frames", quiet=quiet))
        stack.enter_context(interrupts_wait())
        done = plan.carry_out(workers, watch=bar.show, stop=interrupt_came)
    for warning in done.warnings:
        print_note(f"warning: {warning}")
    if as_json:
        print_json(done.as_dict())
    elif not quiet:
        kept = len(done.pictures) - done.made
        there = f", {kept} {'was' if kept == 1 else 'were'} there already" if kept else ""
        print_note(f"{counted(done.made, 'picture')} made{there}{done.speed and f'; film: {done.speed}'}")
        print_text("\n".join(map(str, done.paths)))
    return 0


def _images(
    result: Any,
    request: Any,
    cameras: Path | None,
    what: str | None,
    workers: int | None,
    quiet: bool,
    as_json: bool,
) -> int:
    """Write the images of cameras."""
    from mpmcli.cli.progress import ProgressBar
    from mpmcli.cores import available_cores
    from mpmcli.plain_text import counted
    from mpmcli.render.camera_images import image_request

    plan = image_request(result, request, cameras, what)
    for note in plan.notes:
        print_note(f"warning: {note}")
    with ProgressBar(len(plan.due), "frames", quiet=quiet) as bar, interrupts_wait():
        plan.carry_out(workers or available_cores(), watch=bar.show, stop=interrupt_came)
    if as_json:
        print_json(plan.as_dict())
    elif not quiet:
        print_note(
            f"images of {counted(len(plan.due), 'frame')} from {counted(len(plan.asked.cameras), 'camera')} made"
        )
        print_text(str(plan.directory))
    return 0


@click.command("plot", epilog="Example: mpmcli plot results/drop -o ledger.png")
@click.argument("result", type=PATH)
@output_option(f"The picture; {LEDGER} in the directory of the result by default.", "OUT.png")
@choice_option("--theme", ["light", "dark"], "light", "Colours.")
@click.option("--size", default="1200x900", show_default=True, metavar="WxH", help="Pixels; the text scales with them.")
@click.option("--overwrite", is_flag=True, help="Replace a file that this command did not make.")
@quiet_option
@json_option
def plot_command(
    result: Path, output: Path | None, theme: str, size: str, overwrite: bool, quiet: bool, as_json: bool
) -> None:
    """Draw the ledger of RESULT, its directory or particles.vtkhdf, also during the run.

    The panels show energies, momentum from walls and forces, time step and its binding limit, Courant number, volumes,
    largest speed, and extent of the particles.
    """
    from mpmcli.output import open_result
    from mpmcli.plot.ledger_figure import ledger_picture, read_history
    from mpmcli.render.picture_file import digest_of, settings_digest, write_picture

    # Without a home directory it warns about its cache.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    width, height = parse_size(size)
    if height is None or min(width, height) < SIZE_MIN or max(width, height) > SIZE_MAX:
        raise InputError(
            f"--size {size} is not possible: each side of this picture has {SIZE_MIN} to {SIZE_MAX} pixels."
        )
    if not height <= width <= WIDEST * height:
        raise InputError(
            f"--size {size} leaves no room for the panels: give a width of one to {WIDEST} times the height."
        )
    opened = open_result(result)
    path = output or opened.directory / LEDGER
    if path.suffix.lower() != ".png":
        raise InputError(f"{path} cannot be a picture of this command: give a name that ends in .png.")
    digest = digest_of(path)
    if digest is not None and not digest.startswith(MARK) and not overwrite:
        raise InputError(f"{path} is there and was not made by mpmcli plot: give another name, or --overwrite.")
    history = read_history(opened)
    for note in history.notes:
        if not quiet:
            print_note(note)
    picture, panels = ledger_picture(history, (width, height), theme)  # type: ignore[arg-type]
    settings = {"theme": theme, "size": (width, height)}
    write_picture(path, picture, MARK + settings_digest(settings))
    if as_json:
        facts = {"path": str(path), "size": (width, height), "theme": theme, "frames": opened.frame_count}
        print_json({**facts, "panels": panels, "notes": history.notes})
    elif not quiet:
        print_text(str(path))

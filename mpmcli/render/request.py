"""The options of `mpmcli render`, validated before anything is drawn."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from mpmcli.errors import InputError
from mpmcli.output.result import Result
from mpmcli.render.coloring import Coloring
from mpmcli.render.files.film import check_film, film_digest
from mpmcli.render.files.picture_file import digest_of, require_writable
from mpmcli.render.frame_choice import choose_frames, evenly_spaced
from mpmcli.render.painter import set_up, usual_color
from mpmcli.render.pictures import FOREIGN, PlannedPicture, is_foreign, picture_digest, picture_name, plan_pictures
from mpmcli.render.render_plan import RenderPlan
from mpmcli.render.render_scene import render_scene_of
from mpmcli.render.settings import Colliders, Mode, Settings, parse_grid, parse_limits, parse_size
from mpmcli.render.surfaces.save_surface import surface_paths
from mpmcli.render.view import CAMERAS

# Directory of pictures in that of the result.
DIRECTORY = "render"
USUAL_FPS = 30.0
USUAL_SIZE, USUAL_MONTAGE_SIZE = "1280x720", "1280xauto"
# Modes in which particles have the colours of a value.
COLORED = ("dots", "surface")


@dataclass(frozen=True)
class Request:
    """The options of the command, as they were given; None where they were not."""

    output: Path | None = None
    mode: Mode = "dots"
    frames: str | None = None
    color: str | None = None
    clim: str | None = None
    cmap: str | None = None
    size: str | None = None
    camera: str = "iso"
    theme: str = "light"
    movie: Path | None = None
    fps: float | None = None
    montage: str | None = None
    save_surface: Path | None = None
    colliders: Colliders = "solid"
    overwrite: bool = False

    @property
    def rate(self) -> float:
        """Frames of a film per second."""
        return USUAL_FPS if self.fps is None else self.fps


def plan_render(result: Result, request: Request, captions: tuple[str, ...] = ()) -> RenderPlan:
    """Validate a request and return the plan that carries it out.

    Args:
        captions: of the frames of the result in a montage; empty for their times.

    Raises:
        InputError: the request is not possible.
    """
    _require_sense(request)
    if request.movie is not None:
        check_film(request.movie, request.rate)
        if film_digest(request.movie) == "" and not request.overwrite:
            raise InputError(FOREIGN.format(path=request.movie).replace("with -o", "with --movie"))
    grid = parse_grid(request.montage) if request.montage else (1, 1)
    several = bool(request.movie or request.montage)
    ks = choose_frames(request.frames or ("all" if several else "last"), result)
    if request.montage:
        ks = evenly_spaced(ks, grid[0] * grid[1])
    usual = USUAL_MONTAGE_SIZE if request.montage else USUAL_SIZE
    settings = Settings(
        mode=request.mode,
        color=request.color or (usual_color(render_scene_of(result)) if request.mode == "dots" else None),
        size=parse_size(request.size or usual),
        camera=request.camera,
        theme=request.theme,
        limits=parse_limits(request.clim) if request.clim else None,
        cmap=request.cmap,
        grid=grid,
        colliders=request.colliders,
    )
    setup = replace(set_up(result, settings), captions=captions)
    if (request.clim or request.cmap) and not isinstance(setup.colors, Coloring):
        option = "--clim" if request.clim else "--cmap"
        raise InputError(f"{option} is for colours that stand for a value: give --color-by speed, or another one.")
    if request.montage:
        path = _montage_path(result, settings.mode, request.output)
        digest = picture_digest(result, setup.settings, ks)
        there = digest_of(path)
        if is_foreign(there) and not request.overwrite:
            raise InputError(FOREIGN.format(path=path))
        plan = [PlannedPicture(ks[0], path, digest, there == digest and not request.overwrite)]
    else:
        path_of = _paths(result, settings.mode, request, len(ks))
        plan = plan_pictures(result, setup.settings, ks, path_of, overwrite=request.overwrite)
    if request.save_surface is not None and not request.overwrite:
        for path in (path for k in ks for path in surface_paths(setup.scene, request.save_surface, k)):
            if path.exists():
                raise InputError(f"{path} is there already: give another directory, or --overwrite.")
    surface = None if request.save_surface is None else request.save_surface / "surface"
    for path in (plan[0].path, request.movie, surface):
        if path is not None:
            require_writable(path)
    return RenderPlan(setup, ks, plan, request.movie, request.rate, request.save_surface, request.overwrite)


def _require_sense(request: Request) -> None:
    if request.movie and request.montage:
        raise InputError("--movie and --montage are two things: ask for one after the other.")
    if request.fps is not None and not request.movie:
        raise InputError("--fps is the rate of a film: name one with --movie.")
    if request.save_surface and request.mode != "surface":
        raise InputError("--save-surface writes the surfaces of --mode surface: ask for that.")
    if request.mode == "surface" and request.color == "body":
        raise InputError("--color-by body is for --mode dots: a surface has no bodies, only materials.")
    if request.mode == "density" and request.camera not in CAMERAS:
        raise InputError(f"--mode density shows a slice: give --camera {', '.join(CAMERAS[1:])}.")
    for option, value in (("--color-by", request.color), ("--clim", request.clim), ("--cmap", request.cmap)):
        allowed = COLORED if option == "--color-by" else (*COLORED, "density")
        if value and request.mode not in allowed:
            raise InputError(
                f"{option} says nothing in --mode {request.mode}, which has colours of its own: use --mode "
                f"{' or '.join(allowed)}."
            )


def _directory(result: Result) -> Path:
    """Return where pictures of a result go."""
    return (result.path if result.path.is_dir() else result.path.parent) / DIRECTORY


def _montage_path(result: Result, mode: str, output: Path | None) -> Path:
    """Return the path of a montage."""
    if output is not None and output.suffix and not output.is_dir():
        _require_png(output)
        return output
    return (output or _directory(result)) / f"{mode}_montage.png"


def _require_png(output: Path) -> None:
    if output.suffix.lower() != ".png":
        film = output.suffix.lower() in (".mp4", ".gif")
        hint = "for a film, give --movie" if film else "pictures are .png, and a directory with a dot has to be there"
        raise InputError(f"-o {output} would be no picture: {hint}.")


def _paths(result: Result, mode: str, request: Request, count: int) -> Callable[[int], Path]:
    """Return the path of the picture of each frame."""
    output = request.output
    if output is not None and output.suffix and not output.is_dir():
        _require_png(output)
        if count > 1:
            raise InputError(f"-o {output} is one picture and {count} were asked for: name a directory.")
        return lambda k: output
    directory = output or _directory(result)
    if directory.exists() and not directory.is_dir():
        raise InputError(f"{directory} is a file, not a directory: give another place with -o.")
    return lambda k: directory / picture_name(mode, int(result.numbers[k]))

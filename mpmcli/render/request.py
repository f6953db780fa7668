"""The options of `mpmcli render`, validated before drawing, and the plan that executes them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.cores import available_cores
from mpmcli.errors import InputError
from mpmcli.output.result import Result
from mpmcli.plain_text import counted
from mpmcli.render.coloring import Coloring
from mpmcli.render.frame_choice import choose_frames, evenly_spaced
from mpmcli.render.picture_file import (
    GIF_FPS_MAX,
    check_film,
    film_digest,
    require_writable,
    settings_digest,
    write_film,
    write_picture,
)
from mpmcli.render.pictures import (
    FOREIGN,
    Outcome,
    PictureRenderer,
    PlannedPicture,
    RenderSetup,
    make_pictures,
    plan_picture,
    set_up,
)
from mpmcli.render.reconstruction import save_surfaces, surface_paths
from mpmcli.render.settings import Arrow, Colliders, Mode, Settings, parse_grid, parse_limits, parse_size
from mpmcli.render.view import CAMERAS

DIRECTORY = "render"  # directory of pictures in that of the result
# Frames of a film per second, least and most, that follow from the time between frames of the result; else USUAL_FPS.
SLOWEST_FPS, FASTEST_FPS, USUAL_FPS = 10.0, 60.0, 30.0
USUAL_MONTAGE_SIZE = "1280xauto"
COLORED = ("dots", "surface")  # modes in which particles have the colours of a value


@dataclass(frozen=True)
class Request:
    """The options of the command as given; None if omitted."""

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
    colliders: Colliders = "auto"
    overwrite: bool = False
    arrows: tuple[Arrow, ...] | None = None

    def rate_of(self, times: np.ndarray) -> float:
        """Return the frames per second of a film of frames at these times, s: as given, or in real time if possible."""
        pace = _pace(times)
        if self.fps is not None:
            return self.fps
        fastest = GIF_FPS_MAX if self.movie is not None and self.movie.suffix.lower() == ".gif" else FASTEST_FPS
        return round(pace, 6) if SLOWEST_FPS <= pace <= fastest else USUAL_FPS


def _pace(times: np.ndarray) -> float:
    """Return the frames per second of the scene's own time, 0 for frames without one."""
    spans = np.abs(np.diff(times))
    return 1 / float(np.median(spans)) if len(spans) and np.median(spans) > 0 else 0.0


def speed_text(rate: float, times: np.ndarray) -> str:
    """Return how fast a film of frames at these times, s, runs, in words."""
    speed = rate / pace if (pace := _pace(times)) else 1.0
    if abs(speed - 1) < 0.01:
        return "in real time"
    return f"1/{1 / speed:.3g} of real time" if speed < 1 else f"{speed:.3g} times real time"


@dataclass(frozen=True)
class RenderSummary:
    """The outcome of a plan."""

    pictures: list[Path]  # files, by frame; the one of a montage
    made: int  # number of files drawn by this plan
    film: Path | None  # None for pictures only
    surfaces: Path | None  # the directory of the surfaces, None if not requested
    speed: str  # of the film, in words; empty for pictures only
    warnings: list[str]  # sentences

    @property
    def paths(self) -> list[Path]:
        """The requested outputs: the film or else the pictures, and the directory of the surfaces."""
        return [*([self.film] if self.film else self.pictures), *([self.surfaces] if self.surfaces else [])]

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        pictures, film = [str(path) for path in self.pictures], str(self.film) if self.film else None
        found = {"pictures": pictures, "made": self.made, "film": film, "warnings": self.warnings}
        return found | ({"speed": self.speed} if film else {})


@dataclass(frozen=True)
class RenderPlan:
    """A validated request for pictures, a film or a montage of a result; nothing is drawn yet."""

    setup: RenderSetup  # shared by all pictures
    ks: list[int]  # positions of the frames in the result
    plan: list[PlannedPicture]  # the picture files, one for each frame; one for a montage
    request: Request
    notes: tuple[str, ...] = ()

    @property
    def due(self) -> int:
        """Number of frames to draw, or to write surfaces for."""
        frames = len(self.ks) if self._is_montage else 1
        return sum(frames for planned in self.plan if not planned.made) + len(self.ks) * bool(self.request.save_surface)

    @property
    def _is_montage(self) -> bool:
        return self.setup.settings.grid != (1, 1)

    def carry_out(
        self,
        workers: int | None = None,
        *,
        watch: Callable[[int], None] = lambda done: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> RenderSummary:
        """Draw the missing pictures, in `workers` processes, None for one per core, and write the film.

        `watch` is called with the number of frames drawn so far; `stop` is polled, and True ends the work by a
        KeyboardInterrupt; finished pictures stay. InputError: no OpenGL window opens on this machine, or a file cannot
        be written; RunError: a process crashed, or the disk is full.
        """
        workers = workers or available_cores()
        source, settings = self.setup.result.path, self.setup.settings
        movie, surface, times = self.request.movie, self.request.save_surface, self.setup.result.times[self.ks]
        rate = self.request.rate_of(times)
        outcomes: dict[int, Outcome] = {}
        numbers = count(1)

        def seen(k: int, outcome: Outcome | None) -> None:
            watch(next(numbers))
            if outcome is not None:
                outcomes[k] = outcome

        def check_stop(*_: object) -> None:
            if stop():
                raise KeyboardInterrupt

        def seen_here(k: int, outcome: Outcome) -> None:
            seen(k, outcome)
            check_stop()

        if not self._is_montage:
            make_pictures(source, settings, self.plan, workers, watch=seen, stop=stop)
        elif not self.plan[0].made:
            picture = PictureRenderer(self.setup).picture(self.ks, seen_here)
            write_picture(self.plan[0].path, picture, self.plan[0].digest)
        if surface is not None:
            save_surfaces(self.setup.result, self.ks, surface, workers, watch=seen, stop=stop)
        paths = [planned.path for planned in self.plan]
        if movie is not None:
            digest = settings_digest({"pictures": [planned.digest for planned in self.plan], "fps": rate})
            if self.request.overwrite or film_digest(movie) != digest:
                write_film(paths, movie, rate, digest=digest, watch=check_stop)
        made = sum(not planned.made for planned in self.plan)
        speed = f"{rate:.4g} frames per second, {speed_text(rate, times)}" if movie else ""
        return RenderSummary(paths, made, movie, surface, speed, self._warnings(outcomes))

    def _warnings(self, outcomes: dict[int, Outcome]) -> list[str]:
        """Return sentences on particles that could not be drawn, one for all frames."""

        def first_of(counts: dict[int, int]) -> str:
            most, first = max(counts.values()), self.setup.result.numbers[min(counts)]
            upto = "up to " if len(counts) > 1 and min(counts.values()) < most else ""
            return f"of {upto}{counted(most, 'particle')} is not a number, first in frame {first}"

        warnings, colors = [*self.notes], self.setup.colors
        missing = {k: missing for k, (missing, _) in outcomes.items() if missing}
        if missing and isinstance(colors, Coloring):
            warnings.append(f"the {colors.name} {first_of(missing)}: drawn in {colors.missing}")
        lost = {k: lost for k, (_, lost) in outcomes.items() if lost}
        if lost:
            warnings.append(f"the position {first_of(lost)}: not drawn")
        return warnings


def plan_render(result: Result, request: Request, captions: tuple[str, ...] = ()) -> RenderPlan:
    """Validate a request and return its plan; InputError: it is impossible.

    `captions` are those of the frames of the result in a montage; empty for their times.
    """
    require_sense(request)
    if request.movie is not None:
        check_film(request.movie, USUAL_FPS if request.fps is None else request.fps)
        if film_digest(request.movie) == "" and not request.overwrite:
            raise InputError(FOREIGN.format(path=request.movie).replace("with -o", "with --movie"))
    grid = parse_grid(request.montage) if request.montage else (1, 1)
    several = bool(request.movie or request.montage)
    ks = choose_frames(request.frames or ("all" if several else "last"), result)
    if request.montage:
        ks = evenly_spaced(ks, grid[0] * grid[1])
    settings = Settings(
        mode=request.mode,
        color=request.color or None,
        size=parse_size(request.size or USUAL_MONTAGE_SIZE) if request.size or request.montage else None,
        camera=request.camera,
        theme=request.theme,
        limits=parse_limits(request.clim) if request.clim else None,
        cmap=request.cmap,
        grid=grid,
        colliders=request.colliders,
        arrows=request.arrows,
    )
    setup = replace(set_up(result, settings), captions=captions)
    if (request.clim or request.cmap) and not isinstance(setup.colors, Coloring):
        option = "--clim" if request.clim else "--cmap"
        raise InputError(f"{option} is for colours that stand for a value: give --color-by speed, or another one.")
    path_of = _paths(result, request, len(ks))
    plan = [
        plan_picture(result, setup.settings, chosen, path_of(chosen[0]), overwrite=request.overwrite)
        for chosen in ([ks] if request.montage else [[k] for k in ks])
    ]
    surface = None
    if request.save_surface is not None:
        surface = request.save_surface / "surface"
        for path in (path for k in ks for path in surface_paths(setup.scene, request.save_surface, k)):
            if path.exists() and not request.overwrite:
                raise InputError(f"{path} is there already: give another directory, or --overwrite.")
    for path in (plan[0].path, request.movie, surface):
        if path is not None:
            require_writable(path)
    return RenderPlan(setup, ks, plan, request)


def require_sense(request: Request) -> None:
    """Refuse options that exclude each other, or have no effect in the mode."""
    if request.movie and request.montage:
        raise InputError("--movie and --montage exclude each other: give one of them.")
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
                f"{option} has no effect in --mode {request.mode}, which has its own colours: use --mode "
                f"{' or '.join(allowed)}."
            )


def _paths(result: Result, request: Request, count: int) -> Callable[[int], Path]:
    """Return the path of the picture of each frame, or of the montage for any frame."""
    output, mode = request.output, request.mode
    if output is not None and output.suffix and not output.is_dir():
        if output.suffix.lower() in (".mp4", ".gif"):
            raise InputError(f"-o {output} cannot be a picture: for a film, give --movie.")
        if output.suffix.lower() != ".png":
            hint = "pictures are .png, and a directory with a dot has to be there"
            raise InputError(f"-o {output} cannot be a picture: {hint}.")
        if count > 1 and not request.montage:
            raise InputError(f"-o {output} is one picture and {count} were asked for: name a directory.")
        return lambda k: output
    directory = output or result.directory / DIRECTORY
    if request.montage:
        return lambda k: directory / f"{mode}_montage.png"
    if directory.exists() and not directory.is_dir():
        raise InputError(f"{directory} is a file, not a directory: give another place with -o.")
    return lambda k: directory / f"{mode}_{int(result.numbers[k]):06d}.png"

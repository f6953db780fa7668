"""What one call of `mpmcli render` is asked for, checked before anything is drawn, and then done."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpmcli.cores import available_cores
from mpmcli.errors import InputError
from mpmcli.output.result import Result
from mpmcli.render.coloring import Coloring
from mpmcli.render.files.film import check_film, film_digest, write_film
from mpmcli.render.files.picture_file import digest_of, require_writable, settings_digest, write_picture
from mpmcli.render.frame_choice import choose_frames, evenly_spaced
from mpmcli.render.painter import Studio, open_studio, usual_color
from mpmcli.render.pictures import (
    FOREIGN,
    Easel,
    Outcome,
    Planned,
    is_foreign,
    make_pictures,
    picture_digest,
    picture_name,
    plan_pictures,
)
from mpmcli.render.settings import Mode, Settings, parse_grid, parse_limits, parse_size
from mpmcli.render.subject import subject_of
from mpmcli.render.surfaces.save_surface import save_surfaces, surface_paths
from mpmcli.render.view import CAMERAS

# Where pictures go, beside the result.
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
    overwrite: bool = False

    @property
    def rate(self) -> float:
        """Frames of a film per second."""
        return USUAL_FPS if self.fps is None else self.fps


@dataclass(frozen=True)
class Done:
    """What came of an assignment.

    Attributes:
        pictures: files, by frame; the one of a montage.
        made: how many of them were made now.
        film: the film, None where none was asked for.
        warnings: sentences.
    """

    pictures: list[Path]
    made: int
    film: Path | None
    warnings: list[str]

    @property
    def place(self) -> Path:
        """The picture, or the directory of several."""
        return self.pictures[0] if len(self.pictures) == 1 else self.pictures[0].parent

    def as_dict(self) -> dict[str, Any]:
        """Return it in the form of JSON."""
        pictures, film = [str(path) for path in self.pictures], str(self.film) if self.film else None
        return {"pictures": pictures, "made": self.made, "film": film, "warnings": self.warnings}


@dataclass(frozen=True)
class Assignment:
    """Pictures, a film or a montage of a result, all questions answered; nothing is drawn yet.

    Attributes:
        studio: what all pictures share.
        ks: positions of the frames in the result.
        plan: the picture files, one for each frame; one for a montage.
    """

    studio: Studio
    ks: list[int]
    plan: list[Planned]
    movie: Path | None
    fps: float
    save_surface: Path | None
    overwrite: bool

    @property
    def due(self) -> int:
        """Number of frames that have to be drawn, or their surfaces written."""
        frames = len(self.ks) if self._is_montage else 1
        return sum(frames for planned in self.plan if not planned.made) + len(self.ks) * (self.save_surface is not None)

    @property
    def _is_montage(self) -> bool:
        return self.studio.settings.grid != (1, 1)

    def carry_out(
        self,
        workers: int | None = None,
        *,
        watch: Callable[[int], None] = lambda done: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> Done:
        """Draw what is due, and put the film together.

        Args:
            workers: processes at a time, as many as cores for None.
            watch: told how many frames have been drawn.
            stop: asked again and again whether to end.

        Raises:
            InputError: nothing draws on this machine, or a place cannot be written to.
            RunError: a process crashed, or the disk is full.
            KeyboardInterrupt: `stop` said so; pictures that are done stay.
        """
        workers = workers or available_cores()
        source, settings = self.studio.result.path, self.studio.settings
        outcomes: dict[int, Outcome] = {}
        done = 0

        def seen(k: int, outcome: Outcome | None) -> None:
            nonlocal done
            done += 1
            watch(done)
            if outcome is not None:
                outcomes[k] = outcome

        if self._is_montage:
            self._draw_montage(seen, stop)
        else:
            make_pictures(source, settings, self.plan, workers, watch=seen, stop=stop)
        if self.save_surface is not None:
            save_surfaces(self.studio.result, self.ks, self.save_surface, workers, watch=seen, stop=stop)
        if self.movie is not None:
            self._put_together(self.movie, stop)
        made = sum(not planned.made for planned in self.plan)
        return Done([planned.path for planned in self.plan], made, self.movie, self._warnings(outcomes))

    def _draw_montage(self, seen: Callable[[int, Outcome], None], stop: Callable[[], bool]) -> None:
        (planned,) = self.plan
        if planned.made:
            return

        def watched(k: int, outcome: Outcome) -> None:
            seen(k, outcome)
            if stop():
                raise KeyboardInterrupt

        write_picture(planned.path, Easel(self.studio).picture(self.ks, watched), planned.digest)

    def _put_together(self, movie: Path, stop: Callable[[], bool]) -> None:
        def watched(_: int) -> None:
            if stop():
                raise KeyboardInterrupt

        digest = settings_digest({"pictures": [planned.digest for planned in self.plan], "fps": self.fps})
        if self.overwrite or film_digest(movie) != digest:
            write_film([planned.path for planned in self.plan], movie, self.fps, digest=digest, watch=watched)

    def _warnings(self, outcomes: dict[int, Outcome]) -> list[str]:
        """Say what could not be shown as it is, once for all frames."""
        told = []
        numbers = self.studio.result.numbers
        colors = self.studio.colors
        missing = [k for k in sorted(outcomes) if outcomes[k].missing]
        if missing and isinstance(colors, Coloring):
            most = _particles([outcomes[k].missing for k in missing])
            told.append(
                f"the {colors.name} of {most} is not a number, first in frame {numbers[missing[0]]}: drawn in "
                f"{colors.missing}"
            )
        lost = [k for k in sorted(outcomes) if outcomes[k].lost]
        if lost:
            most = _particles([outcomes[k].lost for k in lost])
            told.append(f"the position of {most} is not a number, first in frame {numbers[lost[0]]}: not drawn")
        return told


def assign(result: Result, request: Request) -> Assignment:
    """Check a request and work out what it means.

    Raises:
        InputError: it cannot be done.
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
        color=request.color or (usual_color(subject_of(result)) if request.mode == "dots" else None),
        size=parse_size(request.size or usual),
        camera=request.camera,
        theme=request.theme,
        limits=parse_limits(request.clim) if request.clim else None,
        cmap=request.cmap,
        grid=grid,
    )
    studio = open_studio(result, settings)
    if (request.clim or request.cmap) and not isinstance(studio.colors, Coloring):
        option = "--clim" if request.clim else "--cmap"
        raise InputError(f"{option} is for colours that stand for a value: give --color-by speed, or another one.")
    if request.montage:
        path = _montage_path(result, settings.mode, request.output)
        digest = picture_digest(result, studio.settings, ks)
        there = digest_of(path)
        if is_foreign(there) and not request.overwrite:
            raise InputError(FOREIGN.format(path=path))
        plan = [Planned(ks[0], path, digest, there == digest and not request.overwrite)]
    else:
        path_of = _paths(result, settings.mode, request, len(ks))
        plan = plan_pictures(result, studio.settings, ks, path_of, overwrite=request.overwrite)
    if request.save_surface is not None and not request.overwrite:
        for path in (path for k in ks for path in surface_paths(studio.subject, request.save_surface, k)):
            if path.exists():
                raise InputError(f"{path} is there already: give another directory, or --overwrite.")
    surface = None if request.save_surface is None else request.save_surface / "surface"
    for path in (plan[0].path, request.movie, surface):
        if path is not None:
            require_writable(path)
    return Assignment(studio, ks, plan, request.movie, request.rate, request.save_surface, request.overwrite)


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


def _particles(counts: list[int]) -> str:
    most = max(counts)
    upto = "up to " if len(counts) > 1 and min(counts) < most else ""
    return f"{upto}{most} particle{'s' if most > 1 else ''}"


def _directory(result: Result) -> Path:
    """Return where pictures of a result go."""
    return (result.path if result.path.is_dir() else result.path.parent) / DIRECTORY


def _montage_path(result: Result, mode: str, output: Path | None) -> Path:
    """Return where a montage goes."""
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
    """Return where the picture of each frame goes."""
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

"""Pictures, a film or a montage of a result, as one call of `mpmcli render` makes them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpmcli.cores import available_cores
from mpmcli.plain_text import counted
from mpmcli.render.coloring import Coloring
from mpmcli.render.files.film import film_digest, write_film
from mpmcli.render.files.picture_file import settings_digest, write_picture
from mpmcli.render.painter import RenderSetup
from mpmcli.render.pictures import Outcome, PictureRenderer, PlannedPicture, make_pictures
from mpmcli.render.surfaces.save_surface import save_surfaces


@dataclass(frozen=True)
class RenderSummary:
    """What carrying out a plan produced.

    Attributes:
        pictures: files, by frame; the one of a montage.
        made: number of them that were drawn now.
        film: the film; None for pictures only.
        surfaces: the directory of the surfaces, None where none was asked for.
        warnings: sentences.
    """

    pictures: list[Path]
    made: int
    film: Path | None
    surfaces: Path | None
    warnings: list[str]

    @property
    def paths(self) -> list[Path]:
        """The requested outputs: the film or else the pictures, and the directory of the surfaces."""
        return [*([self.film] if self.film else self.pictures), *([self.surfaces] if self.surfaces else [])]

    def as_dict(self) -> dict[str, Any]:
        """Return it in the form of JSON."""
        pictures, film = [str(path) for path in self.pictures], str(self.film) if self.film else None
        return {"pictures": pictures, "made": self.made, "film": film, "warnings": self.warnings}


@dataclass(frozen=True)
class RenderPlan:
    """A validated request for pictures, a film or a montage of a result; nothing is drawn yet.

    Attributes:
        setup: shared by all pictures.
        ks: positions of the frames in the result.
        plan: the picture files, one for each frame; one for a montage.
    """

    setup: RenderSetup
    ks: list[int]
    plan: list[PlannedPicture]
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
        return self.setup.settings.grid != (1, 1)

    def carry_out(
        self,
        workers: int | None = None,
        *,
        watch: Callable[[int], None] = lambda done: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> RenderSummary:
        """Draw the missing pictures, and write the film.

        Args:
            workers: processes at a time, as many as cores for None.
            watch: called with the number of frames drawn so far.
            stop: polled; true ends the work.

        Raises:
            InputError: no OpenGL window opens on this machine, or a file cannot be written.
            RunError: a process crashed, or the disk is full.
            KeyboardInterrupt: `stop` returned true; finished pictures stay.
        """
        workers = workers or available_cores()
        source, settings = self.setup.result.path, self.setup.settings
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
            save_surfaces(self.setup.result, self.ks, self.save_surface, workers, watch=seen, stop=stop)
        if self.movie is not None:
            self._put_together(self.movie, stop)
        made = sum(not planned.made for planned in self.plan)
        return RenderSummary(
            [planned.path for planned in self.plan], made, self.movie, self.save_surface, self._warnings(outcomes)
        )

    def _draw_montage(self, seen: Callable[[int, Outcome], None], stop: Callable[[], bool]) -> None:
        (planned,) = self.plan
        if planned.made:
            return

        def watched(k: int, outcome: Outcome) -> None:
            seen(k, outcome)
            if stop():
                raise KeyboardInterrupt

        write_picture(planned.path, PictureRenderer(self.setup).picture(self.ks, watched), planned.digest)

    def _put_together(self, movie: Path, stop: Callable[[], bool]) -> None:
        def watched(_: int) -> None:
            if stop():
                raise KeyboardInterrupt

        digest = settings_digest({"pictures": [planned.digest for planned in self.plan], "fps": self.fps})
        if self.overwrite or film_digest(movie) != digest:
            write_film([planned.path for planned in self.plan], movie, self.fps, digest=digest, watch=watched)

    def _warnings(self, outcomes: dict[int, Outcome]) -> list[str]:
        """Return sentences on particles that could not be drawn, one for all frames."""
        told = []
        numbers = self.setup.result.numbers
        colors = self.setup.colors
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


def _particles(counts: list[int]) -> str:
    most = max(counts)
    upto = "up to " if len(counts) > 1 and min(counts) < most else ""
    return upto + counted(most, "particle")

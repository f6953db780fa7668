"""Pictures of frames as files: which of them are missing or outdated, and drawing these in several processes."""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from mpmcli.errors import InputError
from mpmcli.frames.frame import STATUS, Frame
from mpmcli.output.result import Result, open_result
from mpmcli.processes.pool import render_frames
from mpmcli.render.coloring import Coloring
from mpmcli.render.files.picture_file import digest_of, settings_digest, write_picture
from mpmcli.render.labels import time_text
from mpmcli.render.painter import Painter, RenderSetup, expected_times, set_up
from mpmcli.render.settings import Settings
from mpmcli.render.window import choose_window

FOREIGN = "{path} is there already, and mpmcli render did not make it: give another place with -o, or --overwrite."


@dataclass(frozen=True)
class PlannedPicture:
    """The picture file of one frame, or of a montage.

    Attributes:
        k: position of the frame in the result.
        digest: of everything that it depends on.
        made: whether the file exists with this digest.
    """

    k: int
    path: Path
    digest: str
    made: bool


@dataclass(frozen=True)
class Outcome:
    """Numbers of particles of a frame that could not be drawn.

    Attributes:
        missing: particles whose value is not a number.
        lost: particles without a place.
    """

    missing: int
    lost: int


@dataclass(frozen=True)
class PictureJob:
    """Pictures of some frames, as a worker process makes them.

    Attributes:
        source: path of the result.
        settings: with the limits of the colours filled in.
        plan: by frame.
    """

    source: Path
    settings: Settings
    plan: dict[int, PlannedPicture] = field(repr=False)

    def start(self) -> Callable[[int], Outcome]:
        """Open the result and a window, and return a function that draws and writes the picture of a frame."""
        setup = set_up(open_result(self.source), self.settings)
        renderer = PictureRenderer(setup)

        def make(k: int) -> Outcome:
            outcomes: list[Outcome] = []
            picture = renderer.picture([k], lambda _, outcome: outcomes.append(outcome))
            write_picture(self.plan[k].path, picture, self.plan[k].digest)
            return outcomes[0]

        return make


class PictureRenderer:
    """Draws whole pictures of frames, which are read one at a time."""

    def __init__(self, setup: RenderSetup) -> None:
        choose_window()
        self._setup = setup
        self._painter: Painter = setup.painter()

    def picture(self, ks: Sequence[int], watch: Callable[[int, Outcome], None] = lambda k, outcome: None) -> np.ndarray:
        """Return the picture of a frame, or the montage of several, (h, w, 3) uint8.

        Args:
            watch: called with each frame that has been drawn, and its outcome.
        """
        setup, drawn, times, missing = self._setup, [], [], 0
        captions = [setup.captions[k] for k in ks] if setup.captions else None
        density = setup.settings.mode == "density"
        for k in ks:
            if density:
                # Which needs to know how many particles share the mass of a body.
                frame = setup.result.frame(k, (*self._painter.fields, *({STATUS} & set(setup.result.field_names))))
            else:
                frame = setup.result.present_frame(k, self._painter.fields)
            drawn.append(self._painter.draw(frame))
            times.append(frame.time)
            outcome = Outcome(self._missing(frame), int((~np.isfinite(frame.position).all(axis=1)).sum()))
            missing += outcome.missing
            watch(k, outcome)
        return setup.layout.compose(drawn, setup.view, times, missing, captions)

    def _missing(self, frame: Frame) -> int:
        colors = self._setup.colors
        if not isinstance(colors, Coloring) or self._setup.settings.mode == "density":
            return 0
        return int((~np.isfinite(colors.values(frame))).sum())


def picture_digest(result: Result, settings: Settings, ks: Sequence[int]) -> str:
    """Return a digest of what a picture of some frames depends on.

    The ledger's row represents the particles, since it holds their energies and momenta to the last bit. The text of a
    time depends on other frames.
    """
    times = expected_times(result)
    labels = [time_text(float(result.times[k]), times) for k in ks]
    frames = [[int(result.numbers[k]), int(result.particle_counts[k]), repr(result.ledger[k])] for k in ks]
    return settings_digest(
        {**asdict(settings), "scene": result.header.stored.get("scene", ""), "frames": frames, "labels": labels}
    )


def plan_pictures(
    result: Result, settings: Settings, ks: Sequence[int], path_of: Callable[[int], Path], *, overwrite: bool
) -> list[PlannedPicture]:
    """Return the pictures of some frames, and whether each exists and is up to date.

    Args:
        path_of: where the picture of a frame goes, by its position in the result.
        overwrite: draw all of them again, and replace any existing file.

    Raises:
        InputError: a file exists that mpmcli did not make.
    """
    plan = []
    for k in ks:
        path, digest = path_of(k), picture_digest(result, settings, [k])
        there = digest_of(path)
        if is_foreign(there) and not overwrite:
            raise InputError(FOREIGN.format(path=path))
        plan.append(PlannedPicture(k, path, digest, there == digest and not overwrite))
    return plan


def is_foreign(there: str | None) -> bool:
    """Return whether a digest, from `digest_of`, belongs to a file that is no picture of frames, such as a ledger's."""
    return there is not None and not re.fullmatch("[0-9a-f]{32}", there)


def make_pictures(
    source: Path,
    settings: Settings,
    plan: Sequence[PlannedPicture],
    workers: int,
    *,
    watch: Callable[[int, Outcome], None] = lambda k, outcome: None,
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Draw the pictures of a plan that do not exist yet.

    Args:
        source: path of the result; settings: as `set_up` has filled them in.
        workers, watch, stop: see `render_frames`.

    Raises:
        InputError: nothing draws on this machine, or a place cannot be written to.
        RunError: a process crashed, or the disk is full.
        KeyboardInterrupt: `stop` returned True.
    """
    due = {planned.k: planned for planned in plan if not planned.made}
    if due:
        # Chosen once, and inherited by the workers.
        choose_window()
        render_frames(PictureJob(source, settings, due), list(due), workers, watch=watch, stop=stop)


def picture_name(mode: str, number: int) -> str:
    """Return the name of the file of a frame with this number."""
    return f"{mode}_{number:06d}.png"

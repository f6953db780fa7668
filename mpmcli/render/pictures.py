"""Pictures of frames as files: which are to be made, and the making of them, in several processes."""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
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
    """A picture of one frame that is to be there in the end.

    Attributes:
        k: position of the frame in the result.
        digest: of everything that it depends on.
        made: whether it is there.
    """

    k: int
    path: Path
    digest: str
    made: bool


@dataclass(frozen=True)
class Outcome:
    """What came up in a frame.

    Attributes:
        missing: particles whose value is not a number.
        lost: particles without a place.
    """

    missing: int
    lost: int


@dataclass(frozen=True)
class PictureJob:
    """Pictures of some frames, as a process of its own makes them.

    Attributes:
        source: path of the result.
        settings: with the limits of the colours filled in.
        plan: by frame.
    """

    source: Path
    settings: Settings
    plan: dict[int, PlannedPicture] = field(repr=False)

    def start(self) -> Callable[[int], Outcome]:
        """Open the result and a window, and return what makes and writes the picture of a frame."""
        setup = set_up(open_result(self.source), self.settings)
        renderer = PictureRenderer(setup)

        def make(k: int) -> Outcome:
            outcomes: list[Outcome] = []
            picture = renderer.picture([k], lambda _, outcome: outcomes.append(outcome))
            write_picture(self.plan[k].path, picture, self.plan[k].digest)
            return outcomes[0]

        return make


class PictureRenderer:
    """A painter at work: whole pictures of frames, read one at a time."""

    def __init__(self, setup: RenderSetup) -> None:
        choose_window()
        self._setup = setup
        self._painter: Painter = setup.painter()

    def picture(self, ks: Sequence[int], watch: Callable[[int, Outcome], None] = lambda k, outcome: None) -> np.ndarray:
        """Return the picture of a frame, or the montage of several, (h, w, 3) uint8.

        Args:
            watch: told of each frame that has been drawn, and what came up in it.
        """
        setup, drawn, times, missing = self._setup, [], [], 0
        for k in ks:
            frame = setup.result.frame(k, self._painter.fields)
            drawn.append(self._painter.draw(frame))
            times.append(frame.time)
            outcome = Outcome(self._missing(frame), int((~np.isfinite(frame.position).all(axis=1)).sum()))
            missing += outcome.missing
            watch(k, outcome)
        return setup.layout.compose(drawn, setup.view, times, missing)

    def _missing(self, frame: Frame) -> int:
        colors = self._setup.colors
        if not isinstance(colors, Coloring) or self._setup.settings.mode == "density":
            return 0
        return int((~np.isfinite(colors.values(frame))).sum())


def picture_digest(result: Result, settings: Settings, ks: Sequence[int]) -> str:
    """Return a digest of what a picture of some frames depends on.

    The ledger's row stands for the particles: it holds their energies and momenta to the last bit. How a time is
    written hangs on other frames.
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
    """Say which pictures are to be made; those that are there and still right are not made again.

    Args:
        path_of: where the picture of a frame goes, by its position in the result.
        overwrite: make all of them again, in place of whatever is there.

    Raises:
        InputError: something that mpmcli did not make is in the way.
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
    """Say whether a file with this digest, from `digest_of`, is not one of these pictures; nor is that of a ledger."""
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
    """Make the pictures of a plan that are not there yet.

    Args:
        source: path of the result; settings: as `set_up` has filled them in.
        workers, watch, stop: see `render_frames`.

    Raises:
        InputError: nothing draws on this machine, or a place cannot be written to.
        RunError: a process crashed, or the disk is full.
        KeyboardInterrupt: `stop` said so.
    """
    due = {planned.k: planned for planned in plan if not planned.made}
    if due:
        # Found out once, and handed down.
        choose_window()
        render_frames(PictureJob(source, settings, due), list(due), workers, watch=watch, stop=stop)


def picture_name(mode: str, number: int) -> str:
    """Return the name of the file of a frame with this number."""
    return f"{mode}_{number:06d}.png"

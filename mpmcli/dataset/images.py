"""Images for training beside the shards of a dataset: `images/000007/<camera>/depth_000000.npz`, and their checksums.

The images of a trajectory are drawn from its shard. They are complete when its directory has checksums.sha256.
"""

import re
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mpmcli.dataset.draw import draw
from mpmcli.dataset.folder import Row
from mpmcli.dataset.shard import IMAGES, group_name
from mpmcli.dataset.sweep import Sweep
from mpmcli.output.checksums import SUMS, path_digest, sums_faults, sums_text
from mpmcli.output.durable import remove_numbered, write_text, writing
from mpmcli.render.frame_choice import frames_in
from mpmcli.scene import Scene
from mpmcli.scene.material import Laws

# The names of images and of what describes them, whole or not; and of those that a killed process has left.
NAMES = re.compile(r"([a-z]+_\d{6,}\.(png|npz)|cameras\.json|transforms\.json|checksums\.sha256)(\.[0-9a-f]{8})?")
LEFT = re.compile(r".*\.(png|npz|json)\.[0-9a-f]{8}")


def images_plan(sweep: Sweep) -> dict[str, Any] | None:
    """Return all that the images of a sweep depend on besides its trajectories, for JSON; None without [images]."""
    return sweep.images and {**sweep.images.model_dump(mode="json"), "tables": sweep.cameras}


def image_frames(sweep: Sweep, scene: Scene) -> list[int]:
    """Return the numbers of the frames of a trajectory that have images; InputError: there is none."""
    numbers = range(scene.time.frames + 1)
    return frames_in(sweep.images.frames, list(numbers), f"trajectories have frames 0 to {numbers[-1]}", "")


def draw_images(directory: Path, row: Row, sweep: Sweep) -> None:
    """Write the missing images of a trajectory in a shard, all of them if some have changed; RunError: it failed."""
    from mpmcli.dataset.dataset import StoredTrajectory
    from mpmcli.dataset.trajectory_frames import TrajectoryFrames
    from mpmcli.render.camera_images import image_request
    from mpmcli.render.request import Request

    trajectory, place = StoredTrajectory(directory / row.file, row.number), directory / IMAGES / group_name(row.number)
    frames = [(trajectory, k) for k in range(trajectory.frame_count)]
    result = TrajectoryFrames(directory, frames, trajectory.frames.tolist())
    for folder in (place, *place.glob("*/")):
        remove_numbered(folder, LEFT)
    asked = sweep.images
    request = Request(mode=asked.mode, frames=asked.frames, output=place, overwrite=(place / SUMS).exists())
    image_request(result, request, sweep.cameras, ",".join(asked.what)).carry_out(1)
    files = [path for path in place.rglob("*.*") if NAMES.fullmatch(path.name) and path.name != SUMS]
    sums = {path.relative_to(place).as_posix(): path_digest(path) for path in files}
    with writing(place):
        write_text(place / SUMS, sums_text(sums))


def image_faults(directory: Path, rows: Iterable[Row]) -> dict[int, list[str]]:
    """Return a sentence for each fault of the images of included trajectories, by number; none if they are right."""
    again, faults = "mpmcli sweep --resume draws them", {}
    for row in (row for row in rows if row.accepted):
        place = directory / IMAGES / group_name(row.number)
        found = sums_faults(place)[1] if place.is_dir() else ["it has none."]
        faults |= {row.number: [f"images of trajectory {row.number}: {fault[:-1]}; {again}." for fault in found]}
    return {number: found for number, found in faults.items() if found}


def remove_images(directory: Path) -> None:
    """Remove the images of a dataset, and the directories that are empty then."""
    for place in (directory / IMAGES).glob("*/"):
        for folder in (*place.glob("*/"), place):
            remove_numbered(folder, NAMES)
    with suppress(OSError):
        (directory / IMAGES).rmdir()


@dataclass(frozen=True)
class ImageCost:
    """What the images of a frame take: bytes, and seconds of one worker; `notes` on the cameras."""

    bytes: float
    seconds: float
    notes: tuple[str, ...]


def image_cost(sweep: Sweep, laws: Laws) -> ImageCost:
    """Measure the images of the start of trajectory 0; InputError: they are impossible, or nothing can be drawn here.

    A start has no flow, which takes the space of a depth.
    """
    from mpmcli.render.camera_images import image_request
    from mpmcli.render.render_scene import result_of_start
    from mpmcli.render.request import Request

    asked, taken = sweep.images, 0.0
    what = dict.fromkeys("depth" if name == "flow" else name for name in asked.what)
    with result_of_start(draw(sweep, 0).scene(laws).scene) as (start, _), TemporaryDirectory() as directory:
        request = Request(mode=asked.mode, output=Path(directory), overwrite=True)
        plan = image_request(start, request, sweep.cameras, ",".join(what))
        # The first time libraries are loaded.
        for _ in range(2):
            began = time.perf_counter()
            plan.carry_out(1)
            taken = time.perf_counter() - began
        sizes = {name: sum(path.stat().st_size for path in Path(directory).glob(f"*/{name}_*")) for name in what}
    return ImageCost(sum(sizes["depth" if name == "flow" else name] for name in asked.what), taken, plan.notes)

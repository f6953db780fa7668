"""Draws the images for training of trajectories, from their shards, and measures what those of a sweep take."""

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from mpmcli.dataset.draw import draw
from mpmcli.dataset.folder import Row
from mpmcli.dataset.image_folder import LEFT, NAMES
from mpmcli.dataset.shard import IMAGES, group_name
from mpmcli.dataset.sweep import Sweep
from mpmcli.output.checksums import SUMS, path_digest, sums_text
from mpmcli.output.durable import remove_numbered, write_text, writing
from mpmcli.scene.material import Laws


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
    from mpmcli.render.camera_images import ImageJob, image_request
    from mpmcli.render.render_scene import result_of_start
    from mpmcli.render.request import Request
    from mpmcli.render.window import choose_window

    choose_window()
    asked, taken = sweep.images, 0.0
    what = dict.fromkeys("depth" if name == "flow" else name for name in asked.what)
    with result_of_start(draw(sweep, 0).scene(laws).scene) as (start, _), TemporaryDirectory() as directory:
        request = Request(mode=asked.mode, output=Path(directory), overwrite=True)
        plan = image_request(start, request, sweep.cameras, ",".join(what))
        write = ImageJob(start, plan.asked, plan.directory).start()
        # The first time libraries are loaded, and windows opened.
        for _ in range(2):
            began = time.perf_counter()
            write(0)
            taken = time.perf_counter() - began
        sizes = {name: sum(path.stat().st_size for path in Path(directory).glob(f"*/{name}_*")) for name in what}
    return ImageCost(sum(sizes["depth" if name == "flow" else name] for name in asked.what), taken, plan.notes)

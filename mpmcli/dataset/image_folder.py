"""Images for training beside the shards of a dataset: `images/000007/<camera>/depth_000000.npz`, and their checksums.

The images of a trajectory are complete when its directory has checksums.sha256.
"""

import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from mpmcli.dataset.folder import Row
from mpmcli.dataset.shard import IMAGES, group_name
from mpmcli.dataset.sweep import Sweep
from mpmcli.output.checksums import sums_faults
from mpmcli.output.durable import remove_numbered
from mpmcli.render.frame_choice import frames_in
from mpmcli.scene import Scene

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

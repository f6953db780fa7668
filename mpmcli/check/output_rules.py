"""Rules on output: number of frames, disk space, memory."""

import shutil
from collections.abc import Iterator
from pathlib import Path

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.forecast import Forecast
from mpmcli.errors import InputError
from mpmcli.output.durable import largest_file
from mpmcli.plain_text import size_text
from mpmcli.solver.plan import Plan, require_room

# During a run each frame is a file; more than this take hours to write.
MOST_FRAMES = 100_000
# While the frames are packed, two copies are on the disk.
COPIES = 2


def output_findings(facts: SceneFacts, plan: Plan, forecast: Forecast, directory: Path) -> Iterator[Finding]:
    """Yield the findings on frames, disk and memory; `directory` is where results would be written."""
    scene = facts.scene
    if facts.interval < facts.step_at_start:
        yield Finding(
            "note",
            "frames",
            f"Frames are {facts.interval:.3g} s apart, less than the stable step of {facts.step_at_start:.3g} s: every "
            "step is stored, and steps are shorter than they need be.",
            f"Set time.frames to {max(1, int(scene.time.end / facts.step_at_start))} or fewer.",
            facts.interval,
        )
    if scene.time.frames > MOST_FRAMES:
        yield Finding(
            "warning",
            "frames",
            f"The run stores {forecast.frames:,} frames, each a file while it goes on.",
            f"Set time.frames to {MOST_FRAMES:,} or fewer.",
            forecast.frames,
        )
    # The directory need not exist yet.
    place = next(place for place in (directory.absolute(), *directory.absolute().parents) if place.exists())
    disk = shutil.disk_usage(place)
    # File systems without a disk, such as /proc, have no size.
    if COPIES * forecast.file_bytes > disk.free and disk.total > 0:
        yield Finding(
            "warning",
            "disk",
            f"The result takes {size_text(forecast.file_bytes)}, twice that while it is packed, and the disk has "
            f"{size_text(disk.free)} left.",
            "Store fewer frames or output.fields, or write to another disk with -o.",
            forecast.file_bytes,
        )
    largest = largest_file()
    if largest is not None and forecast.file_bytes > largest:
        yield Finding(
            "warning",
            "disk",
            f"The result takes {size_text(forecast.file_bytes)}, and a file may have {size_text(largest)} here.",
            "Raise the limit on the size of a file (ulimit -f), or store fewer frames or output.fields.",
            forecast.file_bytes,
        )
    try:
        require_room(plan)
    except InputError as error:
        what, _, fix = str(error).rstrip(".").rpartition("; ")
        total = plan.device_bytes + plan.host_bytes
        yield Finding("error", "memory", f"{what[:1].upper()}{what[1:]}.", f"{fix[:1].upper()}{fix[1:]}.", total)
    if facts.bounds.speed == 0 and facts.bounds.gravity == 0:
        yield Finding(
            "note",
            "at-rest",
            "Nothing moves: there is no gravity, and no body has a velocity.",
            "Give domain.gravity, or a velocity to a body.",
        )

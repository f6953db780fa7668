"""Names of the files that frames are in: segments while a run goes on, and one packed file at its end."""

import re
from pathlib import Path

from mpmcli.output.durable import numbered_files, remove_numbered

PACKED = "particles.vtkhdf"
# A damaged one is kept by this name until it has been computed again.
DAMAGED = "particles.vtkhdf.damaged"
SEGMENTS = "segments"
SEGMENT_NAME = re.compile(r"frame_\d{6,}\.vtkhdf")


def segment_name(index: int) -> str:
    """Return the file name of the segment whose first frame has this number."""
    return f"frame_{index:06d}.vtkhdf"


def sealed_segments(directory: Path) -> list[Path]:
    """Return the sealed segments of a run that was not packed, in order, without unfinished files."""
    return numbered_files(directory / SEGMENTS, SEGMENT_NAME)


def remove_segments(directory: Path) -> None:
    """Remove sealed and unfinished segments, and their folder unless something else lies in it."""
    remove_numbered(directory / SEGMENTS, SEGMENT_NAME)

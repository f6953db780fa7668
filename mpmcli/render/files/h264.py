"""H.264 in an .mp4, by the ffmpeg that imageio-ffmpeg provides."""

import errno
import os
import signal
import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import IO

import numpy as np

from mpmcli.errors import InputError, RunError

# Constant rate factor of H.264: 18 is visually near-lossless, 23 is ffmpeg's default.
QUALITY = 18
# Three times as fast as "medium", for visually equal films of the same size.
PRESET = "veryfast"
# Fixed, since the bytes of a film depend on the number of threads.
THREADS = 2
# Exit statuses of ffmpeg that stand for a full disk, with the errors.
FULL_STATUS = {256 - number: number for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)}
if hasattr(signal, "SIGXFSZ"):
    FULL_STATUS[-signal.SIGXFSZ] = errno.EFBIG
# Lines of ffmpeg's stderr that are quoted on failure.
LAST_WORDS = 2
# Players assume BT.709 for large pictures, while ffmpeg writes BT.601 by default.
COLOURS = (
    "scale=out_range=tv:out_color_matrix=bt709:flags=accurate_rnd+full_chroma_int+bicubic,"
    "setparams=range=tv:colorspace=bt709:color_primaries=bt709:color_trc=bt709"
)


def write_h264(images: Iterable[np.ndarray], place: Path, name: Path, fps: float) -> None:
    """Write pictures, one at a time, as a film.

    Args:
        images: (h, w, 3) uint8, all of one size; at least one.
        place: the file to write; name: what it is called in errors.
        fps: frames per second.

    Raises:
        InputError: there is no ffmpeg.
        RunError: ffmpeg failed.
        OSError: the disk is full.
    """
    program = _ffmpeg()
    process: subprocess.Popen[bytes] | None = None
    with tempfile.TemporaryFile() as said:
        try:
            for image in images:
                image = _even(image)
                if process is None:
                    process = _started(program, image.shape[1], image.shape[0], place, fps, said)
                assert process.stdin is not None
                try:
                    process.stdin.write(np.ascontiguousarray(image))
                except OSError:
                    break  # ffmpeg has ended; its stderr gives the reason
            if process is not None:
                _finish(process, said, name)
        finally:
            if process is not None:
                process.kill()
                process.wait()
                _close(process)


def _ffmpeg() -> str:
    import imageio_ffmpeg

    try:
        return imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise InputError(
            "There is no ffmpeg for an .mp4: install imageio-ffmpeg or ffmpeg, or name its program in "
            "IMAGEIO_FFMPEG_EXE; a .gif needs none."
        ) from error


def _started(program: str, width: int, height: int, place: Path, fps: float, said: IO[bytes]) -> subprocess.Popen:
    rate = str(Fraction(fps).limit_denominator(100_000))
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", rate, "-i", "pipe:0"]
    codec = ["-c:v", "libx264", "-preset", PRESET, "-crf", str(QUALITY), "-pix_fmt", "yuv420p"]
    # No time, no version: the same pictures are the same bytes.
    exact = ["-threads", str(THREADS), "-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact"]
    out = ["-movflags", "+faststart", "-f", "mp4", f"file:{place}"]
    try:
        return subprocess.Popen(
            [program, "-y", "-v", "error", "-nostdin", *raw, "-vf", COLOURS, *codec, *exact, *out],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=said,
            # Ctrl-C at the terminal reaches only this process, which then ends ffmpeg.
            start_new_session=True,
        )
    except OSError as error:
        raise RunError(f"ffmpeg could not be started ({error.strerror}): is {program} the program?") from error


def _finish(process: subprocess.Popen, said: IO[bytes], name: Path) -> None:
    _close(process)
    status = process.wait()
    if status != 0:
        said.seek(0)
        if status in FULL_STATUS:
            raise OSError(FULL_STATUS[status], os.strerror(FULL_STATUS[status]))
        words = " ".join(said.read().decode("utf-8", errors="replace").split("\n")[-LAST_WORDS - 1 :]).strip()
        how = f"it was ended by signal {-status}" if status < 0 else f"its status is {status}"
        raise RunError(
            f"ffmpeg failed to write {name}, {how}: {words.rstrip('.') or 'it said nothing'}; mpmcli doctor tries it."
        )


def _close(process: subprocess.Popen) -> None:
    assert process.stdin is not None
    # The process may have ended.
    with suppress(OSError):
        process.stdin.close()


def _even(image: np.ndarray) -> np.ndarray:
    """Repeat the last row or column where their number is odd: colours are stored for 2x2 pixels."""
    height, width = image.shape[:2]
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")

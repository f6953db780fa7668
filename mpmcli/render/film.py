"""Films of pictures: H.264 in .mp4 by the ffmpeg that imageio-ffmpeg provides, and animated .gif."""

import errno
import math
import os
import signal
import struct
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING

import numpy as np

from mpmcli.errors import InputError, RunError
from mpmcli.output.durable import sealed
from mpmcli.render.frame_choice import evenly_spaced
from mpmcli.render.picture_file import write_fault

if TYPE_CHECKING:
    from PIL.Image import Image

FPS_MIN, FPS_MAX = 0.01, 1000.0  # frames per second, least and most
FEW = 12  # number of pictures from which the palette of a gif is computed
KEYWORD = b"mpmcli"  # marks the digest at the end of a film
SKIPPED = b"free"  # type of the box that players of .mp4 skip
DIGEST_MAX = 64
GIF_FPS_MAX = 50  # browsers slow down faster films
# Colours of the palette; the last index marks pixels unchanged since the previous picture.
COLOURS, UNCHANGED = 255, 255
BITS = 6  # bits of each channel in the histogram of colours
CHOOSING = 200_000  # number of pixels from which the palette is computed
QUALITY = 18  # constant rate factor of H.264: 18 is visually near-lossless, 23 is ffmpeg's default
PRESET = "veryfast"  # three times as fast as "medium", for visually equal films of the same size
THREADS = 2  # fixed, since the bytes of a film depend on the number of threads
# Exit statuses of ffmpeg that stand for a full disk, with the errors.
FULL_STATUS = {256 - number: number for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)}
if hasattr(signal, "SIGXFSZ"):
    FULL_STATUS[-signal.SIGXFSZ] = errno.EFBIG
LAST_WORDS = 2  # lines of ffmpeg's stderr that are quoted on failure
# Players assume BT.709 for large pictures, while ffmpeg writes BT.601 by default.
BT709 = (
    "scale=out_range=tv:out_color_matrix=bt709:flags=accurate_rnd+full_chroma_int+bicubic,"
    "setparams=range=tv:colorspace=bt709:color_primaries=bt709:color_trc=bt709"
)


def check_film(path: Path, fps: float) -> None:
    """Raise InputError for a file that is neither .mp4 nor .gif, or for a rate out of range."""
    if path.suffix.lower() not in (".mp4", ".gif"):
        raise InputError(f"{path} would be no film: give a name that ends in .mp4 or .gif.")
    if not (math.isfinite(fps) and FPS_MIN <= fps <= FPS_MAX):
        raise InputError(f"{fps:g} frames per second are not possible: give {FPS_MIN:g} to {FPS_MAX:g}.")
    if path.suffix.lower() == ".gif" and fps > GIF_FPS_MAX:
        raise InputError(
            f"{path} cannot show {fps:g} frames per second, as a gif has {GIF_FPS_MAX} at most: give fewer, or an .mp4."
        )


def write_film(
    pictures: Sequence[Path],
    path: Path,
    fps: float,
    *,
    digest: str = "",
    watch: Callable[[int], None] = lambda done: None,
) -> None:
    """Write a film, whole or not at all, in place of what is there; the same pictures give the same bytes.

    An .mp4 is H.264 in yuv420p, the colours of BT.709, which every player shows; a picture of odd width or height
    gets one more column or row like its last. A .gif repeats for ever and has 255 colours, chosen for the whole film;
    its frames last whole hundredths of a second, such that each begins within half of one of its time and the film
    lasts as long as it should. Only a few pictures, all of one size, are in memory at a time.

    The `digest` is one of `settings_digest`; `watch` is called after each picture with the number of pictures read.
    """
    check_film(path, fps)
    if not pictures:
        raise InputError("A film needs at least one picture, and there is none.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with sealed(path) as temporary:
            if path.suffix.lower() == ".mp4":
                write_h264(_images(pictures, watch), temporary, path, fps)
            else:
                few = [_image(pictures[k]) for k in evenly_spaced(range(len(pictures)), FEW)]
                write_gif(few, _images(pictures, watch), temporary, fps)
            with temporary.open("ab") as file:
                file.write(_end(digest))
    except OSError as error:
        raise write_fault(path, error) from error


def film_digest(path: Path) -> str | None:
    """Return the digest in a film; "" where mpmcli did not make the file, None where none is."""
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(-min(file.tell(), len(_end("")) + DIGEST_MAX), os.SEEK_CUR)
            _, found, digest = file.read().rpartition(SKIPPED + KEYWORD)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError:
        return ""
    return digest.decode("ascii", errors="replace") if found else ""


def _end(digest: str) -> bytes:
    """Return what follows the film: a box that players of .mp4 skip; those of gif do not read beyond its end."""
    content = KEYWORD + digest.encode("ascii")
    return struct.pack(">I", 8 + len(content)) + SKIPPED + content


def _images(pictures: Sequence[Path], watch: Callable[[int], None]) -> Iterator[np.ndarray]:
    """Yield the pictures as arrays of one size."""
    size = None
    for done, picture in enumerate(pictures, start=1):
        image = _image(picture)
        size = size or image.shape[:2]
        if image.shape[:2] != size:
            raise InputError(
                f"{picture} is {image.shape[1]}x{image.shape[0]} and those before it "
                f"{size[1]}x{size[0]}: a film needs pictures of one size."
            )
        yield image
        watch(done)


def _image(picture: Path) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(picture) as image:
            return np.asarray(image.convert("RGB"))
    # A damaged file makes Pillow raise a SyntaxError too.
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"{picture} cannot be read as a picture: make it anew with --overwrite.") from error


def write_gif(few: Sequence[np.ndarray], images: Iterable[np.ndarray], place: Path, fps: float) -> None:
    """Write pictures (h, w, 3), one at a time, as a gif that repeats for ever and has the colours of a few of them.

    One palette serves the whole film, and of each picture only what has changed is written. Frame k begins at the
    hundredth of a second next to k / fps. Pillow's `save_all` keeps every frame in memory (254 MB for 151 frames of
    1280x720, against 135 MB here), takes 9.8 s against 5.2 s, and merges equal frames.
    """
    from PIL import Image

    palette = _palette(few)
    before = None
    with place.open("wb") as file:
        for k, image in enumerate(images):
            shown = np.asarray(Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE))
            if before is None:
                file.write(_header(shown, palette))
            hundredths = round((k + 1) * 100 / fps) - round(k * 100 / fps)
            file.writelines(_changes(shown, before, 10 * hundredths))
            before = shown
        file.write(b";")


def _palette(few: Sequence[np.ndarray]) -> "Image":
    """Return an image with the colours of the film, by the root of their frequency: no ground dominates."""
    from PIL import Image

    size = 1 << (3 * BITS)
    count, total = np.zeros(size), np.zeros((3, size))
    for image in few:
        pixels = image.reshape(-1, 3)
        r, g, b = (pixels >> (8 - BITS)).astype(np.int32).T
        place = (r << (2 * BITS)) | (g << BITS) | b
        count += np.bincount(place, minlength=size)
        for channel in range(3):
            total[channel] += np.bincount(place, weights=pixels[:, channel], minlength=size)
    seen = count > 0
    means = np.rint(total[:, seen] / count[seen]).astype(np.uint8).T
    weight = np.sqrt(count[seen])
    times = np.maximum(1, np.rint(weight * CHOOSING / weight.sum())).astype(int)
    chosen = Image.fromarray(np.repeat(means, times, axis=0)[None])
    return chosen.quantize(COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)


def _header(shown: np.ndarray, palette: "Image") -> bytes:
    """Return signature, size, 256 colours and the extension that repeats the film (GIF89a specification, 17 to 19)."""
    height, width = shown.shape
    colours = bytes(palette.getpalette() or [])[: 3 * COLOURS].ljust(3 * 256, b"\x00")
    forever = b"!\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"
    return b"GIF89a" + struct.pack("<HHBBB", width, height, 0xF7, 0, 0) + colours + forever


def _changes(shown: np.ndarray, before: np.ndarray | None, milliseconds: int) -> list[bytes]:
    """Return the block of a picture: the box in which it differs from the one before, and only what differs there."""
    from PIL import GifImagePlugin, Image

    if before is None:
        return GifImagePlugin.getdata(Image.fromarray(shown), duration=milliseconds, disposal=1)
    changed = shown != before
    rows, columns = (np.flatnonzero(changed.any(axis)) for axis in (1, 0))
    box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)) if len(rows) else (slice(1), slice(1))
    part = np.where(changed, shown, np.uint8(UNCHANGED))[box]
    offset = (int(box[1].start or 0), int(box[0].start or 0))
    keywords = {"duration": milliseconds, "disposal": 1, "transparency": UNCHANGED}
    return GifImagePlugin.getdata(Image.fromarray(part), offset, **keywords)


def write_h264(images: Iterable[np.ndarray], place: Path, name: Path, fps: float) -> None:
    """Write pictures (h, w, 3), one at a time, as a film to a place; errors call it by its name."""
    program = _ffmpeg()
    process: subprocess.Popen[bytes] | None = None
    with TemporaryFile() as messages:
        try:
            for image in images:
                # The last row or column is repeated where their number is odd: colours are stored for 2x2 pixels.
                height, width = image.shape[:2]
                image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                if process is None:
                    process = _started(program, image.shape[1], image.shape[0], place, fps, messages)
                assert process.stdin is not None
                try:
                    process.stdin.write(np.ascontiguousarray(image))
                except OSError:
                    break  # ffmpeg has ended; its stderr gives the reason
            if process is not None:
                _finish(process, messages, name)
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


def _started(program: str, width: int, height: int, place: Path, fps: float, messages: IO[bytes]) -> subprocess.Popen:
    rate = str(Fraction(fps).limit_denominator(100_000))
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", rate, "-i", "pipe:0"]
    codec = ["-c:v", "libx264", "-preset", PRESET, "-crf", str(QUALITY), "-pix_fmt", "yuv420p"]
    # No time, no version: the same pictures are the same bytes.
    exact = ["-threads", str(THREADS), "-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact"]
    out = ["-movflags", "+faststart", "-f", "mp4", f"file:{place}"]
    try:
        return subprocess.Popen(
            [program, "-y", "-v", "error", "-nostdin", *raw, "-vf", BT709, *codec, *exact, *out],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=messages,
            # Ctrl-C at the terminal reaches only this process, which then ends ffmpeg.
            start_new_session=True,
        )
    except OSError as error:
        raise RunError(f"ffmpeg could not be started ({error.strerror}): is {program} the program?") from error


def _finish(process: subprocess.Popen, messages: IO[bytes], name: Path) -> None:
    _close(process)
    status = process.wait()
    if status != 0:
        messages.seek(0)
        if status in FULL_STATUS:
            raise OSError(FULL_STATUS[status], os.strerror(FULL_STATUS[status]))
        words = " ".join(messages.read().decode("utf-8", errors="replace").split("\n")[-LAST_WORDS - 1 :]).strip()
        how = f"it was ended by signal {-status}" if status < 0 else f"its status is {status}"
        raise RunError(
            f"ffmpeg failed to write {name}, {how}: {words.rstrip('.') or 'it said nothing'}; mpmcli doctor tries it."
        )


def _close(process: subprocess.Popen) -> None:
    assert process.stdin is not None
    # The process may have ended.
    with suppress(OSError):
        process.stdin.close()

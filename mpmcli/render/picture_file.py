"""Files of pictures, with a digest of their settings: PNG, and films by the ffmpeg that imageio-ffmpeg provides.

Films are H.264 in .mp4, and animated .gif.
"""

import errno
import hashlib
import json
import math
import os
import signal
import struct
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any

import numpy as np

from mpmcli import __version__
from mpmcli.errors import InputError, MpmcliError, RunError
from mpmcli.output.durable import sealed
from mpmcli.render.frame_choice import evenly_spaced

KEYWORD = "mpmcli"  # of the tEXt chunk that holds the digest, and before the digest at the end of a film
# 1280x720 dots: level 0 takes 11 ms for 2.8 MB, 1 18 ms for 228 kB, 4 22 ms for 207 kB, 9 300 ms for 200 kB.
COMPRESS_LEVEL = 1
DISK_FAULTS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}  # errors of the disk rather than of the request
FPS_MIN, FPS_MAX = 0.01, 1000.0  # frames per second, least and most
FEW = 12  # number of pictures from which the palette of a gif is computed
SKIPPED = b"free"  # type of the box that players of .mp4 skip
DIGEST_MAX = 64
GIF_FPS_MAX = 50  # browsers slow down faster films
COLOURS = 255  # of the palette, besides the one that marks pixels unchanged since the previous picture
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


def settings_digest(settings: dict[str, Any]) -> str:
    """Return a digest of the settings of a picture and of the version of mpmcli, 32 hexadecimal digits.

    They contain JSON values and numpy numbers and arrays, which count to the last digit; the order of keys is
    irrelevant.
    """

    def plain(value: Any) -> Any:
        if hasattr(value, "tolist"):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} cannot be part of the settings of a picture")

    content = {"version": __version__, "settings": settings}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), default=plain)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def write_picture(path: Path, image: np.ndarray, digest: str) -> None:
    """Write a PNG of (h, w, 3) uint8 atomically, replacing an existing file; a missing directory is created.

    The digest is from `settings_digest`; `digest_of` reads it back. InputError for the place, RunError for a full disk.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    text.add_text(KEYWORD, digest)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with sealed(path, unique=True) as temporary:
            Image.fromarray(image).save(temporary, format="png", compress_level=COMPRESS_LEVEL, pnginfo=text)
    except OSError as error:
        raise write_fault(path, error) from error


def digest_of(path: Path) -> str | None:
    """Return the digest in a picture; "" if the file is incomplete or not of mpmcli, None if there is no file."""
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG"]) as image:
            image.verify()
            return image.info.get(KEYWORD, "")
    except (FileNotFoundError, NotADirectoryError):
        return None
    # Pillow raises almost any exception at a damaged or huge file.
    except Exception:
        return ""


def require_writable(path: Path) -> None:
    """Raise InputError if a file cannot be created, without creating it."""
    directory = path.parent
    while not directory.exists() and directory != directory.parent:
        directory = directory.parent
    if path.is_dir():
        raise InputError(f"{path} is a directory, and a file is to be written: give another place.")
    if not directory.is_dir() or not os.access(directory, os.W_OK | os.X_OK):
        what = "is not a directory" if not directory.is_dir() else "does not let files be made in it"
        raise InputError(f"{path} cannot be written, as {directory} {what}: give another place.")


def write_fault(path: Path, error: OSError) -> MpmcliError:
    """Return the exception for a failed write: RunError for a fault of the disk, else InputError."""
    reason = error.strerror or str(error)
    if isinstance(error, FileExistsError | NotADirectoryError):
        reason = f"{path.parent} is no directory"
    if error.errno in DISK_FAULTS:
        return RunError(f"{path} could not be written ({reason}): free some space or write to another disk with -o.")
    return InputError(f"{path} cannot be written ({reason}): give another place with -o.")


def check_film(path: Path, fps: float) -> None:
    """Raise InputError for a file that is neither .mp4 nor .gif, or for a rate out of range."""
    if path.suffix.lower() not in (".mp4", ".gif"):
        raise InputError(f"{path} cannot be a film: give a name that ends in .mp4 or .gif.")
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
    """Write a film of PNG files atomically, replacing an existing file; the same files give the same bytes.

    An .mp4 is H.264 in yuv420p, the colours of BT.709, which every player shows; a picture of odd width or height gets
    one more column or row like its last. A .gif repeats for ever and has 255 colours, chosen for the whole film; its
    frames last whole hundredths of a second, and each begins within half a hundredth of its time.

    The `digest` is one of `settings_digest`; `watch` is called after each picture with the number of pictures read.
    """
    check_film(path, fps)
    if not pictures:
        raise InputError("A film needs at least one picture, and there is none.")
    width, height = _checked(pictures[0], None)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with sealed(path, unique=True) as temporary, TemporaryDirectory() as directory:
            if path.suffix.lower() == ".mp4":
                # Colours are stored for 2x2 pixels.
                even = f"pad=iw+{width % 2}:ih+{height % 2},fillborders=right={width % 2}:bottom={height % 2},{BT709}"
                form = ["-vf", even, "-c:v", "libx264", "-preset", PRESET, "-crf", str(QUALITY), "-pix_fmt", "yuv420p"]
                form += ["-movflags", "+faststart", "-f", "mp4"]
            else:
                palette = Path(directory) / "palette.png"
                _write_palette(evenly_spaced(pictures, FEW), palette)
                form = ["-i", str(palette), "-lavfi", "paletteuse=dither=none", "-f", "gif"]
            _encode(_contents(pictures, (width, height), watch), form, temporary, path, fps)
            with temporary.open("ab") as file:
                file.write(_end(digest))
    except OSError as error:
        raise write_fault(path, error) from error


def film_digest(path: Path) -> str | None:
    """Return the digest in a film; "" if the file is not of mpmcli, None if there is no file."""
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(-min(file.tell(), len(_end("")) + DIGEST_MAX), os.SEEK_CUR)
            _, found, digest = file.read().rpartition(SKIPPED + KEYWORD.encode())
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError:
        return ""
    return digest.decode("ascii", errors="replace") if found else ""


def _end(digest: str) -> bytes:
    """Return the trailer of a film: a box that .mp4 players skip; .gif players do not read beyond the end."""
    content = KEYWORD.encode() + digest.encode("ascii")
    return struct.pack(">I", 8 + len(content)) + SKIPPED + content


def _contents(pictures: Sequence[Path], size: tuple[int, int], watch: Callable[[int], None]) -> Iterator[bytes]:
    """Yield the files of pictures of one size."""
    for done, picture in enumerate(pictures, start=1):
        _checked(picture, size)
        yield picture.read_bytes()
        watch(done)


def _checked(picture: Path, size: tuple[int, int] | None) -> tuple[int, int]:
    """Return width and height of a picture; InputError: they are not `size`, or the file is damaged."""
    from PIL import Image

    try:
        with Image.open(picture, formats=["PNG"]) as image:
            image.verify()
    # Pillow may also raise a SyntaxError at a damaged file.
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"{picture} cannot be read as a picture: make it anew with --overwrite.") from error
    if size not in (None, image.size):
        raise InputError(
            f"{picture} is {image.size[0]}x{image.size[1]} and those before it {size[0]}x{size[1]}: a film needs "
            "pictures of one size."
        )
    return image.size


def _write_palette(few: Sequence[Path], path: Path) -> None:
    """Write a palette of a few pictures as a picture; colours are weighted by the square root of their frequency."""
    from PIL import Image

    for picture in few:
        _checked(picture, None)
    pixels = [np.asarray(Image.open(picture).convert("RGBA")).view(np.uint32).ravel() for picture in few]
    colors, counts = np.unique(np.concatenate(pixels), return_counts=True)
    chosen = np.repeat(colors, np.ceil(np.sqrt(counts)).astype(int)).view(np.uint8).reshape(1, -1, 4)
    image = Image.fromarray(chosen).convert("RGB").quantize(COLOURS, method=Image.Quantize.MEDIANCUT)
    # The last of the 256 colours for ffmpeg is transparent.
    table = np.resize(np.array(image.getpalette(), np.uint8).reshape(-1, 3), (256, 3))
    opaque = np.where(np.arange(256) < COLOURS, np.uint8(255), np.uint8(0))
    Image.fromarray(np.column_stack([table, opaque]).reshape(16, 16, 4)).save(path)


def _encode(contents: Iterator[bytes], form: Sequence[str], place: Path, name: Path, fps: float) -> None:
    """Write the contents of PNG files with ffmpeg, one at a time, to `place`; errors call it `name`."""
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise InputError(
            "There is no ffmpeg for films: install imageio-ffmpeg or ffmpeg, or name its program in IMAGEIO_FFMPEG_EXE."
        ) from error
    given = ["-f", "image2pipe", "-c:v", "png", "-r", str(Fraction(fps).limit_denominator(100_000)), "-i", "pipe:0"]
    # No time and no version, so that the same pictures give the same bytes.
    exact = ["-threads", str(THREADS), "-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact"]
    with TemporaryFile() as messages:
        try:
            process = subprocess.Popen(
                [program, "-y", "-v", "error", *given, *form, *exact, f"file:{place}"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=messages,
                # Ctrl-C at the terminal reaches only this process, which then ends ffmpeg.
                start_new_session=True,
            )
        except OSError as error:
            raise RunError(f"ffmpeg could not be started ({error.strerror}): is {program} the program?") from error
        try:
            # If ffmpeg has ended, its stderr has the reason.
            with suppress(BrokenPipeError):
                for content in contents:
                    process.stdin.write(content)
                process.stdin.close()
            status = process.wait()
        finally:
            process.kill()
            process.wait()
            with suppress(BrokenPipeError):
                process.stdin.close()
        messages.seek(0)
        words = " ".join(messages.read().decode("utf-8", errors="replace").split("\n")[-LAST_WORDS - 1 :]).strip()
    if status in FULL_STATUS:
        raise OSError(FULL_STATUS[status], os.strerror(FULL_STATUS[status]))
    if status != 0:
        how = f"it was ended by signal {-status}" if status < 0 else f"its status is {status}"
        raise RunError(
            f"ffmpeg failed to write {name}, {how}: {words.rstrip('.') or 'it gave no reason'}; mpmcli doctor tests it."
        )

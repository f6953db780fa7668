"""Films of pictures: H.264 in .mp4 by ffmpeg, and .gif."""

import math
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mpmcli.errors import InputError
from mpmcli.output.durable import sealed
from mpmcli.render.files.gif import FPS_MAX as GIF_FPS_MAX
from mpmcli.render.files.gif import write_gif
from mpmcli.render.files.h264 import write_h264
from mpmcli.render.files.picture_file import write_fault

Picture = Path | np.ndarray
# Frames per second, least and most.
FPS_MIN, FPS_MAX = 0.01, 1000.0
# Number of pictures from which the palette of a gif is computed.
FEW = 12
# Marks the digest at the end of a film; type of the box that players of .mp4 skip.
KEYWORD = b"mpmcli"
SKIPPED = b"free"
DIGEST_MAX = 64
NONE = "A film needs at least one picture, and there is none."


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
    pictures: Iterable[Picture],
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
    lasts as long as it should. Only a few pictures are in memory at a time.

    Args:
        pictures: files, or (h, w, 3) uint8, all of one size.
        path: its end says which kind: .mp4 or .gif.
        fps: frames per second.
        digest: from `settings_digest`, which `film_digest` reads back.
        watch: called after each picture with the number of pictures read.

    Raises:
        InputError: see `check_film`; there is no picture, one cannot be read or has another size, the place cannot be
            written to, or there is no ffmpeg.
        RunError: ffmpeg failed, or the disk is full.
    """
    check_film(path, fps)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with sealed(path) as temporary:
            if path.suffix.lower() == ".mp4":
                write_h264(_images(pictures, watch), temporary, path, fps)
            elif isinstance(pictures, Sequence):
                write_gif(_few(pictures), _images(pictures, watch), temporary, fps)
            else:
                with TemporaryDirectory() as folder:
                    kept = _kept(_images(pictures, watch), Path(folder))
                    write_gif(_few(kept), _images(kept), temporary, fps)
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


def _images(pictures: Iterable[Picture], watch: Callable[[int], None] = lambda done: None) -> Iterator[np.ndarray]:
    """Yield the pictures as arrays of one size."""
    size = None
    for done, picture in enumerate(pictures, start=1):
        image = _image(picture)
        size = size or image.shape[:2]
        if image.shape[:2] != size:
            raise InputError(
                f"{_name(picture, done - 1)} is {image.shape[1]}x{image.shape[0]} and those before it "
                f"{size[1]}x{size[0]}: a film needs pictures of one size."
            )
        yield image
        watch(done)
    if size is None:
        raise InputError(NONE)


def _image(picture: Picture) -> np.ndarray:
    if not isinstance(picture, Path):
        return picture
    from PIL import Image

    try:
        with Image.open(picture) as image:
            return np.asarray(image.convert("RGB"))
    # A damaged file makes Pillow raise a SyntaxError too.
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"{picture} cannot be read as a picture: make it anew with --overwrite.") from error


def _name(picture: Picture, k: int) -> str:
    return str(picture) if isinstance(picture, Path) else f"Picture {k}"


def _few(pictures: Sequence[Picture]) -> list[np.ndarray]:
    """Return some pictures from first to last, for the palette."""
    if not pictures:
        raise InputError(NONE)
    count = min(len(pictures), FEW)
    return [_image(pictures[round(k * (len(pictures) - 1) / max(count - 1, 1))]) for k in range(count)]


def _kept(images: Iterable[np.ndarray], folder: Path) -> list[Path]:
    """Save the pictures of an iterator on disk, since they are read twice."""
    from PIL import Image

    kept = []
    for k, image in enumerate(images):
        kept.append(folder / f"{k}.png")
        Image.fromarray(image).save(kept[-1], compress_level=1)
    return kept

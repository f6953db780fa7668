"""PNG files with a digest of their settings in a text chunk."""

import errno
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli import __version__
from mpmcli.errors import InputError, MpmcliError, RunError
from mpmcli.output.durable import sealed

KEYWORD = "mpmcli"  # keyword of the tEXt chunk that holds the digest
# 1280x720 dots: level 0 takes 11 ms for 2.8 MB, 1 18 ms for 228 kB, 4 22 ms for 207 kB, 9 300 ms for 200 kB.
COMPRESS_LEVEL = 1
DISK_FAULTS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}  # errors of the disk rather than of the request


def settings_digest(settings: dict[str, Any]) -> str:
    """Return a digest of the settings of a picture and of the version of mpmcli, 32 hexadecimal digits.

    They hold what JSON can, and numpy's numbers and arrays, which count to their last digit; keys may have any order.
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
        with sealed(path) as temporary:
            Image.fromarray(image).save(temporary, format="png", compress_level=COMPRESS_LEVEL, pnginfo=text)
    except OSError as error:
        raise write_fault(path, error) from error


def digest_of(path: Path) -> str | None:
    """Return the digest in a picture; "" where mpmcli did not make the file or it is not whole, None where none is."""
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG"]) as image:
            image.verify()
            return image.info.get(KEYWORD, "")
    except (FileNotFoundError, NotADirectoryError):
        return None
    # Of a damaged or a huge file Pillow raises almost anything.
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
    """Return the exception for a file that could not be written: RunError for a fault of the disk, else InputError."""
    reason = error.strerror or str(error)
    if isinstance(error, FileExistsError | NotADirectoryError):
        reason = f"{path.parent} is no directory"
    if error.errno in DISK_FAULTS:
        return RunError(f"{path} could not be written ({reason}): free some space or write to another disk with -o.")
    return InputError(f"{path} cannot be written ({reason}): give another place with -o.")

"""The settings of a picture, and the parsing of their texts."""

import math
import re
from dataclasses import dataclass
from typing import Literal

from mpmcli.errors import InputError

Mode = Literal["dots", "surface", "fluid", "density"]
MODES: tuple[Mode, ...] = ("dots", "surface", "fluid", "density")
Colliders = Literal["solid", "clear", "none"]
COLLIDERS: tuple[Colliders, ...] = ("solid", "clear", "none")
# Pixels along a side, and in all: more would not fit into the memory of a renderer.
SIDE_MIN, SIDE_MAX = 64, 16_384
PIXELS_MAX = 64_000_000
# Largest limit of colours and least distance between two, well within double precision; least distance relative to the
# limits, as closer ones round to the same number.
LIMIT_MAX, LIMIT_MIN, NARROWEST = 1e300, 1e-300, 1e-12
# Pictures in a montage, along each side.
GRID_MAX = 20


@dataclass(frozen=True)
class Settings:
    """Everything that a picture depends on, except the frame.

    Attributes:
        color: as `--color-by`; None for materials that look like what they are.
        size: of the whole picture, pixels, (width, height); None for a height that follows from the scene.
        limits: of the colours, None where they have none.
        cmap: colour map of matplotlib, None for the one that suits the values.
        grid: columns and rows of a montage, (1, 1) for a picture of one frame.
        colliders: how they are drawn; "clear": in 3D their far sides only, as containers are.
    """

    mode: Mode
    color: str | None
    size: tuple[int, int | None]
    camera: str = "iso"
    theme: str = "light"
    limits: tuple[float, float] | None = None
    cmap: str | None = None
    grid: tuple[int, int] = (1, 1)
    colliders: Colliders = "solid"


def parse_size(text: str) -> tuple[int, int | None]:
    """Read "1280x720", or "1280xauto" for a height that follows from the scene: None.

    Raises:
        InputError: it is no size, or an absurd one.
    """
    found = re.fullmatch(r"(\d{1,9})[xX](\d{1,9}|auto)", text.strip())
    if not found:
        raise InputError(f'--size "{text}" is no size: give width and height in pixels, such as 1280x720 or 1280xauto.')
    width, height = int(found[1]), None if found[2] == "auto" else int(found[2])
    require_possible(width, height or width, text)
    return width, height


def require_possible(width: int, height: int, text: str) -> None:
    """Raise InputError for a size that no picture can have; `text` is the option as given."""
    if not (min(width, height) >= SIDE_MIN and max(width, height) <= SIDE_MAX and width * height <= PIXELS_MAX):
        raise InputError(
            f"--size {text} is not possible: a side has {SIDE_MIN} to {SIDE_MAX} pixels, and a picture at most "
            f"{PIXELS_MAX // 1_000_000} million."
        )


def parse_grid(text: str) -> tuple[int, int]:
    """Read "3x2", columns and rows.

    Raises:
        InputError: it is no such thing.
    """
    found = re.fullmatch(r"(\d{1,9})[xX](\d{1,9})", text.strip())
    grid = (int(found[1]), int(found[2])) if found else None
    if grid is None or not (min(grid) >= 1 and max(grid) <= GRID_MAX):
        raise InputError(f'--montage "{text}" is not possible: give columns and rows, 1x1 to {GRID_MAX}x{GRID_MAX}.')
    return grid


def parse_limits(text: str) -> tuple[float, float]:
    """Read "0,2.5".

    Raises:
        InputError: it is no two finite numbers that rise.
    """
    words = text.split(",")
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 2 or not all(map(math.isfinite, numbers)) or not numbers[0] < numbers[1]:
        raise InputError(f'--clim "{text}" is no range: give the lower and the upper limit, such as 0,2.5.')
    low, high = numbers
    if max(-low, high) > LIMIT_MAX or not high - low >= max(LIMIT_MIN, NARROWEST * max(abs(low), abs(high))):
        raise InputError(f'--clim "{text}" is too wide or too narrow for colours: give limits such as 0,2.5.')
    return low, high

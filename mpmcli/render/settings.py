"""The settings of a picture, the parsing of their texts, and the light and the dark theme."""

import math
import re
from dataclasses import dataclass
from typing import Literal

from mpmcli.errors import InputError

Mode = Literal["dots", "surface", "fluid", "density"]
MODES: tuple[Mode, ...] = ("dots", "surface", "fluid", "density")
# What an image for training may hold, and the endings of its files; what they hold by default, and what cameras see.
What = Literal["rgb", "depth", "mask", "flow", "normal"]
WHAT: dict[What, str] = {"rgb": ".png", "depth": ".npz", "mask": ".png", "flow": ".npz", "normal": ".npz"}
USUAL_WHAT: tuple[What, ...] = ("rgb", "depth", "mask", "flow")
CameraMode = Literal["dots", "surface", "fluid"]
IMAGE_DIRECTORY = "cameras"  # of images for training, in the directory of a result
Colliders = Literal["auto", "solid", "clear", "none"]
COLLIDERS: tuple[Colliders, ...] = ("auto", "solid", "clear", "none")
# A place, m, a vector there relative to the longest of its kind, each (d,), and its magnitude with the unit.
Arrow = tuple[tuple[float, ...], tuple[float, ...], str]
ThemeName = Literal["light", "dark"]
# Limits of the pixels along a side, and in total, by the memory of a renderer.
SIDE_MIN, SIDE_MAX = 64, 16_384
PIXELS_MAX = 64_000_000
# Largest limit of colours and smallest distance between two, well within double precision; smallest distance relative
# to the limits, because closer ones round to the same number.
LIMIT_MAX, LIMIT_MIN, NARROWEST = 1e300, 1e-300, 1e-12
GRID_MAX = 20  # pictures in a montage, along each side


@dataclass(frozen=True)
class Settings:
    """Everything that a picture depends on, except the frame."""

    mode: Mode
    color: str | None  # as `--color-by`; None for the default of dots, and for natural colours of materials
    # Size of the whole picture, pixels; None for a size, or a height, that follows from the scene.
    size: tuple[int, int | None] | None
    camera: str = "iso"
    theme: str = "light"
    limits: tuple[float, float] | None = None  # limits of the colours, None if they have none
    cmap: str | None = None  # colour map of matplotlib, None for the one that suits the values
    grid: tuple[int, int] = (1, 1)  # columns and rows of a montage, (1, 1) for a picture of one frame
    # "clear": in 3D only their far sides are drawn, as for containers; "auto": hollow ones are cut open.
    colliders: Colliders = "auto"
    arrows: tuple[Arrow, ...] | None = None  # of the start of a scene, whose held parts are shown; None for a result


@dataclass(frozen=True)
class Theme:
    """The colours, "#rrggbb", of everything except particles."""

    name: ThemeName
    ground: str  # background of the picture, and behind the particles in 2D
    sky: str  # of the background of a 3D scene, above; `horizon` below
    horizon: str
    floor: str  # surface under shadows
    text: str  # titles and numbers; `faint`: secondary marks
    faint: str
    wall: str  # lines of the domain; `solid`: colliders
    solid: str
    missing: str = "#ff00c8"  # values that are not numbers


THEMES: dict[str, Theme] = {
    "light": Theme("light", "#ffffff", "#dfe8f2", "#ffffff", "#eceff3", "#1c2330", "#6b7482", "#3f4856", "#8e97a6"),
    "dark": Theme("dark", "#11141a", "#0d1016", "#232a36", "#1b2029", "#e8ebf1", "#8b94a4", "#aeb7c6", "#6d7686"),
}


def rgb_bytes(color: str) -> tuple[int, ...]:
    """Return "#rrggbb" as three numbers from 0 to 255."""
    return tuple(bytes.fromhex(color[1:]))


def rgb(color: str) -> tuple[float, ...]:
    """Return "#rrggbb" as three numbers from 0 to 1."""
    return tuple(part / 255.0 for part in rgb_bytes(color))


def lighter(color: str, share: float) -> str:
    """Return a colour "#rrggbb" mixed with the given fraction of white."""
    return "#" + bytes(round(part + share * (255 - part)) for part in rgb_bytes(color)).hex()


def parse_size(text: str) -> tuple[int, int | None]:
    """Read "1280x720", or "1280xauto" for a height that follows from the scene: None; InputError for anything else."""
    match = re.fullmatch(r"(\d{1,9})[xX](\d{1,9}|auto)", text.strip())
    if not match:
        raise InputError(f'--size "{text}" is not a size: give width and height, such as 1280x720 or 1280xauto.')
    width, height = int(match[1]), None if match[2] == "auto" else int(match[2])
    require_possible(width, height or width, text)
    return width, height


def require_possible(width: int, height: int, text: str) -> None:
    """Raise InputError for an impossible size of a picture; `text` is the option as given."""
    if not (min(width, height) >= SIDE_MIN and max(width, height) <= SIDE_MAX and width * height <= PIXELS_MAX):
        raise InputError(
            f"--size {text} is not possible: a side has {SIDE_MIN} to {SIDE_MAX} pixels, and a picture at most "
            f"{PIXELS_MAX // 1_000_000} million."
        )


def parse_grid(text: str) -> tuple[int, int]:
    """Read "3x2", columns and rows; InputError for anything else."""
    match = re.fullmatch(r"(\d{1,9})[xX](\d{1,9})", text.strip())
    grid = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (min(grid) >= 1 and max(grid) <= GRID_MAX):
        raise InputError(f'--montage "{text}" is not possible: give columns and rows, 1x1 to {GRID_MAX}x{GRID_MAX}.')
    return grid


def parse_limits(text: str) -> tuple[float, float]:
    """Read "0,2.5", two finite numbers that rise; raise InputError for anything else."""
    try:
        low, high = map(float, text.split(","))
    except ValueError:
        low = high = math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(f'--clim "{text}" is not a range: give the lower and the upper limit, such as 0,2.5.')
    if max(-low, high) > LIMIT_MAX or not high - low >= max(LIMIT_MIN, NARROWEST * max(abs(low), abs(high))):
        raise InputError(f'--clim "{text}" is too wide or too narrow for colours: give limits such as 0,2.5.')
    return low, high

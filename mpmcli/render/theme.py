"""The light and the dark theme: the colours of everything except particles."""

from dataclasses import dataclass
from typing import Literal

ThemeName = Literal["light", "dark"]


@dataclass(frozen=True)
class Theme:
    """Colours, "#rrggbb".

    Attributes:
        ground: background of the picture, and behind the particles in 2D.
        sky, horizon: of the background of a 3D scene, above and below.
        floor: what shadows fall on.
        text: titles and numbers; faint: secondary marks.
        wall: lines of the domain; solid: colliders.
        missing: values that are not numbers.
    """

    name: ThemeName
    ground: str
    sky: str
    horizon: str
    floor: str
    text: str
    faint: str
    wall: str
    solid: str
    missing: str = "#ff00c8"


THEMES: dict[str, Theme] = {
    "light": Theme("light", "#ffffff", "#dfe8f2", "#ffffff", "#eceff3", "#1c2330", "#6b7482", "#3f4856", "#8e97a6"),
    "dark": Theme("dark", "#11141a", "#0d1016", "#232a36", "#1b2029", "#e8ebf1", "#8b94a4", "#aeb7c6", "#6d7686"),
}


def rgb_bytes(color: str) -> tuple[int, int, int]:
    """Return "#rrggbb" as three numbers from 0 to 255."""
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return red, green, blue


def rgb(color: str) -> tuple[float, float, float]:
    """Return "#rrggbb" as three numbers from 0 to 1."""
    red, green, blue = rgb_bytes(color)
    return red / 255.0, green / 255.0, blue / 255.0

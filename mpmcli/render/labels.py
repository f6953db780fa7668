"""Numbers, times and lengths as short texts, and the fonts they are drawn in."""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.render.coloring import Coloring

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

# Units of length, m, from the longest.
LENGTHS = ((1e3, "km"), (1.0, "m"), (1e-2, "cm"), (1e-3, "mm"), (1e-6, "µm"))
PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""))
TIMES = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))
DIGITS_MAX = 6
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@cache
def ticks_of(colors: Coloring, most: int) -> tuple[list[float], list[str], str]:
    """Return places and texts of up to `most` ticks, and the unit with the power of ten of the texts."""
    from matplotlib.ticker import MaxNLocator

    low, high = colors.limits
    places = [p for p in MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high) if low <= p <= high]
    places = [float(place) for place in places] or [low, high]
    largest = max(abs(low), abs(high))
    factor, unit = 1.0, colors.unit
    if unit == "Pa" and 1e3 <= largest < 1e13:
        factor, prefix = next((f, p) for f, p in PREFIXES if largest >= f)
        unit = prefix + unit
    elif largest >= 1e5 or largest < 1e-2:
        power = math.floor(math.log10(largest))
        factor = 10.0**power
        unit = f"10{str(power).translate(SUPERSCRIPTS)} {unit}".strip()
    step = (places[1] - places[0]) / factor if len(places) > 1 else largest / factor
    digits = max(0, -math.floor(math.log10(abs(step)) + 1e-9)) if step else 0
    if round(step, digits) and abs(step - round(step, digits)) > 1e-6 * abs(step):
        digits += 1
    texts = [f"{place / factor:.{digits}f}".replace("-", "\u2212") for place in places]
    return places, texts, unit


def time_text(time: float, times: Sequence[float]) -> str:
    """Return a time with enough digits to distinguish the times of a film, for example "t = 0.250 s"."""
    longest = max([abs(t) for t in times], default=0.0) or abs(time) or 1.0
    factor, unit = next(((f, u) for f, u in TIMES if longest >= 0.1 * f), TIMES[-1])
    ordered = np.unique(np.asarray(times, dtype=np.float64)) / factor
    step = float(np.median(np.diff(ordered))) if len(ordered) > 1 else 0.1
    if not 0.0 < step < math.inf:
        # Of times in a damaged file, whose differences may be too large or too small for numbers.
        step = 0.1
    least = min(max(0, math.ceil(-math.log10(step) - 1e-9)), DIGITS_MAX)
    # The digits of an exact step such as 0.25; one more than necessary for others such as 1/3.
    exact = (least + more for more in range(3) if abs(step * 10 ** (least + more) % 1 - 0.5) >= 0.45)
    digits = min(next(exact, least + 1), DIGITS_MAX)
    return f"t = {time / factor:.{digits}f} {unit}"


def round_length(longest: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is no longer."""
    power = 10.0 ** math.floor(math.log10(longest))
    return max(m * power for m in (1, 2, 5) if m * power <= longest * (1 + 1e-9))


def length_text(length: float) -> str:
    """Return a length in the unit that gives a short number."""
    factor, unit = next(((f, u) for f, u in LENGTHS if length >= 0.999 * f), LENGTHS[-1])
    return f"{length / factor:g} {unit}"


def cut(text: str, fits: Callable[[str], bool]) -> str:
    """Shorten a text until it fits."""
    if fits(text):
        return text
    while text and not fits(text + "…"):
        text = text[:-1].rstrip()
    return text + "…" if text else ""


@cache
def font_of(size: int, bold: bool = False) -> "FreeTypeFont":
    from matplotlib import get_data_path
    from PIL import ImageFont

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/{name}", size)

"""The layout of a picture: title, time, colour bar or legend, scale bar, and the walls of a 2D domain."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import binary_erosion

from mpmcli.render.coloring import Categories, Coloring
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.settings import Arrow, Theme, rgb_bytes
from mpmcli.render.view import View, corners_of
from mpmcli.scene.colliders import Collider
from mpmcli.scene.domain import OPEN, PERIODIC
from mpmcli.scene.surface import collider_surface

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont

# Sizes in pixels for a picture of 1280x720; they scale with the picture, down to the smallest legible scale.
PIXELS = 1280 * 720
SMALLEST = 0.55
TEXT, SMALL = 17, 14
PAD = 16
TOP, BOTTOM, LABEL, GAP = 44, 44, 26, 8
LEAST = 16  # smallest number of pixels along each side of the viewport
BAR_WIDTH, TICK = 18, 6
SWATCH = 16
LEGEND_SHARE = 0.3  # largest fraction of the width for legends; longer names are shortened
ARROW = 0.15  # length of the largest velocity arrow, as a fraction of the domain
SCALE_SHARE = 0.18  # largest length of a scale bar, as a fraction of the width
TICKS = 6
NO_NUMBER = "no number"
LENGTHS = ((1e3, "km"), (1.0, "m"), (1e-2, "cm"), (1e-3, "mm"), (1e-6, "µm"))  # units of length, m, from the longest
PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""))
TIMES = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))
DIGITS_MAX = 6
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class PictureLayout:
    """The layout shared by all pictures of one film, or by the pictures of a montage."""

    size: tuple[int, int]  # of the whole picture, pixels, (width, height)
    scene: RenderScene
    theme: Theme
    times: tuple[float, ...]  # of the frames of the result, s, which determine the digits of times
    colors: Coloring | Categories | None  # explained by a colour bar or a legend; None without either
    grid: tuple[int, int] = (1, 1)  # columns and rows of pictures of the scene
    walls: bool = True  # whether the walls of the domain are drawn around each of them
    scale_bar: bool = True  # in a parallel view; in perspective the edges of the box have their lengths
    arrows: tuple[Arrow, ...] = ()

    @property
    def viewport_size(self) -> tuple[int, int]:
        """Pixels of each picture of the scene, (width, height)."""
        left, top, right, bottom = self._scene_box
        columns, rows = self.grid
        gap = self._px(GAP)
        width = (right - left - (columns - 1) * gap) // columns
        height = (bottom - top - (rows - 1) * gap) // rows - self._label
        return max(width, LEAST), max(height, LEAST)

    def compose(
        self,
        pictures: Sequence[np.ndarray],
        view: View,
        times: Sequence[float],
        missing: int = 0,
        captions: Sequence[str] | None = None,
    ) -> np.ndarray:
        """Return the whole picture (height, width, 3) uint8 from pictures of the scene, row by row, and their times, s.

        With `missing` particles, whose value is not a number, the colour bar has an entry for them. The captions, or
        else the times, are above each picture of a montage, shortened if too long.
        """
        from PIL import Image, ImageDraw

        whole = Image.new("RGB", self.size, rgb_bytes(self.theme.ground))
        draw = ImageDraw.Draw(whole)
        for k, (picture, time) in enumerate(zip(pictures, times, strict=True)):
            x, y = self._place(k)
            whole.paste(Image.fromarray(picture), (x, y))
            if self._label:
                # The part of a caption that fits, or a time if it fits completely.
                room = self.viewport_size[0]
                text = self._cut(captions[k], room) if captions else time_text(time, self.times)
                free = room - self._small.getlength(text)
                if free >= 0:
                    self._write(draw, x + min(self._px(PAD), free), y - self._label // 2, text)
            if self.walls:
                self._walls(draw, view, (x, y))
            for collider in self.scene.held:
                self._hatch(whole, view, (x, y), collider)
            if self.arrows:
                self._draw_arrows(draw, view, (x, y))
        if self.scale_bar:
            self._draw_scale_bar(draw, view)
        elif self.grid == (1, 1):
            self._draw_lengths(draw, view)
        self._heading(draw, times[0] if self.grid == (1, 1) else None)
        if isinstance(self.colors, Coloring):
            self._color_bar(draw, self.colors, missing)
        elif self.colors is not None:
            self._legend(draw, self.colors)
        return np.asarray(whole)

    def height_for(self, aspect: float) -> int:
        """Return the height of the whole picture that gives those of the scene this ratio of height to width."""
        rows = self.grid[1]
        viewport = round(self.viewport_size[0] * aspect) + self._label
        return self._px(TOP) + self._bottom + rows * viewport + (rows - 1) * self._px(GAP)

    @property
    def _scene_box(self) -> tuple[int, int, int, int]:
        """The rectangle that the pictures of the scene share: left, top, right, bottom, pixels."""
        width, height = self.size
        return 0, self._px(TOP), width - self._column, height - self._bottom

    @property
    def _bottom(self) -> int:
        return self._px(BOTTOM if self.scale_bar else GAP)

    @property
    def _label(self) -> int:
        """Rows above each picture of a montage, for its time."""
        return 0 if self.grid == (1, 1) else self._px(LABEL)

    def _place(self, k: int) -> tuple[int, int]:
        """Return left and top of the k-th picture of the scene."""
        row, column = divmod(k, self.grid[0])
        (width, height), (left, top, _, _), gap = self.viewport_size, self._scene_box, self._px(GAP)
        return left + column * (width + gap), top + row * (height + self._label + gap) + self._label

    def _px(self, length: float) -> int:
        scale = max(math.sqrt(self.size[0] * self.size[1] / PIXELS), SMALLEST)
        return max(1, round(length * scale))

    @property
    def _small(self) -> "FreeTypeFont":
        return font_of(self._px(SMALL))

    def _cut(self, text: str, room: float) -> str:
        return cut(text, lambda text: self._small.getlength(text) <= room)

    def _write(self, draw: "ImageDraw", x: float, y: float, text: str, color: str = "", anchor: str = "lm") -> None:
        """Draw a small text in a colour, by default the text colour."""
        draw.text((x, y), text, color or self.theme.text, self._small, anchor=anchor)

    @property
    def _column(self) -> int:
        """Return the width of the column of the colour bar or the legend, pixels; 0 without colours."""
        length = self._small.getlength
        if self.colors is None:
            return 0
        if isinstance(self.colors, Coloring):
            texts, head = self._bar(self.colors)[3:]
            ticks = self._px(BAR_WIDTH + TICK + 6) + max(map(length, texts))
            wide = max(ticks, self._px(BAR_WIDTH + 6) + length(NO_NUMBER), *map(length, head))
        else:
            wide = self._px(SWATCH + 8) + max(map(length, self.colors.names))
            wide = min(wide, LEGEND_SHARE * self.size[0])
        return math.ceil(wide) + 2 * self._px(PAD)

    def _heading(self, draw: "ImageDraw", time: float | None) -> None:
        bold, plain = font_of(self._px(TEXT), bold=True), font_of(self._px(TEXT))
        pad, middle = self._px(PAD), self._px(TOP) // 2
        room = self.size[0] - 2 * pad
        if time is not None:
            text = time_text(time, self.times)
            draw.text((self.size[0] - pad, middle), text, self.theme.text, plain, anchor="rm")
            # Space for the longest time, so that a title keeps its length throughout a film.
            room -= pad + max(plain.getlength(time_text(t, self.times)) for t in (*self.times[-1:], time))
        title = cut(self.scene.title, lambda text: bold.getlength(text) <= room)
        draw.text((pad, middle), title, self.theme.text, bold, anchor="lm")

    def _walls(self, draw: "ImageDraw", view: View, place: tuple[int, int]) -> None:
        """Draw the walls just outside the domain, so that they hide nothing inside.

        Open faces of a 2D domain are left out, and periodic ones are dashed.
        """
        corners = view.pixels(np.array([self.scene.lower, self.scene.upper]))
        edges = np.rint(corners[:, :2] + place).astype(int)
        (x0, y0), (x1, y1) = edges.min(axis=0).tolist(), edges.max(axis=0).tolist()
        w, dash = self._px(2), self._px(12)
        faces = self.scene.faces if self.scene.dimension == 2 and self.scene.faces else (("", ""), ("", ""))
        left, right = (x0 - w, y0 - w, x0 - 1, y1 + w - 1), (x1, y0 - w, x1 + w - 1, y1 + w - 1)
        below, above = (x0 - w, y1, x1 + w - 1, y1 + w - 1), (x0 - w, y0 - w, x1 + w - 1, y0 - 1)
        for line, word in zip((left, right, below, above), sum(faces, ()), strict=True):
            if word != OPEN:
                draw.rectangle(line, fill=self.theme.wall)
            along = int(line in (left, right))
            for start in range(line[along] + dash, line[along + 2], 2 * dash) if word == PERIODIC else ():
                gap = list(line)
                gap[along], gap[along + 2] = start, min(start + dash, line[along + 2]) - 1
                draw.rectangle(gap, fill=self.theme.ground)

    def _draw_arrows(self, draw: "ImageDraw", view: View, place: tuple[int, int]) -> None:
        """Draw the arrows, the longest of a kind as long as a part of the domain, each with its magnitude."""
        flat = [0.0] * (3 - self.scene.dimension)
        starts, vectors = (np.array([(*one[k], *flat) for one in self.arrows]) for k in (0, 1))
        ends = starts + ARROW * float(np.ptp([self.scene.lower, self.scene.upper], axis=0).max()) * vectors
        (tails, tips), width = (view.pixels(points)[:, :2] + place for points in (starts, ends)), self._px(3)
        for tail, tip, (_, _, text) in zip(tails, tips, self.arrows, strict=True):
            length = float(np.linalg.norm(tip - tail))
            along = (tip - tail) / max(length, 1.0)
            head = min(self._px(12), length)
            wings = [tip - head * along + sign * 0.45 * head * np.array([-along[1], along[0]]) for sign in (1, -1)]
            draw.line([*map(tuple, (tail, tip - 0.8 * head * along))], self.theme.text, width)
            draw.polygon([*map(tuple, (tip, *wings))], self.theme.text)
            beside, anchor = tip + self._px(SMALL) * along, "lm" if along[0] >= 0 else "rm"
            self._write_over(draw, beside, text, anchor)

    def _hatch(self, whole: "Image", view: View, place: tuple[int, int], collider: Collider) -> None:
        """Hatch what a collider holds, also where something hides it, and write "held" there."""
        from PIL import Image, ImageDraw

        mask = Image.new("L", view.size)
        if self.scene.dimension == 2:
            low, high = np.sort(view.pixels(np.array([self.scene.lower, self.scene.upper]))[:, :2], axis=0)
            columns, rows = (np.arange(math.ceil(a), math.floor(b)) for a, b in zip(low, high, strict=True))
            points = view.rays(columns[None, :], rows[:, None])[0][..., :2]
            inside = collider.signed_distance(points.reshape(-1, 2), 0.0).reshape(points.shape[:2]) < 0.0
            mask.paste(Image.fromarray(inside), (int(columns[0]), int(rows[0])))
        else:
            surface = collider_surface(collider, *map(np.array, (self.scene.lower, self.scene.upper)))
            triangles = view.pixels(collider.motion.placed(surface.points, 0.0))[surface.cells]
            for corners in triangles[(triangles[..., 2] > view.near).all(axis=1), :, :2]:
                ImageDraw.Draw(mask).polygon([*map(tuple, corners)], 255)
        covered = np.asarray(mask) > 0
        if covered.any():
            y, x = np.indices(covered.shape)
            lines = (x + y) % self._px(10) < self._px(2)
            rim = covered & ~binary_erosion(covered, iterations=self._px(2), border_value=1)
            whole.paste(self.theme.wall, place, Image.fromarray(covered & lines | rim))
            middle = np.argwhere(covered).mean(axis=0)[::-1] + place
            self._write_over(ImageDraw.Draw(whole), middle, "held", "mm")

    def _write_over(self, draw: "ImageDraw", place: np.ndarray, text: str, anchor: str) -> None:
        """Write a small text that is legible on whatever is there."""
        halo = {"stroke_width": self._px(3), "stroke_fill": self.theme.ground}
        draw.text(tuple(place), text, self.theme.text, self._small, anchor=anchor, **halo)

    def _draw_scale_bar(self, draw: "ImageDraw", view: View) -> None:
        length = round_length(SCALE_SHARE * self.size[0] / view.pixels_per_metre)
        pixels = round(length * view.pixels_per_metre)
        left = self._place(0)[0] + round(view.pixels(np.array([self.scene.lower, self.scene.upper]))[:, 0].min())
        pad, w = max(self._px(PAD), left), self._px(2)
        y = self.size[1] - self._bottom // 2
        tip = self._px(5)
        draw.rectangle((pad, y - w // 2, pad + pixels - 1, y - w // 2 + w - 1), fill=self.theme.text)
        for x in (pad, pad + pixels - w):
            draw.rectangle((x, y - tip, x + w - 1, y + tip), fill=self.theme.text)
        self._write(draw, pad + pixels + self._px(8), y, length_text(length))

    def _draw_lengths(self, draw: "ImageDraw", view: View) -> None:
        """Write the length of the domain along each axis next to its lowest or leftmost edge in the picture."""
        corners = corners_of(self.scene)
        places = view.pixels(corners) + np.array([*self._place(0), 0])
        if (places[:, 2] < view.near).any():
            # The camera is inside the domain.
            return
        middle = places[:, :2].mean(axis=0)
        for axis in range(3):
            lower = np.flatnonzero(corners[:, axis] == self.scene.lower[axis])
            halves = 0.5 * (places[lower] + places[lower + (1 << axis)])[:, :2]
            upright = abs(self.scene.up[axis]) == 1.0
            x, y = halves[halves[:, 0].argmin() if upright else halves[:, 1].argmax()]
            outwards = np.array([x, y]) - middle
            x, y = (x, y) + self._px(12) * outwards / np.linalg.norm(outwards)
            text = length_text(self.scene.upper[axis] - self.scene.lower[axis])
            wide = self._small.getlength(text)
            left = x - wide if x < middle[0] else x
            left = min(max(left, self._px(PAD) / 2), self._scene_box[2] - wide)
            self._write(draw, left, y, text, self.theme.faint, "lm" if upright else "lt")

    def _legend(self, draw: "ImageDraw", colors: Categories) -> None:
        """Draw a swatch and a name for each category for which there is room, and the number of the others."""
        pad, swatch, step = self._px(PAD), self._px(SWATCH), self._px(SWATCH + 10)
        x, y = self._scene_box[2] + pad, self._scene_box[1] + pad
        beside = x + swatch + self._px(8)
        room = self.size[0] - x - pad - self._px(SWATCH + 8)
        rows = max(1, int((self.size[1] - pad - swatch - y) / step) + 1)
        named = rows - 1 if len(colors.names) > rows else rows
        for name, ink in zip(colors.names[:named], colors.inks, strict=False):
            draw.ellipse((x, y, x + swatch, y + swatch), fill=ink, outline=self.theme.faint)
            self._write(draw, beside, y + swatch / 2, self._cut(name, room))
            y += step
        if named < len(colors.names):
            more = self._cut(f"and {len(colors.names) - named} more", room)
            self._write(draw, beside, y + swatch / 2, more, self.theme.faint)

    def _bar(self, colors: Coloring) -> tuple[int, int, list[float], list[str], list[str]]:
        """Return the first and last row of the bar, places and texts of its ticks, and the lines above it."""
        line = self._px(SMALL + 6)
        top = self._px(TOP) + self._px(4) + 2 * line + self._px(8)
        bottom = self.size[1] - self._bottom - self._px(PAD) - 2 * line
        places, texts, unit = ticks_of(colors, max(1, min(TICKS, int((bottom - top) / (1.5 * self._px(SMALL))))))
        return top, bottom, places, texts, [colors.name, unit]

    def _color_bar(self, draw: "ImageDraw", colors: Coloring, missing: int) -> None:
        """Draw heading, bar and ticks, and a swatch for particles without a number if any are `missing`."""
        line, width = self._px(SMALL + 6), self._px(BAR_WIDTH)
        x, y = self._scene_box[2] + self._px(PAD), self._scene_box[1] + self._px(4)
        top, bottom, places, texts, heading = self._bar(colors)
        for k, text in enumerate(heading):
            self._write(draw, x, y + k * line, text, anchor="lt")
        if bottom - top < 2 * line:
            return
        low, high = colors.limits
        for k, color in enumerate(colors.rgb(np.linspace(high, low, bottom - top)).tolist()):
            draw.rectangle((x, top + k, x + width - 1, top + k), fill=tuple(color))
        start, end = x + width, x + width + self._px(TICK)
        for place, text in zip(places, texts, strict=True):
            row = bottom - (place - low) / (high - low) * (bottom - top)
            draw.rectangle((start, round(row), end - 1, round(row)), fill=self.theme.faint)
            self._write(draw, start + self._px(TICK + 6), row, text)
        if missing:
            y = bottom + line
            draw.rectangle((x, y, x + width - 1, y + width - 1), fill=self.theme.missing)
            self._write(draw, x + width + self._px(6), y + width / 2, NO_NUMBER)


@cache
def ticks_of(colors: Coloring, most: int) -> tuple[list[float], list[str], str]:
    """Return places and texts of up to `most` ticks, and the unit with the power of ten of the texts."""
    from matplotlib.ticker import MaxNLocator

    low, high = colors.limits
    ticks = MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    places = [place for place in ticks.tolist() if low <= place <= high] or [low, high]
    largest = max(abs(low), abs(high))
    factor, unit = 1.0, colors.unit
    if unit == "Pa" and 1e3 <= largest < 1e13:
        factor, prefix = next((f, p) for f, p in PREFIXES if largest >= f)
        unit = prefix + unit
    elif largest >= 1e5 or largest < 1e-2:
        power = math.floor(math.log10(largest))
        factor = 10.0**power
        unit = f"10{str(power).translate(SUPERSCRIPTS)} {unit}".strip()
    shown, near = np.array(places) / factor, 1e-6 * (high - low) / factor
    digits = next((n for n in range(15) if np.abs(shown.round(n) - shown).max() < near), 15)
    return places, [f"{number:.{digits}f}".replace("-", "\u2212") for number in shown], unit


def time_text(time: float, times: Sequence[float]) -> str:
    """Return a time with enough digits to distinguish the times of a film, for example "t = 0.250 s"."""
    longest = max([abs(t) for t in times], default=0.0) or abs(time) or 1.0
    factor, unit = next(((f, u) for f, u in TIMES if longest >= 0.1 * f), TIMES[-1])
    ordered = np.unique(np.asarray(times, dtype=np.float64)) / factor
    step = float(np.median(np.diff(ordered))) if len(ordered) > 1 else 0.1
    if not 0.0 < step < math.inf:
        # Times in a damaged file may have differences that overflow or underflow.
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

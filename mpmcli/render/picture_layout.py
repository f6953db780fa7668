"""The layout of a picture: title, time, colour bar or legend, scale bar, the walls of a flat domain."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.render.coloring import Categories, Coloring
from mpmcli.render.labels import cut, font_of, length_text, round_length, ticks_of, time_text
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.theme import Theme, rgb_bytes
from mpmcli.render.view import View

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

# Sizes in pixels for a picture of 1280x720; they scale with the picture, down to the smallest legible scale.
PIXELS = 1280 * 720
SMALLEST = 0.55
TEXT, SMALL = 17, 14
PAD = 16
TOP, BOTTOM, LABEL, GAP = 44, 44, 26, 8
# Least pixels along each side of the viewport.
LEAST = 16
BAR_WIDTH, TICK = 18, 6
SWATCH = 16
# Largest fraction of the width for legends; longer names are shortened.
LEGEND_SHARE = 0.3
# Largest length of a scale bar, as a fraction of the width.
SCALE_SHARE = 0.18
TICKS = 6
NO_NUMBER = "no number"


@dataclass(frozen=True)
class PictureLayout:
    """The frame of all pictures of one film, or of the pictures of a montage.

    Args:
        size: of the whole picture, pixels, (width, height).
        times: of the frames of the result, s, which determine the digits of times.
        colors: explained by a colour bar or a legend; None without either.
        grid: columns and rows of pictures of the scene.
        walls: whether the walls of the domain are drawn around each of them.
        scale_bar: whether there is room for one below.
    """

    size: tuple[int, int]
    scene: RenderScene
    theme: Theme
    times: tuple[float, ...]
    colors: Coloring | Categories | None
    grid: tuple[int, int] = (1, 1)
    walls: bool = True
    scale_bar: bool = True

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
        """Return the whole picture, (height, width, 3) uint8.

        Args:
            pictures: of the scene, of the size of the viewport, row by row.
            times: of each, s.
            missing: particles whose value is not a number.
            captions: above each picture of a montage, cut where they are too long; None for times.
        """
        from PIL import Image, ImageDraw

        whole = Image.new("RGB", self.size, rgb_bytes(self.theme.ground))
        draw = ImageDraw.Draw(whole)
        for k, (picture, time) in enumerate(zip(pictures, times, strict=True)):
            x, y = self._place(k)
            whole.paste(Image.fromarray(picture), (x, y))
            if self._label:
                self._caption(draw, captions[k] if captions else time, (x, y - self._label // 2))
            if self.walls:
                self._walls(draw, view, (x, y))
        if self.scale_bar:
            self._draw_scale_bar(draw, view)
        self._heading(draw, times[0] if self.grid == (1, 1) else None)
        if isinstance(self.colors, Coloring):
            self._color_bar(draw, self.colors, missing)
        elif self.colors is not None:
            self._legend(draw, self.colors)
        return np.asarray(whole)

    def height_for(self, aspect: float) -> int:
        """Return the height of the whole picture at which those of the scene have this ratio of height to width."""
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

    @property
    def _scale(self) -> float:
        return max(math.sqrt(self.size[0] * self.size[1] / PIXELS), SMALLEST)

    def _px(self, length: float) -> int:
        return max(1, round(length * self._scale))

    @property
    def _column(self) -> int:
        """Width of what stands on the right."""
        if self.colors is None:
            return 0
        small = font_of(self._px(SMALL))
        if isinstance(self.colors, Coloring):
            texts, head = self._ticks(self.colors)[1], self._bar_heading(self.colors)
            ticks = self._px(BAR_WIDTH + TICK + 6) + max(small.getlength(text) for text in texts)
            rest = self._px(BAR_WIDTH + 6) + small.getlength(NO_NUMBER)
            wide = max(ticks, rest, *(small.getlength(line) for line in head))
        else:
            wide = self._px(SWATCH + 8) + max(small.getlength(name) for name in self.colors.names)
            wide = min(wide, LEGEND_SHARE * self.size[0])
        return math.ceil(wide) + 2 * self._px(PAD)

    def _heading(self, draw: "ImageDraw", time: float | None) -> None:
        font, small = font_of(self._px(TEXT), bold=True), font_of(self._px(TEXT))
        pad, middle = self._px(PAD), self._px(TOP) // 2
        room = self.size[0] - 2 * pad
        if time is not None:
            told = time_text(time, self.times)
            draw.text((self.size[0] - pad, middle), told, self.theme.text, small, anchor="rm")
            # Space for the longest time, so that a title keeps its length throughout a film.
            room -= pad + max(small.getlength(time_text(t, self.times)) for t in (*self.times[-1:], time))
        title = cut(self.scene.title, lambda text: font.getlength(text) <= room)
        draw.text((pad, middle), title, self.theme.text, font, anchor="lm")

    def _caption(self, draw: "ImageDraw", said: str | float, place: tuple[int, int]) -> None:
        """Draw what fits of a text above a picture of a montage, or a time if all of it fits."""
        font, room = font_of(self._px(SMALL)), self.viewport_size[0]
        if isinstance(said, str):
            told = cut(said, lambda text: font.getlength(text) <= room)
        else:
            told = time_text(said, self.times)
        free = room - font.getlength(told)
        if free >= 0:
            start = place[0] + min(self._px(PAD), free)
            draw.text((start, place[1]), told, self.theme.text, font, anchor="lm")

    def _walls(self, draw: "ImageDraw", view: View, place: tuple[int, int]) -> None:
        """Draw the walls just outside of the domain, so that nothing inside is hidden."""
        corners = view.pixels(np.array([self.scene.lower, self.scene.upper]))
        edges = np.rint(corners[:, :2] + place).astype(int)
        (x0, y0), (x1, y1) = edges.min(axis=0).tolist(), edges.max(axis=0).tolist()
        w = self._px(2)
        level = [(x0 - w, y0 - w, x1 + w, y0), (x0 - w, y1, x1 + w, y1 + w)]
        upright = [(x0 - w, y0 - w, x0, y1 + w), (x1, y0 - w, x1 + w, y1 + w)]
        for left, top, right, bottom in (*level, *upright):
            draw.rectangle((left, top, right - 1, bottom - 1), fill=self.theme.wall)

    def _draw_scale_bar(self, draw: "ImageDraw", view: View) -> None:
        length = round_length(SCALE_SHARE * self.size[0] / view.pixels_per_metre)
        pixels = round(length * view.pixels_per_metre)
        pad, w = self._px(PAD), self._px(2)
        y = self.size[1] - self._bottom // 2
        tip = self._px(5)
        draw.rectangle((pad, y - w // 2, pad + pixels - 1, y - w // 2 + w - 1), fill=self.theme.text)
        for x in (pad, pad + pixels - w):
            draw.rectangle((x, y - tip, x + w - 1, y + tip), fill=self.theme.text)
        font = font_of(self._px(SMALL))
        draw.text((pad + pixels + self._px(8), y), length_text(length), self.theme.text, font, anchor="lm")

    def _legend(self, draw: "ImageDraw", colors: Categories) -> None:
        font = font_of(self._px(SMALL))
        x = self._scene_box[2] + self._px(PAD)
        room = self.size[0] - x - self._px(PAD) - self._px(SWATCH + 8)
        swatch, step = self._px(SWATCH), self._px(SWATCH + 10)
        y = self._scene_box[1] + self._px(PAD)
        rows = max(1, int((self.size[1] - self._px(PAD) - swatch - y) / step) + 1)
        told = rows - 1 if len(colors.names) > rows else rows
        for name, ink in zip(colors.names[:told], colors.inks, strict=False):
            draw.ellipse((x, y, x + swatch, y + swatch), fill=ink, outline=self.theme.faint)
            text = cut(name, lambda text: font.getlength(text) <= room)
            draw.text((x + swatch + self._px(8), y + swatch / 2), text, self.theme.text, font, anchor="lm")
            y += step
        if told < len(colors.names):
            more = cut(f"and {len(colors.names) - told} more", lambda text: font.getlength(text) <= room)
            draw.text((x + swatch + self._px(8), y + swatch / 2), more, self.theme.faint, font, anchor="lm")

    def _bar_heading(self, colors: Coloring) -> list[str]:
        unit = self._ticks(colors)[2]
        return [colors.name, unit] if unit else [colors.name]

    def _bar_span(self, colors: Coloring) -> tuple[int, int]:
        """Return the first and last row of the bar, estimated before the text of its heading is known."""
        line = self._px(SMALL + 6)
        top = self._px(TOP) + self._px(4) + (2 if colors.unit else 1) * line + self._px(8)
        return top, self.size[1] - self._bottom - self._px(PAD) - 2 * line

    def _ticks(self, colors: Coloring) -> tuple[list[float], list[str], str]:
        """Return places, texts and unit of the ticks that fit along the bar."""
        top, bottom = self._bar_span(colors)
        return ticks_of(colors, max(1, min(TICKS, int((bottom - top) / (1.5 * self._px(SMALL))))))

    def _color_bar(self, draw: "ImageDraw", colors: Coloring, missing: int) -> None:
        font = font_of(self._px(SMALL))
        x = self._scene_box[2] + self._px(PAD)
        line = self._px(SMALL + 6)
        y = self._scene_box[1] + self._px(4)
        for text in self._bar_heading(colors):
            draw.text((x, y), text, self.theme.text, font, anchor="lt")
            y += line
        top, bottom = y + self._px(8), self._bar_span(colors)[1]
        if bottom - top < 2 * line:
            return
        width = self._px(BAR_WIDTH)
        low, high = colors.limits
        rows = np.linspace(high, low, max(bottom - top, 2))
        for k, color in enumerate(colors.rgb(rows).tolist()):
            draw.rectangle((x, top + k, x + width - 1, top + k), fill=tuple(color))
        places, texts, _ = self._ticks(colors)
        for place, text in zip(places, texts, strict=True):
            row = bottom - (place - low) / (high - low) * (bottom - top)
            start = x + width
            draw.rectangle((start, round(row), start + self._px(TICK) - 1, round(row)), fill=self.theme.faint)
            draw.text((start + self._px(TICK + 6), row), text, self.theme.text, font, anchor="lm")
        if missing:
            y = bottom + line
            draw.rectangle((x, y, x + width - 1, y + width - 1), fill=self.theme.missing)
            draw.text((x + width + self._px(6), y + width / 2), NO_NUMBER, self.theme.text, font, anchor="lm")

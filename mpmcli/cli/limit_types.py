"""Wall times and sizes on the command line, as batch systems write them."""

import math
import re

import click

SECONDS = {"d": 86400, "h": 3600, "m": 60, "min": 60, "s": 1}
BYTES = {
    f"{letter}{end}": base**power for power, letter in enumerate("KMGT", 1) for end, base in (("B", 1000), ("iB", 1024))
}
_PARTS = re.compile(r"(\d+(?:\.\d+)?)\s*(d|h|min|m|s)", re.IGNORECASE)
_CLOCK = re.compile(r"(?:(\d+)-)?(\d+):(\d\d):(\d\d)")
_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([KMGT]i?B)", re.IGNORECASE)


class Duration(click.ParamType):
    """A time in seconds: 2h, 90m, 45s, 1h30m, 1:30:00, or 1-12:00:00 with days."""

    name = "time"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if isinstance(value, int | float):
            return float(value)
        text = str(value).strip()
        seconds = 0.0
        if clock := _CLOCK.fullmatch(text):
            days, hours, minutes, rest = (int(part or 0) for part in clock.groups())
            if minutes < 60 and rest < 60:
                seconds = 86400.0 * days + 3600 * hours + 60 * minutes + rest
        elif not _PARTS.sub("", text).strip():
            seconds = sum(float(number) * SECONDS[unit.lower()] for number, unit in _PARTS.findall(text))
        if not 0 < seconds < math.inf:
            self.fail(f"{text} is no time; give 2h, 90m, 45s, 1h30m or 1:30:00", param, ctx)
        return seconds


class Size(click.ParamType):
    """A number of bytes: 8GB or 500MB of 1000, 8GiB of 1024."""

    name = "size"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        text = str(value).strip()
        units = {unit.lower(): size for unit, size in BYTES.items()}
        found = _SIZE.fullmatch(text)
        size = float(found[1]) * units[found[2].lower()] if found else 0.0
        if not 1 <= size < 2**63:
            self.fail(f"{text} is no size; give 8GB, 500MB or 8GiB", param, ctx)
        return int(size)

"""Options shared by several commands, and parsers of wall times, sizes and lists of numbers."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import click

PATH = click.Path(path_type=Path)


class SceneOrResult(click.Path):
    """A path, or the name of an example scene if no file has that name."""

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        from mpmcli.scene.examples import example_path

        return example_path(super().convert(value, param, ctx))


SCENE = SceneOrResult(path_type=Path)
COUNT = click.IntRange(min=1)

SECONDS = {"d": 86400, "h": 3600, "m": 60, "min": 60, "s": 1}
# In lower case: kb has 1000 bytes, kib 1024.
BYTES = {
    f"{letter}{end}": base**power for power, letter in enumerate("kmgt", 1) for end, base in (("b", 1000), ("ib", 1024))
}
_PARTS = re.compile(r"(\d+(?:\.\d+)?)\s*(d|h|min|m|s)", re.IGNORECASE)
_CLOCK = re.compile(r"(?:(\d+)-)?(\d+):(\d\d):(\d\d)")
_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([KMGT]i?B)", re.IGNORECASE)

set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Replace a key of the scene, e.g. --set time.end=0.5; the value is TOML. May be repeated.",
)
plugin_option = click.option(
    "--plugin",
    "plugins",
    type=PATH,
    multiple=True,
    metavar="FILE",
    help="A Python file that defines LAW, one more constitutive law; its code is run. May be repeated.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON on stdout.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")


def output_option(text: str, metavar: str = "DIR", name: str = "output") -> Callable:
    """Return the option for the output path; `name` is that of the parameter."""
    return click.option("-o", "--output", name, type=PATH, metavar=metavar, help=text)


class Word(click.Choice):
    """One of many long words; an error names the nearest one."""

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> str:
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            from difflib import get_close_matches

            near = get_close_matches(str(value), self.choices, n=1)
            if not near:
                raise
            self.fail(f'there is no "{value}"; did you mean "{near[0]}"?', param, ctx)


def choice_option(flags: str, choices: list[str], default: str, text: str) -> Callable:
    """Return an option that takes one of several words; `flags` may name the parameter after a space."""
    return click.option(*flags.split(), type=click.Choice(choices), default=default, show_default=True, help=text)


def arch_option(what: str) -> Callable:
    """Return the option for the backend; `what` begins its help."""
    text = f"{what}; auto takes CUDA or Metal if available, else the CPU."
    return choice_option("--arch", ["auto", "cpu", "cuda", "vulkan", "metal"], "auto", text)


def time_option(text: str) -> Callable:
    """Return the option for the wall time after which a command ends."""
    return click.option("--max-time", type=duration, metavar="TIME", help=text)


def duration(text: str) -> float:
    """Read a time in seconds: 2h, 90m, 45s, 1h30m, 1:30:00, or 1-12:00:00 with days."""
    text, seconds = text.strip(), 0.0
    if clock := _CLOCK.fullmatch(text):
        days, hours, minutes, rest = (int(part or 0) for part in clock.groups())
        if minutes < 60 and rest < 60:
            seconds = 86400.0 * days + 3600 * hours + 60 * minutes + rest
    elif not _PARTS.sub("", text).strip():
        seconds = sum(float(number) * SECONDS[unit.lower()] for number, unit in _PARTS.findall(text))
    if not 0 < seconds < math.inf:
        raise click.BadParameter(f"{text} is not a time; give 2h, 90m, 45s, 1h30m or 1:30:00")
    return seconds


def size(text: str) -> int:
    """Read a number of bytes: 8GB or 500MB of 1000, 8GiB of 1024."""
    text = text.strip()
    match = _SIZE.fullmatch(text)
    count = float(match[1]) * BYTES[match[2].lower()] if match else 0.0
    if not 1 <= count < 2**63:
        raise click.BadParameter(f"{text} is not a size; give 8GB, 500MB or 8GiB")
    return int(count)


def part(text: str) -> tuple[int, int]:
    """Read a part of the work, `i/n`."""
    first, slash, parts = text.partition("/")
    if not (slash and first.isdecimal() and parts.isdecimal() and 1 <= int(first) <= int(parts)):
        raise click.BadParameter(f"{text} is not a part; give 1/2 for the first of two")
    return int(first), int(parts)


def thread_counts(text: str) -> tuple[int, ...]:
    """Read comma-separated numbers of threads, such as `1,2`."""
    counts = [word.strip() for word in text.split(",")]
    if not all(count.isascii() and count.isdecimal() and 0 < int(count) < 10**6 for count in counts):
        raise click.BadParameter(f"{text} is not a number of threads; give 2, or 1,2 for each of both")
    return tuple(dict.fromkeys(int(count) for count in counts))

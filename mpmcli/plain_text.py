"""Tables, sizes, counts and titles as plain text."""

import re
from collections.abc import Collection, Iterable, Sequence

SIZES = ("B", "kB", "MB", "GB", "TB", "PB")
_UNUSUAL = re.compile(r"[^\x20-\x7e\n\t]")


def text_table(head: tuple[str, ...], rows: list[tuple[str, ...]], left: set[int]) -> str:
    """Write rows below their head and a line; columns are aligned to the right but for those numbered in `left`."""
    widths = [max(len(row[column]) for row in [head, *rows]) for column in range(len(head))]
    lines = [
        "  ".join(
            text.ljust(width) if column in left else text.rjust(width)
            for column, (text, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in [head, *rows]
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]], left: Collection[int]) -> str:
    """Return a table in Markdown; columns are aligned to the right but for those numbered in `left`."""
    rule = ["---" if column in left else "---:" for column in range(len(head))]
    lines = (" | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) for row in (head, rule, *rows))
    return "\n".join(f"| {line} |" for line in lines)


def counted(count: int, noun: str) -> str:
    """Return a number and its noun, such as "1 frame", "2 frames" or "2 trajectories"."""
    if count == 1:
        return f"{count} {noun}"
    return f"{count} {noun[:-1]}ies" if noun.endswith("y") else f"{count} {noun}s"


def plain_number(value: float) -> str:
    """Write a number with three digits, without an exponent where that is legible, such as "3,920" or "0.0251"."""
    return f"{float(f'{value:.3g}'):,.10g}" if 1e-4 <= abs(value) < 1e7 else f"{value:.3g}"


def duration_text(seconds: float) -> str:
    """Write a time in the unit that suits it, such as "40 s", "12 min" or "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"


def one_line(text: str) -> str:
    """Return a text without line breaks and other characters that have no glyph."""
    return " ".join("".join(character if character.isprintable() else " " for character in text).split())


def escaped(text: str) -> str:
    """Return a text with an escape, such as \\u001b, in place of each character but line breaks and tabs without glyph.

    What stands in a file can so not speak to the terminal. In JSON the escapes stand for the characters.
    """
    return _UNUSUAL.sub(_escape, text)


def _escape(match: re.Match[str]) -> str:
    if match[0].isprintable():
        return match[0]
    units = match[0].encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{units[k : k + 4]}" for k in range(0, len(units), 4))


def size_text(count: float) -> str:
    """Write a number of bytes with three digits and its unit."""
    for unit in SIZES[:-1]:
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} {SIZES[-1]}"

"""Tables, sizes, counts and titles as plain text."""

import json

SIZES = ("B", "kB", "MB", "GB", "TB", "PB")


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


def counted(count: int, noun: str) -> str:
    """Return a number and its noun, such as "1 frame", "2 frames" or "2 trajectories"."""
    if count == 1:
        return f"{count} {noun}"
    return f"{count} {noun[:-1]}ies" if noun.endswith("y") else f"{count} {noun}s"


def duration_text(seconds: float) -> str:
    """Write a time in the unit that suits it, such as "40 s", "12 min" or "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"


def one_line(text: str) -> str:
    """Return a text without line breaks and other characters that have no glyph."""
    return " ".join("".join(character if character.isprintable() else " " for character in text).split())


def escaped(text: str) -> str:
    """Return a text whose characters without a glyph are written as JSON escapes, but line breaks and tabs.

    Text from files may hold sequences that change what a terminal shows.
    """
    if all(line.isprintable() for line in text.split("\n")):
        return text
    return "".join(
        c if c.isprintable() or c in "\n\t" else json.dumps(c)[1:-1] if c != "\x7f" else "\\u007f" for c in text
    )


def size_text(count: float) -> str:
    """Write a number of bytes with three digits and its unit."""
    for unit in SIZES[:-1]:
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} {SIZES[-1]}"

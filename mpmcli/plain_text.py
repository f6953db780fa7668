"""Tables, sizes, counts and titles as plain text."""

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
    """Return a number and its noun, such as "1 frame" or "2 frames"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def one_line(text: str) -> str:
    """Return a text without line breaks and other characters that have no glyph."""
    return " ".join("".join(character if character.isprintable() else " " for character in text).split())


def size_text(count: float) -> str:
    """Write a number of bytes with three digits and its unit."""
    for unit in SIZES[:-1]:
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} {SIZES[-1]}"

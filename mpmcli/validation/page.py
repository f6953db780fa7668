"""Markdown blocks of a report."""

from collections.abc import Collection, Iterable, Sequence


def heading(level: int, text: str, anchor: str = "") -> str:
    """Return a heading of level 1, 2 or 3, preceded by an HTML anchor if one is given."""
    return (f'<a id="{anchor}"></a>\n\n' if anchor else "") + f"{'#' * level} {text}"


def bullets(lines: Iterable[str]) -> str:
    """Return a bullet list."""
    return "\n".join(f"* {line}" for line in lines)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], right: Collection[int], folded: str = "") -> str:
    """Return a table; the columns numbered in `right` are aligned to the right.

    Args:
        folded: summary of a collapsed table; "" for a visible one.
    """
    rule = ["---:" if column in right else "---" for column in range(len(head))]
    lines = (" | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) for row in (head, rule, *rows))
    text = "\n".join(f"| {line} |" for line in lines)
    return f"<details>\n<summary>{folded}</summary>\n\n{text}\n\n</details>" if folded else text

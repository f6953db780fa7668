"""A page as Markdown."""

from collections.abc import Sequence

from mpmcli.validation.page import Block, Bullets, Heading, Paragraph, Picture, Table


def to_markdown(blocks: Sequence[Block], folder: str) -> str:
    """Return the page; pictures are links to files in `folder`, beside it."""
    return "\n\n".join(_block(block, folder) for block in blocks) + "\n"


def _block(block: Block, folder: str) -> str:
    match block:
        case Heading(level, text, anchor):
            return (f'<a id="{anchor}"></a>\n\n' if anchor else "") + f"{'#' * level} {text}"
        case Paragraph(text):
            return text
        case Bullets(lines):
            return "\n".join(f"* {line}" for line in lines)
        case Picture(name, text):
            return f"![{text}]({folder}/{name})"
        case Table(head, rows, right, folded):
            rule = tuple("---:" if column in right else "---" for column in range(len(head)))
            lines = [" | ".join(_cell(cell) for cell in row) for row in (head, rule, *rows)]
            table = "\n".join(f"| {line} |" for line in lines)
            return f"<details>\n<summary>{folded}</summary>\n\n{table}\n\n</details>" if folded else table


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")

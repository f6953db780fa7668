"""A page as one HTML file that needs nothing else."""

import base64
import html
import re
from collections.abc import Mapping, Sequence

from mpmcli.validation.page import Block, Bullets, Heading, Paragraph, Picture, Table

STYLE = """\
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 66rem; margin: 2rem auto;
  padding: 0 1rem; }
h1, h2, h3 { line-height: 1.25; }
h2 { margin-top: 3rem; border-bottom: 1px solid #ddd; padding-bottom: .2rem; }
h3 { margin-top: 2.5rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .875rem; margin: 1rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #e4e4e4; text-align: left; vertical-align: top; }
th { border-bottom: 2px solid #888; white-space: nowrap; }
td.right, th.right { text-align: right; white-space: nowrap; }
tbody tr:hover { background: #f6f6f6; }
img { max-width: 100%; height: auto; display: block; margin: 1rem 0; }
code { font-size: .9em; background: #f3f3f3; padding: .05em .25em; border-radius: 3px; }
summary { cursor: pointer; color: #0b57a4; }
a { color: #0b57a4; }
"""


def to_html(title: str, blocks: Sequence[Block], pictures: Mapping[str, bytes]) -> str:
    """Return the page; pictures, SVG by their names, stand in the file itself."""
    body = "\n".join(_block(block, pictures) for block in blocks)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{html.escape(title)}</title>\n'
        f"<style>\n{STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _block(block: Block, pictures: Mapping[str, bytes]) -> str:
    match block:
        case Heading(level, text, anchor):
            name = f' id="{html.escape(anchor)}"' if anchor else ""
            return f"<h{level}{name}>{_inline(text)}</h{level}>"
        case Paragraph(text):
            return f"<p>{_inline(text)}</p>"
        case Bullets(lines):
            return "<ul>\n" + "\n".join(f"<li>{_inline(line)}</li>" for line in lines) + "\n</ul>"
        case Picture(name, text):
            data = base64.b64encode(pictures[name]).decode()
            return f'<img alt="{html.escape(text)}" src="data:image/svg+xml;base64,{data}">'
        case Table(head, rows, right, folded):
            table = "\n".join(
                [
                    '<div class="wide"><table>',
                    f"<thead>{_row('th', head, right)}</thead>",
                    "<tbody>",
                    *(_row("td", row, right) for row in rows),
                    "</tbody></table></div>",
                ]
            )
            return f"<details><summary>{_inline(folded)}</summary>\n{table}\n</details>" if folded else table


def _row(tag: str, cells: Sequence[str], right: frozenset[int]) -> str:
    kinds = [' class="right"' if column in right else "" for column in range(len(cells))]
    texts = [f"<{tag}{kind}>{_inline(cell)}</{tag}>" for kind, cell in zip(kinds, cells, strict=True)]
    return f"<tr>{''.join(texts)}</tr>"


def _inline(text: str) -> str:
    """Turn `code`, **bold** and [text](link) into tags, and leave everything else as it is written."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(f"<code>{html.escape(part[1:-1])}</code>" if i % 2 else _words(part) for i, part in enumerate(parts))


def _words(text: str) -> str:
    text = html.escape(text)
    text = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", text)
    return re.sub(r"\[([^\]]+)\]\(([^)\s]+)\)", r'<a href="\2">\1</a>', text)

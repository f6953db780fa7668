"""Conversion of a Markdown page to a self-contained HTML file."""

import base64
import html
import re
from collections.abc import Mapping

from markdown_it import MarkdownIt

STYLE = """\
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 66rem; margin: 2rem auto;
  padding: 0 1rem; }
h1, h2, h3 { line-height: 1.25; }
h2 { margin-top: 3rem; border-bottom: 1px solid #ddd; padding-bottom: .2rem; }
h3 { margin-top: 2.5rem; }
table { display: block; overflow-x: auto; border-collapse: collapse; font-size: .875rem; margin: 1rem 0;
  font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #e4e4e4; text-align: left; vertical-align: top; }
th { border-bottom: 2px solid #888; white-space: nowrap; }
tbody tr:hover { background: #f6f6f6; }
img { max-width: 100%; height: auto; display: block; margin: 1rem 0; }
code { font-size: .9em; background: #f3f3f3; padding: .05em .25em; border-radius: 3px; }
summary { cursor: pointer; color: #0b57a4; }
a { color: #0b57a4; }
"""
# Escaped tags of headings and tables in `report_page`, and their HTML.
TAGS = {
    r"<p>&lt;a id=&quot;(\w+)&quot;&gt;&lt;/a&gt;</p>": r'<a id="\1"></a>',
    r"<p>&lt;details&gt;\n&lt;summary&gt;(.*)&lt;/summary&gt;</p>": r"<details>\n<summary>\1</summary>",
    r"<p>&lt;/details&gt;</p>": "</details>",
}


def to_html(title: str, markdown: str, pictures: Mapping[str, bytes]) -> str:
    """Return the page as HTML with embedded pictures.

    Args:
        title: title of the HTML document.
        markdown: the page.
        pictures: SVG files by their links in the page.
    """
    # All tags are escaped except for those of `report_page`.
    body = MarkdownIt("commonmark", {"html": False, "xhtmlOut": False}).enable("table").render(markdown)
    for escaped, tag in TAGS.items():
        body = re.sub(escaped, tag, body)
    for link, picture in pictures.items():
        body = body.replace(f'src="{link}"', f'src="data:image/svg+xml;base64,{base64.b64encode(picture).decode()}"')
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{html.escape(title)}</title>\n'
        f"<style>\n{STYLE}</style>\n</head>\n<body>\n{body}</body>\n</html>\n"
    )

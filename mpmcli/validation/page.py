"""The parts of a page, before it is Markdown or HTML."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Heading:
    """A heading of level 1, 2 or 3, and what links to it call it."""

    level: int
    text: str
    anchor: str = ""


@dataclass(frozen=True)
class Paragraph:
    """A paragraph; `code`, **bold** and [text](link) as in Markdown."""

    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of lines, each as a paragraph."""

    lines: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """A table; the columns numbered in `right` are aligned to the right. Cells as in a paragraph.

    Attributes:
        folded: whether a page that can do so hides it until it is asked for; what it is called then.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    right: frozenset[int] = frozenset()
    folded: str = ""


@dataclass(frozen=True)
class Picture:
    """A figure of its own file; `text` says what it shows to whoever does not see it."""

    name: str
    text: str


Block = Heading | Paragraph | Bullets | Table | Picture

"""A page as a list of blocks, written as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

FIGURES = "figures"
"""The folder of the figures beside a page."""


@dataclass(frozen=True)
class Heading:
    """A heading."""

    text: str
    """Its text."""
    level: int = 2
    """1 to 3."""


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str
    """Plain text."""


@dataclass(frozen=True)
class Code:
    """Commands."""

    text: str
    """The lines."""


@dataclass(frozen=True)
class Table:
    """A table."""

    header: Sequence[str]
    """Titles of the columns."""
    rows: Sequence[Sequence[str]]
    """Cells, as many in a row as there are titles."""


@dataclass(frozen=True)
class Picture:
    """A figure beside the page."""

    file: Path
    """Its PNG file, relative to the page."""
    caption: str
    """What it shows."""


Block = Heading | Text | Code | Table | Picture


def markdown(blocks: Sequence[Block]) -> str:
    """The page as Markdown."""
    return "\n\n".join(_markdown(block) for block in blocks) + "\n"


def _markdown(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {text}"
        case Text(text):
            return text
        case Code(text):
            return f"```bash\n{text}\n```"
        case Table(header, rows):
            lines = [header, ["---"] * len(header), *rows]
            cells = ([cell.replace("|", "\\|") for cell in line] for line in lines)
            return "\n".join(f"| {' | '.join(line)} |" for line in cells)
        case Picture(file, caption):
            return f"![{caption}]({file.as_posix()})\n\n*{caption}*"

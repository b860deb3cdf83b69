"""A page as a list of blocks, written as Markdown and as self-contained HTML."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

STYLE = """
body { max-width: 68rem; margin: 2rem auto; padding: 0 1rem; color: #222;
       font: 16px/1.5 system-ui, sans-serif; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 0.9rem; }
th, td { padding: 0.25rem 0.7rem; border-bottom: 1px solid #ddd; text-align: left; }
img { max-width: 100%; }
figure { margin: 1.5rem 0; } figcaption { color: #555; font-size: 0.9rem; }
.scroll { overflow-x: auto; }
"""


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
    """A figure beside the page: NAME.png and NAME.svg."""

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


def page(blocks: Sequence[Block], title: str, folder: Path) -> str:
    """The page as HTML with its figures inside.

    Args:
        blocks: The page.
        title: Its title.
        folder: Where its figures are.
    """
    body = "\n".join(_html(block, folder) for block in blocks)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head>\n"
        f"<body>\n{body}\n</body></html>\n"
    )


def _html(block: Block, folder: Path) -> str:
    match block:
        case Heading(text, level):
            return f"<h{level}>{html.escape(text)}</h{level}>"
        case Text(text):
            return f"<p>{html.escape(text)}</p>"
        case Code(text):
            return f"<pre><code>{html.escape(text)}</code></pre>"
        case Table(header, rows):
            lines = [_row(header, "th"), *(_row(row, "td") for row in rows)]
            return f'<div class="scroll"><table>{"".join(lines)}</table></div>'
        case Picture(file, caption):
            data = base64.b64encode((folder / file).read_bytes()).decode()
            text = html.escape(caption)
            return (
                f'<figure><img alt="{text}" src="data:image/png;base64,{data}">'
                f"<figcaption>{text}</figcaption></figure>"
            )


def _row(cells: Sequence[str], tag: str) -> str:
    return f"<tr>{''.join(f'<{tag}>{html.escape(c)}</{tag}>' for c in cells)}</tr>"

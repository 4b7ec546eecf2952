"""The one way to write what a benchmark found: figures as JSON, tables as Markdown, pictures beside them.

A report with a title is one HTML page instead, which needs nothing but itself: pictures are embedded.
"""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from warprrf.files import plain, write_atomically, write_json, write_text

Row = dict[str, Any]
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1c1c1c; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; margin-bottom: .2rem; } h2 { font-size: 1.2rem; margin-top: 2.4rem; }
figcaption { color: #555; font-size: .92rem; } figure { margin: 1rem 0; } img { max-width: 100%; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: bottom; }
th:first-child, td:first-child { text-align: left; white-space: nowrap; }
"""


@dataclass(frozen=True)
class Report:
    """What a benchmark found.

    Attributes:
        name: of the files, ``NAME.json`` and ``NAME.md``.
        figures: everything measured, as data.
        text: the tables, as Markdown.
        pictures: file name to a function that draws a matplotlib figure, and the caption.
        title: of a page ``NAME.html`` that holds text and pictures, in the place of the Markdown one.
        dpi: of the pictures.
    """

    name: str
    figures: Mapping[str, Any]
    text: str
    pictures: Mapping[str, tuple[Callable[[], Any], str]] = field(default_factory=dict)
    title: str = ""
    dpi: int = 100

    def page(self, folder: Path) -> Path:
        """Where the page of a report in ``folder`` lies."""
        return folder / f"{self.name}.{'html' if self.title else 'md'}"

    def write(self, folder: Path) -> dict[str, Any]:
        """Write all files into ``folder`` and return the figures as JSON holds them.

        Raises:
            ImportError: if there are pictures and matplotlib is missing.
        """
        figures: dict[str, Any] = plain(dict(self.figures))
        write_json(folder / f"{self.name}.json", figures)
        if self.title:
            write_text(self.page(folder), self._html())
            return figures
        parts = [self.text]
        for name, (draw, caption) in self.pictures.items():
            write_atomically(folder / name, partial(draw().savefig, dpi=self.dpi))
            parts.append(f"![{caption}]({name})\n\n{caption}")
        write_text(self.page(folder), "\n\n".join(parts) + "\n")
        return figures

    def _html(self) -> str:
        head = f"<meta charset='utf-8'><title>{html.escape(self.title)}</title><style>{STYLE}</style>"
        parts = [
            f"<!doctype html><html lang='en'><head>{head}</head><body><h1>{html.escape(self.title)}</h1>"
        ]
        parts += [_block(block) for block in self.text.split("\n\n")]
        for name, (draw, caption) in self.pictures.items():
            kind, content = "jpeg" if name.endswith(".jpg") else "png", io.BytesIO()
            draw().savefig(content, format=kind, dpi=self.dpi)
            source = f"data:image/{kind};base64,{base64.b64encode(content.getvalue()).decode()}"
            said = html.escape(caption, quote=True)
            parts.append(f"<figure><img alt='{said}' src='{source}'><figcaption>{said}</figcaption></figure>")
        return "\n".join([*parts, "</body></html>"])


def _block(text: str) -> str:
    """A heading, a table or a paragraph of Markdown as HTML."""
    lines = html.escape(text).splitlines()
    if text.startswith("#"):
        return f"<h2>{lines[0].lstrip('# ')}</h2>"
    if not text.startswith("|"):
        code = re.sub(r"`([^`]*)`", r"<code>\1</code>", " ".join(lines))
        return f"<p>{code}</p>"
    head, _, *rows = ([cell.strip() for cell in line.strip("| ").split("|")] for line in lines)
    marked = [("th", head), *(("td", row) for row in rows)]
    body = "".join(
        "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in row) + "</tr>" for tag, row in marked
    )
    return f"<div class='wide'><table>{body}</table></div>"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells under a head, as Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cell(value: Any, form: str = "{:.2f}") -> str:
    """``value`` in the format ``form``; "-" for None."""
    return "-" if value is None else form.format(value)


def columns_table(columns: Sequence[tuple[str, str, str]], rows: Sequence[Row]) -> str:
    """Rows of figures as Markdown, by ``columns``: key, title and format; columns that no row fills are left out."""
    shown = [column for column in columns if any(row.get(column[0]) is not None for row in rows)]
    cells = [[cell(row.get(key), form) for key, _, form in shown] for row in rows]
    return table([title for _, title, _ in shown], cells)

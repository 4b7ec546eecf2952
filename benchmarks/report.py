"""The one way to write what a benchmark found: figures as JSON, tables as Markdown, pictures beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from warprrf.files import plain, write_atomically, write_json, write_text

Row = dict[str, Any]


@dataclass(frozen=True)
class Report:
    """What a benchmark found.

    Attributes:
        name: of the files, ``NAME.json`` and ``NAME.md``.
        figures: everything measured, as data.
        text: the tables, as Markdown.
        pictures: file name to a function that draws a matplotlib figure, and the caption.
        html: a page of its own in the place of the Markdown one; it is called with the figures as they were written.
        dpi: of the pictures.
    """

    name: str
    figures: Mapping[str, Any]
    text: str
    pictures: Mapping[str, tuple[Callable[[], Any], str]] = field(default_factory=dict)
    html: Callable[[dict[str, Any]], str] | None = None
    dpi: int = 100

    def page(self, folder: Path) -> Path:
        """Where the page of a report in ``folder`` lies."""
        return folder / f"{self.name}.{'html' if self.html else 'md'}"

    def write(self, folder: Path) -> dict[str, Any]:
        """Write all files into ``folder`` and return the figures as JSON holds them.

        Raises:
            ImportError: if there are pictures and matplotlib is missing.
        """
        figures: dict[str, Any] = plain(dict(self.figures))
        write_json(folder / f"{self.name}.json", figures)
        if self.html is not None:
            write_text(self.page(folder), self.html(figures))
            return figures
        parts = [self.text]
        for name, (draw, caption) in self.pictures.items():
            write_atomically(folder / name, partial(draw().savefig, dpi=self.dpi))
            parts.append(f"![{caption}]({name})\n\n{caption}")
        write_text(self.page(folder), "\n\n".join(parts) + "\n")
        return figures


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

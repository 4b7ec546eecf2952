"""What Sphinx does not do alone: reference pages, plots from result files, equations as MathML.

A page names a figure by ``<!-- figure: NAME -->``; see :mod:`plots`. Tables stand in the pages already (:mod:`results`).
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import plots
import reference
from docutils import nodes
from latex2mathml.converter import convert
from sphinx.domains.python import PyObject

FIELD = re.compile(r"^:(?:param|ivar) \w+(?:, \w+)+:")
MARK = "(no type)"
FIGURE = re.compile(r"<!-- figure: ([\w-]+) -->")


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    next(field for field in PyObject.doc_field_types if field.name == "variable").label = "Attributes"
    app.connect("builder-inited", make_files)
    app.connect("source-read", put_figures)
    app.connect("autodoc-process-docstring", whole_sentences, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", escape_bars)
    app.add_html_math_renderer(
        "mathml", inline_renderers=(inline_math, None), block_renderers=(block_math, None)
    )
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def make_files(app: Any) -> None:
    """Write the reference's pages and the figures below ``docs/`` (not kept in the repository)."""
    os.environ["COLUMNS"] = "92"  # argparse's help is as wide on every machine
    made = {Path(app.srcdir) / path: text for path, text in {**reference.pages(), **plots.figures()}.items()}
    for old in (f for folder in {file.parent for file in made} for f in folder.glob("*") if f not in made):
        old.unlink()
    for file, text in made.items():
        file.parent.mkdir(exist_ok=True)
        if not file.is_file() or file.read_text() != text:
            file.write_text(text)


def put_figures(app: Any, name: str, source: list[str]) -> None:
    """Put figures where a page names them."""
    up = "../" * name.count("/")
    source[0] = FIGURE.sub(lambda f: f"![{plots.CAPTIONS[f[1]]}]({up}figures/{f[1]}.svg)", source[0])


def whole_sentences(app: Any, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """A colon in the docstring of a property ends no type."""
    if what in ("attribute", "property", "data"):
        lines.insert(0, MARK)


def escape_bars(app: Any, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """Absolute values are no substitutions of reStructuredText, and several names of one field no type and name."""
    lines[:] = [line for line in lines if line.strip() != MARK]
    for i, line in enumerate(lines):
        line = FIELD.sub(lambda m: m[0].replace(", ", ","), line)
        parts = line.split("``")
        parts[::2] = [re.sub(r"(?<!\\)\|", r"\\|", part) for part in parts[::2]]
        lines[i] = "``".join(parts)


def inline_math(writer: Any, node: Any) -> None:
    """An equation within a sentence."""
    writer.body.append(convert(node.astext()))
    raise nodes.SkipNode


def block_math(writer: Any, node: Any) -> None:
    """An equation on a line of its own."""
    writer.body.append(convert(node.astext(), display="block"))
    raise nodes.SkipNode

"""Public names that are imported when first used, listed once: in the stub beside a package's ``__init__.py``.

Type checkers read the stub as it stands. At run time its lines give the package's attributes and its table of contents:
``# == heading ==`` begins a section, ``# text`` says what the name imported below is for.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

_IMPORT = re.compile(r"from (\S+) import (\w+) as (\w+)$")


def attach(file: str, about: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], str]:
    """``__getattr__``, ``__dir__`` and ``__doc__`` of the package whose ``__init__.py`` is ``file``.

    Args:
        about: its docstring, which the table of contents follows.
    """
    homes: dict[str, tuple[str, str]] = {}
    contents: list[tuple[str, str]] = []  # name and text; headings have no text
    text = ""
    for line in Path(file).with_suffix(".pyi").read_text(encoding="utf-8").splitlines():
        if line.startswith("# =="):
            contents.append((line.strip("#= "), ""))
        elif line.startswith("# "):
            text = line.removeprefix("# ")
        elif found := _IMPORT.match(line):
            home, origin, name = found.groups()
            homes[name] = home, origin
            contents.append((name, text))
    width = max(len(name) for name, text in contents)
    table = [f"    {name:{width}}  {text}" if text else f"\n{name}:" for name, text in contents]

    def lookup(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"{Path(file).parent.name} has no attribute {name!r}")
        home, origin = homes[name]
        module = importlib.import_module(home)
        if not hasattr(module, origin):  # a module of a package that is not imported yet
            importlib.import_module(f"{home}.{origin}")
        return getattr(module, origin)

    def listing() -> list[str]:
        return sorted(homes)

    return lookup, listing, "\n".join([about.rstrip(), *table, ""])

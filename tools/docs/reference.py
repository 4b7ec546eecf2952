"""Pages of the API reference, from what the library makes public: nothing here names a function or module by hand."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from types import ModuleType
from typing import Any

import warprrf

GROUPS = {
    "geometry": ("Geometry", "Photos, cameras, Gaussians, meshes and rays: stage 1."),
    "rf.em": ("Waves and materials", "Materials, and absorption by the air."),
    "rf.scene": (
        "Scenes and paths",
        "A scene's mesh and materials; line of sight and mirror paths through it.",
    ),
    "rf.spectra": ("Spectra", "One spectrum, data sets of many, and how predictions are scored."),
    "rf.fields": (
        "Radio fields",
        "Stage 2: fitted models of a place, asked for spectra, paths, links and maps.",
    ),
    "rf.channel": ("Channels and beams", "Arrays, codebooks, precoders, and the band plan."),
    "rf.interop": ("Exchange", "Scenes and paths to and from other programs."),
}
WITH = {
    "rf.simulate": "rf.scene",
    "rf.paths": "rf.scene",
    "rf.maps": "rf.fields",
    "rf.relevance": "rf.fields",
}
"""Packages whose names stand on another's page."""


def pages() -> dict[str, str]:
    """Path below ``docs/`` to reStructuredText: an index, a page a group, a page a public submodule, the commands."""
    groups: dict[str, list[str]] = {key: [] for key in GROUPS}
    modules: dict[str, ModuleType] = {}
    for name in sorted(warprrf.__all__, key=str.lower):
        found = getattr(warprrf, name)
        if isinstance(found, ModuleType):
            modules[name] = found
        elif inspect.isclass(found) or inspect.isfunction(found):
            groups[_group(found.__module__)].append(_entry("warprrf", name, found))
    for model in _models():
        groups["rf.fields"].append(_entry(model.__module__, model.__name__, model))
    written = {
        f"reference/{key.replace('.', '-')}.rst": "\n\n".join([_title(title), words, *groups[key]]) + "\n"
        for key, (title, words) in GROUPS.items()
        if groups[key]
    }
    written |= {
        f"reference/module-{name}.rst": _module_page(name, module) for name, module in modules.items()
    }
    written["reference/command-line.rst"] = _command_line()
    index = [
        _title("API reference"),
        "Everything on these pages is reached as ``warprrf.NAME`` (``import warprrf as wr``) unless another module is named.",
        ".. toctree::\n   :maxdepth: 2\n",
        "\n".join(f"   {path.removeprefix('reference/').removesuffix('.rst')}" for path in written),
    ]
    return {"reference/index.rst": "\n\n".join(index) + "\n", **written}


def _title(text: str) -> str:
    return f"{text}\n{'=' * len(text)}"


def _entry(module: str, name: str, found: Any) -> str:
    kind = "autoclass" if inspect.isclass(found) else "autofunction"
    return f".. {kind}:: {module}.{name}"


def _group(module: str) -> str:
    inner = module.removeprefix("warprrf.") + "."
    for key, page in {**WITH, **{k: k for k in GROUPS}}.items():
        if inner.startswith(key + "."):
            return page
    raise ValueError(
        f"{module}: no page of the reference takes names from there; see tools/docs/reference.py"
    )


def _models() -> list[type]:
    """The classes that :meth:`RadioField.fit` makes."""
    package = importlib.import_module("warprrf.rf.fields")
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(found.name)
    return sorted(warprrf.RadioField.__subclasses__(), key=lambda c: c.__name__)


def _module_page(name: str, module: ModuleType) -> str:
    parts = [_title(f"warprrf.{name}"), f".. currentmodule:: warprrf.{name}", inspect.getdoc(module) or ""]
    for member in getattr(module, "__all__", ()):
        found = getattr(module, member)
        if (inspect.isclass(found) or inspect.isfunction(found)) and member not in warprrf.__all__:
            parts.append(_entry(module.__name__, member, found))
    return "\n\n".join(parts) + "\n"


def _command_line() -> str:
    parser = importlib.import_module("warprrf.cli")._parser()
    commands = next(a for a in parser._actions if isinstance(getattr(a, "choices", None), dict))
    parts = [_title("Command line"), _text(parser.format_help())]
    for name, command in commands.choices.items():
        heading = f"warprrf {name}"
        parts += [f"{heading}\n{'-' * len(heading)}", _text(command.format_help())]
    return "\n\n".join(parts) + "\n"


def _text(text: str) -> str:
    lines = "\n".join(f"   {line}".rstrip() for line in text.rstrip().splitlines())
    return f".. code-block:: text\n\n{lines}"

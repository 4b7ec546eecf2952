"""Pages of the API reference, from what the library makes public: nothing here names a function or module by hand."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
from pathlib import Path
from types import ModuleType
from typing import Any

import warprrf
from warprrf.viewer import Viewer

GROUPS = {
    "geometry": ("Geometry", "Photos, cameras, Gaussians, meshes and rays: stage 1."),
    "rf.scene": (
        "Scenes and paths",
        "Materials and scenes, spectra by simulation, paths through a scene, arrays.",
    ),
    "rf.spectra": ("Spectra", "One spectrum, data sets of many, and how predictions are scored."),
    "rf.fields": (
        "Radio fields",
        "Stage 2: fitted models of a place, which give spectra, paths, links and maps.",
    ),
    "viewer": ("Viewer", "Everything in the browser."),
}
WITH = {
    "rf.em": "rf.scene", "rf.simulate": "rf.scene", "rf.paths": "rf.scene", "rf.channel": "rf.scene",
    "rf.maps": "rf.fields", "rf.relevance": "rf.fields", "rf.tracing": "rf.fields",
}  # fmt: skip
"""Packages whose names stand on another's page."""


def pages() -> dict[str, str]:
    """Path below ``docs/`` to reStructuredText: an index, a page a group, a page a public submodule, the commands."""
    groups: dict[str, list[str]] = {key: [] for key in GROUPS}
    modules: dict[str, ModuleType] = {}
    for name in dir(warprrf):
        found = getattr(warprrf, name)
        if isinstance(found, ModuleType):
            modules[name] = found
        elif inspect.isclass(found) or inspect.isfunction(found):
            groups[_group(found.__module__)].append(_entry("warprrf", name, found))
    for model in _models():
        options = _options(model)
        groups["rf.fields"].append(_entry(model.__module__, model.__name__, model))
        groups["rf.fields"].append(
            _entry(options.__module__, options.__name__, options) + "\n   :no-members:"
        )
    groups["viewer"].append(_entry("warprrf.viewer", "Viewer", Viewer))
    written = {
        f"reference/{key.replace('.', '-')}.rst": "\n\n".join([_title(title), words, *groups[key]]) + "\n"
        for key, (title, words) in GROUPS.items()
        if groups[key]
    }
    written |= {f"reference/module-{name}.rst": _module_page(name, found) for name, found in modules.items()}
    written["reference/command-line.rst"] = _command_line()
    index = [
        _title("API reference"),
        "Names are reached as ``warprrf.NAME`` (``import warprrf as wr``), those of a module as ``wr.MODULE.NAME``; the "
        "models that a fit makes, and their options, are imported from where they are. ``help(wr)`` and "
        "``help(wr.MODULE)`` print the same lists.",
        ".. toctree::\n   :maxdepth: 2\n",
    ]
    listed = "\n".join(f"   {path.removeprefix('reference/').removesuffix('.rst')}" for path in written)
    return {"reference/index.rst": "\n\n".join(index) + "\n" + listed + "\n", **written}


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


def _options(model: Any) -> type:
    """The dataclass of the options that a model's ``fit`` takes."""
    annotation = inspect.signature(model.fit).parameters["options"].annotation
    names = inspect.unwrap(model.fit.__func__).__globals__
    found: type = names[str(annotation).split(" ")[0]]
    return found


def _module_page(name: str, module: ModuleType) -> str:
    about = ast.get_docstring(ast.parse(Path(module.__file__ or "").read_text())) or ""
    parts = [_title(f"wr.{name}"), about.split("\n\n")[0]]
    for member in dir(module):
        found = getattr(module, member)
        known = inspect.isclass(found) or inspect.isfunction(found)
        listed = hasattr(module, "__path__") or getattr(found, "__module__", "") == module.__name__
        if known and listed and not member.startswith("_"):
            parts.append(_entry(f"warprrf.{name}", member, found) if member not in dir(warprrf) else "")
    return "\n\n".join(part for part in parts if part) + "\n"


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

"""Marks of code: what a kept result depends on besides its inputs.

A result that is kept for a later run is valid for the inputs it was made from and for the code that made it. The mark
of a step's code is a hash of the source of its modules and of all that they import, so that nobody has to keep a list,
or remember to count up a version.
"""

from __future__ import annotations

import ast
import hashlib
import logging
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.metadata import packages_distributions, version
from importlib.util import find_spec, resolve_name
from pathlib import Path

_log = logging.getLogger(__name__)


def code_mark(*modules: str, packages: Sequence[str] = ()) -> str:
    """SHA-256 of the source that ``modules`` run, and of the versions of ``packages``.

    Imports are followed within the modules' own package, where a module makes them when it is loaded: not those inside
    functions, nor those for type checkers. Where a result depends on what a function imports, name that too.

    Args:
        modules: full names, ``"warprrf.geometry.photos.sfm"``; a package stands for all modules below it.
        packages: import names of other packages whose version counts, ``"pycolmap"``; one may be missing.

    Raises:
        ValueError: if there is no source file for a module.
    """
    digest = hashlib.sha256()
    for name, source in sorted(_sources(modules).items()):
        digest.update(f"{name} {source}\n".encode())
    for package in sorted(packages):
        digest.update(f"{package} {', '.join(_versions(package))}\n".encode())
    return digest.hexdigest()


def log_other_code(kept: Path) -> None:
    """Say why what ``kept`` holds is not used, though nothing that went into it has changed."""
    _log.warning("%s was made by other code or packages: this step and those after it are done again", kept)


def _sources(modules: Sequence[str]) -> dict[str, str]:
    """Hashes of the source of ``modules`` and of all that they import, by name."""
    found: dict[str, str] = {}
    waiting = [name for module in modules for name in _below(module)]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name], imported = _read(name)
            waiting += imported
    return found


def _file(module: str) -> Path | None:
    """Where a module's source lies; nothing is imported to find out."""
    package, *rest = module.split(".")
    spec = find_spec(package)
    for root in (spec.submodule_search_locations or ()) if spec is not None else ():
        place = Path(root, *rest)
        for file in (place.with_suffix(".py"), place / "__init__.py"):
            if file.is_file():
                return file
    return None


def _source(module: str) -> Path:
    file = _file(module)
    if file is None:
        raise ValueError(f"modules: {module!r} has no source file, expected a name such as 'warprrf.device'")
    return file


def _below(module: str) -> list[str]:
    """The module's name, or of a package the names of all modules in it."""
    file = _source(module)
    if file.name != "__init__.py":
        return [module]
    inside = [path.relative_to(file.parent).with_suffix("").parts for path in file.parent.rglob("*.py")]
    return [".".join((module, *parts)).removesuffix(".__init__") for parts in inside]


@cache
def _read(module: str) -> tuple[str, tuple[str, ...]]:
    """Hash of a module's source, and the modules of its package that it imports."""
    file = _source(module)
    source = file.read_bytes()
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    found: dict[str, None] = {}
    for name in _imports(ast.parse(source), package):
        if name.split(".")[0] == module.split(".")[0]:
            # What is taken from a module is a module below it, or else something that it defines.
            found[name if _file(name) is not None else name.rpartition(".")[0]] = None
    return hashlib.sha256(source).hexdigest(), tuple(found)


def _imports(node: ast.AST, package: str) -> Iterator[str]:
    """Names that are imported when a module of ``package`` is loaded, those taken from a module behind its name."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            origin = resolve_name("." * child.level + (child.module or ""), package)
            yield from (f"{origin}.{alias.name}" for alias in child.names)
        elif not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) and not _for_type_checkers(child):
            yield from _imports(child, package)


def _for_type_checkers(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


@cache
def _versions(package: str) -> tuple[str, ...]:
    """Versions of the installed distributions that a package comes from; none where it is missing."""
    return tuple(f"{name} {version(name)}" for name in sorted(set(packages_distributions().get(package, ()))))

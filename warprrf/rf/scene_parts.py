"""What a scene is put together from: objects of one material each, and which material a name stands for."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from warprrf.checks import check_type
from warprrf.rf.em.materials import Material, load_materials

Materials = Mapping[str, Material] | str | os.PathLike[str]
"""Materials by the name of what they replace, or a table's file."""


@dataclass(frozen=True)
class ScenePart:
    """One object.

    Attributes:
        name: its name.
        vertices: positions [m], shape ``(V, 3)``.
        faces: vertex indices, shape ``(F, 3)``.
        material: what it is made of.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    material: Material


class MaterialChoice:
    """Materials by name: the caller's, then a table's, then what the scene says.

    Args:
        given: a mapping, every name of which must be asked for, or a table's file, which may hold more.
        table: the scene's own table.
        extrapolate: see :meth:`Material.extrapolated`.

    Raises:
        TypeError, ValueError, FileNotFoundError: if ``given`` is no such mapping or file.
    """

    def __init__(
        self, given: Materials | None, table: Mapping[str, Material] | None = None, extrapolate: bool = False
    ) -> None:
        self._table = dict(table or {})
        self._wanted: set[str] = set()
        if isinstance(given, Mapping):
            for name, material in given.items():
                check_type(f"materials[{name!r}]", material, Material)
            self._wanted = set(given)
            self._table |= given
        elif given is not None:
            if not isinstance(given, str | os.PathLike):
                raise TypeError(
                    f"materials: got {type(given).__name__}, expected a mapping of names to materials, or a table's file"
                )
            self._table |= load_materials(given)
        self._extrapolate = extrapolate
        self._chosen: dict[str, Material] = {}

    @property
    def names(self) -> list[str]:
        """Names that are known whatever the scene says."""
        return sorted(self._table)

    def choose(self, name: str, declared: Callable[[], Material]) -> Material:
        """The material of ``name``; ``declared`` is asked where neither the caller nor a table has it."""
        if name not in self._chosen:
            material = self._table[name] if name in self._table else declared()
            self._chosen[name] = material.extrapolated() if self._extrapolate else material
        return self._chosen[name]

    def check_used(self) -> None:
        """Refuse names that nothing is made of.

        Raises:
            ValueError: naming one, and what there is.
        """
        for name in sorted(self._wanted - set(self._chosen)):
            raise ValueError(
                f"materials: got {name!r}, of which nothing in the scene is made; it has "
                f"{', '.join(sorted(self._chosen))}"
            )

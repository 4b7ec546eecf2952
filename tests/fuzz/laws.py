"""Laws of what is not one call nor one file: a list of edits makes the case, as for files, and a law says what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import rooms

from fuzz.files import Edit, Unfit
from fuzz.place import Place


@dataclass(frozen=True)
class Law:
    """What must hold.

    Attributes:
        edits: names that edits may have; each has two numbers too.
        wrong: what is wrong where edits were made; empty if nothing is.
        most: how many edits.
    """

    edits: Sequence[str]
    wrong: Callable[[Place, tuple[Edit, ...]], str]
    most: int = 3


@cache
def _before(room: str, figure: str) -> np.ndarray:
    return rooms.FIGURES[figure](rooms.ROOMS[room]().with_gaussians())


def _rooms(place: Place, edits: tuple[Edit, ...]) -> str:
    """What a room is written like does not change what it does; rounding first, so that it is of the room's own size."""
    laws = sorted({name for name, _, _ in edits}, key=lambda name: (name in rooms.EXACT, name))
    if sum(law in rooms.ROUNDED for law in laws) > 1 or (
        len(laws) > 1 and "doubled, of another material" in laws
    ):
        raise Unfit("two errors at once, or copies of another material that are copied")
    _, a, b = edits[0]
    figure, room = list(rooms.FIGURES)[a % 5], list(rooms.ROOMS)[b % 3]
    if room == "lobby" and figure not in ("mirrors", "exact"):
        raise Unfit("takes minutes")
    changed = rooms.ROOMS[room]().with_gaussians()
    for law in laws:
        changed = rooms.LAWS[law](changed)
    now, before = rooms.FIGURES[figure](changed), _before(room, figure)
    most = sum(rooms.most_db(figure, law) for law in laws)
    total = rooms.total_change_db(now, before)
    rms = 0.0 if changed.turned is None or figure == "mirrors" else rooms.rms_change_db(now, before)
    found = f"{figure} in the room {room}: {total:.2g} dB of the total, {rms:.2g} dB rms, at most {most:.2g} dB wanted"
    return found if total > most or rms > max(0.3, most) else ""


LAWS: dict[str, Law] = {
    "rooms": Law(list(rooms.LAWS), _rooms),
}

"""Laws of what is not one call nor one file: a list of edits makes the case, as for files, and a law says what is wrong."""

from __future__ import annotations

import contextlib
import io
import pickle
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import rooms
from radio_scenes import box_mesh, joined, square
from small_room import TRANSMITTER

import warprrf as wr
from fuzz.answers import differs, leaves
from fuzz.calls import CLASSES
from fuzz.files import Edit, Unfit
from fuzz.place import POINTS, TOWARDS, Place
from warprrf import cli


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
    if changed.gaussians is None and figure == "rf3dgs+":
        raise Unfit("has no Gaussians")
    with rooms.rays_turned(changed.rotation) if figure == "exact" else contextlib.nullcontext():
        now = rooms.FIGURES[figure](changed)
    before = _before(room, figure)
    most = sum(rooms.most_db(figure, law) for law in laws)
    total = rooms.total_change_db(now, before)
    rms = 0.0 if changed.turned is None or figure == "mirrors" else rooms.rms_change_db(now, before)
    found = f"{figure} in the room {room}: {total:.2g} dB of the total, {rms:.2g} dB rms, at most {most:.2g} dB wanted"
    return found if total > most or rms > max(0.3, most) else ""


def _fit(geometry: Any, data: Any) -> wr.RadioField:
    return wr.RadioField.fit(geometry, data, quick=True, device="cpu")


def _told(ask: Callable[[], Any]) -> str:
    """What is said of a problem: the error that refuses it, or warnings; empty if nothing is."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            ask()
        except (ValueError, TypeError, OSError) as error:
            return str(error)
    return "; ".join(str(w.message) for w in said)


SIZE = np.array([6.0, 5.0, 3.0])
BASES = ("room", "open room", "loose walls", "boxes on the ground")


def _sheet(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """One vertical wall of no thickness somewhere in the room, wound either way."""
    start, angle, length = rng.uniform(0.8, 0.7 * SIZE[:2]), rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 2.0)
    end = np.clip(start + length * np.array([np.cos(angle), np.sin(angle)]), 0.1, SIZE[:2] - 0.1)
    v = np.array([[*start, 0.1], [*end, 0.1], [*end, 2.2], [*start, 2.2]])
    return v, np.array([[0, 1, 2], [0, 2, 3]])[:, :: rng.choice([1, -1])]


def _free_places(place: Place, edits: tuple[Edit, ...]) -> str:
    """Free is what no closed box holds, and in a closed room what is in the room: sheets and openings change nothing."""
    rng = np.random.default_rng([edits[0][1], edits[0][2]])
    base = BASES[edits[0][1] % 4]
    walls, faces = box_mesh([0, 0, 0], SIZE, inward=True)
    side = 2 * int(rng.integers(4))  # x and y sides, of two faces each
    parts = {
        "room": [(walls, faces)],
        "open room": [(walls, np.delete(faces, [side, side + 1], axis=0))],
        "loose walls": [(walls, faces[-4:-2])] + [_sheet(rng) for _ in range(3)],  # and a floor
        "boxes on the ground": [square(9.0)],
    }[base]
    solids = []
    for name in ["solid"] * (base == "boxes on the ground") + [name for name, _, _ in edits]:
        if name == "sheet":
            parts.append(_sheet(rng))
        elif name == "solid":
            low = rng.uniform(0.3, 0.6 * SIZE)
            solids.append((low, low + rng.uniform(0.2, 0.35 * SIZE)))
            parts.append(box_mesh(*solids[-1]))
    mesh, part = joined(*parts)
    stuff = wr.Material.custom("stone", relative_permittivity=3.0, scattering=0.5, thickness_m=0.05)
    scene = wr.Scene(mesh, [stuff], np.zeros(len(part), int))

    def free(points: np.ndarray) -> np.ndarray:
        held = [((points > low) & (points < high)).all(axis=-1) for low, high in solids]
        return ~np.any(held, axis=0) if held else np.ones(points.shape[:-1], bool)

    points = rng.uniform(*mesh.bounds, (200, 3))
    points = points[mesh.distance(points) > 0.05]
    bad = {
        f"is_free is wrong at {n} of {len(points)} places": n
        for n in [(scene.is_free(points) != free(points)).sum()]
    }
    floor, height = mesh.bounds[0, 2], np.ptp(mesh.bounds[:, 2])
    drawn = wr.sample_receivers(
        scene, 30, z=(floor + 0.25 * height, floor + 0.75 * height), clearance=0.1, seed=0
    )
    bad[f"sample_receivers draws {(~free(drawn)).sum()} of 30 in solids"] = (~free(drawn)).sum()
    source = drawn[0]
    field = _fit(scene, wr.SpectrumDataset.empty(transmitter=source, frequency_hz=28e9, shape=(6, 12)))
    shown = field.radio_map(float(source[2]), 0.4)
    cells = np.stack(np.broadcast_arrays(*np.meshgrid(shown.x, shown.y), source[2]), axis=-1)
    clear = mesh.distance(cells.reshape(-1, 3)).reshape(cells.shape[:2]) > 0.1
    n = (shown.free != free(cells))[clear & (np.linalg.norm(cells - source, axis=-1) > 0.2)].sum()
    bad[f"radio_map is wrong at {n} of {clear.sum()} cells"] = n
    return "; ".join([base, *(text for text, count in bad.items() if count)]) if any(bad.values()) else ""


def _patterns(place: Place, edits: tuple[Edit, ...]) -> str:
    """A pattern that is a function gives what its samples give, wherever one is taken."""
    verb, a, _ = edits[0]
    horn, grid = wr.horn(0.3 + 0.1 * (a % 10)), np.linspace(0.0, np.pi, 4001)
    found = [leaves(PATTERNS[verb](place, pattern)) for pattern in (horn, horn.gain_off_boresight(grid))]
    return differs(*found, 1e-3)


def _element(pattern: Any) -> wr.PlanarArray:
    return wr.PlanarArray(1, 2, pattern=pattern)


def _kept(place: Place, pattern: Any) -> Any:
    Path("cfr.nc").unlink(missing_ok=True)
    return place.field.cfr(
        POINTS, [300e9], tx_array=_element(pattern), diffuse="power", max_paths=9, store="cfr.nc"
    )


PATTERNS: dict[str, Callable[[Place, Any], Any]] = {
    "gain": lambda place, pattern: _element(pattern).gain(TOWARDS),
    "codebook": lambda place, pattern: wr.channel.dft_codebook(_element(pattern)).power(TOWARDS, np.array([1e-9, 2e-9])),
    "paths": lambda place, pattern: place.paths.cfr(np.array([300e9]), tx_array=_element(pattern)),
    "cfr": lambda place, pattern: place.field.cfr(POINTS, [300e9], rx_array=_element(pattern), diffuse="power", max_paths=9),
    "stored cfr": _kept,
    "suggest": lambda place, pattern: place.field.suggest(
        POINTS, 2, arrival=np.full((3, 2), 1.5), receive_pattern=pattern
    ),
    "readings": lambda place, pattern: (
        _fit(place.scene, replace(place.readings, receive_pattern=pattern)).spectrum(POINTS[1]).path_gain
    ),
    "deembed": lambda place, pattern: (
        place.train.subset([0]).deembed(pattern=pattern, iterations=10, tolerance=1e-2).path_gain
    ),
}  # fmt: skip


COLUMNS = (
    "tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z", "power_db", "azimuth_deg", "elevation_deg", "std_db", "chain",
)  # fmt: skip
TABLE = (
    "misspelt", "renamed", "extra column", "twice", "extra value", "NA", "empty", "spaces", "byte order", "quoted", "blank line",
)  # fmt: skip


def _table(place: Place, edits: tuple[Edit, ...]) -> str:
    """A CSV file is read as it says, or what is odd about it is told."""
    rows = [
        [*(f"{x:g}" for x in (*TRANSMITTER, *POINTS[k])), f"{-80 - k}", f"{30 * k}", "5", "1", "a"]
        for k in range(3)
    ]
    head, told, mark, gap, quote, blank = list(COLUMNS), False, "", ",", "", False
    chains = ["a", "a", "a"]
    for name, a, b in edits:
        k = b % len(head)
        if name == "misspelt":
            head[k], told = head[k][:-1] if b % 2 else head[k].replace("_", ""), True
            told = head[k] not in COLUMNS
        elif name == "renamed":
            head[k] = head[k].partition("_")[0]
            told = head[k] not in COLUMNS
        elif name == "extra column":
            head.append(f"note_{a}")
            rows = [[*row, "x"] for row in rows]
        elif name == "twice":
            head.insert(k, head[k])
            rows = [[*row[:k], str(a % 90), *row[k:]] for row in rows]
            told = True
        elif name == "extra value":
            rows[a % 3] = [*rows[a % 3], "7"] if b % 2 else ["7", *rows[a % 3]]
            told = True
        elif name in ("NA", "empty") and "chain" in head:
            rows[a % 3][head.index("chain")] = chains[a % 3] = "NA" if name == "NA" else ""
        else:
            mark, gap, quote, blank = (
                "\ufeff" if name == "byte order" else mark, ", " if name == "spaces" else gap,
                '"' if name == "quoted" else quote, blank or name == "blank line",
            )  # fmt: skip
    lines = [gap.join(f"{quote}{cell}{quote}" for cell in row) for row in [head, *rows]]
    Path("readings.csv").write_text(mark + ("\n\n" if blank else "\n").join(lines) + "\n", encoding="utf-8")
    got: list[wr.Readings] = []
    setting = {"frequency_hz": 300e9, "floor": 1e-14, "receive_pattern": wr.horn(0.2)}
    said = _told(lambda: got.append(wr.Readings.load("readings.csv", **setting)))
    if said:
        return "" if got or "readings.csv" in said else f"the file is not named: {said}"
    if told:
        return "nothing is said"
    (found,) = got
    right = {
        "receivers": POINTS, "power": 10.0 ** np.array([-8.0, -8.1, -8.2]), "std_db": np.ones(3),
        "arrival": np.radians([[85.0, 30.0 * k] for k in range(3)]),
    }  # fmt: skip
    bad = [name for name, value in right.items() if not np.allclose(getattr(found, name), value)]
    bad += ["chain"] * (found.chain.tolist() != chains)
    return f"read as other {', '.join(bad)}" if bad else ""


PICKLED: dict[str, Callable[[Place], Any]] = {
    "idw": lambda place: wr.lookups.idw(place.train),
    "constant": lambda place: wr.lookups.constant(place.train),
    "mean": lambda place: wr.lookups.mean(place.train),
}


def _pickles(place: Place, edits: tuple[Edit, ...]) -> str:
    """What a pickle brings back is the same."""
    held = (CLASSES | PICKLED)[edits[0][0]](place)
    again = pickle.loads(pickle.dumps(held))
    return differs(leaves(again), leaves(held)) if type(again) is type(held) else f"a {type(again).__name__}"


COMMANDS = {
    "simulate": "{0}/scene.xml -o x.nc --transmitter 0.8 0.9 2.2 --receivers 1,1,1.5 --shape 6 12",
    "fit": "{0}/scene.xml {0}/spectra.nc -o f.safetensors --quick --train 2",
    "evaluate": "{0}/bistatic.safetensors {0}/spectra.nc --train 8 -o e.json",
    "suggest": "{0}/bistatic.safetensors 1,1,1.5 2,3,1 -n 1 -o next.csv",
    "map": "{0}/bistatic.safetensors -o m.nc --cell 1 --height 1.2",
    "twin": "{0}/bistatic.safetensors -o twin",
    "render": "{0}/bistatic.safetensors --receiver 1 1 1.5 -o r.npz",
    "relevance": "{0}/scene.xml --spectra {0}/spectra.nc --most 1 -o rel.json",
}  # fmt: skip
WORDS = [*"nonsense -1 0 nan 1e999 --none = 1,2 1,2,3,4 . none.nc é".split(), "", "x" * 300, "\0"]


def _command(place: Place, edits: tuple[Edit, ...]) -> str:
    """A command ends with 0, or with 2 and one line that says what is wrong."""
    name = edits[0][0]
    words = [name, *COMMANDS[name].format(place.folder).split(), "--device", "cpu", "--quiet"]
    for _, a, b in edits:
        k = 1 + a % (len(words) - 1)
        words[k : k + 1] = (
            [WORDS[b // 4 % len(WORDS)]],
            [],
            [words[k]] * 2,
            [words[k], WORDS[b // 4 % len(WORDS)]],
        )[b % 4]
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            status = cli.main(words)
        except SystemExit as end:  # --help
            status = end.code
    lines = said.getvalue().strip().splitlines()
    wrong = status not in (0, 2) or (status == 2 and sum("error: " in line for line in lines) != 1)
    return f"{words} ended with {status}: {lines[-3:]}" if wrong else ""


LAWS: dict[str, Law] = {
    "rooms": Law(list(rooms.LAWS), _rooms),
    "free places": Law(["none", "sheet", "sheet", "solid"], _free_places),
    "patterns": Law(list(PATTERNS), _patterns, 1),
    "table": Law(TABLE, _table),
    "pickles": Law([*CLASSES, *PICKLED], _pickles, 1),
    "command line": Law(list(COMMANDS), _command),
}
"""By name."""

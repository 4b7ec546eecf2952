"""A floor of offices over 3 to 7 GHz: impulse responses from three places of a transmitter, at two heights, to four receivers.

Measured in Rennes in 2008 by CEA-Leti and Siradel in the project WHERE (Uguen et al., European Wireless 2012), and given away by
IETR with PyLayers (repository buguen/pylayers, MIT licence). Known: where the ends are, the plan with names of walls, where
cupboards of metal stand, and heights: the transmitter's is in each file, 1.2 m of the receivers stands in
``data/ini/w2m1tx.ini`` and in ``mesuwb.py``. Channels 1 to 4 of a file are receivers 3, 4, 1 and 2: ``mesuwb.py`` reads them so,
and delays say so too. Guessed: that walls are as thick as that project's table says (a partition: 0.1 m) and are what ITU-R P.2040
calls so, and that both antennas are as the far field in ``data/ant/defant.vsh3``, which that project's notebooks say was of the
campaign, and send as it does along the horizon.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from configparser import ConfigParser
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.polynomial.legendre import Legendre
from scipy.io import loadmat

import warprrf as wr
from benchmarks.measured.arrivals import CLEAR, Arrivals, Response, compared
from benchmarks.measured.links import Links, Place, crossings, db
from benchmarks.report import Row, columns_table
from warprrf.rf.em.materials import itu_material
from warprrf.rf.em.waves import SPEED_OF_LIGHT

FREQUENCIES_HZ = np.arange(3e9, 7.001e9, 5e6)  # what the pulse fills
FREQUENCY_HZ = 4.9e9  # whose free-space loss is that of the band in its window
QUIET_NS = 25.0  # no wave can come before; the nearest ends are 28.7 ns apart
END_NS = 175.0  # of the power that is summed: the record repeats after 200
NEAR = (2, 4)  # receivers at most two partitions away
RECEIVERS = (
    (-12.2724, 7.7632, 1.2),
    (-18.7747, 15.1780, 1.2),
    (-4.1418, 8.8603, 1.2),
    (-9.0914, 15.1899, 1.2),
)
TRANSMITTERS = {"P001": (-27.3569, 14.7833), "P002": (-27.3445, 13.7810), "P003": (-27.3563, 12.7818)}
"""Positions [m], from ``data/ini/w2m1tx.ini`` and ``w2m1rx.ini``."""
CHANNELS = (3, 4, 1, 2)  # of receivers 1 to 4
CEILING_M, FOOT_M = 3.0, 0.01  # of the plan's walls; of furniture, above the floor
SLABS = 6  # most that a path passes: five partitions stand between some ends
FADING = 100  # independent samples in a power: some 40 ns of echoes, 2.7 of them in each
MATERIALS = {
    "PARTITION": ("plasterboard", 0.1), "PLASTERBOARD_7CM": ("plasterboard", 0.07), "PLASTERBOARD_10CM": ("plasterboard", 0.1),
    "PLASTERBOARD_14CM": ("plasterboard", 0.14), "WALL": ("brick", 0.07), "CONCRETE_7CM3D": ("concrete", 0.07),
    "CONCRETE_20CM3D": ("concrete", 0.2), "PILLAR": ("concrete", 0.3), "WOOD": ("wood", 0.04), "SLAB": ("concrete", 0.1),
    "METAL": ("metal", 0.001),
}  # fmt: skip
"""P.2040's name, and thickness [m] from ``data/ini/slabDB.ini``, by the plan's name of a wall; floor and ceiling, and metal."""
PLAN, FURNITURE = Path("data/struc/lay/WHERE1.lay"), Path("data/struc/furnitures/Furw1.ini")
RESPONSES, ANTENNA = Path("data/meas/W1"), Path("data/ant/defant.vsh3")
OUTLINE = ((-28.2, 4.2), (31.8, 4.2), (31.8, 16.9), (-28.2, 16.9))  # of floor and ceiling [m]
ASSUMED_M = (0.8, 1.0, 1.2, 1.5, 2.0, 2.5)  # heights of receivers, to say how much delays depend on them
EFFECTS = wr.Effects(
    mirrors=2, scatterings=1, mirror_scatter=False, scatter_mirror=False, transmissions=SLABS
)
Spot: TypeAlias = tuple[float, ...]
Quad: TypeAlias = list[Spot]
NOISE = (
    ("receiver", "receiver", "{}"), ("noise_db", "noise [dB]", "{:.1f}"), ("clear_db", "first arrival above noise [dB]", "{:.0f}"),
    ("first_ns", "error by noise: its delay [ns]", "{:.3f}"), ("first_db", "its power [dB]", "{:.2f}"),
    ("total_db", "total power [dB]", "{:.2f}"), ("heights_ns", "between heights: its delay [ns]", "{:.2f}"),
    ("heights_db", "its power [dB]", "{:.1f}"), ("heights_total_db", "total power [dB]", "{:.1f}"),
)  # fmt: skip
ARRIVALS = (
    ("model", "nothing fitted", "{}"), ("missed", "links not traced", "{}"),
    ("first_ns", "first arrival: delay, median [ns]", "{:.2f}"),
    ("first_db", "power, rms [dB]", "{:.1f}"), ("first_mean_db", "power, mean [dB]", "{:+.1f}"),
    ("near_first_ns", "first arrival, receivers 2 and 4: delay [ns]", "{:.2f}"), ("near_first_db", "power, rms [dB]", "{:.1f}"),
    ("near_first_mean_db", "power, mean [dB]", "{:+.1f}"), ("strongest_ns", "strongest arrival: delay, median [ns]", "{:.2f}"),
    ("strongest_db", "power, rms [dB]", "{:.1f}"), ("met", "strong arrivals matched", "{:.0%}"),
    ("by_chance", "by chance", "{:.0%}"),
)  # fmt: skip


def place(folder: Path, seed: int) -> Place:
    """The floor as measured; ``seed`` decides nothing here.

    Raises:
        FileNotFoundError, ValueError: naming the file that is not there or does not fit.
    """
    measured = responses(folder / RESPONSES)
    plan, furnished = scene(folder, "walls"), scene(folder, "walls", "metal")
    number = np.array([one.receiver for one in measured])
    fixed, moved = np.array(RECEIVERS)[number - 1], np.array([one.transmitter for one in measured])
    metal = np.where(furnished.face_material == list(MATERIALS).index("METAL"), 1, 0)
    walls = (
        crossings(plan, fixed, moved, np.zeros_like(plan.face_material))[:, 0],
        crossings(furnished, fixed, moved, metal)[:, 1] // 2,
    )
    power, noise = np.array([one.response.power(QUIET_NS, END_NS) for one in measured]).T
    cell = np.unique(moved[:, :2], axis=0, return_inverse=True)[1].reshape(-1)
    links = Links(
        fixed, moved, db(power), number, cell, np.full(len(number), "floor"), np.stack(walls, axis=1)
    )
    every = {"mirror_order": 2, "transmissions": SLABS, "diffractions": 1}
    traced: dict[str, tuple[wr.Scene, Mapping[str, Any]]] = {
        "straight ray in air": (scene(folder), {"mirror_order": 0}),
        "straight ray, P.2040 walls": (plan, {"mirror_order": 0, "transmissions": SLABS}),
        "traced, walls": (plan, every), "traced, walls and metal": (furnished, every),
    }  # fmt: skip
    both = antenna(folder, FREQUENCIES_HZ) ** 2
    rows = [{"model": name} | _unfitted(measured, both, *given) for name, given in traced.items()]
    stated = _noise(measured, links, noise / power)
    each = [
        {"receiver": one.receiver, "transmitter": one.transmitter.tolist(), "total_db": float(level)}
        | {key: value for key, value in vars(one.arrivals).items() if np.isscalar(value)}
        for one, level in zip(measured, links.level_db, strict=True)
    ]
    files = tuple(folder / part for part in (RESPONSES, PLAN, FURNITURE, ANTENNA))
    fields = {
        "field, walls": (plan, EFFECTS), "field, walls and metal": (furnished, EFFECTS),
        "field, walls, three slabs at most": (plan, replace(EFFECTS, transmissions=3)),
    }  # fmt: skip
    return Place(
        str(__doc__).split("\n")[0], files, links, FREQUENCY_HZ, float(links.level_db.min() - 10.0), FADING, ("pair", "height"),
        traced, fields, {"rows": stated}, columns_table(NOISE, stated) + "\n\n" + columns_table(ARRIVALS, rows),
        {"arrivals": rows, "heights": [_assumed(links, z) for z in ASSUMED_M], "links": each},
    )  # fmt: skip


@dataclass(frozen=True)
class Measured:
    """What was measured on a link: ``transmitter`` (3,) [m], number of the ``receiver``, ``response`` and its ``arrivals``."""

    transmitter: np.ndarray
    receiver: int
    response: Response
    arrivals: Arrivals


def responses(folder: Path) -> list[Measured]:
    """Of all files in ``folder`` and below, four links each.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: naming a file that does not say what is needed, or a place that is not known.
    """
    files = sorted(folder.rglob("*.mat"))
    if not files:
        raise FileNotFoundError(
            f"{folder}: no file *.mat there; --source is a copy of the repository github.com/buguen/pylayers, which holds some"
        )
    found = []
    for file in files:
        held = loadmat(file, simplify_cells=True)
        try:
            data, name, height = held["DECONV_DATA"]["FREQ_DOMAIN"], held["Tx_position"], held["Tx_height"]
            spot = np.array([*TRANSMITTERS[name], float(height.removesuffix("cm")) / 100.0])
            frequency, transfer = data["Freq"], [data[f"CH{channel}"] for channel in CHANNELS]
        except (KeyError, ValueError) as error:
            raise ValueError(
                f"{file}: {error!r}: expected DECONV_DATA.FREQ_DOMAIN with Freq and CH1 to CH4, Tx_height in cm, and Tx_position, "
                f"one of {', '.join(TRANSMITTERS)}"
            ) from error
        own = (frequency >= FREQUENCIES_HZ[0]) & (frequency <= FREQUENCIES_HZ[-1])
        for k, values in enumerate(transfer):
            response = Response.of(frequency[own], values[own], QUIET_NS)
            found.append(Measured(spot, k + 1, response, Arrivals.of(response)))
    return found


def scene(folder: Path, *parts: str) -> wr.Scene:
    """Floor and ceiling, and of ``parts`` the plan's ``"walls"`` as sheets, and furniture of ``"metal"`` as closed boxes."""
    names, quads = list(MATERIALS), [("SLAB", _level(OUTLINE, z)) for z in (0.0, CEILING_M)]
    if "walls" in parts:
        plan = _sections(folder / PLAN)
        point = {name: ast.literal_eval(text) for name, text in plan["points"].items()}
        walls = [ast.literal_eval(text) for text in plan["segments"].values()]
        quads += [
            (wall["name"], _upright(*(point[str(end)] for end in wall["connect"]), *wall["z"]))
            for wall in walls if wall["name"] in MATERIALS
        ]  # fmt: skip
    if "metal" in parts:
        furniture = [
            item for item in _sections(folder / FURNITURE).values() if item.get("matname") == "METAL"
        ]
        quads += [("METAL", side) for item in furniture for side in _box(item)]
    faces = (4 * np.arange(len(quads))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    mesh = wr.Mesh(np.concatenate([np.array(quad, float) for _, quad in quads]), faces)
    of_face = np.repeat([names.index(name) for name, _ in quads], 2)
    materials = [itu_material(itu, name=name, thickness_m=thick) for name, (itu, thick) in MATERIALS.items()]
    return wr.Scene(mesh, materials, of_face, face_object=of_face, object_names=names)


def _sections(path: Path) -> ConfigParser:
    read = ConfigParser(interpolation=None, delimiters="=")
    read.optionxform = str  # type: ignore[assignment,method-assign]
    with path.open(encoding="utf-8") as file:
        read.read_file(file)
    return read


def _upright(a: Spot, b: Spot, low: float, high: float) -> Quad:
    return [(*a, low), (*b, low), (*b, high), (*a, high)]


def _level(corners: Sequence[Spot], z: float) -> Quad:
    return [(*corner, z) for corner in corners]


def _box(item: Mapping[str, str]) -> list[Quad]:
    """Six sides of a piece of furniture, normals outward."""
    turn, length, width, high = (float(item[key]) for key in ("angle", "length", "width", "height"))
    along = np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
    start, across = np.array(ast.literal_eval(item["origin"])), np.array([-along[1], along[0]])
    square = ((0, 0), (1, 0), (1, 1), (0, 1))
    corners = [tuple((start + u * length * along + v * width * across).tolist()) for u, v in square]
    sides = [_upright(corners[k], corners[(k + 1) % 4], FOOT_M, high) for k in range(4)]
    return [*sides, _level(corners, high), _level(corners[::-1], FOOT_M)]


def antenna(folder: Path, frequency_hz: np.ndarray) -> np.ndarray:
    """What the antenna sends along the horizon, in the mean over azimuths: the root of its gain, and its phase, shape ``(F,)``.

    From its vector spherical harmonics of order 0, of which the horizon has the derivatives of Legendre polynomials at 0; a field
    of the root of 30 V is a gain of one, and a phase of -2 pi f tau is one that comes tau later.
    """
    if not (folder / ANTENNA).is_file():
        raise FileNotFoundError(
            f"{folder}: there is no {ANTENNA}, which the repository github.com/buguen/pylayers holds"
        )
    held = loadmat(folder / ANTENNA, simplify_cells=True)
    degree, order = held["Br.ind"].T
    known = np.linspace(held["fmin"], held["fmax"], len(held["Br.s3"])) * 1e9
    slope = [np.sqrt((n + 0.5) / (n * (n + 1.0))) * Legendre.basis(int(n)).deriv()(0.0) for n in degree]
    field = held["Br.s3"] @ np.where(order == 0, slope, 0.0) / np.sqrt(30.0)
    return np.interp(frequency_hz, known, field.real) + 1j * np.interp(frequency_hz, known, field.imag)


def _unfitted(
    measured: Sequence[Measured], antennas: np.ndarray, place: wr.Scene, options: Mapping[str, Any]
) -> Row:
    """Arrivals of sharp paths between ``antennas``, in the measurement's band and over its noise, against those measured."""
    traced = []
    for one in measured:
        ends: dict[str, Any] = {"transmitter": one.transmitter, "receivers": RECEIVERS[one.receiver - 1]}
        paths = wr.trace_paths(place, **ends, frequency_hz=FREQUENCY_HZ, **options)
        gain = np.sqrt(paths.power) * np.exp(
            1j * np.angle(paths.gain) + 2j * np.pi * FREQUENCY_HZ * paths.tau
        )
        transfer = antennas * (np.exp(-2j * np.pi * FREQUENCIES_HZ[:, None] * paths.tau) @ gain)
        traced.append(Arrivals.of(Response.of(FREQUENCIES_HZ, transfer, QUIET_NS, one.response.noise)))
    least = db([(CLEAR * one.response.noise) ** 2 for one in measured])
    near = np.array([one.receiver in NEAR for one in measured])
    arrived = [one.arrivals for one in measured]
    close = compared(
        *([one for one, own in zip(side, near, strict=True) if own] for side in (arrived, traced, least))
    )
    return compared(arrived, traced, least) | {f"near_{key}": value for key, value in close.items()}


def _noise(measured: Sequence[Measured], links: Links, share: np.ndarray) -> list[Row]:
    """By receiver: what noise makes of delay and power at most, and what heights of one place differ by, over the root of two.

    ``share`` is that of noise in the measured power (L,): its level is known from ``QUIET_NS`` alone.
    """
    width = measured[0].response.bandwidth_ghz
    unsure = (
        10.0 / np.log(10.0) * share * np.sqrt(1.0 / (QUIET_NS * width) + 1.0 / ((END_NS - QUIET_NS) * width))
    )
    first = np.array([[one.arrivals.first_ns, one.arrivals.first_db] for one in measured])
    first[:, 0] -= links.distance_m / SPEED_OF_LIGHT * 1e9
    read = np.column_stack([first, links.level_db])
    rows: list[Row] = []
    for k in np.unique(links.anchor):
        own = links.anchor == k
        heights = np.unique(links.receivers[own, 2])
        low, high = (np.flatnonzero(own & (links.receivers[:, 2] == z)) for z in heights[[0, -1]])
        _, a, b = np.intersect1d(links.cell[low], links.cell[high], return_indices=True)
        apart = np.sqrt(np.nanmean((read[low[a]] - read[high[b]]) ** 2, axis=0) / 2.0)
        heard = [measured[n].response for n in np.flatnonzero(own & np.isfinite(first[:, 0])).tolist()]
        power, delay = np.max([one.noise_of(one.peaks[0]) for one in heard], axis=0)
        rows.append({
            "receiver": int(k), "noise_db": float(db(np.mean([one.noise**2 for one in heard]))),
            "clear_db": float(np.median([db(np.abs(one.amplitude[one.peaks[0]]) ** 2 / one.noise**2) for one in heard])),
            "first_ns": float(delay), "first_db": float(power), "total_db": float(unsure[own].max()),
            "heights_ns": float(apart[0]), "heights_db": float(apart[1]), "heights_total_db": float(apart[2]),
        })  # fmt: skip
    return rows


def _assumed(links: Links, height_m: float) -> Row:
    """How much later straight rays would be if receivers stood at another height: rms and most over the links [ns]."""
    moved = np.column_stack([links.senders[:, :2], np.full(len(links), height_m)])
    later = (np.linalg.norm(moved - links.receivers, axis=1) - links.distance_m) / SPEED_OF_LIGHT * 1e9
    return {
        "height_m": height_m,
        "later_rms_ns": float(np.sqrt((later**2).mean())),
        "later_most_ns": float(later.max()),
    }

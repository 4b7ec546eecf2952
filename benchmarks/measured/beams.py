"""Paths as pairs of beams see them: which traced paths are measured ones, and what powers of pairs are predicted.

Both beams turn in the horizontal plane. Powers are those of a pair of beams whose peaks have a gain of one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

import warprrf as wr
from benchmarks.fits import rms
from benchmarks.measured.links import db
from benchmarks.report import Row
from warprrf.rf.spectra.antenna import turned_gain
from warprrf.rf.spectra.levels import free_space_gain
from warprrf.rf.spectra.spectrum import directions_from_angles
from warprrf.steps import Steps

SENDING, RECEIVING = (wr.horn(np.radians(width)) for width in (10.0, 8.0))  # as line of sight looks
PEAKS = SENDING.peak_gain * RECEIVING.peak_gain
NEAR_M, NEAR_RAD = 0.3, np.radians(6.0)  # of a measured path: three standard deviations of line of sight
SIGHT_M, FOUND_RAD = (
    0.5,
    np.radians(10.0),
)  # of line of sight; of a strongest pair, and of line of sight: a beam's width
BOUNCE_M = 0.7  # between where a single bounce is seen from both ends, and from a line that it is at
EMPTY_RAD = np.radians(
    15.0
)  # between pairs at which nothing was found, and from those at which something was
STEP_RAD = np.radians(3.0)  # between pairs among which the strongest is sought
DEPARTURES, ARRIVALS = np.arange(-np.pi, 0.01, STEP_RAD), np.arange(-np.pi, np.pi, STEP_RAD)
VERSION = 1
"""Counted up by hand when predictions of pairs come out differently."""


@dataclass(frozen=True)
class Rays:
    """Paths of a link, K of them.

    Attributes:
        power: [linear], shape ``(K,)``.
        length_m: [m], shape ``(K,)``.
        departure, arrival: zenith and azimuth [rad] away from the transmitter and from the receiver, shape ``(K, 2)``.
    """

    power: np.ndarray
    length_m: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray

    @classmethod
    def of(cls, paths: wr.Paths) -> list[Rays]:
        """Those of every receiver of paths ``(R, L)``."""
        ends = np.stack([paths.theta_t, paths.phi_t], -1), np.stack([paths.theta_r, paths.phi_r], -1)
        every = zip(paths.valid, paths.power, paths.length_m, *ends, strict=True)
        return [cls(*(values[own] for values in row)) for own, *row in every]

    def times(self, gain_db: float) -> Rays:
        """The same, stronger."""
        return replace(self, power=self.power * 10.0 ** (gain_db / 10.0))

    def seen(self, departures: np.ndarray, arrivals: np.ndarray) -> np.ndarray:
        """Power of the pair of each of D with each of A beams, by their azimuths, shape ``(D, A)``."""
        sent, received = (
            turned_gain(horn, level(azimuth), directions_from_angles(*angles.T))
            for horn, azimuth, angles in ((SENDING, departures, self.departure), (RECEIVING, arrivals, self.arrival))
        )  # fmt: skip
        return np.asarray((sent * self.power) @ received.T / PEAKS)

    def pairs(self, departures: np.ndarray, arrivals: np.ndarray) -> np.ndarray:
        """Power of pairs (N,) by their azimuths."""
        once, own = zip(*(np.unique(a, return_inverse=True) for a in (departures, arrivals)), strict=True)
        return np.asarray(self.seen(*once)[own])

    @property
    def own(self) -> np.ndarray:
        """Power that each path alone gives the pair of its own azimuths, shape ``(K,)``."""
        gains = [
            turned_gain(horn, level(np.zeros(1)), directions_from_angles(angles[:, 0], 0.0))[0]
            for horn, angles in ((SENDING, self.departure), (RECEIVING, self.arrival))
        ]
        return np.asarray(self.power * gains[0] * gains[1] / PEAKS)

    @cached_property
    def strongest(self) -> tuple[float, float, float]:
        """Azimuths [rad] and power of the strongest pair of beams."""
        table = self.seen(DEPARTURES, ARRIVALS)
        d, a = np.unravel_index(table.argmax(), table.shape)
        return float(DEPARTURES[d]), float(ARRIVALS[a]), float(table[d, a])


@dataclass(frozen=True)
class Walk:
    """What was measured between a transmitter and L places of a receiver.

    Attributes:
        transmitter: its position [m], shape ``(3,)``.
        receivers: places, one after the other [m], shape ``(L, 3)``.
        rays: paths of each, with the noise in their powers.
        floor: that noise, in the unit of the powers [linear].
        frequency_hz: of the carrier [Hz].
    """

    transmitter: np.ndarray
    receivers: np.ndarray
    rays: list[Rays]
    floor: float
    frequency_hz: float

    def off(self, link: int) -> np.ndarray:
        """Length [m], departure and arrival [rad] of the paths of a link, less those of line of sight, shape ``(3, K)``."""
        way, rays = (self.receivers[link] - self.transmitter)[:2], self.rays[link]
        sent, received = np.arctan2(way[1], way[0]), np.arctan2(-way[1], -way[0])
        angles = turn(rays.departure[:, 1] - sent), turn(rays.arrival[:, 1] - received)
        return np.array([rays.length_m - np.hypot(*way), *angles])

    @cached_property
    def nlos(self) -> list[np.ndarray]:
        """Which paths of each link are not line of sight, shape ``(K,)``, bool."""
        most = [[SIGHT_M], [FOUND_RAD], [FOUND_RAD]]
        return [(np.abs(self.off(k)) > most).any(axis=0) for k in range(len(self.rays))]

    def empty(self, link: int) -> tuple[np.ndarray, np.ndarray]:
        """Azimuths of departure and arrival of pairs all round that are away from those at which something was found."""
        steps, own = np.arange(-np.pi, np.pi - 1e-9, EMPTY_RAD), self.rays[link]
        ahead = steps[(steps > -np.pi) & (steps < 0.0)]  # where the transmitter's beams point
        departure, arrival = (a.ravel() for a in np.meshgrid(ahead, steps, indexing="ij"))
        apart = [
            np.abs(turn(a[:, None] - b[:, 1]))
            for a, b in ((departure, own.departure), (arrival, own.arrival))
        ]
        clear = (np.maximum(*apart) > EMPTY_RAD).all(axis=1)
        return departure[clear], arrival[clear]

    def readings(self, links: np.ndarray) -> wr.Readings:
        """Pairs of some links: those with a path, less the noise, and those at which nothing was found, at the floor."""
        columns = []
        for k in links:
            own, (departure, arrival) = self.rays[k], self.empty(k)
            power = np.concatenate([np.maximum(own.power - self.floor, 0.0), np.zeros(len(departure))])
            turned = [
                np.concatenate([own.departure, level(departure)]),
                np.concatenate([own.arrival, level(arrival)]),
            ]
            columns.append((np.tile(self.receivers[k], (len(power), 1)), power, *turned))
        places, power, departure, arrival = (np.concatenate(side) for side in zip(*columns, strict=True))
        return wr.Readings(
            self.transmitter, places, power, self.frequency_hz, self.floor, arrival=arrival, departure=departure,
            receive_pattern=RECEIVING, transmit_pattern=SENDING, chain=["chain"] * len(power),
        )  # fmt: skip


def level(azimuth: np.ndarray) -> np.ndarray:
    """Zenith and azimuth of level directions."""
    return np.column_stack([np.full(len(azimuth), np.pi / 2), azimuth])


def turn(angle: np.ndarray) -> np.ndarray:
    """An angle between -pi and pi."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def near(measured: Rays, traced: Rays, floor: float) -> np.ndarray:
    """Which traced path above the floor is nearest to each measured one, shape ``(K,)``; -1 if none is near."""
    apart = np.abs(measured.length_m[:, None] - traced.length_m) / NEAR_M
    for name in ("departure", "arrival"):
        a, b = getattr(measured, name)[:, 1], getattr(traced, name)[:, 1]
        apart = np.maximum(apart, np.abs(turn(a[:, None] - b)) / NEAR_RAD)
    apart = np.where(traced.own > floor, apart, np.inf)
    if not apart.size:
        return np.full(len(measured.power), -1)
    return np.where(apart.min(axis=1) < 1.0, apart.argmin(axis=1), -1)


def sight(walk: Walk, chosen: np.ndarray) -> Row:
    """How far line of sight is from geometry and free space on ``chosen`` links (L,), bool.

    Returns:
        On how many ``links`` it was ``found``; medians, and half of what 68 percent of these links span (``_spread``).
    """
    names, found = ("length_m", "departure_deg", "arrival_deg", "gain_db"), []
    free = db(free_space_gain(walk.transmitter, walk.receivers, walk.frequency_hz))
    for k in np.flatnonzero(chosen).tolist():
        power = np.where(walk.nlos[k], 0.0, walk.rays[k].power)
        if power.any():
            off = walk.off(k)[:, power.argmax()]
            found.append([off[0], *np.degrees(off[1:]), db(power.max()) - free[k]])
    if not found:
        return {"links": int(chosen.sum()), "found": 0}
    low, middle, high = np.percentile(found, [16.0, 50.0, 84.0], axis=0)
    spread = dict(zip([f"{name}_spread" for name in names], ((high - low) / 2.0).tolist(), strict=True))
    return (
        {"links": int(chosen.sum()), "found": len(found)}
        | dict(zip(names, middle.tolist(), strict=True))
        | spread
    )


def compared(walk: Walk, traced: Sequence[Rays]) -> Row:
    """How many measured paths have a traced one near them, and how near.

    Returns:
        Share of NLOS paths that are ``met``, and of their ``power``, and the same ``by_chance``: with what was traced a third of
        the walk away and further; median errors of those met; rms error of the ``strongest`` pair's power; and :func:`pointing`.
    """
    count, row = len(walk.rays), Row()
    nlos, power = np.concatenate(walk.nlos), np.concatenate([one.power for one in walk.rays])
    for name, shifts in (("", [0]), ("_by_chance", range(count // 3, count - count // 3 + 1))):
        hits = [
            np.concatenate(
                [near(one, traced[(k + s) % count], walk.floor) for k, one in enumerate(walk.rays)]
            )
            >= 0
            for s in shifts
        ]
        row[f"met{name}"] = float(np.mean([hit[nlos] for hit in hits]))
        row[f"power{name}"] = float(np.mean([power[hit & nlos].sum() for hit in hits]) / power[nlos].sum())
    errors = []
    for one, other, own in zip(walk.rays, traced, walk.nlos, strict=True):
        k = near(one, other, walk.floor)
        own = own & (k >= 0)
        k = k[own]
        angles = [
            turn(getattr(one, end)[own, 1] - getattr(other, end)[k, 1]) for end in ("departure", "arrival")
        ]
        errors.append(
            [
                one.length_m[own] - other.length_m[k],
                *np.degrees(angles),
                db(other.own[k]) - db(one.power[own]),
            ]
        )
    every, names = (
        np.abs(np.concatenate(errors, axis=1)),
        ("length_m", "departure_deg", "arrival_deg", "level_db"),
    )
    row |= zip(names, np.median(every, axis=1).tolist() if every.size else [None] * 4, strict=True)
    asked = np.array([one.strongest for one in traced])
    best = db([one.strongest[2] for one in walk.rays])
    row["strongest_db"] = rms(db(np.maximum(asked[:, 2], walk.floor)) - best)
    return row | pointing(walk, asked[:, :2])


def pointing(walk: Walk, asked: np.ndarray) -> Row:
    """What pairs of beams at azimuths ``asked`` (L, 2) of departure and arrival are worth.

    Returns:
        ``found``: share within :data:`FOUND_RAD` of the strongest path at both ends; ``lost_db``, ``lost_most_db``: median and 90th
        percentile of what they receive less than the strongest pair, from the measured paths alone and no less than the floor;
        the same (``nlos_``) of links whose strongest path is not line of sight.
    """
    found, lost, own = [], [], []
    for one, (departure, arrival), nlos in zip(walk.rays, asked, walk.nlos, strict=True):
        best = one.power.argmax()
        off = turn(np.array([one.departure[best, 1] - departure, one.arrival[best, 1] - arrival]))
        got = one.seen(np.array([departure]), np.array([arrival]))[0, 0]
        found.append(np.abs(off).max() < FOUND_RAD)
        lost.append(float(db(one.strongest[2]) - db(max(got, walk.floor))))
        own.append(bool(nlos[best]))
    row: Row = {"links": len(own), "nlos_links": sum(own)}
    for name, chosen in (("", np.ones(len(own), bool)), ("nlos_", np.array(own))):
        if chosen.any():
            row |= {
                f"{name}found": float(np.mean(np.array(found)[chosen])),
                f"{name}lost_db": float(np.median(np.array(lost)[chosen])),
                f"{name}lost_most_db": float(np.percentile(np.array(lost)[chosen], 90)),
            }
    return row


def bounces(walk: Walk, drawn: Mapping[str, np.ndarray], traced: Sequence[Rays]) -> list[Row]:
    """What NLOS paths meet: where a single bounce of their length is, seen from either end, and which of the ``drawn`` lines
    (N, 2, 2) is there; and the share of them that are met by ``traced`` ones."""
    found: list[tuple[str, float, bool]] = []
    start = walk.transmitter[:2]
    for rays, end, nlos, other in zip(walk.rays, walk.receivers[:, :2], walk.nlos, traced, strict=True):
        way, length, points = end - start, rays.length_m[nlos], []
        for place, along, angles in ((start, way, rays.departure), (end, -way, rays.arrival)):
            to = directions_from_angles(*angles[nlos].T)[:, :2]
            points.append(place + to * ((length**2 - way @ way) / 2.0 / (length - to @ along))[:, None])
        single = np.linalg.norm(points[0] - points[1], axis=1) < BOUNCE_M
        hit, power = (near(rays, other, walk.floor) >= 0)[nlos], rays.power[nlos]
        for k, point in enumerate((points[0] + points[1]) / 2.0):
            away = {name: apart(lines, point).min() for name, lines in drawn.items()}
            nearest = min(away, key=lambda name: away[name])
            there = nearest if away[nearest] < BOUNCE_M else "elsewhere"
            found.append((there if single[k] else "several", float(power[k]), bool(hit[k])))
    total, rows = sum(power for _, power, _ in found), []
    for at in (*drawn, "elsewhere", "several"):
        own = [(power, hit) for there, power, hit in found if there == at]
        if own:
            powers, hits = zip(*own, strict=True)
            rows.append(
                {"at": at, "paths": len(own), "power": sum(powers) / total, "met": float(np.mean(hits))}
            )
    return rows


def apart(lines: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Distance of a point (2,) from each of lines (N, 2, 2) [m]."""
    way = lines[:, 1] - lines[:, 0]
    share = np.clip(((point - lines[:, 0]) * way).sum(axis=1) / (way**2).sum(axis=1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(lines[:, 0] + share[:, None] * way - point, axis=1))


Predict: TypeAlias = Callable[[np.ndarray, np.ndarray], list[Rays]]


def predicted(walk: Walk, models: Mapping[str, tuple[Predict, str]], block: int, steps: Steps) -> list[Row]:
    """Powers of pairs, and the strongest pair, on ``block`` links after each other of which a model knows nothing.

    Args:
        models: from numbers of links that are known and asked for to paths of the latter; and what its steps depend on.
    """
    power, nlos = np.concatenate([one.power for one in walk.rays]), np.concatenate(walk.nlos)
    every, rows = np.arange(len(walk.rays)), []
    for model, (predict, known) in models.items():
        parts: list[dict[str, np.ndarray]] = []
        for first in every[::block]:
            out = (every >= first) & (every < first + block)

            def make(predict: Predict = predict, out: np.ndarray = out) -> dict[str, np.ndarray]:
                rays, asked = predict(every[~out], every[out]), [walk.rays[k] for k in every[out]]
                own = [
                    one.pairs(at.departure[:, 1], at.arrival[:, 1])
                    for one, at in zip(rays, asked, strict=True)
                ]
                rest = [one.pairs(*walk.empty(k)) for one, k in zip(rays, every[out], strict=True)]
                best = np.array([one.strongest for one in rays])
                return {"pairs": np.concatenate(own), "empty": np.concatenate(rest), "strongest": best}

            step = "".join(c if c.isalnum() else "-" for c in f"pairs {model} {first}")
            parts.append(steps.arrays(step, make, version=VERSION, inputs=[known, out]))
        pairs, empty, best = (
            np.concatenate([part[key] for part in parts]) for key in ("pairs", "empty", "strongest")
        )
        error, heard = db(pairs + walk.floor) - db(power), power > 2.0 * walk.floor
        rows.append({
            "model": model, "pairs": int(heard.sum()), "rms_db": rms(error[heard]), "sight_db": rms(error[heard & ~nlos]),
            "nlos_db": rms(error[heard & nlos]), "nlos_mean_db": float(error[heard & nlos].mean()),
            "lit": float((empty > walk.floor).mean()), **pointing(walk, best[:, :2]),
        })  # fmt: skip
    return rows


def straight(walk: Walk, rays: Sequence[Rays], train: np.ndarray, test: np.ndarray) -> list[Rays]:
    """Traced paths, with the gain that the strongest pairs of known links have in the median."""
    gain = np.median([db(walk.rays[k].strongest[2]) - db(rays[k].strongest[2]) for k in train])
    return [rays[k].times(float(gain)) for k in test]


def nearest(walk: Walk, train: np.ndarray, test: np.ndarray) -> list[Rays]:
    """What the nearest known receiver has."""
    away = np.linalg.norm(walk.receivers[test, None] - walk.receivers[train], axis=2)
    return [walk.rays[k] for k in train[away.argmin(axis=1)]]


def fitted(walk: Walk, scene: wr.Scene, train: np.ndarray, test: np.ndarray, **options: Any) -> list[Rays]:
    """Paths of a field of the scene that is fitted to the pairs of known links."""
    field = wr.RadioField.fit(scene, walk.readings(train), model="bistatic", quick=True, **options)
    gain = field.report["chains"]["chain"]["gain_db"] + float(db(PEAKS))
    return [one.times(gain) for one in Rays.of(field.paths(walk.receivers[test]))]

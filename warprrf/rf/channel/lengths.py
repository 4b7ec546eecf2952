"""Lengths that the places of antenna elements add to paths: plane waves, and spherical waves about exact points.

For line of sight and mirrors a spherical wave comes from the transmitting element's image: the transmitter's lies one
path length away along the arrival, and its array is turned by the reflections of the way. For diffuse paths it runs
from the element to the first interaction point, and from the last to the receiving element.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warprrf.rf.channel.path_arrays import PathArrays, points_along


@dataclass(frozen=True)
class PairLengths:
    """Lengths that the places of elements add to paths, and what they make of amplitudes.

    Attributes:
        place: Receiving elements about their centre [m], shape ``(M, 3)``.
        target: Plane waves: unit directions of arrival, shape ``(1, P, 3)``. Spherical waves: the source that the
            receiving elements see, from their centre [m], shape ``(1, P, 3)``, or ``(N, P, 3)`` if every transmitting
            element is a source of its own.
        extra: Length to add for transmitting elements [m], shape ``(N, P)``.
        scale: Factor of amplitudes for transmitting elements, shape ``(N, P)``, or ``(1, 1)`` for one.
        spherical: Whether waves are.
    """

    place: np.ndarray
    target: np.ndarray
    extra: np.ndarray
    scale: np.ndarray
    spherical: bool

    @property
    def separable(self) -> bool:
        """Whether a length is that of a receiving element plus that of a transmitting one."""
        return len(self.target) == 1

    @property
    def alone(self) -> bool:
        """Whether there is one element at either end, at the centre."""
        return len(self.place) == 1 and len(self.extra) == 1

    def received(self) -> tuple[np.ndarray, np.ndarray]:
        """Of separable ones: length [m] that receiving elements add, ``(M, P)``, and factor of amplitudes."""
        if not self.spherical:
            return -(self.place @ self.target[0].T), np.ones((1, 1))
        reach, far = self._reach(self.target[0], self.place[:, None])
        return reach - far, far / reach

    def longer(self) -> tuple[np.ndarray, np.ndarray]:
        """Added length [m] and factor of amplitudes, each ``(M, N, P)``."""
        if self.separable:
            added, ratio = self.received()
            return added[:, None] + self.extra, ratio[:, None] * self.scale
        reach, far = self._reach(self.target, self.place[:, None, None])
        return self.extra + (reach - far), self.scale * (far / reach)

    @staticmethod
    def _reach(source: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.linalg.norm(source - place, axis=-1), np.linalg.norm(source, axis=-1)

    def between(self, m: slice, n: slice) -> PairLengths:
        """Those of receiving elements ``m`` and transmitting ones ``n``."""
        target = self.target if self.separable else self.target[n]
        scale = self.scale if len(self.scale) == 1 else self.scale[n]
        return replace(self, place=self.place[m], target=target, extra=self.extra[n], scale=scale)


def plane_lengths(paths: PathArrays, sending: np.ndarray, receiving: np.ndarray) -> PairLengths:
    """Plane waves: projections on the directions of departure and arrival.

    Args:
        sending, receiving: Elements about their array's centre [m], shapes ``(N, 3)`` and ``(M, 3)``.
    """
    return PairLengths(
        place=receiving,
        target=np.ascontiguousarray(paths.arrival)[None],
        extra=-(sending @ paths.departure.T),
        scale=np.ones((1, 1)),
        spherical=False,
    )


def spherical_lengths(paths: PathArrays, sending: np.ndarray, receiving: np.ndarray) -> PairLengths:
    """Line of sight and mirrors: distances from the transmitting elements' images."""
    tx, rx, bounces = _ends(paths)
    each, some = np.arange(len(bounces)), bounces > 0
    last = np.where(some[:, None], paths.vertices[each, np.maximum(bounces - 1, 0)], tx)
    toward = (last - rx) / np.linalg.norm(last - rx, axis=1, keepdims=True)
    points = np.concatenate([np.broadcast_to(tx, (len(each), 1, 3)), paths.vertices], axis=1)
    step = np.linalg.norm(np.diff(points, axis=1), axis=2)
    length = np.where(np.isfinite(step), step, 0.0).sum(axis=1) + np.linalg.norm(rx - last, axis=1)
    # The image lies ``length`` away along the arrival; its array is mirrored by every bounce.
    mirrored = np.einsum("pij,nj->npi", _mirrorings(tx, rx, paths.vertices, bounces), sending)
    target = length[:, None] * toward + mirrored
    far = np.linalg.norm(target, axis=2)
    return PairLengths(receiving, target, extra=far - length, scale=length / far, spherical=True)


def scattered_lengths(paths: PathArrays, sending: np.ndarray, receiving: np.ndarray) -> PairLengths:
    """Diffuse paths: distances to the first interaction point and from the last."""
    tx, rx, bounces = _ends(paths)
    first = paths.vertices[:, 0] - tx
    last = paths.vertices[np.arange(len(bounces)), bounces - 1] - rx
    near = np.linalg.norm(first, axis=1)
    each = np.linalg.norm(first - sending[:, None], axis=2)
    return PairLengths(receiving, last[None], extra=each - near, scale=near / each, spherical=True)


def _ends(paths: PathArrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transmitter, receiver and numbers of interactions, which spherical waves need."""
    if paths.transmitter is None or paths.receiver is None:
        raise ValueError("paths: got ones without transmitter and receiver, which spherical waves need")
    bounces = np.isfinite(paths.vertices[..., 0]).sum(axis=1)
    if (bounces[paths.kind != "los"] == 0).any():
        raise ValueError(
            "paths: got mirror or diffuse paths without interaction points, which spherical waves need"
        )
    return paths.transmitter, paths.receiver, bounces


def _mirrorings(tx: np.ndarray, rx: np.ndarray, vertices: np.ndarray, bounces: np.ndarray) -> np.ndarray:
    """What the bounces do to directions, shape ``(P, 3, 3)``: a product of reflections."""
    count, depth = vertices.shape[:2]
    legs = np.diff(points_along(tx, vertices, rx), axis=1)
    legs = legs / np.linalg.norm(legs, axis=2, keepdims=True)
    turned = np.broadcast_to(np.eye(3), (count, 3, 3))
    for k in range(depth):
        normal = legs[:, k + 1] - legs[:, k]
        there = (k < bounces) & (np.linalg.norm(np.nan_to_num(normal), axis=1) > 1e-9)
        unit = np.where(there[:, None], normal, 1.0)
        unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
        mirror = np.eye(3) - 2.0 * np.where(there[:, None, None], unit[:, :, None] * unit[:, None, :], 0.0)
        turned = mirror @ turned
    return turned

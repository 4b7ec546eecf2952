"""How readings answer to the parameters: values and Jacobian of anything that is linear in path powers.

A reading of a receiver (pixels of its spectrum, its total path gain, taps of its delay profile) is a sum over columns:
a power that geometry fixes, times a coefficient that the parameters of one group or a few fix. The columns are traced
once; values are ``coefficients @ columns``, and the Jacobian follows from the coefficients' derivatives alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from warprrf.rf.em.fresnel import fresnel_curves
from warprrf.rf.fields.bistatic.materials import Layout, Materials, Parameters, Terms, mirror_power
from warprrf.rf.fields.bistatic.measured import Measurement, Superposition
from warprrf.rf.fields.bistatic.render import mirror_shown, sent_on
from warprrf.rf.fields.bistatic.scattering import resolve, send
from warprrf.rf.fields.bistatic.transport import ReceiverView

NEGLIGIBLE = 1e-3
"""Groups that bring a reading less than this share of the floor at unit weight are left out."""


@dataclass(frozen=True)
class Response:
    """Readings of one receiver as sums over columns, in units of a floor.

    Attributes:
        group: groups whose single bounces are read, shape ``(A,)``.
        bounce: their power at unit weight, by lobe and Fresnel component, shape ``(A, L, 3, N)`` float32.
        seen: groups that are seen at all, shape ``(B,)``.
        indirect: their power at unit indirect radiance, shape ``(B, N)`` float32.
        sender: groups that send on light of others, shape ``(C,)``.
        sent: what they send per unit of what they scatter of even light, shape ``(C, N)`` float32.
        path_group: groups that each line-of-sight or mirror path meets, -1 for none, shape ``(K, 3)``.
        cosine, turn: of incidence there, and angles between planes of incidence [rad], shapes ``(K, 3)``.
        path_power: of each path without its reflections, shape ``(K,)``.
        path: readings of unit power on each path, shape ``(K, N)`` float32.
        offset: power that no parameter changes but the common gain, shape ``(N,)``.
        together: how those paths add up where their phases count; None where their powers add.
    """

    group: np.ndarray
    bounce: np.ndarray
    seen: np.ndarray
    indirect: np.ndarray
    sender: np.ndarray
    sent: np.ndarray
    path_group: np.ndarray
    cosine: np.ndarray
    turn: np.ndarray
    path_power: np.ndarray
    path: np.ndarray
    offset: np.ndarray
    together: Superposition | None = None

    def tied(self, material: np.ndarray) -> Response:
        """The response of materials instead of groups; ``material`` (G,) is that of each group."""
        group, bounce = _summed(material[self.group], self.bounce)
        seen, indirect = _summed(material[self.seen], self.indirect)
        sender, sent = _summed(material[self.sender], self.sent)
        reflects = self.path_group >= 0
        owner = np.where(reflects, material[np.where(reflects, self.path_group, 0)], -1)
        return replace(
            self, group=group, bounce=bounce, seen=seen, indirect=indirect, sender=sender, sent=sent, path_group=owner
        )  # fmt: skip

    def limited(self, terms: Terms) -> Response:
        """The response without the single bounces and paths that ``terms`` leave out."""
        order = (self.path_group >= 0).sum(axis=1)
        keep = (order <= terms.mirror_order) & ((order > 0) | terms.line_of_sight)
        scattered = slice(None) if terms.diffuse else slice(0)
        return replace(
            self, group=self.group[scattered], bounce=self.bounce[scattered], path_group=self.path_group[keep],
            cosine=self.cosine[keep], turn=self.turn[keep], path_power=self.path_power[keep], path=self.path[keep],
            together=None if self.together is None else self.together.subset(keep),
        )  # fmt: skip


def _summed(owner: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns (C, ...) summed by ``owner`` (C,): the owners, and the sum of each."""
    found, place = np.unique(owner, return_inverse=True)
    out = np.zeros((len(found), *columns.shape[1:]), np.float32)
    for a, k in enumerate(place.reshape(-1)):
        out[k] += columns[a]
    return found, out


def respond(view: ReceiverView, measurement: Measurement, terms: Terms, floor: float) -> Response:
    """How ``measurement`` of one receiver answers to the parameters of all groups, light of second bounces left out.

    Args:
        view: what the receiver sees.
        measurement: what is read.
        terms: which lobes there are.
        floor: unit of the readings, path gain.
    """
    t = view.transport
    bins, count = measurement.bins(view)
    group, images = resolve(t.surface, view.hits.face, view.light, terms, t.wavelength_m, bins, count)
    read = measurement.of_bins(images.reshape(count, -1), quick=True) / np.float32(floor)
    bounce = np.ascontiguousarray(read.T).reshape(*images.shape[1:], len(read))
    strong = np.abs(bounce).max(axis=(1, 2, 3), initial=0.0) > NEGLIGIBLE
    unit = send(t, view.hits, np.ones(t.surface.element_sides))
    seen, indirect = _read_by_group(measurement, view, unit / floor)
    path = measurement.of_paths(view)
    none = np.zeros((0, path.shape[1]), np.float32)
    return Response(
        group=group[strong], bounce=bounce[strong], seen=seen, indirect=indirect, sender=np.zeros(0, int), sent=none,
        path_group=view.path_groups, cosine=view.paths.cosine, turn=view.paths.turn, path_power=view.friis / floor,
        path=path, offset=np.zeros(path.shape[1], np.float32), together=measurement.together,
    )  # fmt: skip


def with_further_bounces(
    response: Response,
    view: ReceiverView,
    measurement: Measurement,
    materials: Materials,
    sent: np.ndarray | None,
    floor: float,
    *,
    follow: bool,
) -> Response:
    """``response`` with light after a first bounce, as it is under ``materials``: what surfaces get of it is held.

    Args:
        sent: see :func:`warprrf.rf.fields.bistatic.render.sent_radiance`.
        follow: whether what surfaces send on of it follows their parameters, which costs columns, or is held too.
    """
    sender, read = _read_by_group(measurement, view, sent_on(view, materials, sent) / floor)
    read = np.maximum(read, 0.0)
    (bins, count), (ray, power) = measurement.bins(view), mirror_shown(view, materials, sent)
    own = bins[ray] >= 0
    shown = np.bincount(bins[ray[own]], power[own] / floor, minlength=count)[:, None]
    offset = np.maximum(measurement.of_bins(shown)[:, 0], 0.0).astype(np.float32)
    if not follow:
        return replace(response, offset=(read.sum(axis=0) + offset).astype(np.float32))
    share = np.maximum(materials.parameters.scattered_share[sender], 1e-12)
    return replace(response, sender=sender, sent=(read / share[:, None]).astype(np.float32), offset=offset)


def _read_by_group(
    measurement: Measurement, view: ReceiverView, power: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Groups that send ``power`` (K,) along rays, and readings of that of each group, shape ``(B, N)``."""
    bins, count = measurement.bins(view)
    ray = np.flatnonzero((bins >= 0) & (power > 0))
    found, column = np.unique(view.transport.surface.group[view.hits.face.numpy()[ray]], return_inverse=True)
    cell = bins[ray] * len(found) + column.reshape(-1)
    table = np.bincount(cell, power[ray], minlength=count * len(found)).reshape(count, len(found))
    return found, np.ascontiguousarray(measurement.of_bins(table).T, np.float32)


# Columns (C, N), their coefficients (C,), and of those the derivatives: places in a parameter vector and values (C,).
_Block = tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]


def predict(response: Response, p: Parameters) -> np.ndarray:
    """Readings under ``p`` in units of the floor, shape ``(N,)``."""
    layout = Layout(*p.log_weight.shape, indirect=bool(np.isfinite(p.log_indirect).any()), gain=False)
    return np.asarray(p.gain * _total(response, list(_blocks(response, p, layout))))


def jacobian(response: Response, p: Parameters, layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Readings, and their derivatives to the free parameters that they depend on.

    Returns:
        Readings ``(N,)``, derivatives ``(C, N)`` float32, and places of those parameters in the vector ``(C,)``.
    """
    blocks = list(_blocks(response, p, layout))
    values = _total(response, blocks)
    tables = []
    for columns, _, slopes in blocks:
        place, slope = (np.concatenate(rows) for rows in zip(*slopes, strict=True))
        column = np.tile(np.arange(len(columns)), len(slopes))
        own = place >= 0
        used, row = np.unique(place[own], return_inverse=True)
        derivative = csr_matrix(
            (slope[own].astype(np.float32), (row.reshape(-1), column[own])), shape=(len(used), len(columns))
        )
        tables.append((used, derivative @ columns))
    if layout.gain:
        tables.append((np.array([layout.common_gain]), values[None].astype(np.float32)))
    index = np.unique(np.concatenate([used for used, _ in tables]))
    table = np.zeros((len(index), len(values)), np.float32)
    for used, rows in tables:
        table[np.searchsorted(index, used)] += rows
    return p.gain * values, table * np.float32(p.gain), index


def _total(response: Response, blocks: list[_Block]) -> np.ndarray:
    """Readings without the common gain; single bounces, which come first, are none where rounding makes them less."""
    values = response.offset.astype(np.float64)
    for k, (columns, coefficient, _) in enumerate(blocks):
        read = coefficient.astype(np.float32) @ columns
        values = values + (np.maximum(read, 0.0) if k == 0 else read)
    return values


def _blocks(r: Response, p: Parameters, layout: Layout) -> Iterator[_Block]:
    """All columns of a response with their coefficients, by kind."""
    curves, count = fresnel_curves(), len(r.offset)
    alpha, rise = curves.at(curves.coordinates, p.log_excess[r.group])
    weight = p.weight[r.group]
    mixed = weight[:, :, None] * alpha[:, None, :]
    per_group = int(np.prod(mixed.shape[1:]))
    yield (
        r.bounce.reshape(mixed.size, count),
        mixed.ravel(),
        [
            (np.repeat(layout.weight(r.group).ravel(), mixed.shape[2]), mixed.ravel()),
            (np.repeat(layout.excess(r.group), per_group), (weight[:, :, None] * rise[:, None, :]).ravel()),
        ],
    )
    even, rise_even = curves.even(p.log_excess[r.sender])
    weight = p.weight[r.sender]
    per_lobe = weight * even[:, None]
    to_lobes = [(layout.weight(r.sender)[:, j], per_lobe[:, j]) for j in range(layout.lobes)]
    yield (
        r.sent,
        per_lobe.sum(axis=1),
        [*to_lobes, (layout.excess(r.sender), weight.sum(axis=1) * rise_even)],
    )
    if layout.indirect:
        radiance = np.exp(p.log_indirect[r.seen])
        yield r.indirect, radiance, [(layout.radiance(r.seen), radiance)]
    where = r.path_power, r.path_group, r.cosine, r.turn, p
    if r.together is None:
        power, slope = mirror_power(*where)
        columns, coefficient, to_mirror, to_excess = r.path, power, power, power[:, None] * slope
    else:  # quadratic: half its slopes times the amplitudes
        amplitude, to_excess = r.together.amplitudes(*where)
        columns, coefficient, to_mirror = r.together.slopes(amplitude), 0.5 * amplitude, 0.5 * amplitude
    slopes = []
    for b in range(r.path_group.shape[1]):
        own, reflects = r.path_group[:, b], r.path_group[:, b] >= 0
        slopes.append((np.where(reflects, layout.mirror(own), -1), to_mirror))
        slopes.append((np.where(reflects, layout.excess(own), -1), to_excess[:, b]))
    yield columns, coefficient, slopes

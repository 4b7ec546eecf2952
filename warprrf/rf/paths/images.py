"""Which patches can mirror a transmitter one after the other, and where: images of images, pruned by what is in view.

An image shines through its patch as through a window. A further patch can follow only if the two face each other and
the beam from the image through the window meets it; beams are tried against a tree of boxes, so that a city does not
try all pairs. Nothing that could be a path is left out, to rounding. Source: J. B. Allen and D. A. Berkley,
"Image method for efficiently simulating small-room acoustics", J. Acoust. Soc. Am. 65 (1979).
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf.checks import check_positive, warn
from warprrf.device import DeviceLike, Progress, filled, launch, resolve
from warprrf.geometry.edges import Edges
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.kernels.radio import edges as edge_kernels
from warprrf.kernels.radio import mirrors as kernels
from warprrf.kernels.radio.edges import find_over_edges
from warprrf.kernels.radio.mirrors import IN_PLANE
from warprrf.rf.paths.ways import Ways, stops_of
from warprrf.rows import Rows, spans

MOST_KEPT = 4_000_000  # pairs of a chain and a patch to try up to which all chains are found once and kept
BLOCK = 500_000  # chains that are unfolded at once
MOST_CHAINS = 20_000_000
"""More chains of mirrors than this are not tried unless asked for: a minute on two cores in a room, twenty in a city."""

_SAMPLE = 1000  # chains from which the number of longer ones is estimated


@dataclass(frozen=True)
class Chains(Rows):
    """Chains of k reflections.

    Attributes:
        patch: Patches in the order in which the wave meets them, shape ``(C, k)``, int32.
        image: Image of the transmitter in the last patch [m], shape ``(C, 3)``.
        axis: Unit axes of cones from there that hold all ways on, shape ``(C, 3)``.
        sine: Sines of their half-angles, shape ``(C,)``; above 1 for all space.
    """

    patch: np.ndarray
    image: np.ndarray
    axis: np.ndarray
    sine: np.ndarray

    @classmethod
    def none(cls, order: int) -> Chains:
        """No chains, of ``order`` reflections."""
        return cls(np.zeros((0, order), np.int32), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


class MirrorImages:
    """Images of one transmitter in the patches of a mesh, to any order.

    Args:
        slack_m: Boxes of patches are widened by it [m]: their tolerance by default.
        to_edges: Whether ways are told that go through the edge between two mirrors, by either first.
        max_chains: Searches that would try more chains are refused.

    Warns:
        UserWarning: of smooth surfaces that were cut into flat mirrors.
    """

    def __init__(
        self,
        patches: PlanarPatches,
        transmitter: ArrayLike,
        *,
        slack_m: float | None = None,
        to_edges: bool = False,
        max_chains: float = MOST_CHAINS,
        device: DeviceLike = None,
    ) -> None:
        detail_m2 = max(0.5, 0.01 * patches.area.sum())
        if patches.two_sided and patches.curved_m2 > detail_m2:
            warn(
                f"mesh: {patches.curved_m2:.3g} m^2 of it are flat facets of smooth surfaces (a round pillar, say); each "
                "mirrors as a plane or not at all, so that mirror paths off them are right in the mean alone"
            )
        self.patches = patches
        self.max_chains = check_positive("max_chains", max_chains)
        self.transmitter = np.asarray(transmitter, float)
        self.device = resolve(device)
        slack_m = patches.tolerance_m if slack_m is None else slack_m
        self._on_device = _patches_on_device(patches, slack_m, to_edges, self.device)
        patch, axis = np.zeros((1, 0), np.int32), np.zeros((1, 3))
        self._kept = [Chains(patch, self.transmitter[None], axis, np.array([2.0]))]

    def search(self, points: np.ndarray, order: int, progress: Progress | None = None) -> Iterator[Ways]:
        """The straight way to each of ``points``, then :meth:`candidates` of 1, 2 ... ``order`` reflections.

        Args:
            points: Where the chains end [m], shape ``(N, 3)``.
        """
        work, seconds = self._work(points, order)
        if sum(work) > self.max_chains:
            raise ValueError(
                f"mirror_order: order {order} would try about {sum(work):.2g} chains of the mesh's {len(self.patches)} "
                f"planar patches, some {seconds:.2g} seconds; expected at most {self.max_chains:.3g}: lower mirror_order, "
                "simplify the mesh (fewer, larger planar patches), or give more max_chains to MirrorTracer"
            )
        ends, parts = np.cumsum([0.0, *work]), 1000  # of a search, in which its progress is reported

        def tick(share: float) -> None:
            if progress is not None:
                behind = ends[k - 1] + share * (ends[k] - ends[k - 1])
                progress("mirrors", round(parts * behind / max(ends[-1], 1.0)), parts)

        nothing = np.zeros((len(points), 0), np.int32), np.zeros((len(points), 0, 3))
        yield self._ways(points, np.arange(len(points)), *nothing)
        for k in range(1, order + 1):
            yield self.candidates(points, k, tick)
            tick(1.0)

    def candidates(
        self,
        points: np.ndarray,
        order: int,
        tick: Callable[[float], None] = lambda share: None,
        first: np.ndarray | None = None,
    ) -> Ways:
        """Ways of ``order`` reflections whose points lie in the boxes of their patches, by point; nothing is cast.

        Args:
            points: Where the chains end [m], shape ``(N, 3)``.
            order: Reflections, at least 1.
            tick: Called now and then with the share of the search that is behind.
            first: Patches that may come first, by default all.
        """
        parts = [(np.zeros(0, int), np.zeros((0, order), np.int32), np.zeros((0, order, 3)))]
        if len(points) and len(self.patches):
            ends, kept = _Ends(points, self.device), self._keep(order)
            known = min(order, len(kept) - 1)
            begun = kept[known]
            begun = begun if first is None else begun.take(np.isin(begun.patch[:, 0], first))
            for chains, share in self._descendants(begun, order - known, ends.middle, ends.radius):
                if len(chains):
                    parts.append(self._unfolded(chains, ends))
                tick(share)
        row, patch, found = (np.concatenate(p) for p in zip(*parts, strict=True))
        by_row = np.argsort(row, kind="stable")
        return self._ways(points, row[by_row], patch[by_row], found[by_row])

    def _ways(self, points: np.ndarray, row: np.ndarray, patch: np.ndarray, found: np.ndarray) -> Ways:
        return Ways.of(self.patches, row, patch, stops_of(self.transmitter, found, points[row]))

    def seen_from(self, point: np.ndarray) -> MirrorImages:
        """Images of another transmitter in the same patches."""
        other = copy.copy(self)
        other.transmitter, other._kept = point, [replace(self._kept[0], image=point[None])]
        return other

    def over_edges(self, leaves: EdgeLeaves, point: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
        """Over which edges chains of ``order`` reflections, known from the transmitter on, reach ``point`` (3,), if nothing
        stands between: index of the edge ``(L,)`` and patches ``(L, order)``, whose boxes hold the mirror points."""
        parts = [(np.zeros(0, int), np.zeros((0, order), np.int32))]
        at_once = 16_000_000  # chains times leaves: the words that are held
        step = max(1, at_once // max(len(leaves.radius), 1))
        kept = self._keep(order)
        known = min(order, len(kept) - 1)
        for chains, _ in self._descendants(kept[known], order - known, point, -1.0):
            for first in range(0, len(chains) if len(leaves.radius) else 0, step):
                some = chains.take(slice(first, first + step))
                words = wp.zeros((len(some), len(leaves.radius)), dtype=wp.uint32, device=self.device)
                inputs = [self._on_device, some.patch, _cones(some, self.device), leaves.on_device]
                inputs += [wp.vec3d(*point), wp.float64(IN_PLANE), words]
                launch(find_over_edges, words.size, inputs, device=self.device)
                chain, leaf, bit = _set_bits(words.numpy())
                edge = leaves.edge[32 * leaf + bit]
                # Pieces of an edge share their ends.
                chain, edge = np.unique(np.column_stack([chain, edge]), axis=0).T
                parts.append((edge, some.patch[chain]))
        edge, patches = (np.concatenate(p) for p in zip(*parts, strict=True))
        return edge, patches

    def _keep(self, order: int) -> list[Chains]:
        """All chains of 0, 1 ... reflections, up to ``order`` or as far as they are few; found once."""
        kept = self._kept
        while len(kept) <= order and len(kept[-1]) * len(self.patches) <= MOST_KEPT:
            blocks = [block for block, _ in self._extended(kept[-1], np.zeros(3), -1.0)]
            kept = [*kept, Chains.joined([Chains.none(len(kept)), *blocks])]
        self._kept = kept
        return kept

    def affordable(self, points: np.ndarray, order: int) -> int:
        """The most reflections, up to ``order``, whose :meth:`search` is not refused."""
        return int((np.cumsum(self._work(points, order)[0]) <= self.max_chains).sum())

    def _work(self, points: np.ndarray, order: int) -> tuple[list[float], float]:
        """Number of chains that each search of 1, 2 ... ``order`` reflections tries, estimated if they are many, and the
        seconds of what is estimated."""
        if len(points) == 0 or len(self.patches) == 0:
            return [0.0] * order, 0.0
        kept, rng, ends = self._keep(order), np.random.default_rng(0), _Ends(points, self.device)
        work = [float(len(chains)) for chains in kept[1 : order + 1]]
        sample, many, shorter, seconds = kept[-1], float(len(kept[-1])), 0.0, 0.0
        for k in range(len(kept), order + 1):
            sample = sample.take(np.sort(rng.permutation(len(sample))[:_SAMPLE]))
            each = many / max(len(sample), 1)
            begin = time.perf_counter()
            last = sum(len(block) for block, _ in self._extended(sample, ends.middle, ends.radius))
            work.append(shorter + each * last)
            seconds += each * (time.perf_counter() - begin)
            if k < order:  # later searches go on from all of them
                begin = time.perf_counter()
                sample, whole = self._some_longer(sample, rng)
                many, shorter = each * whole, shorter + each * whole
                seconds += (order - k) * each * (time.perf_counter() - begin)
        return work, seconds

    def _some_longer(self, chains: Chains, rng: np.random.Generator) -> tuple[Chains, int]:
        """About ``_SAMPLE`` of the chains of one reflection more that follow ``chains``, and how many these are."""
        parts = []
        for block, _ in self._extended(chains, np.zeros(3), -1.0):
            parts.append((block.take(rng.permutation(len(block))[:_SAMPLE]), len(block)))
        whole = sum(size for _, size in parts)
        share = min(1.0, _SAMPLE / max(whole, 1))
        some = [part.take(slice(int(np.ceil(share * size)))) for part, size in parts]
        return Chains.joined([Chains.none(chains.patch.shape[1] + 1), *some]), whole

    def _descendants(
        self, chains: Chains, steps: int, middle: np.ndarray, reach: float
    ) -> Iterator[tuple[Chains, float]]:
        """Chains of ``steps`` reflections more, at the end those that may reach the ball, and the share that is done."""
        if steps == 0:
            for k in range(0, len(chains), BLOCK):
                yield chains.take(slice(k, k + BLOCK)), min((k + BLOCK) / len(chains), 1.0)
            return
        before = 0.0
        for block, share in self._extended(chains, middle, reach if steps == 1 else -1.0):
            for some, within in self._descendants(block, steps - 1, middle, reach):
                yield some, before + within * (share - before)
            before = share

    def _extended(self, chains: Chains, middle: np.ndarray, reach: float) -> Iterator[tuple[Chains, float]]:
        """Chains of one reflection more, about :data:`BLOCK` at a time, and the share of ``chains`` that is done."""
        last = chains.patch[:, -1] if chains.patch.shape[1] else np.full(len(chains), -1)
        size = 16_384  # of a launch: a second or so in a city, after which the caller is told
        for first in range(0, len(chains), size):
            stretch = slice(first, first + size)
            count = self._extend(chains.take(stretch), last[stretch], middle, reach, None)[0]
            ends, done = np.cumsum(count, dtype=np.int64), 0
            while done < len(count):
                before = ends[done - 1] if done else 0
                stop = max(done + 1, int(np.searchsorted(ends, before + BLOCK, side="right")))
                some = slice(first + done, first + stop)
                parents = chains.take(some)
                inputs = last[some], middle, reach, count[done:stop]
                _, parent, patch, image, axis, sine = self._extend(parents, *inputs)
                longer = np.column_stack([parents.patch[parent], patch]).astype(np.int32, copy=False)
                yield Chains(longer, image, axis, sine), (first + stop) / len(chains)
                done = stop

    def _extend(
        self, chains: Chains, last: np.ndarray, middle: np.ndarray, reach: float, count: np.ndarray | None
    ) -> tuple[np.ndarray, ...]:
        """How many chains follow each of ``chains``; and, where ``count`` says so already, which."""
        where, size = self.device, 0 if count is None else int(count.sum())
        start = np.zeros(len(chains), np.int32)
        if count is not None:
            start = (np.cumsum(count) - count).astype(np.int32)
        counted = wp.zeros(len(chains), dtype=wp.int32, device=where)
        parent, patch = (wp.zeros(size, dtype=wp.int32, device=where) for _ in range(2))
        children = kernels.Cones()
        children.apex, children.axis = (wp.zeros(size, dtype=wp.vec3d, device=where) for _ in range(2))
        children.sine = wp.zeros(size, dtype=wp.float64, device=where)
        inputs = [self._on_device, last, _cones(chains, where), wp.vec3d(*middle), wp.float64(reach)]
        inputs += [start, counted, parent, patch, children]
        launch(kernels.extend_chains, len(chains), inputs, device=where, grain=16)
        arrays = (counted, parent, patch, children.apex, children.axis, children.sine)
        return tuple(a.numpy() for a in arrays)

    def _unfolded(self, chains: Chains, ends: _Ends) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        where = self.device
        words = wp.zeros((len(chains), len(ends.leaf_radius)), dtype=wp.uint32, device=where)
        inputs = [self._on_device, chains.patch, _cones(chains, where), *ends.on_device, words]
        launch(kernels.find_chains, words.size, inputs, device=where)
        chain, leaf, bit = _set_bits(words.numpy())
        row = ends.order[32 * leaf + bit]
        patches = chains.patch[chain]
        point = wp.zeros(patches.shape, dtype=wp.vec3d, device=where)
        inputs = [self._on_device, patches, chains.image[chain], ends.positions[row], point]
        launch(kernels.unfold_chains, len(row), inputs, device=where)
        return row, patches, point.numpy().reshape(*patches.shape, 3)


class _Ends:
    """Points where chains end, in leaves of 32 neighbours with a ball around each, and one around all."""

    def __init__(self, points: np.ndarray, where: wp.Device) -> None:
        self.positions, self.order = points, _along_curve(points)
        ordered = points[self.order]
        middle, self.leaf_radius = _leaves(ordered, ordered)
        vectors = (wp.array(a, dtype=wp.vec3d, device=where) for a in (ordered, middle))
        self.on_device = *vectors, wp.array(self.leaf_radius, dtype=wp.float64, device=where)
        low, high = points.min(axis=0), points.max(axis=0)
        self.middle, self.radius = 0.5 * (low + high), 1e-6 + 0.5 * float(np.linalg.norm(high - low))


class EdgeLeaves:
    """Edges in pieces, in leaves of 32 neighbours with a ball around each."""

    def __init__(self, edges: Edges, where: wp.Device) -> None:
        longest_m = 20.0  # longer edges are cut, so that balls around neighbours stay small
        count = np.maximum(1, np.ceil(edges.length / longest_m)).astype(int)
        edge, place = spans(0 * count, count)
        piece = edges.length[edge] / count[edge]
        start = edges.start[edge] + (place * piece)[:, None] * edges.along[edge]
        middle = start + 0.5 * piece[:, None] * edges.along[edge]
        order = _along_curve(middle)
        self.edge, start, piece, middle = edge[order], start[order], piece[order], middle[order]
        own = edges.take(self.edge)
        half = 0.5 * piece[:, None] * np.abs(own.along)
        leaf_middle, self.radius = _leaves(middle - half, middle + half)
        below = np.cross(own.along, own.inward), own.n[:, None] * np.pi
        far = np.sin(below[1]) * own.inward - np.cos(below[1]) * below[0]
        self.on_device = filled(
            edge_kernels.EdgePieces, where, start=start, along=own.along, first=below[0], last=far, length=piece,
            leaf_middle=leaf_middle, leaf_radius=self.radius,
        )  # fmt: skip


def _leaves(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middles and radii of balls around each 32 of what lies between ``low`` and ``high`` (N, 3)."""
    first = np.arange(0, len(low), 32)
    low, high = np.minimum.reduceat(low, first), np.maximum.reduceat(high, first)
    return 0.5 * (low + high), 1e-6 + 0.5 * np.linalg.norm(high - low, axis=1)


def _set_bits(words: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and number of each bit that is set in ``words`` (C, K), lowest first."""
    row, column = np.nonzero(words)
    octets = words[row, column].astype("<u4", copy=False).view(np.uint8).reshape(-1, 4)
    some, bit = np.nonzero(np.unpackbits(octets, axis=1, bitorder="little"))
    return row[some], column[some], bit


def _cones(chains: Chains, where: wp.Device) -> Any:
    return filled(kernels.Cones, where, apex=chains.image, axis=chains.axis, sine=chains.sine)


def _patches_on_device(patches: PlanarPatches, slack_m: float, to_edges: bool, where: wp.Device) -> Any:
    """The kernels' view of patches: boxes and balls ``slack_m`` too large, and a binary tree of the boxes."""
    low, high = patches.boxes[:, 0] - slack_m, patches.boxes[:, 1] + slack_m
    order = _along_curve(0.5 * (low + high))
    levels = [(low[order], high[order])]
    while len(levels[-1][0]) > 1:
        low_, high_ = levels[-1]
        pairs = np.arange(0, len(low_), 2)
        levels.append((np.minimum.reduceat(low_, pairs), np.maximum.reduceat(high_, pairs)))
    tree_low, tree_high = (np.concatenate(a) for a in zip(*levels, strict=True))
    return filled(
        kernels.Patches,
        where,
        normal=patches.normal,
        plane_offset=patches.offset,
        radius=0.5 * np.linalg.norm(high - low, axis=1),
        box_middle=0.5 * (low + high),
        box_half=0.5 * (high - low),
        order=order,
        node_middle=0.5 * (tree_low + tree_high),
        node_half=0.5 * (tree_high - tree_low),
        level=np.cumsum([0, *(len(a) for a, _ in levels[:-1])]),
        two_sided=patches.two_sided,
        to_edges=to_edges,
    )


def _along_curve(points: np.ndarray) -> np.ndarray:
    """Indices that sort ``points`` (N, 3) along Morton's curve: neighbours in space are near each other in order."""
    span = np.maximum(np.ptp(points, axis=0), 1e-30) if len(points) else np.ones(3)
    cell = ((points - points.min(axis=0, initial=np.inf)) / span * 1023).astype(np.int64)
    key = sum(((cell[:, a] >> bit) & 1) << (3 * bit + a) for a in range(3) for bit in range(10))
    return np.argsort(key, kind="stable")

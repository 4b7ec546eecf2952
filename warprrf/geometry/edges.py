"""Edges of a mesh: straight lines about which more than half a turn is air, wedges and borders of sheets, in metres.

An edge is told by what surfaces leave its line, whichever faces these are made of: around the middle of each piece of a
line, all faces that touch it, sharing vertices with it or not, are sorted by direction, and a gap of more than half a turn
is a wedge of that exterior angle. So windings, repeated faces, subdivisions and seams that don't match change nothing; there is no
edge between coplanar faces, in a room's corner, or where a partition stands on a floor. Collinear pieces are one edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from warprrf.geometry.mesh import Mesh, components, cut, headings, sides_of, vectors_across
from warprrf.rows import Rows, couples, distinct_rows

LEAST_BEND_RAD = np.radians(1.0)
"""Faces that are bent less make no edge."""
_ALIKE_RAD = (
    1e-3  # directions of pieces of one edge, and of an edge and the plane that it lies in, differ by no more
)
_SIDE = np.array([0.5377, 0.6391, 0.5498])  # edges point to its side: no plane across it is likely in a scene


@dataclass(frozen=True)
class Edges(Rows):
    """E edges of a mesh.

    Attributes:
        start: One end [m], shape ``(E, 3)``.
        along: Unit vector to the other, shape ``(E, 3)``.
        length: Length [m], shape ``(E,)``.
        inward: Unit vector across the edge into face 0, shape ``(E, 3)``. Turned about ``along`` it goes through the air
            until, by ``n`` pi, it lies in face n.
        n: Exterior angle over pi, shape ``(E,)``: 2 where a sheet ends.
        face: Faces 0 and n of the mesh, one of those at the edge each, shape ``(E, 2)``.
    """

    start: np.ndarray
    along: np.ndarray
    length: np.ndarray
    inward: np.ndarray
    n: np.ndarray
    face: np.ndarray

    @property
    def outward(self) -> np.ndarray:
        """Unit vectors into the air, halfway between the faces, shape ``(E, 3)``."""
        half = 0.5 * np.pi * self.n[:, None]
        return np.cos(half) * self.inward + np.sin(half) * np.cross(self.along, self.inward)


def mesh_edges(mesh: Mesh, normal: np.ndarray, groups: np.ndarray) -> Edges:
    """The edges of ``mesh``.

    Args:
        normal: Normals that say how faces lie, shape ``(F, 3)``, in place of their own: of the planes that they are part of,
            say. A face whose normal is zero is left out.
        groups: Index of what each face is made of, shape ``(F,)``: edges end where it changes.
    """
    sides, place, reach = _candidates(mesh, normal), mesh.places, mesh.weld_m
    ends = _split(mesh, sides)
    span = place[ends[:, 1]] - place[ends[:, 0]]
    span *= np.where(span @ _SIDE < 0, -1.0, 1.0)[:, None]
    along, length = headings(span)
    middle = 0.5 * (place[ends[:, 0]] + place[ends[:, 1]])
    piece, inward, n, face = _gaps(mesh, normal, middle, along, length, reach)
    keep = n > 1.0 + LEAST_BEND_RAD / np.pi
    piece, inward, n, face = piece[keep], inward[keep], n[keep], face[keep]
    pieces = Edges(middle[piece] - 0.5 * span[piece], along[piece], length[piece], inward, n, face)
    return _merged(pieces, ends[piece], groups[face], reach)


def _candidates(mesh: Mesh, normal: np.ndarray) -> np.ndarray:
    """Sides of triangles that may be on an edge: all but those of two faces in one plane; pairs of places ``(S, 2)``."""
    face = mesh.distinct_faces[(normal[mesh.distinct_faces] != 0).any(axis=1)]
    sides = sides_of(mesh.welded_faces[face])
    owner, third = np.repeat(face, 3), mesh.triangles[face][:, [2, 0, 1]].reshape(-1, 3)
    start = mesh.triangles[face].reshape(-1, 3)
    once, _, count = distinct_rows(sides)
    found, (first, second) = sides[once], couples(sides)
    a, b = normal[owner[first]], normal[owner[second]]
    cosine, sine = np.abs((a * b).sum(axis=1)), np.linalg.norm(np.cross(a, b), axis=1)
    span = mesh.triangles[face][:, [1, 2, 0]].reshape(-1, 3)[first] - start[first]
    across = np.cross(a, span)
    apart = (across * (third[first] - start[first])).sum(axis=1) * (
        across * (third[second] - start[first])
    ).sum(axis=1)
    flat = count == 2
    flat[flat] = (np.arctan2(sine, cosine) <= LEAST_BEND_RAD) & (apart < 0)
    return found[~flat & (found[:, 0] != found[:, 1])]


def _split(mesh: Mesh, sides: np.ndarray) -> np.ndarray:
    """The pieces into which ends of other ``sides`` cut them, each once, as pairs of places ``(P, 2)``."""
    point, key = np.unique(sides), [len(mesh.places), 1]
    row, face = mesh.faces_at(mesh.places[point], mesh.weld_m)
    beside = sides_of(mesh.welded_faces[face])
    which = np.searchsorted(sides @ key, beside @ key).clip(max=len(sides) - 1)
    own = (sides[which] == beside).all(axis=1)
    pieces = cut(sides, which[own], np.repeat(point[row], 3)[own], mesh)[0]
    pieces = pieces[distinct_rows(pieces)[0]]
    return pieces[pieces[:, 0] != pieces[:, 1]]


def _gaps(
    mesh: Mesh, normal: np.ndarray, middle: np.ndarray, along: np.ndarray, length: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The widest gap between surfaces around each piece: piece, direction that it begins at, width over pi, and faces."""
    piece, face = mesh.faces_at(middle, reach)
    lies = np.abs((normal[face] * along[piece]).sum(axis=1)) <= _ALIKE_RAD + 4.0 * reach / length[piece]
    lies &= (normal[face] != 0).any(axis=1)
    piece, face = np.repeat(piece[lies], 2), np.repeat(face[lies], 2)
    toward = np.cross(normal[face], along[piece])
    toward = headings(toward * (np.arange(len(toward)) % 2 * 2.0 - 1.0)[:, None])[0]
    goes_on = _depth(mesh, face, middle[piece], toward) > 4.0 * reach
    piece, face, toward = piece[goes_on], face[goes_on], toward[goes_on]
    u, v = vectors_across(along)
    angle = np.arctan2((toward * v[piece]).sum(axis=1), (toward * u[piece]).sum(axis=1))
    order = np.lexsort((face, angle, piece))
    piece, face, toward, angle = piece[order], face[order], toward[order], angle[order]
    first = np.flatnonzero(np.diff(piece, prepend=-1))
    last = np.append(first[1:], len(piece)) - 1
    after = np.arange(1, len(piece) + 1)
    after[last] = first
    width = angle[after] - angle if len(piece) else np.zeros(0)
    width[last] += 2.0 * np.pi
    order = np.lexsort((width, piece))  # the widest of a piece comes last
    begin = order[last]
    return (
        piece[begin],
        toward[begin],
        width[begin] / np.pi,
        np.column_stack([face[begin], face[after[begin]]]),
    )


def _depth(mesh: Mesh, face: np.ndarray, point: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """How far each face goes on from ``point``, on it, in the direction ``toward`` [m]."""
    corner, normal = mesh.triangles[face], mesh.face_normals[face]
    depth = np.full(len(face), np.inf)
    for k in range(3):
        side = headings(np.cross(normal, corner[:, (k + 1) % 3] - corner[:, k]))[0]
        left = np.maximum((side * (point - corner[:, k])).sum(axis=1), 0.0)
        pace = -(side * toward).sum(axis=1)
        depth = np.where(pace > 1e-9, np.minimum(depth, left / np.maximum(pace, 1e-9)), depth)
    return depth


def _merged(pieces: Edges, ends: np.ndarray, group: np.ndarray, reach: float) -> Edges:
    """Collinear ``pieces`` that share an end, between alike faces, as one edge each."""
    count = len(pieces)
    owner, size = np.tile(np.arange(count), 2), (count, ends.max(initial=0) + 1)
    at = sparse.coo_array((np.ones(2 * count, bool), (owner, ends.T.reshape(-1))), shape=size).tocsr()
    a, b = sparse.triu(at @ at.T, 1).nonzero()
    limit = _ALIKE_RAD + 2.0 * reach / np.minimum(pieces.length[a], pieces.length[b])
    alike = np.abs(pieces.n[a] - pieces.n[b]) <= limit
    for vector in (pieces.along, pieces.inward):
        alike &= np.linalg.norm(vector[a] - vector[b], axis=1) <= limit
    alike &= (group[a] == group[b]).all(axis=1)
    label = components(count, np.column_stack([a, b])[alike]) if count else np.zeros(0, int)
    longest = np.lexsort((-pieces.length, label))
    longest = longest[np.flatnonzero(np.diff(label[longest], prepend=-1))]
    base, along = pieces.start[longest][label], pieces.along[longest][label]
    low = ((pieces.start - base) * along).sum(axis=1)
    high = low + (pieces.length[:, None] * pieces.along * along).sum(axis=1)
    first, last = (np.lexsort((x, label)) for x in (low, -high))
    begins = np.flatnonzero(np.diff(label[first], prepend=-1))
    first, last = first[begins], last[begins]
    start = pieces.start[first]
    along, length = headings(pieces.start[last] + pieces.length[last, None] * pieces.along[last] - start)
    inward = pieces.inward[longest]
    inward = headings(inward - (inward * along).sum(axis=1, keepdims=True) * along)[0]
    return Edges(start, along, length, inward, pieces.n[longest], pieces.face[longest])

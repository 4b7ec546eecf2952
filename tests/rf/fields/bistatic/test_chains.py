"""Chains of mirrors: what several reflect of unpolarised light, against Jones matrices and laws that they obey."""

from dataclasses import replace

import numpy as np
import pytest
from furnished import RECEIVERS, ROOM, TX
from path_makers import random_directions
from radio_scenes import joined, mirror_paths

from warprrf.geometry.mesh import Mesh
from warprrf.kernels.radio.records import MIRROR, SCATTER, SLAB
from warprrf.rf.paths.polarisation import turns
from warprrf.rf.tracing.model import Parameters
from warprrf.rf.tracing.records import Materials, Records
from warprrf.rf.tracing.surface import POSITION_ERROR_M, Surface

RX = RECEIVERS[0]


def reflected_ways(count, mirrors, seed):
    """Stops (L, k + 2, 3), normals and cosines (L, k, ...) of random chains that obey the law of reflection."""
    rng = np.random.default_rng(seed)
    normal = random_directions(count * mirrors, rng).reshape(count, mirrors, 3)
    along = random_directions(count, rng)
    stops, cosine = [-along, np.zeros((count, 3))], []
    for k in range(mirrors):
        height = (along * normal[:, k]).sum(axis=1)
        cosine.append(np.abs(height))
        along = along - 2.0 * height[:, None] * normal[:, k]
        stops.append(stops[-1] + (1.0 + k) * along)
    return np.stack(stops, axis=1), normal, np.stack(cosine, axis=1)


def reflected(excess, cosine, turn):
    """Share of unpolarised light that chains of mirrors (L, k) reflect, by the kernel of records; 0 in ``excess`` is none."""
    index = np.where(excess > 0, np.arange(excess.size).reshape(excess.shape), -1).astype(np.int32)
    none = np.zeros(excess.size)
    p = Parameters(none[:, None], np.log(np.where(excess > 0, excess, 1.0)).ravel(), none, (0,))
    angle = np.stack([cosine, turn, 0.0 * turn], axis=2)
    kind = np.full(index.shape, MIRROR, np.int8)
    records = Records(index, angle, kind, np.ones(len(excess)), np.arange(len(excess)))
    return records.powers(Materials(p, (none + 0j, none)))


def test_a_mirror_met_head_on_has_no_plane_of_incidence():
    """A wave that goes to a wall and back keeps its polarisation, whichever plane stands in for the missing one."""
    stops = np.array([[[0.0, 0.0, 2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 4.0], [0.0, 0.0, 1.0]]])
    normal = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    share = reflected(np.array([[3.0, 3.0]]), np.ones((1, 2)), turns(stops, normal))
    np.testing.assert_allclose(share, (1.0 / 3.0) ** 4, rtol=1e-12)


@pytest.mark.parametrize("rough", [False, True])
def test_every_interaction_of_a_long_record_counts(rough):
    """Eight slabs on either side of a surface that scatters, or sixteen and a mirror, met head on; and slopes to their shares."""
    let_through, other = 0.9, 0.8  # shares of the slabs' material and of what stands in their middle
    kind = np.full((1, 17), SLAB, np.int8)
    kind[0, 8] = SCATTER if rough else MIRROR
    index = (np.arange(17) == 8).astype(np.int32)[None]
    p = Parameters(
        np.log(np.full((2, 1), other)),
        np.log([1.25, 3.0]),
        np.log([0.5, other]),
        (0,),
        log_through=np.log([let_through, 0.5]),
    )
    records = Records(index, np.tile([1.0, 0.0, 0.0], (1, 17, 1)), kind, np.ones(1), np.zeros(1, np.int32))
    materials = Materials(p, (np.zeros(2, complex), np.zeros(2)))
    one = let_through * (1.0 - 0.2**2) ** 2  # of a face, epsilon_r is 2.25
    share = other / 9.0 / (np.pi if rough else 1.0)
    found = records.powers(materials)
    np.testing.assert_allclose(found, one**16 * share, rtol=1e-12)
    slope = records.slopes(materials, np.array([0, 4], np.int32), 8)[0] / found
    np.testing.assert_allclose(slope[[3, 4 if rough else 6]], [16.0, 1.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("edge_m", "least", "most"), [(-0.2, 1.0, 1.0), (-0.012, 0.4, 0.75), (0.01, 0.0, 0.0)]
)
def test_a_screen_beside_a_chain_covers_part_of_its_zone(edge_m, least, most):
    """Floor, then a wall: a screen across the leg between them leaves all, about half, or nothing of the path.

    The screen ends ``edge_m`` past the path, where the zone has a radius of 23 mm; rays start a position error above a mirror,
    which moves them by a centimetre.
    """
    mesh = Mesh(*ROOM)
    alone = mirror_paths(_surface(mesh), TX, RX[None], 1e-3, 2)
    order = np.flatnonzero(alone.order == 2)
    over = alone.point[order]
    pick = order[np.flatnonzero((np.abs(over[:, 0, 2]) < 1e-9) & (np.abs(over[:, 1, 0] - 5.0) < 1e-9))[0]]
    floor, wall = alone.point[pick, 0], alone.point[pick, 1]
    middle, toward = 0.5 * (floor + wall), wall - floor
    across = np.cross(toward, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    up = np.cross(across, toward / np.linalg.norm(toward))
    corner = middle + edge_m * across
    plate = np.array(
        [corner - 0.3 * up, corner + 0.3 * up, corner - across + 0.3 * up, corner - across - 0.3 * up]
    )
    both, _ = joined((mesh.vertices, mesh.faces), (plate, np.array([[0, 1, 2], [0, 2, 3]])))
    found = mirror_paths(_surface(both), TX, RX[None], 1e-3, 2)
    same = (found.order == 2) & (np.abs(found.length_m - alone.length_m[pick]) < 1e-9)
    same &= found.arrival @ alone.arrival[pick] > 1 - 1e-12
    assert alone.share[pick] == 1.0
    assert same.sum() == (most > 0)
    assert all(least <= share <= most for share in found.share[same])


def _surface(mesh):
    """A surface that is as wrong as one from photos: its position error widens the zones."""
    return replace(Surface.of(mesh), position_error_m=POSITION_ERROR_M)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("mirrors", [1, 2, 3])
def test_any_chain_reflects_as_fields_in_space_do(mirrors):
    """Two field vectors across the first leg, reflected one mirror after the other in room coordinates.

    With three mirrors the sense of each turn counts: of two, only its size.
    """
    stops, normal, cosine = reflected_ways(200, mirrors, 11)
    excess = np.random.default_rng(4).uniform(0.5, 12.0, (200, mirrors))
    share = reflected(excess, cosine, turns(stops, normal))
    leg = np.diff(stops, axis=1)
    leg /= np.linalg.norm(leg, axis=2, keepdims=True)
    for path in range(200):
        u = np.linalg.svd(leg[path, :1])[2][1:]  # two unit vectors across the first leg
        for k in range(mirrors):
            s = np.cross(leg[path, k], normal[path, k])
            s /= np.linalg.norm(s)
            before, after = np.cross(s, leg[path, k]), np.cross(s, leg[path, k + 1])
            c, permittivity = cosine[path, k], 1.0 + excess[path, k]
            root = np.sqrt(permittivity - 1.0 + c**2)
            te, tm = (c - root) / (c + root), (permittivity * c - root) / (permittivity * c + root)
            u = te * np.outer(u @ s, s) + tm * np.outer(u @ before, after)
        assert share[path] == pytest.approx(0.5 * (u**2).sum(), rel=1e-9)

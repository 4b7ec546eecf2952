"""Diffraction and transmission past obstacles, against closed forms and geometry done by hand."""

import numpy as np
import pytest
from radio_scenes import box_mesh, joined

from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.fresnel import slab_reflection, slab_transmission
from warprrf.rf.paths.blockage import diffracted, knife_edge_loss_db, transmitted

WAVELENGTH = 1e-3
WALL = Mesh([[0, -50, 0], [0, 50, 0], [0, 50, 2], [0, -50, 2]], [[0, 1, 2], [0, 2, 3]])  # a screen, 2 m high


def test_knife_edge_loss_at_grazing_and_far_in_the_shadow() -> None:
    assert knife_edge_loss_db(0.0) == pytest.approx(6.02, abs=0.1)  # half the field
    # Far in the shadow the Fresnel integral gives 1 / (pi v sqrt(2)) of the field.
    assert knife_edge_loss_db(30.0) == pytest.approx(20 * np.log10(np.pi * 30 * np.sqrt(2)), abs=0.1)
    assert knife_edge_loss_db(-2.0) == 0.0


def test_a_screen_diffracts_over_its_top_by_the_height_it_stands_above_the_ray() -> None:
    transmitter, receiver = np.array([-10.0, 0, 1.9]), np.array([10.0, 0, 1.9])
    found = diffracted(WALL, transmitter, receiver[None], WAVELENGTH)
    over = found.power[found.arrival[:, 2] > 0]
    assert len(over) == 1
    v = 0.1 * np.sqrt(2 / WAVELENGTH * (1 / 10 + 1 / 10))  # P.526, eq. (26)
    friis = (WAVELENGTH / (4 * np.pi * 20)) ** 2
    assert over[0] == pytest.approx(friis * 10 ** (-float(knife_edge_loss_db(v)) / 10), rel=1e-3)
    longer = 2 * np.hypot(10, 0.1)
    assert found.length_m[found.arrival[:, 2] > 0][0] == pytest.approx(longer, rel=1e-9)


def test_inner_corners_and_flat_seams_do_not_diffract() -> None:
    room = Mesh(*box_mesh([-5, -5, 0], [5, 5, 3], inward=True))
    assert len(diffracted(room, np.array([-4.0, 0, 1]), np.array([[4.0, 0, 1]]), WAVELENGTH).power) == 0


def test_a_pillar_is_passed_on_both_sides() -> None:
    mesh, _ = joined(box_mesh([-9, -9, 0], [9, 9, 3], inward=True), box_mesh([-0.5, -0.5, 0], [0.5, 0.5, 3]))
    found = diffracted(mesh, np.array([-5.0, 0, 1]), np.array([[5.0, 0, 1]]), WAVELENGTH)
    # Front edges alone see both ends of neither side: a ray bends at the corner once, so none passes a wide pillar.
    assert len(found.power) == 0
    thin, _ = joined(
        box_mesh([-9, -9, 0], [9, 9, 3], inward=True), box_mesh([-0.001, -0.5, 0], [0.001, 0.5, 3])
    )
    found = diffracted(thin, np.array([-5.0, 0, 1]), np.array([[5.0, 0, 1]]), WAVELENGTH)
    assert {-1, 1} <= set(np.sign(np.round(found.arrival[:, 1], 9)))
    assert found.power.max() == pytest.approx(found.power[found.arrival[:, 1] > 0].max(), rel=1e-3)


def test_edges_diffract_however_faces_are_wound() -> None:
    """A mast over a house's roof and a street in its shadow: one way, over the roof's edge."""
    ground = (
        np.array([[-60.0, -60, 0], [60, -60, 0], [60, 60, 0], [-60, 60, 0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    mast, street = np.array([-8.0, 0, 25.0]), np.array([[20.0, 1.0, 1.5]])
    found = [
        diffracted(
            joined(ground, box_mesh([-10, -30, 0], [10, 30, 20], inward=inward))[0], mast, street, 0.0857
        )
        for inward in (False, True)
    ]
    assert len(found[0].power) == 1
    assert found[1].power == pytest.approx(found[0].power, rel=1e-9)
    assert found[0].arrival[0] @ [10.0 - 20.0, -0.6, 18.5] > 0.99 * np.linalg.norm([10.0, 0.6, 18.5])


def test_what_a_lossless_slab_does_not_reflect_passes() -> None:
    cosine = np.linspace(0.05, 1, 40)
    reflected = slab_reflection(cosine, 5.0, 0.0123, WAVELENGTH)
    passed = slab_transmission(cosine, 5.0, 0.0123, WAVELENGTH)
    for r, t in zip(reflected, passed, strict=True):
        np.testing.assert_allclose(np.abs(r) ** 2 + np.abs(t) ** 2, 1.0, rtol=1e-12)
    assert not np.any(slab_transmission(cosine, 5.0 - 0.1j, np.inf, WAVELENGTH))
    assert np.abs(slab_transmission(1.0, 5.0 - 0.5j, 0.0123, WAVELENGTH)[0]) ** 2 < 1e-4


def test_transmission_counts_a_screen_once_and_a_solid_by_its_front() -> None:
    transmitter, receiver = np.array([-10.0, 0, 1.0]), np.array([[10.0, 0, 1.0]])
    expected = np.abs(slab_transmission(1.0, 3.0 - 0.05j, 0.004, WAVELENGTH)[0]) ** 2
    friis = (WAVELENGTH / (4 * np.pi * 20)) ** 2
    box = Mesh(*box_mesh([-1, -1, 0], [1, 1, 3]))
    for mesh in (WALL, box):
        faces = len(mesh.faces)
        found = transmitted(
            mesh, transmitter, receiver, WAVELENGTH, np.full(faces, 3.0 - 0.05j), np.full(faces, 0.004)
        )
        assert found.power[0] == pytest.approx(friis * expected, rel=1e-9)

"""Arrays: symmetries, limits and the patterns' own definitions."""

import numpy as np
import pytest
from path_makers import random_directions

from warprrf.rf.channel.arrays import PlanarArray, orientation_towards, plane_wave_error
from warprrf.rf.spectra.antenna import PATTERNS, rotation_matrix
from warprrf.rf.spectra.spectrum import pixel_directions, pixel_solid_angles, transverse_basis

WAVELENGTH = 1e-3


def test_elements_run_down_columns_from_the_top_left():
    p = PlanarArray(2, 3, spacing=(0.5, 0.7)).positions(WAVELENGTH)
    assert np.allclose(p.mean(axis=0), 0)
    assert np.allclose(p[1] - p[0], [0, 0, -0.5e-3])
    assert np.allclose(p[2] - p[0], [0, 0.7e-3, 0])


def test_rotation_follows_tr_38901():
    # Yaw turns x to y; pitch then lowers the boresight: eq. (7.1-4).
    assert np.allclose(rotation_matrix([np.pi / 2, 0, 0]) @ [1, 0, 0], [0, 1, 0])
    assert np.allclose(rotation_matrix([0, np.pi / 2, 0]) @ [1, 0, 0], [0, 0, -1])
    assert np.allclose(rotation_matrix([0, 0, np.pi / 2]) @ [0, 1, 0], [0, 0, 1])
    r = rotation_matrix([0.4, -0.8, 2.0])
    assert np.allclose(r @ r.T, np.eye(3)) and np.isclose(np.linalg.det(r), 1)


def test_orientation_towards_points_the_boresight():
    for d in random_directions(20, 1):
        assert np.allclose(rotation_matrix(orientation_towards(d)) @ [1, 0, 0], d)


@pytest.mark.parametrize("pattern", [*PATTERNS, "callable"])
@pytest.mark.parametrize("polarisation", [None, "cross"])
def test_turning_array_and_waves_together_changes_nothing(pattern, polarisation):
    pattern = (lambda angle: 1.0 + np.cos(angle)) if pattern == "callable" else pattern
    d = random_directions(50, 2)
    still = PlanarArray(4, 3, pattern=pattern, polarisation=polarisation)
    turn = rotation_matrix([0.3, -1.1, 0.7])
    turned = PlanarArray(4, 3, orientation=turn, pattern=pattern, polarisation=polarisation)
    np.testing.assert_allclose(
        turned.response(d @ turn.T, WAVELENGTH), still.response(d, WAVELENGTH), atol=1e-11
    )
    np.testing.assert_allclose(turned.gain(d @ turn.T), still.gain(d), rtol=1e-9)
    np.testing.assert_allclose(still.response(2.5 * d, WAVELENGTH), still.response(d, WAVELENGTH), atol=1e-11)
    point = 0.5 * d
    np.testing.assert_allclose(
        turned.spherical_response(point @ turn.T, WAVELENGTH),
        still.spherical_response(point, WAVELENGTH),
        atol=1e-9,
    )
    if polarisation:
        before = np.einsum("k...a,...ai->k...i", still.field(d), transverse_basis(d))
        after = np.einsum("k...a,...ai->k...i", turned.field(d @ turn.T), transverse_basis(d @ turn.T))
        np.testing.assert_allclose(after, before @ turn.T, atol=1e-9)


@pytest.mark.parametrize(
    ("pattern", "mean"), [("isotropic", 1.0), ("dipole", 1.0), ("half_wave_dipole", 1.0013)]
)
def test_lossless_patterns_average_to_one(pattern, mean):
    shape = (720, 360)
    gain = PlanarArray(1, 1, pattern=pattern).gain(pixel_directions(shape))
    share = (gain * pixel_solid_angles(shape)[:, None]).sum() / (4 * np.pi)
    assert share == pytest.approx(mean, rel=2e-4)  # 1.643 for 1.6409, the usual figure


def test_tr38901_element():
    a = PlanarArray(1, 1, pattern="tr38901")
    assert 10 * np.log10(a.gain([1, 0, 0])) == pytest.approx(8)
    half = np.deg2rad(65 / 2)
    for d in ([np.cos(half), np.sin(half), 0], [np.cos(half), 0, np.sin(half)]):
        assert 10 * np.log10(a.gain(d)) == pytest.approx(8 - 3)  # half power at half of 65 degrees
    assert 10 * np.log10(a.gain([-1, 0, 0])) == pytest.approx(8 - 30)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_polarised_field_carries_the_gain(pattern):
    d = random_directions(200, 3)
    for polarisation in ("V", "H", "VH", "cross"):
        a = PlanarArray(1, 1, pattern=pattern, polarisation=polarisation, orientation=(0.3, 0.2, -0.5))
        np.testing.assert_allclose(
            (a.field(d) ** 2).sum(axis=-1), np.tile(a.gain(d), (a.ports, 1)), atol=1e-12
        )


def test_plane_wave_error_falls_as_fresnel_says():
    a = PlanarArray(64, 64)
    size = np.linalg.norm(np.ptp(a.positions(WAVELENGTH), axis=0))
    fraunhofer = 2 * size**2 / WAVELENGTH
    for distance in (fraunhofer, 10 * fraunhofer):
        # Path to the corner: r (sqrt(1 + (D / 2 r)^2) - 1) ~ D^2 / 8 r.
        expected = 2 * np.pi / WAVELENGTH * size**2 / (8 * distance)
        assert plane_wave_error(a, distance, WAVELENGTH).phase_rad == pytest.approx(expected, rel=1e-4)
    assert plane_wave_error(a, fraunhofer, WAVELENGTH).phase_rad == pytest.approx(np.pi / 8, rel=1e-4)
    near, far = (plane_wave_error(a, d, WAVELENGTH) for d in (0.05 * fraunhofer, 100 * fraunhofer))
    assert near.beam_loss_db > 1.0 and far.beam_loss_db < 1e-4
    assert far.entry_error < 5e-3 < near.entry_error

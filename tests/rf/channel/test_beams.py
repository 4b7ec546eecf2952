"""Beams: codebooks keep power, a beam steered along its direction gains N, choices follow the paths and the users."""

import dataclasses
import itertools

import numpy as np
import pytest
from path_makers import CARRIER, paths_along, random_directions

import warprrf as wr
from warprrf.rf.channel.beams import signal_over_interference
from warprrf.rf.spectra.spectrum import pixel_directions

WAVELENGTH_M = 299792458.0 / CARRIER


@pytest.mark.parametrize(("rows", "cols"), [(1, 1), (4, 4), (3, 8)])
def test_dft_beams_are_orthonormal(rows, cols):
    weights = wr.channel.dft_codebook(wr.PlanarArray(rows, cols, orientation=(0.3, -0.2, 0.1))).weights
    np.testing.assert_allclose(weights @ weights.conj().T, np.eye(rows * cols), atol=1e-12)


def test_dft_beam_looks_along_the_cosines_that_are_stated():
    array = wr.PlanarArray(4, 8)  # axes of the array are those of the world: y across, z up
    book = wr.channel.dft_codebook(array)
    for across, down in itertools.product(range(2, 6), range(1, 3)):
        y, z = ((across + 0.5) / 8 - 0.5) / 0.5, -((down + 0.5) / 4 - 0.5) / 0.5
        direction = np.array([[np.sqrt(1.0 - y**2 - z**2), y, z]])
        gain = np.abs(book.amplitude(direction)[:, 0]) ** 2
        assert gain.argmax() == across * 4 + down
        np.testing.assert_allclose(gain.max(), 32.0, rtol=1e-12)
        np.testing.assert_allclose(book.beam(across * 4 + down), book.weights[across * 4 + down], atol=1e-15)


def test_steered_beam_gains_the_number_of_elements():
    array = wr.PlanarArray(8, 8, orientation=(1.0, 0.2, -0.3))
    directions = random_directions(20)
    book = wr.channel.steering_codebook(array, 3.0 * directions)
    np.testing.assert_allclose(np.abs(np.diag(book.amplitude(directions))) ** 2, 64.0, rtol=1e-12)


def test_beam_focused_on_a_near_point_loses_nothing_and_a_plane_one_does():
    array = wr.PlanarArray(64, 64)
    point = np.array([[0.4, 0.05, -0.1]])
    true = array.spherical_response(point[0], WAVELENGTH_M)
    whole = np.sum(np.abs(true) ** 2)
    near = wr.channel.steering_codebook(array, points=point, wavelength_m=WAVELENGTH_M)
    plane = wr.channel.steering_codebook(array, point)
    np.testing.assert_allclose(np.abs(near.received(true)[0]) ** 2, whole, rtol=1e-12)
    loss_db = wr.channel.plane_wave_error(
        array, float(np.linalg.norm(point)), WAVELENGTH_M, point[0]
    ).beam_loss_db
    assert loss_db > 1.0
    np.testing.assert_allclose(
        np.abs(plane.received(true)[0]) ** 2, whole * 10.0 ** (-0.1 * loss_db), rtol=1e-9
    )


@pytest.mark.parametrize("pattern", ["isotropic", "tr38901"])
def test_received_superposed_and_dense_sums_agree(pattern):
    array = wr.PlanarArray(3, 5, spacing=(0.5, 0.7), orientation=(0.4, 0.1, 0.2), pattern=pattern)
    rng = np.random.default_rng(1)
    d, c = random_directions(30), rng.normal(size=30) + 1j * rng.normal(size=30)
    book = wr.channel.dft_codebook(array, oversampling=2)
    h = (array.response(d, 1.0) * np.sqrt(array.gain(d))[:, None] * c[:, None]).sum(axis=0)
    expected = book.weights @ h
    np.testing.assert_allclose(book.received(h), expected, atol=1e-10)
    np.testing.assert_allclose(book.superposed(d, c), expected, atol=1e-10)
    dense = wr.channel.Codebook(array, (book.weights,))
    np.testing.assert_allclose(dense.superposed(d, c), expected, atol=1e-10)
    np.testing.assert_allclose(dense.power(d, np.abs(c) ** 2), book.power(d, np.abs(c) ** 2), rtol=1e-10)


def test_one_path_is_met_by_the_beams_along_it():
    tx, rx = wr.PlanarArray(8, 8, orientation=(0.3, 0, 0)), wr.PlanarArray(4, 4)
    arrival, departure = random_directions(10, seed=2), random_directions(10, seed=3)
    for a, d in zip(arrival, departure, strict=True):
        paths = paths_along(a[None], d[None], np.array([0.01j]))
        chosen = wr.channel.select_beams(paths, tx, rx)
        h = paths.cfr([CARRIER], tx_array=tx, rx_array=rx)[..., 0]
        power = np.abs(wr.channel.dft_codebook(rx).weights @ h @ wr.channel.dft_codebook(tx).weights.T) ** 2
        assert (chosen.rx[0], chosen.tx[0]) == np.unravel_index(power.argmax(), power.shape)
        np.testing.assert_allclose(chosen.gain[0], power.max(), rtol=1e-9)


def test_batched_paths_choose_as_each_receiver_does_and_best_come_first():
    tx, rx = wr.PlanarArray(4, 4), wr.PlanarArray(4, 2)
    lists = [
        paths_along(random_directions(n, seed=n), random_directions(n, seed=n + 9), np.arange(1.0, n + 1))
        for n in (2, 5)
    ]
    together = wr.channel.select_beams(wr.Paths.stack(lists), tx, rx, count=7)
    assert together.gain.shape == (2, 7) and (np.diff(together.gain, axis=1) <= 0).all()
    for row, paths in enumerate(lists):
        alone, gains = wr.channel.select_beams(paths, tx, rx, count=7), wr.channel.beam_gains(paths, tx, rx)
        np.testing.assert_array_equal(together.tx[row], alone.tx)
        np.testing.assert_array_equal(gains[alone.rx, alone.tx], alone.gain)
        np.testing.assert_allclose(np.sort(gains.ravel())[::-1][:7], alone.gain)


def test_spectrum_is_taken_as_powers_at_its_pixels():
    shape = (12, 24)
    gain, aod = np.zeros(shape), np.full((*shape, 2), np.nan)
    gain[5, 3], gain[7, 20] = 1e-9, 3e-10
    aod[5, 3], aod[7, 20] = (1.2, 0.4), (1.7, -0.8)
    spectrum = wr.Spectrum(path_gain=gain, aod=aod)
    tx, rx = wr.PlanarArray(4, 4), wr.PlanarArray(4, 4)
    chosen = wr.channel.select_beams(spectrum, tx, rx)
    along = pixel_directions(shape)[5, 3]
    best = np.abs(wr.channel.dft_codebook(rx).amplitude(along[None])[:, 0]).argmax()
    assert chosen.rx[0] == best
    two = wr.Spectrum.stack([spectrum, dataclasses.replace(spectrum, path_gain=gain[::-1], aod=aod[::-1])])
    with pytest.raises(ValueError, match="spectra: got aod of shapes"):
        wr.Spectrum.stack([spectrum, dataclasses.replace(spectrum, aod=None)])
    together = wr.channel.select_beams(two, tx, rx, count=3)
    for k, row in enumerate(together.gain):
        np.testing.assert_array_equal(row, wr.channel.select_beams(two[k], tx, rx, count=3).gain)
    assert len(wr.channel.select_beams_multiuser(two, tx, rx, noise=1e-9).tx) == 2
    alone = wr.channel.select_beams(wr.Spectrum(path_gain=gain), rx_array=rx)
    assert alone.rx[0] == best and alone.tx[0] == 0
    for one in (wr.Antenna("isotropic"), wr.PlanarArray(1, 1, pattern=wr.Antenna("isotropic"))):
        assert wr.channel.select_beams(wr.Spectrum(path_gain=gain), one, rx).gain == alone.gain
    with pytest.raises(ValueError, match="source: got a spectrum without aod"):
        wr.channel.select_beams(wr.Spectrum(path_gain=gain), tx, rx)


def test_receiver_without_paths_gets_gain_zero():
    nothing = paths_along(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert wr.channel.select_beams(nothing, wr.PlanarArray(2, 2), wr.PlanarArray(2, 2)).gain[0] == 0.0
    assert wr.channel.select_beams(nothing, rx_array=wr.PlanarArray(2, 2)).gain[0] == 0.0


def test_multi_user_choice_is_as_good_as_trying_everything():
    tx, rx = wr.PlanarArray(2, 3), wr.PlanarArray(1, 2)
    users = [
        paths_along(
            random_directions(3, seed=s), random_directions(3, seed=50 + s), np.array([1.0, 0.6, 0.4])
        )
        for s in range(2)
    ]
    gains = [wr.channel.beam_gains(p, tx, rx) for p in users]
    best = max(
        np.log2(1.0 + signal_over_interference(gains, [t0, t1], [r0, r1], 0.3)).sum()
        for t0, t1, r0, r1 in itertools.product(range(6), range(6), range(2), range(2))
    )
    found = wr.channel.select_beams_multiuser(wr.Paths.stack(users), tx, rx, noise=0.3)
    np.testing.assert_allclose(np.log2(1.0 + found.sinr).sum(), best, rtol=1e-12)
    with pytest.raises(ValueError, match="gains"):
        signal_over_interference([-gains[0], gains[1]], [0, 0], [0, 0], 0.3)


def test_what_no_codebook_can_be_made_of_is_named():
    array = wr.PlanarArray(2, 2)
    with pytest.raises(ValueError, match="array: got polarisation 'V'"):
        wr.channel.dft_codebook(wr.PlanarArray(2, 2, polarisation="V"))
    with pytest.raises(ValueError, match="array: got polarisation 'VH'"):
        wr.channel.Codebook(wr.PlanarArray(2, 2, polarisation="VH"), (np.eye(4),))
    for factors in ((np.ones((2, 5)),), (np.ones((2, array.cols)),) * 3, ()):
        with pytest.raises(ValueError, match="factors: got"):
            wr.channel.Codebook(array, factors)
    with pytest.raises(ValueError, match="factors: got weights of another norm than 1"):
        wr.channel.Codebook(array, (np.exp(1j * np.arange(8.0).reshape(2, 4)),))
    with pytest.raises(ValueError, match="either directions or points"):
        wr.channel.steering_codebook(array)
    with pytest.raises(ValueError, match="wavelength_m: got None"):
        wr.channel.steering_codebook(array, points=np.ones((1, 3)))

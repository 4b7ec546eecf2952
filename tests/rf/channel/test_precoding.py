"""Precoders: what each must null or maximise, by SciPy and by closed form, and what a field's covariance means."""

from dataclasses import replace

import numpy as np
import pytest
from path_makers import random_paths
from scipy.linalg import eigh

import warprrf as wr
from warprrf.rf.channel.beams import signal_over_interference

USERS, ELEMENTS = 4, 12


def rayleigh(users=USERS, elements=ELEMENTS, seed=0):
    rng = np.random.default_rng(seed)
    return 1e-5 * (rng.normal(size=(users, elements)) + 1j * rng.normal(size=(users, elements)))


def diffuse(seed):
    return random_paths(5, seed, kind="diffuse")


def alike(a, b):
    """|<a, b>| of rows of unit norm: 1 where they differ by a phase alone."""
    return np.abs((a.conj() * b).sum(axis=1))


def rank_one(h):
    return h.conj()[:, :, None] * h[:, None, :]


@pytest.mark.parametrize("method", ["mr", "zf", "slnr"])
def test_weights_have_unit_norm_and_one_user_gets_maximum_ratio(method):
    h = rayleigh()
    for channels in (h, rank_one(h)):
        w = wr.channel.precoders(channels, method, noise=1e-9)
        np.testing.assert_allclose(np.linalg.norm(w, axis=1), 1.0, rtol=1e-12)
        alone = wr.channel.precoders(channels[:1], method, noise=1e-9)
        gain = np.abs(h[0] @ alone[0]) ** 2
        assert gain == pytest.approx(np.linalg.norm(h[0]) ** 2, rel=1e-10)
        assert wr.channel.precoded_sinr(h[:1], alone, noise=1e-9)[0] == pytest.approx(gain / 1e-9, rel=1e-10)


def test_zero_forcing_nulls_interference_and_gives_what_the_inverse_gram_says():
    h = rayleigh()
    for channels in (h, rank_one(h)):
        heard = np.abs(h @ wr.channel.precoders(channels, "zf", noise=1e-9).T)
        own = np.diag(heard)
        assert (heard - np.diag(own)).max() < 1e-10 * own.min()
        # |h_u^T w_u|^2 = 1 / [(H H^H)^-1]_uu
        np.testing.assert_allclose(own**2, 1.0 / np.diag(np.linalg.inv(h @ h.conj().T)).real, rtol=1e-9)


def test_slnr_is_the_generalised_eigenvector_and_for_channels_the_mmse_precoder():
    h, noise = rayleigh(), 3e-10
    scattered = wr.channel.transmit_covariance([diffuse(seed) for seed in range(3)], wr.PlanarArray(3, 4))
    for covariances, quiet in ((rank_one(h), noise), (scattered, 0.1)):
        w = wr.channel.precoders(covariances, "slnr", noise=quiet)
        for own, found in zip(covariances, w, strict=True):
            leaked = covariances.sum(axis=0) - own + len(covariances) * quiet * np.eye(ELEMENTS)
            values, vectors = eigh(own, leaked)
            best = vectors[:, -1:].T / np.linalg.norm(vectors[:, -1])
            assert alike(found[None], best)[0] == pytest.approx(1.0, abs=1e-9)
            ratio = (found.conj() @ own @ found) / (found.conj() @ leaked @ found)
            assert ratio.real == pytest.approx(values[-1], rel=1e-9)
    w = wr.channel.precoders(h, "slnr", noise=noise)
    mmse = h.conj().T @ np.linalg.inv(h @ h.conj().T + USERS * noise * np.eye(USERS))
    np.testing.assert_allclose(alike(w, mmse.T / np.linalg.norm(mmse.T, axis=1)[:, None]), 1.0, rtol=1e-12)


def test_slnr_of_hardly_any_noise_is_the_limit_that_it_tends_to():
    """With more users than elements no zero forcing is: the least leakage of SciPy's eigenvectors; alike users get one beam."""
    h = rayleigh(6, 4)
    limit = wr.channel.precoders(rank_one(h), "slnr", noise=1e-20)
    for noise in (1e-20, 1e-28, 1e-40):
        np.testing.assert_allclose(alike(wr.channel.precoders(h, "slnr", noise=noise), limit), 1.0, rtol=1e-6)
    twins = wr.channel.precoders(h[[0, 0]], "slnr", noise=1e-40)
    np.testing.assert_allclose(alike(twins, wr.channel.precoders(h[[0, 0]], "mr", noise=1.0)), 1.0, rtol=1e-9)


def test_slnr_goes_from_zero_forcing_to_maximum_ratio_with_the_noise():
    h = rayleigh()
    for channels in (h, rank_one(h)):
        loud, quiet = (wr.channel.precoders(channels, "slnr", noise=n) for n in (1.0, 1e-18))
        np.testing.assert_allclose(alike(loud, wr.channel.precoders(h, "mr", noise=1.0)), 1.0, rtol=1e-9)
        np.testing.assert_allclose(alike(quiet, wr.channel.precoders(h, "zf", noise=1.0)), 1.0, rtol=1e-6)


def test_covariance_gives_every_pair_of_beams_its_mean_gain():
    tx = wr.channel.dft_codebook(wr.PlanarArray(4, 4, pattern="tr38901"))
    rx = wr.channel.dft_codebook(wr.PlanarArray(2, 2, orientation=(0.4, 0.1, 0.0)))
    users = [diffuse(seed) for seed in range(3)]
    chosen = np.array([3, 0, 2])
    found = wr.channel.transmit_covariance(users, tx, rx, rx=chosen)
    gains = np.stack([wr.channel.beam_gains(p, tx, rx)[beam] for p, beam in zip(users, chosen, strict=True)])
    power = np.einsum("bn,unm,bm->ub", tx.weights.conj(), found, tx.weights).real
    np.testing.assert_allclose(power, gains, rtol=1e-10)
    stacked = wr.channel.transmit_covariance(wr.Paths.stack(users), tx, rx, rx=chosen)
    np.testing.assert_allclose(stacked, found, rtol=1e-12)
    one = wr.channel.transmit_covariance(users[0], wr.PlanarArray(1, 1))
    assert one.shape == (1, 1, 1)
    assert one[0, 0, 0].real == pytest.approx(users[0].power.sum(), rel=1e-12)


def test_sinr_of_beams_is_that_of_the_multi_user_choice():
    book = wr.channel.dft_codebook(wr.PlanarArray(3, 4))
    h = rayleigh()
    gains = [np.abs(book.received(row))[None] ** 2 for row in h]
    sent = np.array([1, 5, 7, 2])
    expected = signal_over_interference(gains, sent, np.zeros(USERS, int), 1e-9)
    for channels in (h, rank_one(h)):
        sinr = wr.channel.precoded_sinr(channels, 3.0 * book.weights[sent], noise=1e-9)
        np.testing.assert_allclose(sinr, expected, rtol=1e-9)


def test_bad_input_is_named():
    h, array = rayleigh(), wr.PlanarArray(2, 2)
    for change, message in (
        ({"channels": rank_one(h) + 1e-10j}, "not Hermitian"),
        ({"channels": np.vstack([h[:2], 0 * h[:1]])}, r"users \[2\] get no power"),
        ({"channels": h[[0, 1, 1]], "method": "zf"}, "cannot part 3 users by 12 elements.*rank 2"),
        ({"channels": rayleigh(5, 4), "method": "zf"}, "cannot part 5 users by 4 elements"),
    ):
        with pytest.raises(ValueError, match=message):
            wr.channel.precoders(**({"channels": h, "method": "slnr", "noise": 1e-9} | change))
    with pytest.raises(ValueError, match="rx: got None, expected the index of a beam for each of 1 users"):
        wr.channel.transmit_covariance(diffuse(0), array, array)
    with pytest.raises(ValueError, match="without a departure angle"):
        wr.channel.transmit_covariance(replace(diffuse(0), theta_t=np.full(5, np.nan)), array)


def test_a_user_without_power_counts_as_dark_where_rates_are_reckoned():
    h = rayleigh()
    w = wr.channel.precoders(h, "zf", noise=1e-9)
    dark = h.copy()
    dark[1] = 0.0
    sinr = wr.channel.precoded_sinr(dark, w, noise=1e-9)
    assert sinr[1] == 0.0
    assert (np.delete(sinr, 1) > 0).all()

"""The true channel that beams are judged on."""

import numpy as np
import pytest

import warprrf as wr
from benchmarks.beams import OFFSETS_HZ, Links
from warprrf.rf.channel.arrays import PlanarArray, orientation_towards

PLACES = np.array([[10.0, 9.0, 1.5], [7.0, 8.5, 1.2]])


@pytest.fixture(scope="module")
def lobby(lobby_scene):
    """Spectra of two receivers, and their true channels."""
    link = {"transmitter": (13.6, 11.2, 2.5), "receivers": PLACES, "frequency_hz": 300e9}
    ds = wr.simulate(lobby_scene, **link, shape=(30, 60))
    links = Links(lobby_scene, ds, seed=3)
    return ds, [links.link(place) for place in PLACES]


def test_scattering_carries_the_power_of_the_spectrum(lobby):
    ds, links = lobby
    for link, image in zip(links, ds.path_gain, strict=True):
        # the coarser rays and the weakest left out cost 2 % at most
        assert link.powers.power.sum() == pytest.approx(float(image.sum()), rel=0.02)


def test_channel_is_the_sum_over_its_paths(lobby):
    """Path by path as plane waves: the array is small, so waves are plane."""
    link, array = lobby[1][1], PlanarArray(2, 2, orientation=orientation_towards([1.0, 0.3, 0.0]))
    everything = link.powers
    turned = everything.gain.copy()
    turned[len(link.specular.gain) :] = link.scattered.gain * link.phase
    steering = array.response(everything.arrival, 1.0)  # phases at half a wavelength, (L, M)
    waves = turned * np.exp(-2j * np.pi * OFFSETS_HZ[:, None] * everything.tau)
    found = link.channel(array)
    np.testing.assert_allclose(found, waves @ steering, atol=2e-3 * np.abs(found).max())

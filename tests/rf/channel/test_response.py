"""Channels against closed forms, brute sums and identities."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from path_makers import CARRIER, random_paths
from radio_scenes import METAL, RadioScene, SlabMaterial, square

from warprrf.geometry.mesh import Mesh
from warprrf.rf.channel import sums
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.channel.band_plan import thz_channel
from warprrf.rf.channel.response import random_turns
from warprrf.rf.em.absorption import Air, gas_attenuation_db_per_m
from warprrf.rf.em.fresnel import slab_reflection
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import trace_paths

F = 300e9
WAVELENGTH = SPEED_OF_LIGHT / F
BAND = thz_channel(69)


def far_square(material, half=1100.0):
    """A floor in the plane z = 0."""
    return RadioScene(Mesh(*square(half)), np.zeros(2, np.int32), [material])


def turned(length, frequency=F):
    return np.exp(-2j * np.pi * ((frequency / SPEED_OF_LIGHT * length) % 1.0))


def close(found, expected):
    """Gain to 1e-6, phase to 1e-3 rad."""
    assert abs(abs(found) / abs(expected) - 1) < 1e-6
    assert abs(np.angle(found / expected)) < 1e-3


def test_friis_at_100_m():
    tx, rx = np.array([0, 0, 30.0]), np.array([100.0, 3.0, 31.0])
    scene = far_square(METAL)
    p = trace_paths(scene, transmitter=tx, receivers=rx, frequency_hz=F, mirror_order=0)
    d = np.linalg.norm(tx - rx)
    for f in (F, 310e9):
        h = p.cfr([f], amplitude="friis")[0, 0, 0]
        close(h, SPEED_OF_LIGHT / (4 * np.pi * f * d) * turned(d, f))
    assert abs(p.cfr([310e9])[0, 0, 0]) == pytest.approx(WAVELENGTH / (4 * np.pi * d), rel=1e-12)


@pytest.mark.parametrize("material", [METAL, SlabMaterial(thickness_m=np.inf), SlabMaterial(scattering=0.6)])
@pytest.mark.parametrize("across", [100.0, 1000.0])
def test_two_rays_from_100_m_to_a_kilometre(material, across):
    h1, h2 = 12.3456789, 1.5
    tx, rx = np.array([-0.5 * across, 3, h1]), np.array([0.5 * across, 3, h2])
    p = trace_paths(far_square(material), transmitter=tx, receivers=rx, frequency_hz=F)
    direct, bounced = np.hypot(across, h1 - h2), np.hypot(across, h1 + h2)
    te, tm = slab_reflection((h1 + h2) / bounced, material.permittivity(F), material.thickness_m, WAVELENGTH)
    smooth = np.sqrt(1 - material.scattering**2)
    # Vertical dipoles' field lies along the zenith unit vectors, horizontal ones' across the plane of incidence.
    for polarisation, reflection in (("V", tm), ("H", te)):
        a = PlanarArray(1, 1, polarisation=polarisation)
        f = 305e9
        h = p.cfr([f], tx_array=a, rx_array=a)[0, 0, 0]
        # Azimuth unit vectors of departure and arrival are opposite; at the ground, so are the zenith's.
        sign = 1.0 if polarisation == "V" else -1.0
        expected = sign * (
            WAVELENGTH
            / (4 * np.pi)
            * (turned(direct, f) / direct + reflection * smooth * turned(bounced, f) / bounced)
        )
        close(h, expected)


@pytest.mark.parametrize("squint", [False, True])
@pytest.mark.parametrize("method", ["dense", "grid"])
def test_response_is_the_sum_over_paths(squint, method):
    p = random_paths(200)
    f = BAND.frequencies_hz(64)
    tx, rx = PlanarArray(2, 3, orientation=(0.4, 0.1, 0)), PlanarArray(3, 2, spacing=0.7, pattern="tr38901")
    h = p.cfr(f, tx_array=tx, rx_array=rx, squint=squint, method=method)
    lam = SPEED_OF_LIGHT / CARRIER
    longer = -np.einsum("mi,pi->mp", rx.positions(lam), p.arrival)[:, None]
    longer = longer - np.einsum("ni,pi->np", tx.positions(lam), p.departure)
    a = p.gain * np.sqrt(rx.gain(p.arrival))
    expected = np.empty_like(h)
    for k, one in enumerate(f):
        at = one if squint else CARRIER
        waves = np.exp(-2j * np.pi * ((one - CARRIER) * p.tau + at * longer / SPEED_OF_LIGHT))
        expected[:, :, k] = (a * waves).sum(axis=-1)
    largest = np.abs(expected).max()
    np.testing.assert_allclose(h, expected, atol=(1e-11 if method == "dense" else 1e-6) * largest)


@pytest.mark.parametrize("count", [16, 17, 63, 256])
@pytest.mark.parametrize("descending", [False, True])
def test_grid_matches_dense_for_any_count_and_order(count, descending):
    p = random_paths(50, latest=3e-6)  # delays wrap round the grid many times
    f = BAND.frequencies_hz(count)[:: -1 if descending else 1]
    a = PlanarArray(2, 2)
    for squint in (False, True):
        dense, grid = (p.cfr(f, tx_array=a, squint=squint, method=m) for m in ("dense", "grid"))
        assert np.abs(grid - dense).max() < 2e-6 * np.abs(dense).max()


def spherical_truth(tx, rx, image, sending, receiving, f):
    """Green's function between every pair: the transmitting elements mirrored with their centre."""
    mirror = np.diag([1.0, 1.0, -1.0]) if image else np.eye(3)
    source = (tx + sending) @ mirror
    d = np.linalg.norm((rx + receiving)[:, None] - source, axis=-1)
    return SPEED_OF_LIGHT / (4 * np.pi * F * d) * np.exp(-2j * np.pi * f / SPEED_OF_LIGHT * d)


@pytest.mark.parametrize("method", ["dense", "grid"])
def test_spherical_waves_are_those_of_every_pair_of_elements(method):
    """Line of sight and a mirror on a perfect reflector, 4 x 4 to 8 x 8 elements half a metre away."""
    floor = Mesh(*square(9.0))
    tx, rx = np.array([0.0, 0, 0.4]), np.array([0.5, 0.1, 0.3])
    p = trace_paths(floor, transmitter=tx, receivers=rx, frequency_hz=F)
    a, b = PlanarArray(4, 4, orientation=(0.3, 0.2, 0.1)), PlanarArray(8, 8, orientation=(2.9, 0, 0.4))
    f = F + np.linspace(-5e9, 5e9, 32)
    h = p.cfr(f, tx_array=a, rx_array=b, wave="spherical", method=method)
    lam = SPEED_OF_LIGHT / F
    places = a.positions(lam), b.positions(lam)
    expected = np.stack(
        [sum(spherical_truth(tx, rx, image, *places, one) for image in (False, True)) for one in f], axis=-1
    )
    assert np.abs(h - expected).max() < (1e-9 if method == "dense" else 2e-6) * np.abs(expected).max()
    plane = p.cfr(f, tx_array=a, rx_array=b)
    assert np.abs(plane - expected).max() > 0.03 * np.abs(expected).max()  # the near field matters here


def test_spherical_waves_of_a_diffuse_path_run_through_its_point():
    tx, rx, point = np.array([0.0, 0, 1]), np.array([1.0, 1, 1]), np.array([0.6, 0.2, 0.0])
    p = Paths.from_points(tx, rx, point[None, None], np.array([2.0 + 0j]), np.array(["diffuse"]), F)
    a, b = PlanarArray(3, 3), PlanarArray(4, 2)
    lam = SPEED_OF_LIGHT / F
    sending = np.linalg.norm(point - tx - a.positions(lam), axis=1)
    receiving = np.linalg.norm(point - rx - b.positions(lam), axis=1)
    d1, d2 = np.linalg.norm(point - tx), np.linalg.norm(point - rx)
    expected = 2.0 * np.outer(turned(receiving) * d2 / receiving, turned(sending) * d1 / sending)
    h = p.cfr([F], tx_array=a, rx_array=b, wave="spherical", diffuse="given")[..., 0]
    np.testing.assert_allclose(h, expected, rtol=1e-8)
    coefficient, tau = p.cir(tx_array=a, rx_array=b, wave="spherical", diffuse="given")
    np.testing.assert_allclose(coefficient[..., 0], expected, rtol=1e-8)
    np.testing.assert_allclose(tau[..., 0], (receiving[:, None] + sending) / SPEED_OF_LIGHT, rtol=1e-12)


def test_taps_are_the_transform_of_the_response():
    p = random_paths(20, latest=10e-9)
    width, count = 2e9, 4096
    f = CARRIER + (np.arange(count) + 0.5) / count * width - 0.5 * width
    response = p.cfr(f, tx_array=PlanarArray(2, 2))
    lags = np.arange(0, 25)
    # h_l = 1/W integral H(f) exp(j 2 pi (f - f_c) l / W)
    expected = response @ np.exp(2j * np.pi * np.outer((f - CARRIER) / width, lags)) / count
    # Squint turns the integrand little over 2 GHz; the midpoint rule errs by 1e-6 of it.
    found = p.taps(width, 0, 24, tx_array=PlanarArray(2, 2))
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_relative_delays_turn_all_by_one_phase():
    p = random_paths(30)
    f = BAND.frequencies_hz(20)
    first = p.tau.min()
    h, shifted = p.cfr(f)[0, 0], p.cfr(f, normalize_delays=True)[0, 0]
    np.testing.assert_allclose(shifted, h * np.exp(2j * np.pi * ((f * first) % 1.0)), rtol=1e-9)
    a, tau = p.cir(normalize_delays=True)
    assert tau.min() == 0.0
    np.testing.assert_allclose(
        (a[0, 0] * np.exp(-2j * np.pi * tau * (f[0] - CARRIER))).sum(), shifted[0], rtol=1e-9
    )
    lags = np.arange(-3, 300)
    np.testing.assert_allclose(
        p.taps(1e9, -3, 299, normalize_delays=True)[0, 0],
        (a[0, 0] * np.sinc(lags[:, None] - 1e9 * tau)).sum(1),
        rtol=1e-9,
    )


def test_several_receivers_are_each_alone():
    parts = [random_paths(n, seed=n) for n in (7, 3, 12)] + [random_paths(3).select([])]
    both = Paths.stack(parts)
    none = ~both.valid
    assert none.sum(axis=1).tolist() == [5, 9, 0, 12]
    assert np.isnan(both.tau[none]).all() and not both.gain[none].any() and (both.kind[none] == "").all()
    f = BAND.frequencies_hz(40)
    a = PlanarArray(2, 2)
    h = both.cfr(f, tx_array=a)
    assert h.shape == (4, 1, 4, 40)
    for squint in (False, True):  # none without paths
        assert not both.cfr(f, tx_array=a, squint=squint, method="grid")[3].any()
    assert not both.taps(1e9, 0, 5)[3].any()
    for k, p in enumerate(parts):
        np.testing.assert_array_equal(h[k], p.cfr(f, tx_array=a))
        np.testing.assert_array_equal(both[k].gain, p.gain)
    coefficient, tau = both.cir(tx_array=a)
    assert coefficient.shape == (4, 1, 4, 12) and tau.shape == (4, 12)
    assert np.isnan(tau[1, 3:]).all() and not coefficient[1, ..., 3:].any()


def test_polarised_ports():
    p = random_paths(20, jones=True)
    one = PlanarArray(2, 2, polarisation="VH")
    h = p.cfr([CARRIER], tx_array=one, rx_array=one)[..., 0]
    assert h.shape == (8, 8)
    coefficient, _ = p.cir(
        tx_array=PlanarArray(1, 1, polarisation="VH"), rx_array=PlanarArray(1, 1, polarisation="VH")
    )
    np.testing.assert_allclose(np.moveaxis(coefficient, -1, 0), p.jones, rtol=1e-12)  # V is zenith, H azimuth
    vertical = PlanarArray(2, 2, polarisation="V")
    np.testing.assert_allclose(
        p.cfr([CARRIER], tx_array=vertical, rx_array=vertical)[..., 0], h[:4, :4], rtol=1e-12
    )
    with pytest.raises(ValueError, match="rx_array"):
        p.cfr([CARRIER], tx_array=vertical)
    with pytest.raises(ValueError, match="polarised amplitudes"):
        replace(p, jones=None).cfr([CARRIER], tx_array=vertical, rx_array=vertical)


def test_diffuse_phases_must_be_chosen():
    p = Paths.concatenate([random_paths(3), random_paths(5000, seed=1, kind="diffuse")])
    f = BAND.frequencies_hz(16)
    with pytest.raises(ValueError, match="diffuse"):
        p.cfr(f)
    np.testing.assert_allclose(p.cfr(f, diffuse="power"), p.select(np.arange(3)).cfr(f), rtol=1e-12)
    given = p.cfr(f, diffuse="given")
    assert np.array_equal(p.cfr(f, diffuse="random_phase", seed=4), p.cfr(f, diffuse="random_phase", seed=4))
    drawn = np.array([p.cfr([CARRIER], diffuse="random_phase", seed=s)[0, 0, 0] for s in range(400)])
    assert not np.isclose(drawn[0], given[0, 0, 0])
    # Mean power of a sum of random phases is the sum of powers; the mean of 400 exponential values errs by 5 %.
    still = p.cfr([CARRIER], diffuse="power")[0, 0, 0]
    assert np.mean(np.abs(drawn - still) ** 2) == pytest.approx(float(p.diffuse_power()), rel=0.2)
    assert float(p.diffuse_power()) == pytest.approx(p.power[3:].sum())


def test_random_phases_hang_on_what_a_path_is_not_on_what_it_is_asked_with():
    receivers = [[5.0, 1.0, -1.0], [5.0, 1.0, -0.5], [-3.0, 2.0, 0.0]]
    each = [
        replace(random_paths(50 + 10 * k, seed=k, kind="diffuse"), receiver=np.array(place))
        for k, place in enumerate(receivers)
    ]
    link = {"diffuse": "random_phase", "seed": 3}
    alone = [p.cfr([CARRIER], **link) for p in each]
    for order in ([0, 1, 2], [2, 0], [1]):
        together = Paths.stack([each[k] for k in order]).cfr([CARRIER], **link)
        np.testing.assert_allclose(together, [alone[k] for k in order], rtol=1e-12)
    path = each[0]
    turned = path.select(np.arange(50)[::-1])
    coefficient, _ = path.cir(**link)
    np.testing.assert_allclose(turned.cir(**link)[0][..., ::-1], coefficient, rtol=1e-12)
    np.testing.assert_allclose(path.select(np.arange(9)).cir(**link)[0], coefficient[..., :9], rtol=1e-12)


def test_random_phases_are_even_and_independent():
    p = random_paths(20_000, kind="diffuse")
    turns = random_turns(p, 0)
    others = [random_turns(p, 1), random_turns(replace(p, receiver=p.receiver + [0, 0, 1e-3]), 0)]
    for change in (turns, np.roll(turns, 1) - turns, *(o - turns for o in others)):
        for k in (1, 2, 3):  # the mean of n unit phasors is 1 / sqrt(n) = 0.007 rms: 4 times that
            assert abs(np.exp(2j * np.pi * k * change).mean()) < 4.0 / np.sqrt(len(turns))
    assert turns.min() >= 0 and turns.max() < 1


@pytest.mark.parametrize("method", ["dense", "grid"])
@pytest.mark.parametrize("squint", [False, True])
def test_absorption_follows_frequency(method, squint):
    p = random_paths(30)
    f = BAND.frequencies_hz(32)
    tx = PlanarArray(2, 1)
    h = p.with_gas().cfr(f, tx_array=tx, method=method, squint=squint)
    loss = 10 ** (-np.multiply.outer(gas_attenuation_db_per_m(f), p.length_m) / 20)
    for k in (0, 17, 31):
        expected = replace(p, gain=p.gain * loss[k]).cfr([f[k]], tx_array=tx, squint=squint)[..., 0]
        assert np.abs(h[..., k] - expected).max() < 1e-6 * np.abs(h).max()


@pytest.mark.parametrize(("carrier", "longest_s"), [(CARRIER, 2e-6), (557e9, 1e-7)])
def test_absorption_of_many_nepers_is_that_of_every_path(carrier, longest_s):
    """Half a kilometre, and 30 m at water vapour's line of 557 GHz, where a series in the lengths would overflow, or cancel."""
    p = replace(random_paths(5), tau=np.linspace(1e-9, longest_s, 5), frequency_hz=carrier).with_gas()
    f = np.linspace(530e9, 580e9, 32)
    dense = p.cfr(f, method="dense")
    np.testing.assert_allclose(p.cfr(f, method="grid"), dense, atol=1e-6 * np.abs(dense).max())


def test_gas_is_put_in_and_taken_out():
    p = random_paths(5)
    wet = p.with_gas(Air(water_vapour_g_m3=20))
    assert (wet.power < p.power).all() and wet.air == Air(water_vapour_g_m3=20)
    np.testing.assert_allclose(wet.with_gas(False).gain, p.gain, rtol=1e-12)
    np.testing.assert_allclose(wet.with_gas().gain, p.with_gas(True).gain, rtol=1e-12)
    db_per_m = gas_attenuation_db_per_m(CARRIER)
    np.testing.assert_allclose(10 * np.log10(p.power / p.with_gas().power), db_per_m * p.length_m, rtol=1e-9)
    assert p.with_gas(False) is p
    # relevance decides
    assert p.with_gas(SimpleNamespace(kept=("line_of_sight",))) is p
    np.testing.assert_array_equal(p.with_gas(SimpleNamespace(kept=("gas",))).gain, p.with_gas(True).gain)


def test_channels_need_a_carrier_delays_and_for_spherical_waves_points():
    p = random_paths(3)
    for changed, asked, name in (
        ({}, {"wave": "spherical"}, "interaction points"),
        ({"frequency_hz": None}, {}, "frequency_hz"),
        ({"tau": np.array([1e-9, np.nan, 2e-9])}, {}, "delay"),
    ):
        with pytest.raises(ValueError, match=name):
            replace(p, **changed).cfr([3e11], **asked)


@pytest.mark.parametrize("end", ["t", "r"])
def test_angles_that_are_not_known_count_with_arrays_alone(end):
    """As of a field that was fitted to spectra without departures."""
    p = random_paths(5)
    blind = replace(p, **{f"{angle}_{end}": np.full(5, np.nan) for angle in ("theta", "phi")})
    np.testing.assert_array_equal(blind.cfr([F, 1.01 * F]), p.cfr([F, 1.01 * F]))
    np.testing.assert_array_equal(blind.cir()[0], p.cir()[0])
    for array in (
        PlanarArray(1, 2),
        PlanarArray(1, 1, polarisation="V"),
        PlanarArray(1, 1, pattern="dipole"),
    ):
        with pytest.raises(ValueError, match=f"{end}x_array: got one for paths whose angles"):
            blind.cfr([F], **{f"{end}x_array": array})


@pytest.mark.parametrize("wave", ["plane", "spherical"])
@pytest.mark.parametrize("squint", [False, True])
@pytest.mark.parametrize("method", ["dense", "grid"])
def test_small_blocks_change_nothing(monkeypatch, wave, squint, method):
    floor = Mesh(*square(9.0))
    p = trace_paths(floor, transmitter=[0, 0, 2], receivers=[3.0, 1, 1], frequency_hz=F)
    points = np.random.default_rng(0).uniform(-1, 1, (7, 1, 3)) * [4, 4, 0]
    many = Paths.from_points(p.transmitter, p.receiver, points, np.full(7, 1e-5), np.full(7, "diffuse"), F)
    p = Paths.concatenate([p, many])
    f = F + np.linspace(-1e9, 1e9, 20)
    ask = {"tx_array": PlanarArray(3, 2), "rx_array": PlanarArray(2, 5), "diffuse": "given", "wave": wave}
    whole = p.cfr(f, squint=squint, method=method, **ask)
    taps = p.taps(1e9, 0, 20, squint=squint, **ask)
    monkeypatch.setattr(sums, "_BLOCK", 10)
    np.testing.assert_allclose(
        p.cfr(f, squint=squint, method=method, **ask), whole, atol=1e-12 * np.abs(whole).max()
    )
    np.testing.assert_allclose(
        p.taps(1e9, 0, 20, squint=squint, **ask), taps, atol=1e-12 * np.abs(taps).max()
    )


def test_a_slab_does_not_turn_the_array_behind_it_however_its_point_is_rounded():
    """Spherical waves through a slab are those of the straight way; single precision moves its point off it."""
    tx, rx = np.array([0.0, 0, 0.4]), np.array([0.31, 0.17, 0.73])
    straight = Paths.from_points(
        tx, rx, np.full((1, 1, 3), np.nan), np.ones(1, complex), np.array(["los"]), F
    )
    point = (tx + 0.31 * (rx - tx)).astype(np.float32)
    passed = replace(
        straight,
        vertices=point.astype(float)[None, None],
        kind=np.array(["slab"]),
        interactions=np.array([[4]]),
    )
    arrays = {"tx_array": PlanarArray(8, 8, orientation=(0.3, 0.2, 0.1)), "rx_array": PlanarArray(8, 8)}
    expected, found = (p.cfr([F], wave="spherical", **arrays) for p in (straight, passed))
    np.testing.assert_allclose(found, expected, rtol=1e-3)

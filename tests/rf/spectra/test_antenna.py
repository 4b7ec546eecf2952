"""Antennas over two angles and two polarisations: symmetries, closed forms, files."""

from dataclasses import replace

import numpy as np
import pytest
from path_makers import random_directions, random_paths

import warprrf as wr
from warprrf.cli.inputs import read_pattern
from warprrf.rf.spectra.antenna import Antenna, horn, main_lobe, rotation_matrix, samples_of
from warprrf.rf.spectra.readings import path_weights
from warprrf.rf.spectra.spectrum import directions_from_angles, transverse_basis

DEGREE = np.pi / 180.0
TURN = (0.4, -0.7, 1.1)


def lopsided(zenith, azimuth):
    """Complex fields of two angles, smooth over the sphere: 3D polynomials of the direction, across it."""
    d = directions_from_angles(zenith, azimuth)
    c, s, around = np.cos(zenith), np.sin(zenith), np.zeros_like(zenith)
    down = np.stack([c * np.cos(azimuth), c * np.sin(azimuth), -s], axis=-1)
    across = np.stack([down, np.stack([-np.sin(azimuth), np.cos(azimuth), around], axis=-1)], axis=-2)
    vector = np.stack(
        [1.0 + d[..., 1] + 0.3j, d[..., 0] * d[..., 2] - 0.5j * d[..., 1], 0.7 + 0.2j * d[..., 0]], axis=-1
    )
    field = np.einsum("...ai,...i->...a", across, vector)
    return field[..., 0], field[..., 1]


def other_port(zenith, azimuth):
    along, across = lopsided(zenith, azimuth)
    return 0.5j * across, np.cos(zenith) * along


BOTH = Antenna((lopsided, other_port))


def grid(step_deg=1.0):
    zenith, azimuth = np.arange(0.0, 180.1, step_deg) * DEGREE, np.arange(-180.0, 180.0, step_deg) * DEGREE
    return zenith, azimuth, np.meshgrid(zenith, azimuth, indexing="ij")


@pytest.mark.parametrize(
    ("antenna", "efficiency"),
    [
        (Antenna("isotropic"), 1.0),
        (Antenna("dipole"), 1.0),
        (horn(10 * DEGREE), 1.0),
        (Antenna("tr38901"), 0.6568),  # as Sionna RT states of it
        # Half of 2 (n + 1) cos^n over the front, n = 3; of fields in two ports alike.
        (Antenna(lambda zenith, azimuth: 4.0 * np.maximum(np.sin(zenith) * np.cos(azimuth), 0.0) ** 3), 0.5),
        (Antenna((lambda z, a: (np.sqrt(0.75) * np.sin(z), 0j), lambda z, a: (0.0, np.sqrt(0.5)))), 0.5),
    ],
)
def test_gain_integrates_to_4_pi_times_the_efficiency(antenna, efficiency):
    assert antenna.turned(TURN).efficiency == pytest.approx(efficiency, rel=1e-3)


@pytest.mark.parametrize("antenna", [BOTH, Antenna("tr38901", "cross"), Antenna("dipole", "H")])
def test_a_turned_antenna_is_the_same_in_turned_directions(antenna):
    d, turn = random_directions(60, 1), rotation_matrix(TURN)
    turned = antenna.turned((0.2, 0.1, -0.3)).turned(turn)
    before = turn @ rotation_matrix((0.2, 0.1, -0.3))
    np.testing.assert_allclose(turned.gain(d @ before.T), antenna.gain(d), rtol=1e-9)

    def vectors(one, directions):
        return np.einsum("k...a,...ai->k...i", one.field(directions), transverse_basis(directions))

    np.testing.assert_allclose(vectors(turned, d @ before.T), vectors(antenna, d) @ before.T, atol=1e-12)


@pytest.mark.parametrize("array", [None, (2, 3)])
def test_an_array_turns_its_elements(array):
    """An antenna that was turned by hand, and the same in an array turned alike."""
    d = random_directions(40, 2)
    element = Antenna((lopsided,), orientation=(0.1, 0.5, 0.0))
    in_array = wr.PlanarArray(*(array or (1, 1)), orientation=TURN, pattern=element)
    np.testing.assert_allclose(in_array.field(d), element.turned(TURN).field(d), atol=1e-13)
    assert in_array.ports == (1 if array is None else 6)


def test_numbers_on_a_grid_are_interpolated_across_seam_and_poles():
    """Linear interpolation of smooth fields errs by step^2 / 8 times the second derivative, here at most some 4 in each angle."""
    zenith, azimuth, angles = grid(2.0)
    field = np.stack([np.stack(shape(*angles), axis=-1) for shape in (lopsided, other_port)])
    found = Antenna.from_grid(zenith, azimuth, field=field)
    assert (found.ports, found.polarised) == (2, True)
    ends = directions_from_angles(
        np.array([0.0, np.pi, 1.0, 1e-9, 1.0]), np.array([0.3, 0.1, np.pi, 0.2, np.pi - 1e-4])
    )
    d = np.concatenate([random_directions(500, 3), ends])
    np.testing.assert_allclose(found.field(d), BOTH.field(d), atol=4.0 * (2 * DEGREE) ** 2)
    at = directions_from_angles(*(a[1:-1:9, ::7] for a in angles))
    np.testing.assert_allclose(found.field(at), BOTH.field(at), atol=1e-12)
    gain = (np.abs(field[0]) ** 2).sum(axis=-1)
    closed = np.append(azimuth, azimuth[0] + 2 * np.pi)  # the last repeats the first
    repeated = Antenna.from_grid(zenith, closed, np.concatenate([gain, gain[:, :1]], axis=1))
    np.testing.assert_allclose(repeated.gain(d), Antenna.from_grid(zenith, azimuth, gain).gain(d), rtol=1e-12)
    samples = np.concatenate([gain, gain[:, :1]], axis=1)
    own = Antenna.from_grid(zenith, closed, samples)
    samples[:] = 0.0  # the caller's array, used again
    np.testing.assert_allclose(own.gain(d), repeated.gain(d), rtol=1e-12)
    # A magnitude with a polarisation is a field of that slant.
    slanted = Antenna.from_grid(zenith, azimuth, gain, polarisation="cross").field(at)
    np.testing.assert_allclose(
        slanted[1], np.sqrt(0.5 * Antenna.from_grid(zenith, azimuth, gain).gain(at))[..., None] * [1, 1]
    )


def test_unpolarised_antennas_keep_their_gain():
    d = random_directions(30, 4)
    for one in (BOTH, Antenna("tr38901", "cross")):
        plain = one.turned(TURN).unpolarised()
        assert (plain.ports, plain.polarised) == (1, False)
        mean = (np.abs(one.turned(TURN).field(d)) ** 2).sum(axis=-1).mean(axis=0)
        np.testing.assert_allclose(plain.gain(d), mean, rtol=1e-12)


# ------------------------------------------------------------------------------------------------------- links


def test_links_are_reciprocal():
    """What A sends to B is what B sends to A, of any complex antennas, over paths whose Jones matrices are turned round."""
    there = random_paths(20)
    there = replace(there, jones=np.random.default_rng(5).normal(size=(20, 2, 2, 2)) @ np.array([1.0, 1j]))
    back = replace(
        there, jones=np.swapaxes(there.jones, 1, 2), theta_r=there.theta_t, phi_r=there.phi_t, theta_t=there.theta_r,
        phi_t=there.phi_r, transmitter=there.receiver, receiver=there.transmitter,
    )  # fmt: skip
    a, b = BOTH.turned(TURN), wr.PlanarArray(2, 2, orientation=(2.0, 0.1, 0.3), pattern=Antenna((lopsided,)))
    f = there.frequency_hz + np.array([-1e8, 0.0, 3e8])
    sent = there.cfr(f, tx_array=a, rx_array=b)
    assert sent.shape == (4, 2, 3)
    np.testing.assert_allclose(back.cfr(f, tx_array=b, rx_array=a), np.swapaxes(sent, 0, 1), rtol=1e-9)


def circular(hand):
    return Antenna((lambda zenith, azimuth: (np.sqrt(0.5) + 0j, hand * 1j * np.sqrt(0.5)),))


@pytest.mark.parametrize("mirrored", [False, True])
def test_circular_polarisation_is_received_by_its_own_hand_and_reflected_into_the_other(mirrored):
    metal = wr.Material.custom("metal", relative_permittivity=1.0, conductivity=1e9)
    floor = wr.Mesh([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], [[0, 1, 2], [0, 2, 3]])
    scene = wr.Scene(floor, [metal], np.zeros(2, int))
    paths = wr.trace_paths(scene, transmitter=[-2.0, 0, 2], receivers=[2.0, 0.5, 3], frequency_hz=60e9)
    one = paths.select(paths.kind == ("mirror" if mirrored else "los"))
    friis = 299792458.0 / 60e9 / (4 * np.pi * one.length_m[0])
    for hand in (1, -1):
        got = {
            other: abs(one.cir(tx_array=circular(hand), rx_array=circular(other))[0][0, 0, 0])
            for other in (1, -1)
        }
        own, other = (-hand, hand) if mirrored else (hand, -hand)
        assert got[own] == pytest.approx(friis, rel=2e-3 if mirrored else 1e-12)
        assert got[other] < friis * (2e-3 if mirrored else 1e-12)


def test_powers_and_fields_do_not_mix():
    paths = random_paths(3)
    with pytest.raises(ValueError, match="polarised amplitudes"):
        paths.cir(tx_array=BOTH, rx_array=BOTH)
    with pytest.raises(ValueError, match="rx_array.*'of its own'.*neither"):
        paths.cir(rx_array=BOTH)
    with pytest.raises(ValueError, match="tx_array.*powers"):
        wr.channel.select_beams(paths, BOTH)
    with pytest.raises(TypeError, match="tx_array"):
        paths.cir(tx_array="dipole")
    for element in (BOTH, wr.Antenna("dipole", "V")):
        with pytest.raises(ValueError, match="polarisation: got 'H' for an antenna with its own"):
            wr.PlanarArray(1, 2, pattern=element, polarisation="H")
    assert wr.PlanarArray(1, 2, pattern=wr.Antenna("dipole"), polarisation="H").element.polarisation == "H"


def test_beams_and_channels_take_the_gain_of_an_antenna():
    paths, antenna = random_paths(30), BOTH.turned(TURN).unpolarised()
    gain = np.abs(BOTH.turned(TURN).field(paths.arrival)) ** 2
    expected = paths.power @ gain.sum(axis=-1).mean(axis=0)
    assert wr.channel.beam_gains(paths, None, antenna)[0, 0] == pytest.approx(expected)
    a = paths.cir(rx_array=antenna)[0][0, 0]
    assert (np.abs(a) ** 2).sum() == pytest.approx(expected)


# ------------------------------------------------------------------------------------------------------- readings


def readings(**changes):
    given = {
        "power": [1e-9] * 3,
        "frequency_hz": 300e9,
        "floor": 1e-15,
        "arrival": [[1.4, 0.3], [1.8, -2.0], [1.4, 0.3]],
    }
    return wr.Readings(
        [1.0, 1, 2], [4.0, 3, 1], **(given | {"receive_pattern": BOTH.unpolarised()} | changes)
    )


def test_readings_weigh_paths_by_an_antenna_that_is_turned():
    """Yaw and pitch turn it, its own orientation is on the mount; a transmitter's the same."""
    on_mount = BOTH.unpolarised().turned((0.0, 0.0, 0.6))
    r = readings(receive_pattern=on_mount, departure=[[1.0, 2.0]] * 3, transmit_pattern="tr38901")
    arrival, departure = random_directions(15, 6), random_directions(15, 7)
    found = path_weights(r, np.arange(3), arrival, departure, np.zeros(15))
    sending = Antenna("tr38901").turned((2.0, 1.0 - np.pi / 2, 0.0)).gain(departure)
    for row, (zenith, azimuth) in zip(found, r.arrival, strict=True):
        receiving = on_mount.turned((azimuth, zenith - np.pi / 2, 0.0)).gain(arrival)
        np.testing.assert_allclose(row, receiving * sending, rtol=1e-9)
    assert (
        np.abs(
            found[0] / path_weights(readings(), np.arange(1), arrival, departure, np.zeros(15))[0] - 1
        ).max()
        > 0.1
    )


def test_readings_of_several_ports_are_refused():
    with pytest.raises(ValueError, match=r"receive_pattern.*2 ports.*unpolarised"):
        readings(receive_pattern=BOTH)


def test_a_main_lobe_ends_where_that_of_the_same_gain_over_one_angle_does():
    round_one = horn(20 * DEGREE, -25.0)
    over_two = Antenna(lambda zenith, azimuth: round_one.gain(directions_from_angles(zenith, azimuth)))
    angle = np.linspace(0.0, np.pi, 400)
    d = np.stack([np.cos(angle), np.sin(angle) * 0.6, np.sin(angle) * 0.8], axis=-1)
    np.testing.assert_allclose(main_lobe(over_two).gain(d), main_lobe(round_one).gain(d), rtol=1e-9)
    assert main_lobe(round_one).gain(d).min() == 0.0
    assert wr.Readings.without_side_lobes(readings()).receive_pattern.polarised is False


def test_stores_tell_antennas_apart():
    """By their gains, their fields and how they stand, not by the functions that they are."""
    several = (BOTH, BOTH.turned((0, 0, 0.1)), BOTH.unpolarised(), horn(0.2), horn(0.3))
    sets = [samples_of(one) for one in several]
    for k, one in enumerate(sets):
        for other in sets[:k]:
            assert one.shape != other.shape or not np.allclose(one, other)
    again = samples_of(Antenna((lambda z, a: lopsided(z, a), lambda z, a: other_port(z, a))))
    np.testing.assert_array_equal(sets[0], again)


# ------------------------------------------------------------------------------------------------------- files


AZIMUTHS, DOWN = np.arange(360.0), np.arange(360.0)


def across_db(azimuth_deg):
    """Loss that is not the same to the left and the right."""
    return 12.0 * (1.0 - np.cos(azimuth_deg * DEGREE)) + 3.0 * np.sin(azimuth_deg * DEGREE) ** 2 * (
        azimuth_deg % 360 < 180
    )


def down_db(elevation_deg):
    """Loss of a beam 6 degrees below the horizon."""
    return np.minimum(12.0 * ((elevation_deg + 6.0) / 20.0) ** 2, 25.0)


def msi(gain="17.5 dBi", horizontal=None, vertical=None):
    """A file's text: azimuths clockwise, elevations down."""
    h = across_db(-AZIMUTHS) if horizontal is None else horizontal
    elevation = (180.0 - DOWN) % 360 - 180.0
    v = down_db(elevation) if vertical is None else vertical
    rows = [
        "NAME sector",
        "MAKE none",
        "FREQUENCY 3500",
        f"GAIN {gain}",
        "TILT ELECTRICAL",
        "COMMENT made by a test",
    ]
    rows += [
        f"HORIZONTAL {len(h)}",
        *(f"{a:.1f}\t{x!r}" for a, x in zip(AZIMUTHS, map(float, h), strict=False)),
    ]
    rows += [f"VERTICAL {len(v)}", *(f"{a:.1f} {x!r}" for a, x in zip(DOWN, map(float, v), strict=False))]
    return "\n".join(rows) + "\n"


def test_an_msi_file_is_the_sum_of_its_cuts(tmp_path):
    """The closed form of a pattern that is separable in decibels, at the file's own angles and between them."""
    (tmp_path / "sector.msi").write_text(msi())
    antenna = Antenna.load(tmp_path / "sector.msi", polarisation="cross")
    assert (antenna.ports, antenna.polarised) == (2, True)
    azimuth, elevation = np.meshgrid(np.arange(-180.0, 180.0, 7.0), np.arange(-90.0, 90.1, 3.0))
    d = directions_from_angles((90.0 - elevation) * DEGREE, azimuth * DEGREE)
    inner = np.abs(elevation) < 90  # at the poles azimuths are not told
    gain_db = 10 * np.log10(antenna.gain(d))
    np.testing.assert_allclose(
        gain_db[inner], (17.5 - across_db(azimuth) - down_db(elevation))[inner], atol=1e-9
    )
    between = directions_from_angles(np.array([(90.0 + 6.5) * DEGREE]), np.array([20.5 * DEGREE]))
    expected = 17.5 - across_db(np.array([20.0, 21.0])).mean() - down_db(np.array([-6.0, -7.0])).mean()
    assert 10 * np.log10(antenna.gain(between)[0]) == pytest.approx(expected, abs=1e-9)
    (tmp_path / "bare.PLN").write_text(msi(gain="15.35"))  # dBd
    np.testing.assert_allclose(Antenna.load(tmp_path / "bare.PLN").gain(d), antenna.gain(d), rtol=1e-9)
    assert read_pattern(str(tmp_path / "bare.PLN")).peak_gain == pytest.approx(
        antenna.peak_gain
    )  # of the command line
    level = Antenna.load(tmp_path / "sector.msi").turned((0.0, -6 * DEGREE, 0.0))  # the tilt taken out
    assert 10 * np.log10(level.gain([1.0, 0, 0])) == pytest.approx(17.5, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (msi().replace("GAIN", "GAME"), "got no GAIN"),
        (msi()[: len(msi()) // 3], r"line 7: HORIZONTAL: got '360' and \d+ more lines"),
        (msi().split("VERTICAL")[0], "got no VERTICAL"),
        (msi(gain="loud"), "line 4: GAIN: got 'loud'"),
        (msi().replace("HORIZONTAL 360", "HORIZONTAL many"), "line 7: HORIZONTAL: got 'many'"),
        (msi(horizontal=-across_db(-AZIMUTHS)), "line 9: HORIZONTAL: got .*loss of at least 0 dB"),
        (msi(vertical=np.full(360, np.nan)), "line 369: VERTICAL: got '0.0 nan'"),
        (msi(horizontal=across_db(AZIMUTHS)[:200]), "line 7: HORIZONTAL: got 161 degrees without a value"),
        (msi().replace("HORIZONTAL 360", "HORIZONTAL 361"), "line 368: HORIZONTAL: got 'VERTICAL 360'"),
        ("", "got no HORIZONTAL, VERTICAL, GAIN"),
    ],
)
def test_damaged_files_are_refused_by_line(tmp_path, text, error):
    (tmp_path / "damaged.msi").write_text(text)
    with pytest.raises(ValueError, match=rf"damaged\.msi: {error}"):
        Antenna.load(tmp_path / "damaged.msi")


def test_other_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.msi"):
        Antenna.load(tmp_path / "none.msi")
    (tmp_path / "gains.csv").write_text("1,2,3")
    with pytest.raises(ValueError, match=r"gains\.csv.*expected \.msi or \.pln"):
        Antenna.load(tmp_path / "gains.csv")


ZENITH, AZIMUTH, _ = grid(10.0)
FLAT = np.ones((19, 36))


@pytest.mark.parametrize(
    ("named", "make"),
    [
        ("pattern: got 'yagi'", lambda: Antenna("yagi")),
        ("polarisation: got 'RHCP'", lambda: Antenna("dipole", "RHCP")),
        ("polarisation.*fields", lambda: Antenna(lopsided, "V")),
        ("pattern.*negative", lambda: Antenna(lambda zenith, azimuth: np.cos(zenith))),
        ("pattern.*shape", lambda: Antenna(lambda zenith, azimuth: np.ones(3))),
        ("pattern: .*missing 1 required", lambda: wr.PlanarArray(1, 1, pattern=lambda zenith, azimuth: 1.0)),
        ("pattern.*no gain", lambda: Antenna(lambda zenith, azimuth: 0.0)),
        ("pattern: got 3 fields", lambda: Antenna(lambda zenith, azimuth: (1.0, 0.0, 0.0))),
        ("pattern.*NaN or infinite fields", lambda: Antenna(lambda zenith, azimuth: (np.nan, 0.0))),
        ("one of several ports", lambda: Antenna((lambda z, a: np.ones(z.shape), lopsided))),
        ("orientation.*-1", lambda: Antenna("dipole", orientation=np.diag([1.0, 1.0, -1.0]))),
        ("orientation.*radians", lambda: Antenna("dipole").turned((90, 0, 0))),
        ("orientation.*radians", lambda: wr.PlanarArray(2, 2, orientation=(0, -90, 0))),
        ("polarisation: got None", lambda: Antenna("dipole").field([1.0, 0, 0])),
        ("two angles", lambda: Antenna("dipole").gain_off_boresight([0.1])),
        ("zenith: got 0 to 1.5", lambda: Antenna.from_grid(ZENITH[:10], AZIMUTH, FLAT[:10])),
        ("zenith.*rising", lambda: Antenna.from_grid(ZENITH[::-1], AZIMUTH, FLAT)),
        ("azimuth.*all the way round", lambda: Antenna.from_grid(ZENITH, AZIMUTH[:18], FLAT[:, :18])),
        ("azimuth.*all the way round", lambda: Antenna.from_grid(ZENITH, np.degrees(AZIMUTH), FLAT)),
        ("gain: got both", lambda: Antenna.from_grid(ZENITH, AZIMUTH, FLAT, field=np.ones((19, 36, 2)))),
        ("gain.*shape", lambda: Antenna.from_grid(ZENITH, AZIMUTH, FLAT.T)),
        ("field: got shape", lambda: Antenna.from_grid(ZENITH, AZIMUTH, field=FLAT)),
        ("negative", lambda: Antenna.from_grid(ZENITH, AZIMUTH, -3.0 * FLAT)),
    ],
)
def test_what_is_no_antenna_is_refused(named, make):
    with pytest.raises((TypeError, ValueError), match=named):
        make()

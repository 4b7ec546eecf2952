"""Links between antennas, and Doppler shifts, beside Sionna RT's: line of sight and one mirror over a metal floor."""

import numpy as np
import pytest
from sionna_room import placed

import warprrf as wr
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.spectra.antenna import PATTERNS, Antenna

CARRIER = 28e9
TX, RX = np.array([-3.0, 1.0, 2.5]), np.array([4.0, -1.5, 1.2])
TURNS = {"tx": (0.3, 0.2, -0.4), "rx0": (2.9, -0.3, 0.5)}
ELLIPTIC = np.array([[1.0, 0.4j], [0.2 - 0.3j, 0.7]])  # fields of two ports


def custom(rt):
    """A pattern of complex fields in two angles and two ports, registered with Sionna RT under a name."""
    import drjit as dr
    import mitsuba as mi

    class Elliptic(rt.AntennaPattern):
        def __init__(self, *, polarization="VH"):
            def port(row):
                def field(theta, phi):
                    size = 1.0 + 0.5 * dr.sin(theta) * dr.cos(phi - 0.4) + 0.2 * dr.cos(theta)
                    return tuple(mi.Complex2f(size * float(f.real), size * float(f.imag)) for f in row)

                return field

            self.patterns = [port(row) for row in ELLIPTIC]

    rt.register_antenna_pattern("elliptic", lambda *, polarization: Elliptic(polarization=polarization))


def ours_of_custom(row):
    def field(zenith, azimuth):
        size = 1.0 + 0.5 * np.sin(zenith) * np.cos(azimuth - 0.4) + 0.2 * np.cos(zenith)
        return size * row[0], size * row[1]

    return field


@pytest.fixture(scope="module")
def scene():
    metal = wr.Material.custom("metal", relative_permittivity=1.0, conductivity=1e7, thickness_m=0.1)
    floor = wr.Mesh([[-20.0, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]], [[0, 1, 2], [0, 2, 3]])
    return wr.Scene(floor, [metal], np.zeros(2, int), object_names=["floor"])


@pytest.fixture(scope="module")
def traced(scene):
    return wr.trace_paths(scene, transmitter=TX, receivers=RX, frequency_hz=CARRIER)


def live(rt, scene, tx="dipole", rx="tr38901", polarization="VH"):
    """The scene in Sionna RT, its devices turned, an array of 1 x 2 elements at the transmitter."""
    shape = {"num_rows": 1, "num_cols": 1, "polarization": polarization}
    room = placed(rt, scene.to_sionna(frequency_hz=CARRIER), TX, [RX])
    room.tx_array = rt.PlanarArray(**{**shape, "num_cols": 2}, pattern=tx)
    room.rx_array = rt.PlanarArray(**shape, pattern=rx)
    for name, turn in TURNS.items():
        room.get(name).orientation = list(turn)
    return room


def solve(rt, room):
    return rt.PathSolver(deterministic=True)(room, max_depth=1, refraction=False, seed=1)


@pytest.mark.parametrize(
    ("tx", "rx", "polarization"),
    [
        ("dipole", "tr38901", "VH"),
        ("tr38901", "hw_dipole", "cross"),
        ("elliptic", "dipole", "VH"),
        ("tr38901", "elliptic", "VH"),
    ],
)
def test_links_are_those_of_sionna_rt(rt, scene, traced, tx, rx, polarization):
    """Every coefficient between ports of turned antennas, to 1e-3 of the path's strongest; Sionna reckons in float32.

    Sionna RT conjugates the receiving antenna's field, so that its links with complex fields there are not reciprocal: ours has the
    antenna of conjugate fields to compare with.
    """
    custom(rt)
    room = live(rt, scene, tx, rx, polarization)
    theirs, taken = solve(rt, room), wr.Scene.from_sionna(room)
    ends = {"tx_array": taken.antennas["tx"], "rx_array": taken.antennas["rx0"]}
    if rx == "elliptic":
        ports = tuple(ours_of_custom(row.conj()) for row in ELLIPTIC)
        ends["rx_array"] = wr.PlanarArray(1, 1, orientation=TURNS["rx0"], pattern=Antenna(ports))
    ours = traced.to_sionna(**ends)
    a = theirs.a[0].numpy()[0, :, 0] + 1j * theirs.a[1].numpy()[0, :, 0]
    order = np.argsort(theirs.tau.numpy()[0, 0])
    assert a.shape == ours.a[0, :, 0].shape == (2, 4, 2)
    np.testing.assert_allclose(theirs.tau.numpy()[0, 0, order], traced.tau, rtol=1e-5)
    for k, path in enumerate(order):
        b = a[..., path]
        # Sionna's phases across its array are those of float32 lengths.
        np.testing.assert_allclose(ours.a[0, :, 0, :, k], b, atol=1e-3 * np.abs(b).max())


def test_a_scene_of_sionna_brings_its_antennas(rt, scene):
    custom(rt)
    room = live(rt, scene, "elliptic", "hw_dipole", "cross")
    taken = wr.Scene.from_sionna(room)
    tx, rx = taken.antennas["tx"], taken.antennas["rx0"]
    assert sorted(taken.antennas) == ["rx0", "tx"] and (tx.rows, tx.cols, tx.ports, rx.ports) == (1, 2, 4, 2)
    np.testing.assert_allclose(tx.orientation, TURNS["tx"], atol=1e-7)
    assert (rx.pattern.pattern, rx.pattern.polarisation) == ("half_wave_dipole", "cross")
    directions = np.random.default_rng(3).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = Antenna(tuple(map(ours_of_custom, ELLIPTIC)), orientation=TURNS["tx"]).field(directions)
    np.testing.assert_allclose(tx.field(directions), expected, atol=1e-5)
    uneven = rt.AntennaArray(
        room.rx_array.antenna_pattern, [[0.0, 0.0, 0.0], [0.0, 0.5, 1.7], [0.0, 0.0, 0.3]]
    )
    with pytest.raises(ValueError, match="rows and columns"):
        wr.interop.array_from_sionna(uneven)
    room.rx_array = uneven
    with pytest.warns(UserWarning, match=r"rt_scene\.rx_array.*left out"):
        assert list(wr.Scene.from_sionna(room).antennas) == ["tx"]


def test_antennas_go_along_to_sionna_rt(rt, scene, traced):
    """Patterns of fields and of a name, turned elements and turned arrays: links of ours are Sionna's, and they come back."""
    fields = Antenna(tuple(map(ours_of_custom, ELLIPTIC)), orientation=(0.5, -0.1, 0.2))
    ends = {
        "tx": wr.PlanarArray(1, 2, orientation=TURNS["tx"], pattern=fields),
        "rx0": wr.PlanarArray(2, 1, [0.7, 0.5], TURNS["rx0"], "half_wave_dipole", "cross"),
    }
    own = with_devices(scene, {"tx": TX}, ends)
    room = own.to_sionna(frequency_hz=CARRIER)
    theirs, ours = solve(rt, room), traced.to_sionna(ends["tx"], ends["rx0"])
    a = theirs.a[0].numpy()[0, :, 0] + 1j * theirs.a[1].numpy()[0, :, 0]
    assert a.shape == ours.a[0, :, 0].shape == (4, 4, 2)
    for k, path in enumerate(np.argsort(theirs.tau.numpy()[0, 0])):
        b = a[..., path]
        np.testing.assert_allclose(ours.a[0, :, 0, :, k], b, atol=1e-3 * np.abs(b).max())
    taken = wr.Scene.from_sionna(room)
    directions = np.random.default_rng(3).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for name, array in ends.items():
        back = taken.antennas[name]
        np.testing.assert_allclose(back.positions(1.0), array.positions(1.0), atol=1e-6)
        np.testing.assert_allclose(back.field(directions), array.field(directions), atol=1e-4)


def with_devices(scene, transmitters, antennas):
    return wr.Scene(
        scene.mesh, scene.materials, scene.face_material, object_names=["floor"], transmitters=transmitters,
        receivers={"rx0": RX}, antennas=antennas,
    )  # fmt: skip


def test_antennas_that_sionna_rt_cannot_hold_are_left_out_and_named(rt, scene):
    two, bare = {"tx": TX, "b": TX + 1.0}, wr.PlanarArray(1, 1, polarisation="V")
    turned = {"tx": bare, "b": wr.PlanarArray(1, 1, orientation=(1.0, 0.0, 0.0), polarisation="V")}
    room = with_devices(scene, two, turned).to_sionna()
    assert room.tx_array.num_ant == 1 and float(room.get("b").orientation.x[0]) == pytest.approx(1.0)
    for other, why in (("dipole", "differ in more"), ("isotropic", "without polarisation")):
        odd = wr.PlanarArray(1, 1, pattern=other, polarisation="V" if other == "dipole" else None)
        with pytest.warns(UserWarning, match=f"{why}.*tx_array is left"):
            assert with_devices(scene, two, {"tx": bare, "b": odd}).to_sionna().tx_array is None


@pytest.mark.parametrize("name", PATTERNS)
def test_patterns_of_sionna_are_known_by_name(rt, name):
    theirs = {"isotropic": "iso", "half_wave_dipole": "hw_dipole"}.get(name, name)
    array = rt.PlanarArray(num_rows=3, num_cols=2, vertical_spacing=0.7, pattern=theirs, polarization="H")
    ours = wr.interop.array_from_sionna(array)
    assert (ours.pattern.pattern, ours.pattern.polarisation, list(ours.spacing)) == (name, "H", [0.7, 0.5])
    with pytest.raises(TypeError, match="rt_array"):
        wr.interop.array_from_sionna("iso")


def mirrored_rate(speed, step_s=1e-6):
    """Shift [Hz] of the path by way of the rising floor, from central differences of its length in double precision."""
    length = []
    for time in (-step_s, step_s):
        sent, heard, floor = (
            p + time * np.array(speed[n]) for n, p in (("tx", TX), ("rx0", RX), ("floor", np.zeros(3)))
        )
        heard[2] = 2.0 * floor[2] - heard[2]
        length.append(np.linalg.norm(sent - heard))
    return -CARRIER / SPEED_OF_LIGHT * (length[1] - length[0]) / (2.0 * step_s)


def test_doppler_shifts_are_those_of_sionna_rt(rt, scene, traced):
    """Of both ends and of the mirror, to 1e-6 of the shift; and channels over time.

    Ours are the rate at which the mirrored path's length changes, to 1e-9. Sionna's is 8e-6 off that rate: its mirror point is
    some 20 um off in single precision, and on its own paths we say the same as it does.
    """
    room = placed(rt, scene.to_sionna(frequency_hz=CARRIER), TX, [RX])
    speed = {"tx": [12.0, 3.0, -2.0], "rx0": [5.0, -4.0, 1.0], "floor": [0.5, 0.25, 8.0]}
    for name, velocity in speed.items():
        room.get(name).velocity = velocity
    theirs = solve(rt, room)
    moves = {
        "transmitter_velocity": speed["tx"], "receiver_velocity": speed["rx0"], "moving": {"floor": speed["floor"]},
        "scene": scene,
    }  # fmt: skip
    order = np.argsort(theirs.tau.numpy()[0, 0])
    shift, own = theirs.doppler.numpy()[0, 0, order], wr.Paths.from_sionna(theirs, frequency_hz=CARRIER)[0]
    own = own.select(np.argsort(own.tau))
    assert own.kind.tolist() == ["los", "mirror"] and np.abs(shift).min() > 400
    np.testing.assert_allclose(own.doppler_hz(**moves), shift, rtol=1e-6)
    ours = traced.doppler_hz(**moves)
    np.testing.assert_allclose(ours[0], shift[0], rtol=1e-6)
    rate = mirrored_rate(speed)
    np.testing.assert_allclose(ours[1], rate, rtol=1e-9)
    np.testing.assert_allclose(shift[1], rate, rtol=1e-5)
    both = wr.Antenna("isotropic", "VH")
    steps = {"sampling_frequency": 2e4, "num_time_steps": 5}
    a = traced.to_sionna(both, both, doppler_hz=ours).cir(**steps)[0]
    b = theirs.cir(**steps, out_type="numpy")[0][..., order, :]
    large = np.abs(b) > 0.1 * np.abs(b).max()
    np.testing.assert_allclose((a / a[..., :1])[large], (b / b[..., :1])[large], atol=1e-4)

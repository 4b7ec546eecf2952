"""Doppler shifts: how fast the phases of paths that are traced anew turn, and what is asked of them."""

from dataclasses import replace

import numpy as np
import pytest
from path_makers import random_paths
from radio_scenes import box_mesh, joined

import warprrf as wr
from warprrf.rf.em.waves import SPEED_OF_LIGHT

CARRIER = 28e9
TX, RX = np.array([1.0, 1.2, 2.1]), np.array([[5.2, 2.9, 1.3], [2.2, 3.4, 0.9]])
SPEED = {
    "tx": np.array([3.0, -1.0, 0.5]),
    "rx": np.array([-0.7, 2.0, 0.3]),
    "panel": np.array([-1.5, 0.4, 0.2]),
}


def room(time_s=0.0):
    """A box of brick, and in it a block of concrete that moves by ``SPEED["panel"]``."""
    step = time_s * SPEED["panel"]
    block = box_mesh(np.array([6.6, 0.5, 0.3]) + step, np.array([7.0, 3.5, 2.6]) + step)
    mesh, part = joined(box_mesh([0, 0, 0], [8, 4, 3], inward=True), block)
    materials = [wr.em.itu_material("brick"), wr.em.itu_material("concrete")]
    return wr.Scene(mesh, materials, part, face_object=part, object_names=["walls", "panel"])


def trace(time_s=0.0, **moved):
    ends = {"transmitter": TX + time_s * SPEED["tx"], "receivers": RX + time_s * SPEED["rx"]} | moved
    return wr.trace_paths(room(time_s), frequency_hz=CARRIER, mirror_order=2, **ends)


@pytest.fixture(scope="module")
def paths():
    return trace()


def matched(a, b):
    """Paths of ``b`` in the order of ``a``, of one receiver: those over the same mirrors leave and arrive alike."""
    gap = np.linalg.norm(a.arrival[:, None] - b.arrival, axis=2) + np.linalg.norm(
        a.departure[:, None] - b.departure, axis=2
    )
    return b.select(gap.argmin(axis=1))


def test_the_shift_is_the_rate_of_the_carriers_phase(paths):
    """f_D = -f d tau / dt of everything that moves at once, by central differences of paths traced anew."""
    shift = paths.doppler_hz(
        transmitter_velocity=SPEED["tx"],
        receiver_velocity=SPEED["rx"],
        moving={"panel": SPEED["panel"]},
        scene=room(),
    )
    step = 1e-5
    before, after = trace(-step), trace(step)
    touched = 0
    for r, own in enumerate(paths.each()):
        ends = [matched(own, other[r]) for other in (before, after)]
        rate = -CARRIER * (ends[1].tau - ends[0].tau) / (2 * step)
        np.testing.assert_allclose(shift[r][paths.valid[r]], rate, atol=1e-6 * np.abs(rate).max())
        x = own.vertices[..., 0]
        touched += ((x > 6.59) & (x < 6.61)).any(axis=1).sum()
    assert touched >= 2 and np.isnan(shift[~paths.valid]).all()


def test_line_of_sight_and_what_stands_still(paths):
    one = paths[0]
    toward = (RX[0] - TX) / np.linalg.norm(RX[0] - TX)
    shift = one.doppler_hz(transmitter_velocity=7.0 * toward)
    assert shift[one.kind == "los"] == pytest.approx(7.0 * CARRIER / SPEED_OF_LIGHT)
    assert (np.abs(shift[one.kind == "mirror"]) < 7.0 * CARRIER / SPEED_OF_LIGHT).all()
    assert not one.doppler_hz().any()
    both = paths.doppler_hz(receiver_velocity=[SPEED["rx"], [0.0, 0, 0]])
    assert np.nanmin(np.abs(both[0])) > 0 and not both[1][paths.valid[1]].any()
    # A material's name stands for all that is made of it.
    by_object, by_material = (
        paths.doppler_hz(moving={name: SPEED["panel"]}, scene=room()) for name in ("panel", "concrete")
    )
    np.testing.assert_array_equal(by_object, by_material)


def test_what_lets_a_wave_through_does_not_shift_it():
    through = wr.trace_paths(
        room(), transmitter=[6.2, 2, 1], receivers=[7.5, 2.1, 1.1], frequency_hz=CARRIER, transmissions=1
    )
    one = through.select(
        (through.interactions == 4).any(axis=1) & (np.isfinite(through.vertices[..., 0]).sum(axis=1) == 1)
    )
    assert len(one.gain) == 1
    assert abs(one.doppler_hz(moving={"panel": [9.0, 9, 9]}, scene=room())[0]) < 1e-9


def test_paths_turn_by_their_shifts(paths):
    """A tenth of a millisecond on, where the receiver has moved by 0.2 mm of the 10.7 mm of a wavelength."""
    time_s = 1e-4
    later = paths.after(time_s, paths.doppler_hz(receiver_velocity=SPEED["rx"]))
    traced = trace(receivers=RX + time_s * SPEED["rx"])
    for r in range(2):
        own, other = later[r], matched(later[r], traced[r])
        np.testing.assert_allclose(own.gain, other.gain, atol=2e-4 * np.abs(own.gain).max())
        np.testing.assert_allclose(own.jones, other.jones, atol=2e-4 * np.abs(own.gain).max())
    assert np.abs(later.gain - paths.gain).max() > 0.05 * np.abs(paths.gain).max()


def test_channels_over_time_turn_each_path(paths):
    shift = paths.doppler_hz(transmitter_velocity=SPEED["tx"])
    array, f = wr.PlanarArray(2, 1), np.array([-1e8, 0.0, 2e8])
    over = paths.to_sionna(array, doppler_hz=shift)
    np.testing.assert_array_equal(over.doppler[:, 0][paths.valid], shift[paths.valid])
    h = over.cfr(f, sampling_frequency=1e3, num_time_steps=3, normalize_delays=False)
    taps = over.taps(1e9, 0, 9, sampling_frequency=1e3, num_time_steps=3, normalize_delays=False)
    a = over.cir(sampling_frequency=1e3, num_time_steps=3, normalize_delays=False)[0]
    for k in range(3):
        then = paths.after(k * 1e-3, shift)
        np.testing.assert_allclose(
            h[:, :, 0, :, k], then.cfr(CARRIER + f, tx_array=array, squint=False), rtol=1e-9
        )
        np.testing.assert_allclose(a[:, :, 0, ..., k], then.cir(tx_array=array)[0], rtol=1e-9, atol=1e-30)
        np.testing.assert_allclose(
            taps[:, :, 0, :, k], then.taps(1e9, 0, 9, tx_array=array, squint=False), rtol=1e-9
        )
    assert np.abs(h[..., 2, :] - h[..., 0, :]).max() > 0.1 * np.abs(h).max()


def test_scattered_paths_of_a_field_shift_with_what_they_touch():
    """Each by its own interaction point: v . (k_out - k_in) / lambda."""
    scene = room()
    nothing = wr.SpectrumDataset.empty(transmitter=TX, frequency_hz=CARRIER)
    paths = wr.RadioField.fit(scene, nothing).paths(RX[0])
    shift = paths.doppler_hz(moving={"panel": SPEED["panel"]}, scene=scene)
    single = np.flatnonzero(
        (paths.kind == "diffuse") & (np.isfinite(paths.vertices[..., 0]).sum(axis=1) == 1)
    )
    point = paths.vertices[single, 0]
    k = [(b - a) / np.linalg.norm(b - a, axis=1, keepdims=True) for a, b in ((TX, point), (point, RX[0]))]
    on_panel = scene.face_object[scene.mesh.closest(point).face] == 1
    expected = np.where(on_panel, (k[1] - k[0]) @ SPEED["panel"], 0.0) * CARRIER / SPEED_OF_LIGHT
    assert on_panel.sum() > 3 and (~on_panel).sum() > 3
    np.testing.assert_allclose(shift[single], expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("named", "options"),
    [
        (
            "moving: got 'door'.*walls, panel, brick, concrete",
            {"moving": {"door": [1, 0, 0]}, "scene": room()},
        ),
        (r"moving\['panel'\]: got shape \(2,\)", {"moving": {"panel": [1, 0]}, "scene": room()}),
        ("scene: got NoneType with moving", {"moving": {"panel": [1, 0, 0]}}),
        ("scene: got Mesh with moving", {"moving": {"panel": [1, 0, 0]}, "scene": room().mesh}),
        ("transmitter_velocity: got shape", {"transmitter_velocity": 3.0}),
        (r"receiver_velocity.*\(2, 3\)", {"receiver_velocity": np.zeros((3, 3))}),
        ("receiver_velocity", {"receiver_velocity": [3e8, 0, 0]}),
    ],
)
def test_what_has_no_velocity_is_refused(paths, named, options):
    with pytest.raises((TypeError, ValueError), match=named):
        paths.doppler_hz(**options)


def test_paths_of_another_scene_are_refused(paths):
    far = replace(paths, vertices=paths.vertices + [0.0, 0.0, 50.0])
    with pytest.raises(ValueError, match="scene: got paths that touch something"):
        far.doppler_hz(moving={"panel": [1, 0, 0]}, scene=room())
    with pytest.raises(ValueError, match="doppler_hz: got shape"):
        paths.after(1.0, [1.0, 2.0])
    with pytest.raises(ValueError, match="doppler_hz: got NaN"):
        random_paths(2).after(1.0, [np.nan, 1.0])

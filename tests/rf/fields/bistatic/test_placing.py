"""How a receiver stood, where paths pass slabs or go over edges on their way to it."""

import numpy as np
import pytest
from radio_scenes import box_mesh, joined, seen

from warprrf.rf.em.materials import Material
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.measured import direct_paths
from warprrf.rf.fields.bistatic.observations import observe
from warprrf.rf.fields.bistatic.placing import position_offset, with_zeros
from warprrf.rf.paths.trace import trace_paths
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.antenna import horn
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import Readings, path_weights
from warprrf.rf.spectra.spectrum import angles_from_directions
from warprrf.rf.tracing.model import Effects

F, TX, RX = 28e9, np.array([-2.0, 0.0, 1.5]), np.array([2.0, 0.4, 1.2])
CONCRETE = Material.custom("concrete", relative_permittivity=5.0, conductivity=0.01, thickness_m=0.2)
SCREEN = (
    np.array([[0.5, -6, 0], [0.5, 0.5, 0], [0.5, 0.5, 6], [0.5, -6, 6.0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)


def readings(scene, effects, **how):
    """What direct paths alone give, at a place that is right."""
    count = len(next(iter(how.values())))
    one = Readings(
        TX, np.repeat(RX[None], count, axis=0), np.full(count, 1e-9), F, 1e-20, position_std_m=0.05, **how
    )
    ((place, view),) = seen(scene, one, effects=effects, slabs_and_edges=effects, sub_pixels=1)
    power = view.records["specular"].power
    read = path_weights(one, place.rows, *direct_paths(view)) @ power
    one = Readings(
        TX, np.repeat(RX[None], count, axis=0), read, F, 1e-4 * read.max(), position_std_m=0.05, **how
    )
    (o,) = observe([one], [(place, view)], F, [])
    return one, o, power / o.floor


def test_a_receiver_behind_a_wall_is_where_it_is_said_to_be():
    """The wall makes line of sight 20 cm longer for a wave: that is no error of position."""
    mesh, part = joined(box_mesh([0.5, -6, -6], [0.7, 6, 6]))
    scene = Scene(mesh, [CONCRETE], part)
    effects = Effects(mirrors=0, scatterings=0, transmissions=1, diffractions=0)
    traced = trace_paths(scene, transmitter=TX, receivers=RX, frequency_hz=F, mirror_order=0, transmissions=1)
    assert traced.length_m[0] - np.linalg.norm(RX - TX) > 0.2
    delay_s = traced.tau[0] + np.arange(-4, 5) * 0.25e-9
    one, o, power = readings(scene, effects, delay_s=delay_s, bandwidth_hz=1e9)
    assert o.view.paths.slabs.tolist() == [1]
    assert np.abs(position_offset(one, [(o, np.zeros(len(one)), power)])).max() < 1e-3


def test_a_path_over_an_edge_leaves_for_the_edge():
    scene = Scene(*[joined(SCREEN)[0], [Material.conductor()], np.zeros(2, np.int32)])
    effects = Effects(mirrors=0, scatterings=0, transmissions=0, diffractions=1)
    traced = trace_paths(scene, transmitter=TX, receivers=RX, frequency_hz=F, mirror_order=0, diffractions=1)
    first = traced.departure[traced.power.argmax()]
    zenith, azimuth = angles_from_directions(first[None])
    turn = np.radians(np.arange(-40, 41, 10))
    departure = np.column_stack([np.repeat(zenith, len(turn)), azimuth + turn])
    one, o, power = readings(scene, effects, departure=departure, transmit_pattern=horn(np.radians(20.0)))
    assert o.view.paths.over_edge.all()
    assert np.abs(position_offset(one, [(o, np.zeros(len(one)), power)])).max() < 1e-3


def test_the_zero_of_azimuths_is_that_of_what_walls_let_through():
    """At 300 GHz a partition of unknown material takes 40 dB from line of sight: what is heard comes round it, over a mirror."""
    carrier_hz, source, place = 300e9, np.array([-2.0, -1.0, 1.5]), np.array([2.0, -1.2, 1.2])
    wall = np.array([[-5, 3, 0], [5, 3, 0], [5, 3, 3], [-5, 3, 3.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    parting = np.array([[0, -6, -6], [0, 1, -6], [0, 1, 6], [0, -6, 6.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    mesh, part = joined(wall, parting)
    scene = Scene(mesh, [Material("wall", ()), Material("partition", ())], part)
    effects = Effects(mirrors=1, scatterings=0, transmissions=1, diffractions=0, residual=False)
    frame = SpectrumDataset.empty(transmitter=source, frequency_hz=carrier_hz, shape=(12, 24))
    paths = BistaticField.prior(scene, frame, effects=effects).paths(place)
    assert sorted(paths.kind) == ["mirror", "slab"] and paths.kind[0] == "mirror"
    azimuth = np.radians(np.arange(-180, 180, 10))
    arrival = np.column_stack([np.full(len(azimuth), np.pi / 2), azimuth])
    how = {"arrival": arrival, "receive_pattern": horn(np.radians(20.0)), "azimuth_known": False}
    places = np.repeat(place[None], len(azimuth), axis=0)
    one = Readings(source, places, np.full(len(azimuth), 1e-9), carrier_hz, 1e-20, **how)
    power = (
        path_weights(one, np.arange(len(azimuth)), paths.arrival, paths.departure, paths.tau) @ paths.power
    )
    one = Readings(source, places, power, carrier_hz, 1e-6 * power.max(), **how)
    every = seen(scene, one, effects=effects, slabs_and_edges=effects, sub_pixels=1)
    zero = with_zeros([one], every)[1]["azimuth_zero_deg"]["readings"]
    assert zero == pytest.approx(0.0, abs=1.0)

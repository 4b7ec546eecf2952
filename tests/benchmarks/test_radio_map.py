"""The radio map's benchmark: its arithmetic, and both maps of the lobby."""

import numpy as np
import pytest
from places import LOBBY
from sionna_room import sionna_or_skip

import warprrf as wr
from benchmarks.radio_map import errors, solver
from warprrf.rf.fields.bistatic.field import BistaticField


def test_errors_of_a_map_that_is_two_decibels_too_strong_where_blocked():
    truth, seen, counted = np.full((4, 5), 1e-10), np.ones((4, 5), bool), np.ones((4, 5), bool)
    seen[0], counted[:, 4] = False, False
    values = np.where(seen, truth, truth * 10**0.2)
    values[1, 4] = np.nan  # not counted
    found = errors(values, truth, counted, seen)
    assert found["rms_blocked_db"] == pytest.approx(2.0)
    assert found["rms_seen_db"] == pytest.approx(0.0, abs=1e-12)
    assert found["rms_db"] == pytest.approx(2.0 * np.sqrt(4 / 16))
    assert found["median_db"] == pytest.approx(0.0, abs=1e-12)
    empty = errors(np.zeros((4, 5)), truth, counted, seen)
    assert empty["rms_db"] == pytest.approx(20.0)  # an empty cell has the lowest level


def test_both_maps_of_the_lobby_agree_where_the_transmitter_is_seen(lobby_scene):
    sionna_or_skip()
    ds = wr.SpectrumDataset.load(LOBBY / "spectra_sionna.nc")
    field = BistaticField.prior(lobby_scene, ds)
    ours = field.radio_map(1.5, 1.5, bounds=[0.0, 0.0, 15.0, 12.0], shape=(10, 20))
    gain = solver(lobby_scene, ours, field.frequency_hz)
    few, many, reference = (gain(samples, k) for k, samples in enumerate((1_000, 100_000, 400_000)))
    places = ours.positions.reshape(-1, 3)
    air = lobby_scene.is_free(places, clearance_m=1.1).reshape(ours.free.shape) & ours.free
    seen = lobby_scene.mesh.visible(ours.transmitter, places).reshape(air.shape)
    # With line of sight the rest is worth a decibel, whatever the materials are taken for.
    assert errors(ours.total_path_gain, reference, air, seen)["rms_seen_db"] < 1.5
    noise = [errors(values, reference, air, seen)["rms_db"] for values in (few, many)]
    assert noise[0] > 2.0 * noise[1] and noise[1] < 2.0

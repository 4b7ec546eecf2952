"""The committed lobby spectra are what the plan says and what the code computes."""

import json

import numpy as np
from places import LOBBY

from benchmarks.lobby import spectra
from warprrf.rf.exact import ExactEngine
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.dataset_files import COMPACT_DELAY_STEP_S
from warprrf.rf.spectra.spectrum import to_db


def test_the_sample_is_60_and_100_of_the_plan_and_subsets_start_its_ordering(lobby_scene):
    who, kept = spectra.plan(lobby_scene), json.loads((LOBBY / "receivers.json").read_text())
    np.testing.assert_array_equal(who.receivers, kept["receivers_m"])
    assert who.role.tolist() == kept["role"] and who.sample.tolist() == kept["sample"]
    order = who.receivers[who.role == "train"]
    for name in spectra.FILES.values():
        ds = SpectrumDataset.load(LOBBY / name)
        np.testing.assert_array_equal(ds.receivers, who.receivers[who.sample])
        seen = lobby_scene.mesh.visible(np.array(spectra.TRANSMITTER), ds.receivers)
        np.testing.assert_array_equal(ds.line_of_sight, seen)
        for n in (10, 25, 60):
            train, test = ds.split(n)
            np.testing.assert_array_equal(train.receivers, order[:n])
            assert len(test) == 100 and np.count_nonzero(~test.line_of_sight) >= 30


def test_the_exact_file_is_what_the_engine_computes(lobby_scene):
    ds = SpectrumDataset.load(LOBBY / spectra.FILES["exact"])
    link = {"transmitter": ds.transmitter, "frequency_hz": ds.frequency_hz}
    engine = ExactEngine(lobby_scene, **link, shape=ds.shape, beam_sigma_rad=ds.beam_sigma_rad)
    got = engine.receive(ds.receivers[7])
    np.testing.assert_allclose(to_db(got.path_gain, ds.floor), ds.path_gain_db[7], atol=0.03)
    same = ~(np.abs(got.delay_s - ds.delay_s[7]) > COMPACT_DELAY_STEP_S)
    assert same.mean() > 0.999  # two paths may be equally strong to rounding


def test_both_engines_tell_of_the_same_room():
    # Depth 3 adds bounces to what one bounce brings, and both hold the same line of sight and mirrors.
    one, three = (SpectrumDataset.load(LOBBY / spectra.FILES[name]) for name in ("exact", "sionna"))
    ratio = three.path_gain.sum(axis=(1, 2), dtype=float) / one.path_gain.sum(axis=(1, 2), dtype=float)
    direct = one.line_of_sight
    assert ratio.min() > 0.95 and np.median(ratio[direct]) < 1.5 < ratio[~direct].max()

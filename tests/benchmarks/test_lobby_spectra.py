"""The committed lobby spectra are what the plan says and what the code computes."""

import json

import numpy as np
import pytest
from places import ROOT

from benchmarks.lobby import spectra
from warprrf.rf.exact import ExactEngine
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.dataset_files import COMPACT_DELAY_STEP_S
from warprrf.rf.spectra.spectrum import to_db

DATA = ROOT / "data" / "lobby"


@pytest.fixture(scope="module")
def scene():
    return Scene.load(DATA / "scene.xml")


@pytest.fixture(scope="module", params=["exact", "sionna"])
def dataset(request):
    return SpectrumDataset.load(DATA / spectra.FILES[request.param])


def test_the_plan_is_the_one_in_the_file(scene):
    who = spectra.plan(scene)
    kept = json.loads((DATA / "receivers.json").read_text())
    np.testing.assert_array_equal(who.receivers, kept["receivers_m"])
    assert who.role.tolist() == kept["role"] and who.sample.tolist() == kept["sample"]
    assert (who.role == "test").sum() == 100 and len(who.role) == 800


def test_the_sample_is_60_and_100_of_the_plan_and_has_real_shadow(scene, dataset):
    who = spectra.plan(scene)
    np.testing.assert_array_equal(dataset.receivers, who.receivers[who.sample])
    assert (dataset.role == "train").sum() == 60 and (dataset.role == "test").sum() == 100
    np.testing.assert_array_equal(
        dataset.line_of_sight, scene.mesh.visible(np.array(spectra.TRANSMITTER), dataset.receivers)
    )
    blocked = ~dataset.line_of_sight[dataset.role == "test"]
    assert blocked.sum() >= 30 and dataset.line_of_sight.mean() >= 0.5


def test_subsets_nest_and_start_the_full_ordering(scene, dataset):
    who = spectra.plan(scene)
    full = who.receivers[who.role == "train"]
    for n in (10, 15, 20, 25, 50, 60):
        train, test = dataset.split(n)
        np.testing.assert_array_equal(train.receivers, full[:n])
        assert len(test) == 100


def test_the_files_are_small():
    assert all((DATA / name).stat().st_size <= 5e6 for name in spectra.FILES.values())


def test_the_exact_file_is_what_the_engine_computes(scene):
    ds = SpectrumDataset.load(DATA / spectra.FILES["exact"])
    engine = ExactEngine(
        scene,
        transmitter=ds.transmitter,
        frequency_hz=ds.frequency_hz,
        shape=ds.shape,
        beam_sigma_rad=ds.beam_sigma_rad,
    )
    got = engine.receive(ds.receivers[7])
    np.testing.assert_allclose(to_db(got.path_gain, ds.floor), ds.path_gain_db[7], atol=0.03)
    same = ~(np.abs(got.delay_s - ds.delay_s[7]) > COMPACT_DELAY_STEP_S)
    assert same.mean() > 0.999  # two paths may be equally strong to rounding


def test_both_engines_tell_of_the_same_room():
    # Depth 3 adds bounces to what one bounce brings, and both hold the same line of sight and mirrors.
    one, three = (SpectrumDataset.load(DATA / spectra.FILES[name]) for name in ("exact", "sionna"))
    ratio = three.path_gain.sum(axis=(1, 2), dtype=float) / one.path_gain.sum(axis=(1, 2), dtype=float)
    assert ratio.min() > 0.95
    direct = one.line_of_sight
    np.testing.assert_array_equal(three.line_of_sight, direct)
    assert np.median(ratio[direct]) < 1.5 < ratio[~direct].max()

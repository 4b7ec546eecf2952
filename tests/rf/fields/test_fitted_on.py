"""A field knows which receivers it was fitted on, and scoring says so when they are among those scored."""

import warnings

import numpy as np
import pytest
from fuzz.answers import differs, leaves
from small_room import small_room

import warprrf as wr
from warprrf import cli
from warprrf.rf.spectra import lookups

QUICK = {"bistatic": {"quick": True}, "rf3dgs+": {"iterations": 2}, "rf3dgs": {"iterations": 2}}


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return small_room(tmp_path_factory.mktemp("room"))


@pytest.mark.parametrize("model", QUICK)
def test_a_field_and_its_file_know_what_it_was_fitted_on(model, room, tmp_path):
    ds = wr.SpectrumDataset.load(room / "spectra.nc")
    mixed = ds.subset([0, 1, 2, 11])  # the last one is for test
    field = wr.RadioField.fit(wr.Reconstruction.load(room / "reconstruction"), mixed, model, **QUICK[model])
    field.save(tmp_path / "field.safetensors")
    again = wr.RadioField.load(tmp_path / "field.safetensors")
    written, read = (leaves((f, f.spectrum(ds.receivers[11]))) for f in (field, again))
    assert not differs(read, written)
    for one in (field, again):
        np.testing.assert_array_equal(one.fitted_on, mixed.receivers)
        np.testing.assert_array_equal(np.flatnonzero(one.was_fitted_on(ds)), [0, 1, 2, 11])
    test = ds.split(3)[1]
    with pytest.warns(
        UserWarning, match="1 of its 4 receivers are among those that the predictor was fitted on"
    ):
        scored = wr.evaluate(test, field.spectrum)
    assert scored["receivers_fitted_on"] == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert wr.evaluate(ds.subset([10, 12]), field.spectrum)["receivers_fitted_on"] == 0
        assert wr.evaluate(ds.subset([10, 12]), lambda rx: field.spectrum(rx))["receivers_fitted_on"] is None

    figures = tmp_path / "figures.json"
    words = [str(tmp_path / "field.safetensors"), str(room / "spectra.nc"), "-o", str(figures)]
    assert cli.main(["evaluate", *words, "--quiet", "--device", "cpu"]) == 2
    assert not figures.exists()


def test_a_lookup_knows_what_it_was_built_from(room):
    ds = wr.SpectrumDataset.load(room / "spectra.nc")
    for build in (lookups.nearest, lookups.idw, lookups.constant, lookups.mean):
        with pytest.warns(UserWarning, match="fitted on"):
            assert wr.evaluate(ds.subset([0, 12]), build(ds.subset([0, 1])))["receivers_fitted_on"] == 1

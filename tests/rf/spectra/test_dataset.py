"""A data set comes back from disk as it was, splits nest, and damaged files say so."""

import os

import numpy as np
import pytest

from warprrf.rf.spectra.dataset import SpectrumDataset, assign_roles
from warprrf.rf.spectra.dataset_files import COMPACT_AOD_STEP_RAD, COMPACT_DELAY_STEP_S
from warprrf.rf.spectra.exr import export_exr, import_exr
from warprrf.rf.spectra.spectrum import Spectrum


def dataset(count=40, shape=(12, 24), seed=0):
    rng = np.random.default_rng(seed)
    delay = rng.uniform(1e-8, 1e-7, (count, *shape))
    aod = np.stack(
        [rng.uniform(0, np.pi, (count, *shape)), rng.uniform(-np.pi, np.pi, (count, *shape))], axis=-1
    )
    empty = rng.uniform(size=(count, *shape)) < 0.1
    gain = np.where(empty, 0, rng.lognormal(-25, 3, (count, *shape)))
    delay[empty], aod[empty] = np.nan, np.nan
    return SpectrumDataset.from_spectra(
        receivers=rng.uniform(-5, 5, (count, 3)),
        transmitter=[1, 2, 3.25],
        frequency_hz=300e9,
        path_gain=gain,
        delay_s=delay,
        aod=aod,
        line_of_sight=rng.uniform(size=count) < 0.5,
        beam_sigma_rad=0.03,
        engine="exact",
        seed=3,
        role=assign_roles(count, test=10, seed=1),
        attributes={"depth": 1, "version_warprrf": "0.1.0"},
    )


def test_round_trip_is_exact(tmp_path):
    before = dataset()
    before.save(tmp_path / "a.nc")
    after = SpectrumDataset.load(tmp_path / "a.nc")
    for name in ("receivers", "transmitter", "path_gain", "delay_s", "aod", "role", "line_of_sight"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
        assert getattr(before, name).dtype == getattr(after, name).dtype
    for name in (
        "frequency_hz",
        "floor",
        "range_db",
        "beam_sigma_rad",
        "engine",
        "polarisation",
        "seed",
        "attributes",
    ):
        assert getattr(before, name) == getattr(after, name)
    assert os.listdir(tmp_path) == ["a.nc"]


def test_compact_rounding_stays_within_what_it_states(tmp_path):
    before = dataset()
    before.save(tmp_path / "a.nc", compact=True)
    before.save(tmp_path / "b.nc")
    after = SpectrumDataset.load(tmp_path / "a.nc")
    error = np.abs(after.path_gain.astype(float) - before.path_gain)
    assert (error <= np.maximum(2.0**-8 * before.path_gain, before.floor / 128) * 1.001).all()
    assert np.abs(after.path_gain_db - before.path_gain_db).max() < 0.05
    assert np.nanmax(np.abs(after.delay_s - before.delay_s)) <= COMPACT_DELAY_STEP_S / 2
    assert np.nanmax(np.abs(after.aod - before.aod)) <= COMPACT_AOD_STEP_RAD / 2 * 1.001
    np.testing.assert_array_equal(np.isnan(after.delay_s), after.path_gain == 0)
    np.testing.assert_array_equal(np.isnan(after.aod[..., 1]), after.path_gain == 0)
    assert (tmp_path / "a.nc").stat().st_size < 0.75 * (tmp_path / "b.nc").stat().st_size


@pytest.mark.parametrize("seed", [0, 7])
def test_splits_nest_and_keep_their_test_receivers(seed):
    ds = dataset()
    splits = [ds.split(n, seed=seed) for n in (3, 10, 30)]
    for (small, test), (large, again) in zip(splits[:-1], splits[1:], strict=True):
        np.testing.assert_array_equal(large.receivers[: len(small)], small.receivers)
        np.testing.assert_array_equal(test.receivers, again.receivers)
    assert (splits[0][1].role == "test").all() and len(splits[0][1]) == 10
    assert splits[0][0].floor == ds.floor and splits[0][0].range_db == ds.range_db


def test_seed_0_takes_the_order_of_the_file():
    ds = dataset()
    np.testing.assert_array_equal(ds.split(12)[0].receivers, ds.receivers[ds.role == "train"][:12])


def test_floor_and_range_follow_from_the_spectra():
    ds = dataset()
    floor = np.median(ds.path_gain.max(axis=(1, 2))) * 1e-6
    assert ds.floor == pytest.approx(floor)
    assert ds.range_db == pytest.approx((10 * np.log10(floor), 10 * np.log10(ds.path_gain.max() + floor)))


def test_exr_keeps_the_spectrum_and_its_numbers(tmp_path):
    pytest.importorskip("OpenEXR")
    ds = dataset()
    ds.export_exr(tmp_path / "one.exr", 5)
    s = import_exr(tmp_path / "one.exr")
    np.testing.assert_array_equal(s.path_gain, ds.path_gain[5])
    np.testing.assert_allclose(s.delay_s, ds.delay_s[5], rtol=1e-7)
    np.testing.assert_array_equal(s.aod, ds.aod[5])
    assert (s.floor, s.range_db) == (ds.floor, ds.range_db)
    assert s.attributes["frequency_hz"] == 300e9
    assert (s.attributes["engine"], s.attributes["polarisation"]) == (ds.engine, ds.polarisation)
    np.testing.assert_array_equal(s.attributes["receiver"], ds.receivers[5])


def test_a_spectrum_without_delays_is_no_exr(tmp_path):
    pytest.importorskip("OpenEXR")
    with pytest.raises(ValueError, match="spectrum: got one without delay"):
        export_exr(tmp_path / "one.exr", Spectrum(np.ones((2, 4))))


def test_missing_and_damaged_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.nc"):
        SpectrumDataset.load(tmp_path / "nothing.nc")
    path = tmp_path / "cut.nc"
    dataset().save(path)
    whole = path.read_bytes()
    for part in (b"", b"not netcdf", whole[: len(whole) // 2], whole[:5000]):
        path.write_bytes(part)
        with pytest.raises(ValueError, match=r"cut\.nc"):
            SpectrumDataset.load(path)
    import xarray

    xarray.Dataset({"temperature": ("x", np.zeros(3))}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(ValueError, match="lacks.*delay"):
        SpectrumDataset.load(path)


def test_bad_values_are_refused():
    ds = dataset()
    from dataclasses import replace

    with pytest.raises(ValueError, match="receivers.*NaN"):
        replace(ds, receivers=np.full((40, 3), np.nan))
    with pytest.raises(ValueError, match="delay_s.*expected"):
        replace(ds, delay_s=ds.delay_s[:3])
    with pytest.raises(ValueError, match="path_gain.*negative"):
        replace(ds, path_gain=-ds.path_gain)
    with pytest.raises(ValueError, match="n_train"):
        ds.split(31)
    with pytest.raises(ValueError, match="indices"):
        ds.subset([99])

"""A data set comes back from disk as it was, splits nest, and damaged files say so."""

import os
import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest
from radio_scenes import RadioScene, SlabMaterial, box_mesh, exact_spectra, joined

from warprrf.rf.paths.trace import trace_paths
from warprrf.rf.spectra.dataset import SpectrumDataset, assign_roles
from warprrf.rf.spectra.dataset_files import (
    COMPACT_AOD_STEP_RAD,
    COMPACT_DELAY_STEP_S,
    export_exr,
)
from warprrf.rf.spectra.levels import free_space_gain
from warprrf.rf.spectra.spectrum import Spectrum, pixel_directions


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
        role=assign_roles(count, test=count // 4, seed=1),
        attributes={"depth": 1, "version_warprrf": "0.1.0"},
    )


def same(a, b):
    for name in (f.name for f in fields(SpectrumDataset) if f.name != "attributes"):
        x, y = getattr(a, name), getattr(b, name)
        np.testing.assert_array_equal(x, y, err_msg=name)
        assert getattr(x, "dtype", None) == getattr(y, "dtype", None), name


def test_round_trip_is_exact_with_or_without_receivers(tmp_path):
    held = {
        "text": "größer", "none": "", "number": 1.5, "whole": 3, "yes": True, "list": [1.0, 2.0], "words": ["a", "b"],
    }  # fmt: skip
    for before in (dataset(), dataset().subset([])):
        replace(before, attributes=held).save(tmp_path / "a.nc")
        after = SpectrumDataset.load(tmp_path / "a.nc")
        same(before, after)
        assert {**after.attributes, "list": list(after.attributes["list"])} == held
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
    # seed 0 takes the order of the file
    np.testing.assert_array_equal(ds.split(12)[0].receivers, ds.receivers[ds.role == "train"][:12])


def test_floor_and_range_follow_from_the_spectra():
    ds = dataset()
    floor = np.median(ds.path_gain.max(axis=(1, 2))) * 1e-6
    assert ds.floor == pytest.approx(floor)
    assert ds.range_db == pytest.approx((10 * np.log10(floor), 10 * np.log10(ds.path_gain.max() + floor)))


def test_pixels_that_were_not_measured_are_so_in_a_single_spectrum():
    """One NaN pixel was an error of what a data set hands out of one receiver."""
    whole = dataset(3)
    gain = whole.path_gain.copy()
    gain[1, 2:4] = np.nan
    for one, own in zip(replace(whole, path_gain=gain), gain, strict=True):
        np.testing.assert_array_equal(one.path_gain, own)
    with pytest.raises(ValueError, match="path_gain: got"):
        Spectrum(np.full((2, 4), np.inf))


def test_exr_keeps_the_spectrum_and_its_numbers(tmp_path):
    exr = pytest.importorskip("OpenEXR")
    ds = dataset()
    ds.export_exr(tmp_path / "one.exr", 5)
    with exr.File(str(tmp_path / "one.exr"), separate_channels=True) as file:
        header = dict(file.header())
        planes = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    np.testing.assert_array_equal(planes["path_gain"], ds.path_gain[5])
    np.testing.assert_allclose(planes["delay"], ds.delay_s[5], rtol=1e-7)
    np.testing.assert_array_equal(np.stack([planes["aod_zenith"], planes["aod_azimuth"]], axis=-1), ds.aod[5])
    numbers = {
        "floor": ds.floor, "range_db": ds.range_db, "frequency_hz": 300e9, "transmitter": ds.transmitter,
        "receiver": ds.receivers[5],
    }  # fmt: skip
    for name, value in numbers.items():
        np.testing.assert_array_equal([float(v) for v in header[f"warprrf_{name}"].split()], np.ravel(value))
    assert (header["warprrf_engine"], header["warprrf_polarisation"]) == (ds.engine, ds.polarisation)
    with pytest.raises(ValueError, match="spectrum: got one without delay"):
        export_exr(tmp_path / "one.exr", Spectrum(np.ones((2, 4))))


def turned(data):
    """Every axis in another order, and columns told from 0 to 2 pi."""
    data = data.assign_coords(azimuth=data.azimuth.values % (2 * np.pi)).sortby("azimuth")
    data = data.isel(zenith=slice(None, None, -1), xyz=[2, 1, 0], angle=[1, 0], receiver=[5, 0, 7, 2])
    return data.roll(azimuth=7, roll_coords=True).transpose("angle", "azimuth", "xyz", "zenith", "receiver")


def as_others_write(data):
    """Labels left out, and empty delays told by a number."""
    delay = data.delay.fillna(-1.0).assign_attrs(data.delay.attrs, missing_value=-1.0)
    return data.drop_vars(["xyz", "angle"]).assign(delay=delay)


def rewritten(tmp_path, change):
    """The file of a data set with a change of what xarray reads of it."""
    xarray = pytest.importorskip("xarray")
    dataset(8).save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf", decode_timedelta=False) as opened:
        change(opened.load()).to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    return tmp_path / "b.nc"


@pytest.mark.parametrize(("change", "receivers"), [(turned, [5, 0, 7, 2]), (as_others_write, range(8))])
def test_what_other_tools_reorder_is_read_by_its_coordinates(tmp_path, change, receivers):
    same(SpectrumDataset.load(rewritten(tmp_path, change)), dataset(8).subset(receivers))


REFUSED = {
    "zenith: got the places": lambda data: data.isel(zenith=slice(0, 6)),
    "azimuth: got the places": lambda data: data.assign_coords(azimuth=data.azimuth + 0.1),
    "azimuth: got the unit 'degrees'": lambda data: data.assign_coords(
        azimuth=("azimuth", np.rad2deg(data.azimuth.values), {"units": "degrees"})
    ),
    "azimuth: got values of type": lambda data: data.assign_coords(azimuth=data.azimuth.astype(str)),
    "xyz: got the places": lambda data: data.assign_coords(xyz=["x", "y", "t"]),
    "delay: got the unit 'ns'": lambda data: data.assign(delay=(data.delay * 1e9).assign_attrs(units="ns")),
    "delay: got values packed by scale_factor": lambda data: data.assign(
        delay=data.delay.assign_attrs(scale_factor=2.0)
    ),
    "lacks aod, role": lambda data: data.drop_vars(["aod", "role"]),
}


@pytest.mark.parametrize(("match", "change"), REFUSED.items(), ids=REFUSED)
def test_what_cannot_be_put_in_order_is_refused(tmp_path, match, change):
    path = rewritten(tmp_path, change)
    with pytest.raises(ValueError, match=rf"b\.nc: {match}"):
        SpectrumDataset.load(path)


def test_a_file_that_states_more_than_it_can_hold_is_refused(tmp_path):
    h5netcdf = pytest.importorskip("h5netcdf")
    with h5netcdf.File(tmp_path / "a.nc", "w") as file:
        file.dimensions = {"receiver": 10**6, "zenith": 1000, "azimuth": 1000}
        file.create_variable("path_gain", ("receiver", "zenith", "azimuth"), "f4", chunks=(1, 100, 100))
    with pytest.raises(ValueError, match=r"a\.nc: damaged.* it states 4\d+ bytes"):
        SpectrumDataset.load(tmp_path / "a.nc")


def test_a_file_that_may_not_be_read_is_not_called_damaged(tmp_path):
    path = tmp_path / "a.nc"
    dataset(8).save(path)
    path.chmod(0)
    tmp_path.chmod(0o755)
    nobody = "import os; os.geteuid() or os.seteuid(65534)\n"
    read = (
        "import sys; from warprrf.rf.spectra.dataset import SpectrumDataset as D; import h5netcdf, h5py\n"
        f"{nobody}"
        "try: D.load(sys.argv[1])\n"
        "except PermissionError as e: print(e.filename)"
    )
    for folder in list(tmp_path.parents)[:2]:
        folder.chmod(folder.stat().st_mode | 0o055)
    done = subprocess.run([sys.executable, "-c", read, path], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == str(path), done.stderr


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
import warprrf as wr
from warprrf.rf.spectra.dataset_files import export_exr
ds = wr.SpectrumDataset.load(sys.argv[1])
ds[0].plot
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, resource.RLIM_INFINITY))
for path in sys.argv[1:]:
    for k in range(3):
        try:
            ds.export_exr(path, 0) if path.endswith("exr") else ds.save(path, compact=k > 0)
        except OSError as error:
            print(Path(error.filename).name)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
ds.save(sys.argv[1])
wr.SpectrumDataset.load(sys.argv[1])
print("lives")
"""


def test_the_process_outlives_a_full_disk(tmp_path):
    pytest.importorskip("OpenEXR")
    paths = [tmp_path / "a.nc", tmp_path / "a.exr"]
    dataset(8).save(paths[0])
    dataset(8).export_exr(paths[1], 0)
    whole = [path.read_bytes() for path in paths]
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, *paths], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.stdout.split() == ["a.nc"] * 3 + ["a.exr"] * 3 + ["lives"], done.stderr
    assert done.returncode == 0 and sorted(os.listdir(tmp_path)) == ["a.exr", "a.nc"]
    assert paths[1].read_bytes() == whole[1]
    same(SpectrumDataset.load(paths[0]), dataset(8))


@pytest.mark.parametrize("name", ["floor", "range_low_db", "title", "compact", "a/b", "", "_x", 5])
def test_names_that_the_file_needs_are_no_attributes(name):
    with pytest.raises(ValueError, match=f"attributes: got .*{name}"):
        replace(dataset(), attributes={name: 1.0})


@pytest.mark.parametrize("value", [None, [[1.0]], 1j, np.zeros(10_000)])
def test_attributes_are_text_and_numbers(value):
    with pytest.raises(TypeError, match="attributes: 'mine' is a "):
        replace(dataset(), attributes={"mine": value})


def test_compact_files_of_the_faintest_floors_hold_numbers(tmp_path):
    before = dataset(4)
    faint = replace(before, path_gain=before.path_gain * 1e-28, floor=1e-44)
    faint.save(tmp_path / "a.nc", compact=True)
    np.testing.assert_allclose(
        SpectrumDataset.load(tmp_path / "a.nc").path_gain, faint.path_gain, rtol=2**-8, atol=1e-40
    )  # float32 ends there


SPECTRUM, SPECTRA = Spectrum(np.ones((2, 4))), dataset()


@pytest.mark.parametrize(
    ("held", "name", "value"),
    [
        (SPECTRA, "receivers", np.zeros((40, 2))),
        (SPECTRA, "transmitter", [1.0, np.nan, 0.0]),
        (SPECTRA, "frequency_hz", 0.0),
        (SPECTRA, "path_gain", -np.ones((40, 12, 24))),
        (SPECTRA, "path_gain", np.full((40, 12, 24), 1e300)),  # no float32
        (SPECTRA, "path_gain", np.ones((39, 12, 24))),
        (SPECTRA, "delay_s", np.full((40, 12, 24), -1e-9)),
        (SPECTRA, "aod", np.full((40, 12, 24, 2), 3.5)),
        (SPECTRA, "floor", -1.0),
        (SPECTRA, "range_db", (-80.0, -170.0)),
        (SPECTRA, "beam_sigma_rad", -0.03),
        (SPECTRA, "role", ["training"] * 40),
        (SPECTRA, "role", ["train"] * 39),
        (SPECTRA, "line_of_sight", np.full(40, 2)),
        (SPECTRUM, "path_gain", -np.ones((2, 4))),
        (SPECTRUM, "delay_s", np.ones((2, 3))),
        (SPECTRUM, "floor", -1.0),
        (SPECTRUM, "range_db", (0.0, np.nan)),
    ],
)
def test_fields_that_nothing_has_are_refused(held, name, value):
    with pytest.raises(ValueError, match=f"^{name}: "):
        replace(held, **{name: value})


def test_bad_choices_are_refused():
    ds = dataset()
    for n in (31, 0):
        with pytest.raises(ValueError, match="n_train"):
            ds.split(n)
    for indices in ([99], [-41], [0.5], [True, False]):
        with pytest.raises(ValueError, match="indices"):
            ds.subset(indices)
    assert len(ds.subset([])) == 0 and len(ds.subset(np.arange(40) < 3)) == 3


def test_spectra_of_paths_are_those_of_the_engine_that_finds_the_same_paths():
    """A box of walls that scatter nothing: line of sight and single mirrors, each in the receiver's beam."""
    mesh, part = joined(box_mesh([0, 0, 0], [5, 4, 3], inward=True))
    scene = RadioScene(mesh, part, [SlabMaterial()])
    ends = {"transmitter": np.array([0.8, 0.9, 2.2]), "frequency_hz": 28e9}
    receivers = np.array([[4.2, 3.1, 1.2], [1.4, 3.4, 1.7]])
    paths = trace_paths(scene, receivers=receivers, mirror_order=1, **ends)
    ds = SpectrumDataset.from_paths(paths, shape=(18, 36), beam_sigma_rad=0.1)
    wanted = exact_spectra(scene, receivers, shape=(18, 36), sigma=0.1, **ends)
    for name in ("receivers", "transmitter", "path_gain", "delay_s", "aod", "line_of_sight", "floor"):
        np.testing.assert_allclose(getattr(ds, name), getattr(wanted, name), rtol=1e-5, err_msg=name)
    one = SpectrumDataset.from_paths(paths[1], shape=(18, 36), beam_sigma_rad=0.1)
    np.testing.assert_array_equal(one.path_gain[0], ds.path_gain[1])
    with pytest.raises(ValueError, match="paths: got ones without receiver"):
        SpectrumDataset.from_paths(replace(paths, receiver=None))
    with pytest.raises(ValueError, match="several transmitters"):
        SpectrumDataset.from_paths(replace(paths, transmitter=receivers + 0.1))


@pytest.mark.parametrize("shape", [(90, 180), (90, 8), (10, 40)])
def test_line_of_sight_is_found_whatever_pixels_are_shaped_like(shape):
    """Columns of 45 degrees: the transmitter's is up to 22 degrees off, which is more than two rows."""
    receivers, transmitter = np.random.default_rng(0).uniform(1.0, 3.0, (6, 3)), np.zeros(3)
    way = transmitter - receivers
    toward = np.einsum(
        "hwc,rc->rhw", pixel_directions(shape), way / np.linalg.norm(way, axis=1, keepdims=True)
    )
    gain = np.zeros((6, *shape))
    for own, cosine, direct in zip(gain, toward, free_space_gain(transmitter, receivers, 60e9), strict=True):
        own[np.unravel_index(cosine.argmax(), shape)] = direct
    gain[3:] = np.roll(gain[3:], shape[1] // 2, axis=2)  # it comes from elsewhere
    ds = SpectrumDataset.from_spectra(
        receivers=receivers,
        transmitter=transmitter,
        frequency_hz=60e9,
        path_gain=gain,
        beam_sigma_rad=0.01,
        floor=1e-15,
    )
    assert ds.line_of_sight.tolist() == 3 * [True] + 3 * [False]

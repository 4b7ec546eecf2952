"""Many receivers at once: the same answers whatever computes them, in memory or in a file that survives a kill."""

import inspect
import os
import signal
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from furnished import RECEIVERS, TX, furnished, spectra
from radio_scenes import SlabMaterial

import warprrf as wr
from warprrf.netcdf_files import Store, Variable
from warprrf.rf.fields import batches
from warprrf.rf.spectra.spectrum import pixel_solid_angles

PLACES, OTHER = RECEIVERS[:6], TX + [0.4, 0.2, -0.3]
F = np.linspace(299e9, 301e9, 5)
MODELS = ["bistatic", "rf3dgs+", "rf3dgs"]
EVERYTHING = "bistatic with slabs, edges, light of several bounces and air"
ARRAYS = {
    "tx_array": wr.PlanarArray(1, 2),
    "rx_array": wr.PlanarArray(3, 1, pattern=wr.horn(0.9)),
    "diffuse": "random_phase",
}


@cache
def fitted(model):
    if model == EVERYTHING:
        every = wr.Effects(mirrors=2, transmissions=2, residual=True)
        return replace(fitted("bistatic"), effects=every).with_gas(True)
    walls, box = SlabMaterial("walls", 3.0, 0.5, np.inf, 0.5), SlabMaterial("box", 6.0, 0.5, np.inf, 0.8)
    scene = furnished(walls, box)
    ds = spectra(scene, PLACES[:3], shape=(12, 24), sigma=0.15)
    return wr.RadioField.fit(
        scene, ds, model, **{"quick": True} if model == "bistatic" else {"iterations": 5}
    )


@pytest.fixture(scope="module")
def field():
    return fitted("bistatic")


@pytest.fixture(autouse=True)
def small_parts(monkeypatch):
    monkeypatch.setattr(batches, "AT_ONCE", 2)


def answers(field, folder=None, **how):
    """Spectra, responses and gains of paths at all places."""

    def store(name):
        return how if folder is None else how | {"store": folder / name}

    paths = field.paths(PLACES, max_paths=7, **store("paths.nc"))
    return [
        field.spectra(PLACES, **store("spectra.nc")).path_gain, field.cfr(PLACES, F, **ARRAYS, **store("cfr.nc")), paths.gain,
        paths.vertices,
    ]  # fmt: skip


@pytest.mark.parametrize("model", [*MODELS, EVERYTHING])
def test_a_row_is_what_its_link_gets_alone_without_a_receiver_axis(model, tmp_path):
    field, other = fitted(model), TX if model == "rf3dgs" else OTHER  # which knows its own transmitter alone
    places, own, stored = PLACES[:4], np.array([TX, other, TX, other]), {}
    verbs: dict[str, Any] = {
        "spectrum": lambda *at: field.spectrum(*at).path_gain, "links": lambda *at: field.links(*at).total_path_gain,
        "array": lambda *at: field.array_spectrum(at[0], wr.PlanarArray(2, 2), [[1.0, 0, 0]], at[1]),
        "traced": lambda *at: wr.trace_paths(field.mesh, receivers=at[0], transmitter=at[1], frequency_hz=3e11).gain,
        "spectra": lambda *at, **how: field.spectra(*at, **how).path_gain,
        "paths": lambda *at, **how: field.paths(*at, 7, **how).gain,
        "cfr": lambda at, source, **how: field.cfr(at, F, source, **ARRAYS, **how),
    }  # fmt: skip
    for name, ask in verbs.items():
        if name == "array" and "bistatic" not in model:
            continue
        rows, alone, shared = ask(places, own), ask(PLACES[1], other), ask(PLACES[1], own)
        for row in (rows[1], shared[1], shared[3]):  # those of paths are padded
            row = row[: len(alone)] if alone.ndim else row
            np.testing.assert_allclose(row, alone, rtol=1e-5, atol=1e-6 * np.abs(alone).max(), err_msg=name)
        for _ in range(2 if name in ("spectra", "paths", "cfr") else 0):
            np.testing.assert_array_equal(ask(PLACES[1], other, store=tmp_path / name), alone)
        stored[name] = rows
    assert wr.Paths.load(tmp_path / "paths").receiver.shape == (3,)
    np.testing.assert_allclose(
        stored["spectra"], stored["spectrum"], rtol=1e-6, atol=1e-6 * stored["spectrum"].max()
    )
    assert (field.paths(places, own, 5).transmitter == own).all()
    for cfr, *link in zip(stored["cfr"], places, own, strict=True):
        np.testing.assert_allclose(
            cfr, field.paths(*link).cfr(F, **ARRAYS), rtol=1e-5, atol=1e-6 * np.abs(cfr).max()
        )
    assert cfr.dtype == np.complex64 and cfr.shape == (3, 2, 5)
    with pytest.raises(ValueError, match=r"transmitter: got shape \(2, 3\)"):
        field.spectra(places, own[:2])
    with pytest.raises(ValueError, match=r"receivers\[1\].*outside"):
        field.spectra([PLACES[0], PLACES[0] + 50.0])


def test_answers_keep_their_places_when_the_caller_moves_on():
    """A cart's position is often one array that is added to."""
    field, at, source = fitted("bistatic"), PLACES[1].copy(), TX.copy()
    one = {"transmitter": source, "frequency_hz": field.frequency_hz, "shape": (6, 12)}
    many, view, found = field.spectra(at, source), field.view(at, source), field.radio_map(1.5, 1.0, source)
    before = field.spectrum(at, source, view=view).delay_s
    concrete = wr.Scene(field.mesh, [wr.em.itu_material("concrete")], np.zeros(len(field.mesh.faces)))
    ds, empty = wr.simulate(concrete, receivers=at, **one), wr.SpectrumDataset.empty(**one)
    for moved in (at, source):
        moved += 0.1
    for own in (many.receivers, view.receivers[0], ds.receivers[0]):
        np.testing.assert_array_equal(own, PLACES[1])
    for own in (many.transmitters, found.transmitter, ds.transmitter, empty.transmitter):
        np.testing.assert_array_equal(own, TX)
    np.testing.assert_array_equal(field.spectrum(PLACES[1], TX, view=view).delay_s, before)
    field.spectrum(PLACES[1]).attributes["transmitter"] += 1.0  # what the next answer is reckoned from stays
    np.testing.assert_array_equal(field.spectrum(PLACES[1], TX, view=field.view(PLACES[1])).delay_s, before)


def test_every_model_takes_what_the_base_says():
    """Names, order, kinds and defaults of parameters, which more may follow by name; places have one name each."""
    for kind in wr.RadioField.models.values():
        for verb in (n for n in dir(wr.RadioField) if n[0] != "_" and callable(getattr(wr.RadioField, n))):
            ours, base = (inspect.signature(getattr(one, verb)).parameters for one in (kind, wr.RadioField))
            shared = [p for p in base.values() if p.kind is not p.VAR_KEYWORD]
            if verb == "fit":  # each class has a model of its own
                shared = [
                    p.replace(default=ours["model"].default) if p.name == "model" else p for p in shared
                ]
            assert [p.replace(annotation=0) for p in ours.values() if p.name in {p.name for p in shared}] == [
                p.replace(annotation=0) for p in shared
            ]
            more = [p.kind for p in ours.values() if p.name not in base]
            assert set(more) <= {inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.VAR_KEYWORD}, verb
        for f in [wr.simulate, wr.trace_paths, *(getattr(kind, n) for n in dir(kind) if n[0] != "_")]:
            names = inspect.signature(f).parameters if callable(f) else ()
            assert not {"rx", "tx", "receiver", "transmitters"} & set(names), f


@pytest.mark.parametrize("model", [*MODELS, EVERYTHING])
def test_a_field_answers_on_any_grid(model):
    """A pixel's centre has its power per solid angle on every grid that has it; totals of scattering are the room's; floor
    and range are a pixel's."""
    field, finer = fitted(model), (36, 72)
    own, other = (field.spectrum(PLACES, shape=shape) for shape in (None, finer))
    if "bistatic" in model:
        np.testing.assert_allclose(other.total_path_gain, own.total_path_gain, rtol=0.02)
    else:
        density = [s.path_gain / pixel_solid_angles(s.shape)[:, None] for s in (own, other)]
        np.testing.assert_allclose(density[1][:, 1::3, 1::3], density[0], rtol=1e-3)
    assert other.aod.shape == (6, *finer, 2)
    assert 9 * other.floor == pytest.approx(own.floor)
    assert field.spectra(PLACES[0], shape=finer).path_gain.shape == finer
    truth = wr.SpectrumDataset.from_spectra(
        receivers=PLACES[3:],
        transmitter=TX,
        frequency_hz=300e9,
        path_gain=other.path_gain[3:],
        beam_sigma_rad=0.15,
    )
    assert wr.evaluate(truth, field.spectrum)["psnr_db"] > 100


def test_a_store_holds_the_same_bits_and_is_known_again(field, tmp_path):
    for a, b, c in zip(answers(field), answers(field, tmp_path), answers(field, tmp_path), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)
    xarray = pytest.importorskip("xarray")
    with xarray.open_dataset(tmp_path / "cfr.nc", engine="h5netcdf") as held:
        np.testing.assert_array_equal(held.cfr, field.cfr(PLACES, F, **ARRAYS))
        np.testing.assert_array_equal(held.frequency, F)
    assert {file.suffix for file in tmp_path.iterdir()} == {".nc"}  # nothing is left beside them


def test_stored_paths_of_one_transmitter_are_those_of_one(field, tmp_path):
    """What takes paths of one transmitter (spectra, DeepMIMO, Sionna's shapes) takes those of a store too."""
    stored = field.paths(PLACES, max_paths=7, store=tmp_path / "paths.nc")
    np.testing.assert_array_equal(stored.transmitter, TX)
    now, before = (
        wr.SpectrumDataset.from_paths(p, shape=(6, 12)) for p in (stored, field.paths(PLACES, max_paths=7))
    )
    np.testing.assert_array_equal(now.path_gain, before.path_gain)


def test_a_store_of_something_else_is_refused(field, tmp_path):
    file = tmp_path / "spectra.nc"
    field.spectra(PLACES, store=file)
    before = file.read_bytes()
    for ask in (
        lambda: field.spectra(PLACES[:5], store=file), lambda: field.spectra(PLACES, OTHER, store=file),
        lambda: field.cfr(PLACES, F, diffuse="power", store=file), lambda: field.spectra(PLACES, shape=(6, 12), store=file),
        lambda: replace(field, floor=2 * field.floor).spectra(PLACES, store=file),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="store: .*another field, other places or other options"):
            ask()
    assert file.read_bytes() == before
    file.write_bytes(before[:5000] + b"?" + before[5001:])
    with pytest.raises(ValueError, match="checksum"):
        field.spectra(PLACES, store=file)
    file.write_text("mine")
    with pytest.raises(ValueError, match="no finished store"):
        field.spectra(PLACES, store=file)
    with pytest.raises(ValueError, match="max_paths"):
        field.paths(PLACES, store=tmp_path / "paths.nc")


KILLED = """
import sys, numpy as np, warprrf as wr
from warprrf.rf.fields import batches
batches.AT_ONCE = 2
field, places = wr.RadioField.load(sys.argv[1]), np.load(sys.argv[2])
def tell(stage, done, total):
    print(done, flush=True)
    if done >= 4:
        input()
field.spectra(places, store=sys.argv[3], progress=tell)
"""


def test_a_killed_process_loses_only_what_it_was_at(field, tmp_path):
    field.save(tmp_path / "field.safetensors")
    field = wr.RadioField.load(tmp_path / "field.safetensors", device="cpu")
    np.save(tmp_path / "places.npy", PLACES)
    names = [str(tmp_path / name) for name in ("field.safetensors", "places.npy", "spectra.nc")]
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, *names], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert [child.stdout.readline() for _ in range(3)] == ["0\n", "2\n", "4\n"]
        with pytest.raises(ValueError, match="another process is at work"):
            field.spectra(PLACES, store=names[2])
        os.kill(child.pid, signal.SIGKILL)
    assert not Path(names[2]).exists() and Path(f"{names[2]}.unfinished").exists()
    with pytest.raises(ValueError, match="another field"):
        field.spectra(PLACES, OTHER, store=names[2])

    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        field.spectra(PLACES, store=names[2], progress=stop)
    told: list[int] = []
    found = field.spectra(PLACES, store=names[2], progress=lambda _, done, __: told.append(done))
    np.testing.assert_array_equal(found.path_gain, field.spectra(PLACES).path_gain)
    assert told == [4, 6]  # the other four were there
    assert not Path(f"{names[2]}.unfinished").exists()


GAIN = np.arange(30.0).reshape(6, 5)


def fill(file, rows=6):
    """What a store of :data:`GAIN` holds, its first ``rows`` written at most."""
    variables = {
        "receiver_position": Variable(("receiver", "xyz")),
        "gain": Variable(("receiver", "zenith")),
    }
    with Store(file, {"receiver_position": PLACES}, variables, {"key": "k"}, 6) as store:
        for row in np.flatnonzero(store.missing[:rows]):
            store.put(np.array([row]), {"gain": GAIN[[row]]})
    return store.arrays()["gain"] if file.exists() else GAIN[:0]


@pytest.mark.parametrize("opened", [False, True])
def test_a_store_that_another_process_finishes_meanwhile_is_read(opened, tmp_path, monkeypatch):
    file, unfinished, open_ = tmp_path / "gain.nc", tmp_path / "gain.nc.unfinished", Store._open
    fill(file)
    os.rename(file, unfinished)  # as it is just before its last step

    def late(self, path):
        if opened:
            open_(self, path)
        os.rename(unfinished, file)
        if not opened:
            open_(self, path)

    monkeypatch.setattr(Store, "_open", late)
    np.testing.assert_array_equal(fill(file), GAIN)


def test_a_limit_of_the_size_of_files_is_an_error_that_names_the_store(tmp_path):
    """In a process of its own: HDF5 crashed at its first failure."""
    fill(tmp_path / "whole.nc")
    assert (tmp_path / "whole.nc").stat().st_size > 7000
    script = (
        f"import sys; sys.path[:0] = {[os.path.dirname(__file__), *sys.path]!r}\n"
        "import resource; from test_batches import *\n"
        "for limit in (0, 2000, 5000, 7000):\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))\n"
        "    with pytest.raises(OSError, match='small.nc'): fill(Path(sys.argv[1]))"
    )
    found = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "small.nc"], capture_output=True, text=True
    )
    assert found.returncode == 0, found.stderr

"""NeWRF's conference room (MATLAB's image method) against ours, and reflection coefficients fitted to channels."""

import os
from pathlib import Path

import numpy as np
import pytest
from places import ROOT
from radio_scenes import box_mesh, joined

from benchmarks import newrf as bench
from benchmarks.newrf_rays import load_newrf
from benchmarks.reflections import fit_reflections, mesh_parts
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.mesh_files import read_mesh
from warprrf.rf.paths.trace import MirrorTracer

LOW, HIGH = np.array([-3.0, -2, 0]), np.array([4.0, 3, 2.5])
TX = np.array([-1.123, 1.456, 1.789])
F = 2.4e9


def furnished():
    return joined(
        box_mesh(LOW, HIGH, inward=True),
        box_mesh([0, -1, 0], [1.2, 0.5, 0.8]),
        box_mesh([-2, -1.5, 0], [-1.4, -1, 1]),
    )[0]


def places(n, seed=0):
    return np.random.default_rng(seed).uniform(LOW + [0.2, 0.2, 1.1], HIGH - 0.2, (n, 3))


@pytest.fixture(scope="module")
def folder():
    root = os.environ.get("WARPRRF_EXTERNAL", ROOT.parent / "shared" / "external")
    path = Path(root) / "newrf"
    if not (path / "newrf_conference.npz").exists():
        pytest.skip(
            f"no {path}: set WARPRRF_EXTERNAL to the folder that holds newrf/ to run this outside check"
        )
    return path


@pytest.fixture(scope="module")
def rays(folder):
    return load_newrf(folder)


def test_all_receivers_rays_once_reflected_and_in_sight_agree(rays):
    match = bench.match_rays(rays, order=1)
    for name in ("line_of_sight", "once"):
        row = match.summary()[name]
        assert row["share"] >= 0.99
        assert row["length_error_m_worst"] < 1e-4
        assert row["phase_error_rad_worst"] < 0.02
        assert row["gain_error_worst"] < 2e-4
    # Rays that only we have do meet a face, within 0.2 mm of the edge of their patch.
    assert len(match.extra_receiver) <= 4
    tracer = MirrorTracer(rays.mesh, transmitter=rays.transmitter, frequency_hz=rays.frequency_hz)
    for receiver, point in zip(match.extra_receiver, match.extra_point, strict=True):
        ours = tracer.find(rays.receivers[receiver][None], 1)
        met = ours.patch[np.linalg.norm(ours.last_point - point, axis=1).argmin()]
        assert tracer.patches.contains(met, point[None], -1e-5).all()
        assert not tracer.patches.contains(met, point[None], -2e-4).any()


@pytest.mark.slow
def test_twice_reflected_rays_agree(rays):
    row = bench.match_rays(rays, order=2).summary()["twice"]
    assert row["share"] >= 0.99 and row["only_ours"] <= 0.01 * row["rays"]
    assert row["length_error_m_worst"] < 1e-4 and row["phase_error_rad_worst"] < 0.02


def test_orders_and_sums_read_from_the_file_are_consistent(rays):
    assert (rays.order == 0).sum() == rays.line_of_sight.sum()
    np.testing.assert_allclose(rays.gain.sum(axis=1), rays.csi, atol=1e-15)
    train, held_out = rays.split()
    assert (len(train), len(held_out)) == (346, 86) and not np.intersect1d(train, held_out).size
    with pytest.raises(ValueError, match="n_train"):
        rays.split(400)


def test_what_does_not_read_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"newrf_conference\.npz"):
        load_newrf(tmp_path)
    (tmp_path / "newrf_conference.npz").write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(FileNotFoundError, match=r"conferenceroom\.stl"):
        load_newrf(tmp_path)
    (tmp_path / "conferenceroom.stl").write_bytes(b"solid text")
    with pytest.raises(ValueError, match="npz"):
        load_newrf(tmp_path)
    with pytest.raises(ValueError, match="binary STL"):
        read_mesh(tmp_path / "conferenceroom.stl")
    content = dict(
        transmitter=np.zeros(3),
        receivers=np.ones((2, 3)),
        frequency_hz=F,
        last_point=np.zeros((2, 4, 3)),
        gain=np.ones((2, 4), complex),
        rays=np.array([1, 2]),
        line_of_sight=np.ones(2, bool),
        csi=np.ones(2, complex),
    )

    def fails(match, **changed):
        kept = {k: v for k, v in {**content, **changed}.items() if v is not None}
        np.savez(tmp_path / "newrf_conference.npz", **kept)
        with pytest.raises(ValueError, match=match):
            load_newrf(tmp_path)

    fails("lacks csi", csi=None)
    fails("receivers: got shape", receivers=np.ones((3, 3)))
    fails("gain: got shape", gain=np.ones((2, 5), complex))
    fails("rays: got", rays=np.array([1, 9]))
    fails("last_point: got NaN", last_point=np.full((2, 4, 3), np.nan))
    fails("gain of zero", gain=np.zeros((2, 4), complex))
    fails("frequency_hz", frequency_hz=-1.0)
    fails("STL")


@pytest.mark.parametrize("order", [0, 1, 2])
def test_chains_of_many_receivers_are_the_tracers_paths(order):
    tracer = MirrorTracer(furnished(), transmitter=TX, frequency_hz=F)
    points = places(40)
    chains = tracer.find(points, order)
    for k, point in enumerate(points):
        one = tracer.trace(point, order)
        mine = chains.receiver == k
        by_length = np.argsort(chains.length_m[mine])
        expected = np.argsort(one.length_m)
        np.testing.assert_allclose(chains.length_m[mine][by_length], one.length_m[expected], rtol=1e-12)
        np.testing.assert_allclose(
            chains.gain(tracer.wavelength_m)[mine][by_length], one.gain[expected], rtol=1e-9
        )
    chosen = chains.patch[chains.order == 2]
    assert (chosen >= 0).all() and (order == 2) == bool(len(chosen))


def test_chains_of_no_receivers_or_at_the_transmitter():
    tracer = MirrorTracer(furnished(), transmitter=TX, frequency_hz=F)
    assert len(tracer.find(np.zeros((0, 3)), 2).receiver) == 0
    with pytest.raises(ValueError, match="receivers"):
        tracer.find([TX], 1)
    with pytest.raises(ValueError, match="order"):
        tracer.find(places(2), -1)


def channels(mesh, points, coefficient, groups):
    """The channel of known coefficients, written out chain by chain."""
    tracer = MirrorTracer(mesh, transmitter=TX, frequency_hz=F)
    chains = tracer.find(points, 2)
    patch_group = np.array([groups[tracer.patches.faces(p)[0]] for p in range(len(tracer.patches))])
    csi = np.zeros(len(points), complex)
    for k, met in enumerate(chains.patch):
        r = np.prod(coefficient[patch_group[met[met >= 0]]])
        d = chains.length_m[k]
        wave = tracer.wavelength_m
        csi[chains.receiver[k]] += wave / (4 * np.pi * d) * np.exp(-2j * np.pi * d / wave) * r
    return csi


def test_known_coefficients_are_found_and_predict_elsewhere():
    mesh = furnished()
    groups = mesh_parts(mesh)
    assert groups.max() == 2
    truth = np.array([0.7 * np.exp(2.5j), 0.4 - 0.3j, -0.8 + 0.1j])
    train, test = places(60, 1), places(40, 2)
    fit = fit_reflections(
        mesh, TX, train, channels(mesh, train, truth, groups), F, groups=groups, regularisation=1e-9
    )
    np.testing.assert_allclose(fit.coefficient[fit.lit], truth[fit.lit], atol=1e-5)
    expected = channels(mesh, test, truth, groups)
    assert bench.snr_db(fit.predict(test), expected) > 60
    assert fit.predict(test[0]).shape == (1,)
    # "part" is the same grouping by another name.
    part = fit_reflections(mesh, TX, train, channels(mesh, train, truth, groups), F, groups="part")
    np.testing.assert_allclose(part.coefficient, fit.coefficient, atol=1e-3)


def test_surfaces_never_lit_stay_at_the_prior_and_noise_does_not_blow_up():
    mesh = furnished()
    groups = mesh_parts(mesh)
    truth = np.array([0.6 + 0j, 0.5, 0.5])
    few, test = places(3, 4), places(40, 5)
    csi = channels(mesh, few, truth, groups)
    noise = np.random.default_rng(0).normal(size=(2, 3)) @ np.eye(3) * 0.03 * np.abs(csi).mean()
    fit = fit_reflections(mesh, TX, few, csi + noise[0] + 1j * noise[1], F, regularisation=1e-2)
    assert not fit.lit.all()
    np.testing.assert_array_equal(fit.coefficient[~fit.lit], 1.0)
    assert np.abs(fit.coefficient).max() < 1.5
    untouched = fit_reflections(mesh, TX, np.zeros((0, 3)), np.zeros(0), F)
    np.testing.assert_array_equal(untouched.coefficient, 1.0)
    assert np.isnan(untouched.training_nmse)
    expected = channels(mesh, test, np.ones(3), groups)
    assert bench.snr_db(untouched.predict(test), expected) > 150


def test_bad_fits_are_refused():
    mesh, points = furnished(), places(4)
    csi = np.ones(4, complex)

    def fails(error, match, **changed):
        given = dict(mesh=mesh, transmitter=TX, receivers=points, csi=csi, frequency_hz=F) | changed
        with pytest.raises(error, match=match):
            fit_reflections(**given)

    fails(TypeError, "mesh", mesh="room")
    fails(ValueError, "csi", csi=np.ones(3, complex))
    fails(ValueError, "csi", csi=np.full(4, np.nan + 0j))
    fails(ValueError, "csi", csi=np.zeros(4, complex))
    fails(ValueError, "receivers", receivers=np.zeros((4, 2)))
    fails(ValueError, "regularisation", regularisation=0.0)
    fails(ValueError, "prior", prior=np.inf)
    fails(ValueError, "groups", groups="wall")
    fails(ValueError, "groups", groups=np.arange(3))
    fails(ValueError, "groups", groups=np.arange(len(mesh.faces)))
    fails(ValueError, "order", order=-1)
    fails(ValueError, "frequency_hz", frequency_hz=0.0)


def test_the_fit_needs_little_to_predict_held_out_receivers(rays):
    # Line of sight and single reflections alone, so that it is quick: fitted to MATLAB's rays of those orders.
    low = (rays.order == 0) | (rays.order == 1)
    csi = np.where(low, rays.gain, 0.0).sum(axis=1)
    train, held_out = rays.split(50)
    fit = fit_reflections(
        rays.mesh,
        rays.transmitter,
        rays.receivers[train],
        csi[train],
        rays.frequency_hz,
        1,
        groups="part",
        prior=0.0,
    )
    # One held-out receiver has a ray of ours that MATLAB leaves out, at the edge of a patch.
    error = np.abs(fit.predict(rays.receivers[held_out]) - csi[held_out]) / np.abs(csi[held_out])
    assert (error < 1e-2).mean() > 0.95


def test_an_empty_room_reads_back_from_stl(tmp_path):
    vertices, faces = box_mesh(LOW, HIGH, inward=True)
    record = np.zeros(len(faces), dtype=[("f", "<f4", 12), ("a", "<u2")])
    record["f"] = np.concatenate(
        [np.zeros((len(faces), 3)), np.asarray(vertices)[faces].reshape(len(faces), 9)], 1
    )
    path = tmp_path / "box.stl"
    path.write_bytes(bytes(80) + np.uint32(len(faces)).tobytes() + record.tobytes())
    found = read_mesh(path)
    triangles = Mesh(found.vertices, found.faces).triangles
    np.testing.assert_allclose(triangles, Mesh(vertices, faces).triangles, atol=1e-6)

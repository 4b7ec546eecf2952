"""Sionna RT's own paths, channels and link-level functions beside ours."""

import numpy as np
import pytest
from path_makers import CARRIER, random_paths
from places import LOBBY
from sionna_room import placed

from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.interop.sionna_engine import load_sionna_scene
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import trace_paths
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset

TX = np.array([13.6, 11.2, 2.5])
RECEIVERS = np.array([[7.0, 4.0, 1.5], [3.1, 9.2, 1.2], [15.0, 3.0, 1.7]])


def solve(rt, array=None, depth=2):
    loaded = load_sionna_scene(LOBBY / "scene.xml", frequency_hz=CARRIER)
    placed(rt, loaded, TX, RECEIVERS, array)
    return rt.PathSolver(deterministic=True)(
        loaded, max_depth=depth, samples_per_src=200_000, synthetic_array=True, refraction=False, seed=1
    )


@pytest.fixture(scope="module")
def solved(rt):
    return solve(rt)


@pytest.fixture(scope="module")
def traced():
    scene = Scene.load(LOBBY / "scene.xml")
    return trace_paths(scene, transmitter=TX, receivers=RECEIVERS, frequency_hz=CARRIER, mirror_order=2)


def test_lobby_paths_agree(solved, traced):
    """Every specular path, its delay, angles and all four complex coefficients; Sionna reckons in float32."""
    theirs = Paths.from_sionna(solved, frequency_hz=CARRIER, drop_repeated=True)
    for r in range(len(RECEIVERS)):
        s, o = theirs[r], traced[r]
        assert len(s.gain) == len(o.gain) > 4
        gap = np.abs(s.tau[:, None] - o.tau) * 3e8 + np.linalg.norm(s.arrival[:, None] - o.arrival, axis=2)
        match = gap.argmin(axis=1)
        assert len(set(match)) == len(match)
        o = o.select(match)
        assert np.abs(s.tau - o.tau).max() < 1e-12
        for a, b in ((s.arrival, o.arrival), (s.departure, o.departure)):
            assert np.linalg.norm(a - b, axis=1).max() < 1e-4
        assert np.abs(10 * np.log10(s.power / o.power)).max() < 0.05
        assert (s.kind == o.kind).all()
        # Without the carrier's turns, which float32 delays cannot carry.
        js, jo = (p.jones * np.exp(2j * np.pi * CARRIER * p.tau)[:, None, None] for p in (s, o))
        error = np.abs(js - jo).max(axis=(1, 2)) / np.abs(js).max(axis=(1, 2))
        assert error.max() < 0.01


@pytest.mark.parametrize(
    "pattern", [("iso", "isotropic"), ("hw_dipole", "half_wave_dipole"), ("tr38901", "tr38901")]
)
@pytest.mark.parametrize("polarisation", ["V", "cross"])
def test_arrays_and_patterns_are_theirs(rt, traced, pattern, polarisation):
    shape = {"num_rows": 2, "num_cols": 3, "pattern": pattern[0], "polarization": polarisation}
    theirs = solve(rt, rt.PlanarArray(**shape), depth=0)
    a = PlanarArray(2, 3, pattern=pattern[1], polarisation=polarisation)
    ours = traced.to_sionna(a, a)
    for r in range(len(RECEIVERS)):
        seen = np.flatnonzero(theirs.valid.numpy()[r, 0])
        direct = np.flatnonzero(traced.kind[r] == "los")
        assert len(seen) == len(direct)
        if len(direct):
            # Angles near an element's null or 2.8 rad off boresight: float32 errs by 1e-3 of the strongest.
            b = theirs.a[0].numpy()[r, :, 0, :, seen[0]] + 1j * theirs.a[1].numpy()[r, :, 0, :, seen[0]]
            np.testing.assert_allclose(ours.a[r, :, 0, :, direct[0]], b, atol=2e-3 * np.abs(b).max())


def test_paths_through_walls_and_round_edges_are_taken_too(rt):
    """Refraction is on by default: every path's power is half that of its four coefficients, and spectra hold them all."""
    room = rt.load_scene(rt.scene.box_one_screen)
    low, high = (np.ravel(corner) for corner in (room.mi_scene.bbox().min, room.mi_scene.bbox().max))
    places = low + (high - low) * [[0.2, 0.3, 0.6], [0.8, 0.7, 0.3], [0.3, 0.6, 0.5]]
    placed(rt, room, places[0], places[1:])
    theirs = rt.PathSolver()(room, max_depth=2, diffraction=True, edge_diffraction=True)
    valid, bounces = theirs.valid.numpy()[:, 0], theirs.interactions.numpy()[:, :, 0]
    assert {4, 8} <= set(np.unique(bounces[:, valid]))
    ours = Paths.from_sionna(theirs, frequency_hz=3.5e9)
    a = theirs.a[0].numpy()[:, :, 0] + 1j * theirs.a[1].numpy()[:, :, 0]
    total = 0.5 * np.where(valid, (np.abs(a) ** 2).sum(axis=(1, 2)), 0.0).sum(axis=-1)
    np.testing.assert_allclose(ours.power.sum(axis=1), total, rtol=1e-5)
    assert (ours.kind == "los").any(axis=1).tolist() == [False, True]
    ds = SpectrumDataset.from_paths(ours, shape=(30, 60), beam_sigma_rad=0.1)
    np.testing.assert_allclose(ds.path_gain.sum(axis=(1, 2)), total, rtol=1e-5)
    np.testing.assert_allclose(ds.receivers, places[1:], atol=1e-5)
    assert ds.line_of_sight.tolist() == [False, True]
    room.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    with pytest.raises(ValueError, match=r"scene.tx_array .* PlanarArray\(num_rows=1"):
        Paths.from_sionna(rt.PathSolver()(room, max_depth=1), frequency_hz=3.5e9)


def test_a_transmitter_that_there_is_not_is_named(solved):
    with pytest.raises(ValueError, match="transmitter: got 1, expected a whole number of 0 to 0"):
        Paths.from_sionna(solved, frequency_hz=CARRIER, transmitter=1)


def test_round_trip_changes_nothing(solved):
    both = PlanarArray(1, 1, polarisation="VH")
    back = Paths.from_sionna(solved, frequency_hz=CARRIER)
    again = back.to_sionna(both, both)
    a = solved.a[0].numpy() + 1j * solved.a[1].numpy()
    tau, valid = solved.tau.numpy(), solved.valid.numpy()
    for r in range(len(RECEIVERS)):
        order = np.argsort(-np.abs(back.gain[r][back.valid[r]]), kind="stable")
        there = np.flatnonzero(valid[r, 0])
        strongest = there[np.argsort(-(np.abs(a[r][..., there]) ** 2).sum(axis=(0, 1, 2)), kind="stable")]
        assert len(order) == len(strongest)
        np.testing.assert_allclose(
            again.a[r, :, 0][..., : len(order)], a[r, :, 0][..., strongest], rtol=1e-5, atol=1e-12
        )
        np.testing.assert_allclose(again.tau[r, 0, : len(order)], tau[r, 0, strongest], rtol=1e-6)
        assert (again.tau[r, 0, len(order) :] == -1).all()
        for name in ("theta_t", "phi_t", "theta_r", "phi_r"):
            np.testing.assert_allclose(
                getattr(again, name)[r, 0, : len(order)],
                getattr(solved, name).numpy()[r, 0, strongest],
                atol=1e-6,
            )
        kinds = solved.interactions.numpy()[:, r, 0][:, strongest]
        np.testing.assert_array_equal(again.interactions[: len(kinds), r, 0, : len(order)], kinds)


def test_channels_are_theirs(rt, solved):
    """``cir``, ``cfr`` and ``taps`` of the same paths; float32 delays limit the agreement."""
    back = Paths.from_sionna(solved, frequency_hz=CARRIER)
    both = PlanarArray(1, 1, polarisation="VH")
    ours = back.to_sionna(both, both)
    f = np.linspace(-2e9, 2e9, 33)
    h, g = ours.cfr(f), solved.cfr(f.astype(np.float32), out_type="numpy")
    assert h.shape == g.shape
    # Delays counted from the first path are exact to 1e-15 s, or 1e-3 rad at the carrier; so the whole to some 1e-3.
    np.testing.assert_allclose(h, g, atol=2e-2 * np.abs(g).max())
    t, u = ours.taps(1e9, -2, 20), solved.taps(1e9, -2, 20, out_type="numpy")
    assert t.shape == u.shape
    # Sionna's taps are NaN for receivers with padded paths, whose delay is -1 s.
    whole = solved.valid.numpy().all(axis=(1, 2))
    assert whole.any() and np.isfinite(t).all()
    np.testing.assert_allclose(t[whole], u[whole], atol=2e-2 * np.abs(u[whole]).max())
    a, tau = ours.cir(num_time_steps=3)
    b, other = solved.cir(num_time_steps=3, out_type="numpy")
    assert a.shape == b.shape and tau.shape == other.shape
    normal = ours.cfr(f, normalize=True)
    np.testing.assert_allclose((np.abs(normal) ** 2).mean(axis=(1, 3, 4, 5)), 1.0)


def test_shapes_of_paths_with_and_without_diffuse_power():
    p = Paths.stack(
        [random_paths(3), Paths.concatenate([random_paths(2), random_paths(2, seed=3, kind="diffuse")])]
    )
    with pytest.raises(ValueError, match="diffuse"):
        p.to_sionna()
    s = p.to_sionna(PlanarArray(2, 2), PlanarArray(1, 3), diffuse="power")
    assert s.a.shape == (2, 3, 1, 4, 4) and s.tau.shape == (2, 1, 4) and s.interactions.shape == (1, 2, 1, 4)
    assert s.valid[1, 0].tolist() == [True, True, False, False] and (s.tau[1, 0, 2:] == -1).all()

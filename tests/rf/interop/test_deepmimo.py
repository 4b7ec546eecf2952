"""Scenario folders, loaded by the DeepMIMO package itself."""

import json
from dataclasses import replace

import numpy as np
import pytest
from path_makers import random_paths
from radio_scenes import box_mesh, joined

from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.materials import Material
from warprrf.rf.interop.deepmimo import write_deepmimo
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import trace_paths
from warprrf.rf.scene import Scene

F = 300e9
WALLS = Material.custom("stone", relative_permittivity=5.0, conductivity=5.0, thickness_m=0.1)


@pytest.fixture
def deepmimo():
    return pytest.importorskip(
        "deepmimo",
        reason="DeepMIMO is no dependency: its wheel asks for an older NumPy (pip install --no-deps deepmimo)",
    )


def room():
    mesh = Mesh(*box_mesh([-7.0, -6, 0], [8.0, 6, 4], inward=True))
    return Scene(mesh, [WALLS], np.zeros(len(mesh.faces), np.int32), object_names=("room",))


def traced():
    points = np.random.default_rng(0).uniform([-6, -5, 0.5], [7, 5, 3], (5, 3))
    return trace_paths(room(), transmitter=[-5.0, 3, 2.5], receivers=points, frequency_hz=F, mirror_order=2)


@pytest.fixture
def loaded(deepmimo, tmp_path, monkeypatch):
    paths = traced()
    write_deepmimo(paths, tmp_path / "deepmimo_scenarios" / "room_1", scene=room())
    monkeypatch.chdir(tmp_path)
    return paths, deepmimo.load("room_1", max_paths=100)


def test_package_reads_what_was_written(loaded):
    paths, data = loaded
    np.testing.assert_allclose(data.rx_pos, paths.receiver, rtol=1e-6)
    np.testing.assert_allclose(data.tx_pos[0], paths.transmitter, rtol=1e-6)
    assert (np.asarray(data.num_paths) == paths.valid.sum(axis=1)).all()
    assert (np.asarray(data.los) == 1).all()
    for r in range(len(paths.gain)):
        p = paths[r]
        p = p.select(np.argsort(-p.power, kind="stable"))
        n = len(p.gain)
        np.testing.assert_allclose(data.power[r, :n], 10 * np.log10(p.power), atol=1e-4)
        np.testing.assert_allclose(data.delay[r, :n], p.tau, rtol=1e-6)
        np.testing.assert_allclose(
            np.exp(1j * np.deg2rad(data.phase[r, :n])), p.gain / np.abs(p.gain), atol=1e-5
        )
        for name, angle in (
            ("aoa_az", p.phi_r),
            ("aoa_el", p.theta_r),
            ("aod_az", p.phi_t),
            ("aod_el", p.theta_t),
        ):
            np.testing.assert_allclose(data[name][r, :n], np.rad2deg(angle), atol=1e-4)
        assert [len(str(int(c))) if c else 0 for c in data.inter[r, :n]] == np.isfinite(
            p.vertices[..., 0]
        ).sum(1).tolist()
        np.testing.assert_allclose(data.inter_pos[r, :n], p.vertices, atol=1e-5)
    assert data.rt_params["frequency"] == F
    assert [o.name for o in data.scene.objects] == ["room"]
    assert list(data.materials.name) == ["stone"]


def test_paths_of_several_transmitters_are_refused(tmp_path):
    paths = traced()
    with pytest.raises(ValueError, match="paths: got ones of several transmitters"):
        write_deepmimo(replace(paths, transmitter=np.tile(paths.transmitter, (5, 1))), tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_paths_of_unknown_departure_are_refused(tmp_path):
    """As of a field that was fitted to spectra without departures: DeepMIMO drops paths without an angle."""
    paths = traced()
    blind = replace(paths, theta_t=np.where(paths.kind == "los", paths.theta_t, np.nan))
    with pytest.raises(ValueError, match="paths: got some without an angle"):
        write_deepmimo(blind, tmp_path / "a")


def test_a_materials_cross_polarisation_is_written(tmp_path):
    mesh, rough = room().mesh, replace(WALLS, scattering=0.5, xpd=0.2)
    scene = Scene(mesh, [rough], np.zeros(len(mesh.faces), np.int32), object_names=("room",))
    folder = write_deepmimo(random_paths(1), tmp_path / "a", scene=scene)
    (said,) = json.loads((folder / "params.json").read_text())["materials"].values()
    assert said["cross_polarization_coefficient"] == 0.2 and said["scattering_coefficient"] == 0.5


def test_folder_without_the_package(tmp_path):
    """What DeepMIMO relies on: names of files, NaN where there is no path, codes of interactions."""
    parts = [
        Paths.concatenate([random_paths(3), random_paths(2, seed=1, kind="diffuse")]),
        random_paths(1, seed=2),
    ]
    unsaid = np.zeros(0, np.int8)
    parts = [
        replace(p, vertices=np.full_like(p.vertices, k), interactions=unsaid) for k, p in enumerate(parts)
    ]
    far = random_paths(1, seed=3, kind="edge")
    codes = np.array([[1, 4, 4, 8]], np.int8)  # of a mirror, two slabs and an edge, as Sionna RT has them
    parts.append(replace(far, vertices=np.full((1, 4, 3), 2.0), interactions=codes))
    paths = Paths.stack(parts)
    with pytest.raises(ValueError, match="diffuse"):
        write_deepmimo(paths, tmp_path / "a")
    folder = write_deepmimo(paths, tmp_path / "a", diffuse="random_phase", max_paths=4)
    power = np.load(folder / "power_t000_tx000_r001.npz")["power"]
    assert power.shape == (3, 4) and np.isnan(power[1, 1:]).all() and (np.diff(power[0]) <= 0).all()
    codes = np.load(folder / "inter_t000_tx000_r001.npz")["inter"]
    assert set(codes[0]) == {1.0, 3.0} and codes[2, 0] == 1442.0
    said = json.loads((folder / "params.json").read_text())
    assert said["txrx_sets"]["txrx_set_1"]["num_points"] == 3
    most = {"path_depth": 4, "reflections": 1, "diffractions": 1, "scattering": 1, "transmissions": 2}
    assert said["rt_params"] == said["rt_params"] | {f"max_{name}": count for name, count in most.items()}
    assert not [f for f in folder.iterdir() if f.name.startswith(".")]


def test_codes_of_many_interactions_keep_their_last_digit(deepmimo, tmp_path, monkeypatch):
    """Eight panes and a mirror: nine digits, which float32 does not hold."""
    thin = Material.custom("thin", relative_permittivity=1.5, conductivity=0.0, thickness_m=0.001)
    panes = [
        (np.array([[x, -6, 0.1], [x, 6, 0.1], [x, 6, 6], [x, -6, 6]]), np.array([[0, 1, 2], [0, 2, 3]]))
        for x in np.linspace(-2.0, 2.0, 8)
    ]
    mesh, part = joined((np.array([[-9.0, 5, 0], [9, 5, 0], [9, 5, 6], [-9, 5, 6]]), panes[0][1]), *panes)
    scene = Scene(mesh, [WALLS, thin], np.minimum(part, 1))
    paths = trace_paths(
        scene,
        transmitter=[-6.0, 0, 3],
        receivers=[2.1, 0, 3],
        frequency_hz=F,
        mirror_order=1,
        transmissions=8,
    )
    codes = ["".join(str({1: 1, 4: 4}[c]) for c in own if c) for own in paths.interactions]
    assert sorted(map(len, codes)) == [8, 9]
    write_deepmimo(paths, tmp_path / "deepmimo_scenarios" / "panes")
    monkeypatch.chdir(tmp_path)
    data = deepmimo.load("panes", max_paths=100)
    order = np.argsort(-paths.power, kind="stable")
    assert [str(int(code)) for code in data.inter[0][: len(codes)]] == [codes[k] for k in order]

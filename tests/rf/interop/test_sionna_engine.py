"""Sionna RT and our own evaluation check each other on a room with a solid in it."""

from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sionna_room import sionna_or_skip, write_scene

from warprrf.rf import scene_sionna
from warprrf.rf.channel.path_arrays import length_along, points_along
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.exact import ExactEngine
from warprrf.rf.interop.sionna_engine import Sampling
from warprrf.rf.scene import Scene
from warprrf.rf.simulate import simulate
from warprrf.rf.spectra.spectrum import pixel_of

F, SHAPE = 300e9, (30, 60)
TX, SEES, BLOCKED = np.array([-5.0, 3.5, 2.7]), np.array([3.0, 4.0, 1.4]), np.array([3.0, -2.0, 1.2])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


COMMON = {"transmitter": TX, "frequency_hz": F, "shape": SHAPE}


@pytest.fixture(scope="module")
def sionna(scene):
    """Sionna's engine, of this scene unless told."""
    engine = sionna_or_skip()
    return lambda room=scene, **sampling: engine(room, sampling=Sampling(**sampling), **COMMON)


@pytest.fixture(scope="module")
def ours(scene):
    return ExactEngine(scene, **COMMON)


@pytest.fixture(scope="module")
def few(sionna):
    """Sionna's engine with few rays, for what does not depend on how many they are."""
    return sionna(depth=1, samples=100_000)


@pytest.mark.parametrize("rx", [SEES, BLOCKED])
def test_total_diffuse_power_agrees_within_half_a_percent(ours, sionna, rx):
    theirs = sionna(depth=1)
    found = theirs.solve(rx, specular=False)
    assert ours.diffuse(rx).power.sum() == pytest.approx(found.power[found.kind == "diffuse"].sum(), rel=5e-3)


def test_one_seed_gives_the_same_paths_in_the_same_order(sionna):
    """Sionna itself stores them in whatever order its threads end."""
    engine = sionna(depth=2, samples=20_000)
    first = engine.solve(SEES)
    assert len(first.tau) > 5000 and (np.diff(first.tau) >= 0).all()
    for _ in range(3):
        again = engine.solve(SEES)
        for name, values in vars(first).items():
            np.testing.assert_array_equal(getattr(again, name), values, err_msg=name)


def test_spectra_have_the_same_shape_and_the_same_strongest_pixel(ours, few):
    ours, theirs = (engine.receive(SEES) for engine in (ours, few))
    pixel = pixel_of(TX - SEES, SHAPE)
    distance = np.linalg.norm(TX - SEES)
    assert theirs.path_gain.sum() == pytest.approx(few.solve(SEES).power.sum(), rel=1e-9)
    for got in (ours, theirs):
        assert np.unravel_index(got.path_gain.argmax(), SHAPE) == pixel
        assert got.delay_s[pixel] == pytest.approx(distance / SPEED_OF_LIGHT, rel=1e-6)
    assert ours.line_of_sight and theirs.line_of_sight


def test_more_bounces_bring_more_power_and_simulate_says_how(scene):
    sionna_or_skip()
    options = COMMON | {"receivers": [BLOCKED], "engine": "sionna", "samples": 100_000}
    one, three = (simulate(scene, depth=n, **options) for n in (1, 3))
    assert 1.05 < three.path_gain.sum() / one.path_gain.sum() < 10
    assert (three.attributes["depth"], three.attributes["samples"]) == (3, 100_000)
    assert three.attributes["version_sionna_rt"] and not three.line_of_sight[0]


def test_a_scene_needs_no_file_and_its_own_devices_play_no_part(few, sionna, scene):
    own = [replace(scene.materials[0], name="rx"), *scene.materials[1:]]
    bare = Scene(
        scene.mesh,
        own,
        scene.face_material,
        transmitters={"tx": TX + 1},
        receivers={"one": SEES},
    )
    found, usual = (e.solve(SEES).power.sum() for e in (sionna(bare, depth=1, samples=100_000), few))
    assert found == pytest.approx(usual, rel=2e-3)


def test_a_room_in_coordinates_of_maps_is_the_room_at_home(few, scene):
    far, moved = np.array([500_000.1, 4_000_000.1, 300.0]), copy(scene)
    moved.mesh = scene.mesh.transformed(shift=far)
    given = COMMON | {"transmitter": TX + far}
    engine = sionna_or_skip()(moved, sampling=Sampling(depth=1, samples=100_000), **given)
    found, usual = engine.solve(SEES + far), few.solve(SEES)
    assert found.power.sum() == pytest.approx(usual.power.sum(), rel=2e-3)
    along = length_along(points_along(found.transmitter, found.vertices, found.receiver))
    np.testing.assert_allclose(along, found.length_m, rtol=1e-4)
    with pytest.warns(UserWarning, match="single precision"):
        moved.to_sionna(frequency_hz=F)


def test_a_place_that_no_path_reaches_has_an_empty_spectrum(sionna):
    engine = sionna(depth=0)
    found = engine.receive(BLOCKED)
    assert not found.path_gain.any() and not found.line_of_sight
    assert np.isnan(found.delay_s).all()
    assert engine.receive(SEES).line_of_sight


def test_reciprocal_materials_are_refused(sionna, scene):
    other = scene.with_materials([replace(m, reciprocal=True) for m in scene.materials])
    with pytest.raises(ValueError, match="reciprocal=False"):
        sionna(other)


def test_an_llvm_that_aborts_is_never_chosen(monkeypatch):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(
        scene_sionna, "installed_llvm", lambda: {14: Path("a"), 15: Path("b"), 19: Path("c"), 17: Path("d")}
    )
    assert scene_sionna.select_llvm() == Path("c")
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH")
    monkeypatch.setattr(scene_sionna, "installed_llvm", lambda: {15: Path("b")})
    with pytest.raises(ImportError, match="15.*libllvm19"):
        scene_sionna.select_llvm()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/mine.so")
    assert scene_sionna.select_llvm() == Path("/mine.so")

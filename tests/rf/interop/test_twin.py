"""The digital twin: exact where a material can say what the field learned, errors stated where it cannot."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from twin_fields import BLOCKED, MATERIALS, SEES, SHAPE, SIGMA, TX, F, known_field, room

import warprrf as wr
from warprrf import cli
from warprrf.rf.em.fresnel import lobe, slab_reflection
from warprrf.rf.exact import ExactEngine
from warprrf.rf.interop import twin as twins
from warprrf.rf.spectra.spectrum import to_db
from warprrf.rf.tracing.model import Effects


@pytest.fixture(scope="module")
def field():
    return known_field()


@pytest.fixture(scope="module")
def twin(field, tmp_path_factory):
    return wr.interop.write_twin(field, tmp_path_factory.mktemp("twin") / "twin")


def spectra(twin, receivers, **options):
    return wr.simulate(
        wr.Scene.load(twin.xml), transmitter=TX, receivers=receivers, frequency_hz=F, shape=SHAPE,
        beam_sigma_rad=SIGMA, **options,
    )  # fmt: skip


@pytest.mark.parametrize("receiver", [SEES, BLOCKED])
def test_the_twin_answers_as_the_room_that_the_field_knows(twin, field, receiver):
    ours = spectra(twin, [receiver]).path_gain[0]
    engine = ExactEngine(room(), transmitter=TX, frequency_hz=F, shape=SHAPE, beam_sigma_rad=SIGMA)
    truth = engine.receive(receiver).path_gain
    # The projection errs by 0.02 dB, as losses bend the curve; the mesh file is float32.
    np.testing.assert_allclose(ours, truth, rtol=0.01, atol=1e-4 * truth.max())
    # The field itself casts fewer rays and softens blocking: the twin is as near to it as the room is.
    known = to_db(field.spectrum(receiver).path_gain, field.floor)
    near, nearest = (np.sqrt(np.mean((to_db(p, field.floor) - known) ** 2)) for p in (ours, truth))
    assert nearest < 1.0
    assert near < nearest + 0.05


def test_materials_are_the_fields_own(twin):
    # By area; no face, no material.
    assert [group.name for group in twin.groups] == ["walls", "block/top <1>"]
    for group, given, weight in zip(twin.groups, MATERIALS, (0.25, 0.64), strict=False):
        assert group.permittivity.real == pytest.approx(given.relative_permittivity, rel=2e-3)
        assert group.scattering**2 == pytest.approx(weight, rel=2e-3)
        assert max(group.scattering_error_db, group.mirror_error_db) < 0.03
        assert group.lobe_error_db < 1e-6
    assert [group.alpha_r for group in twin.groups] == [4, 0]
    area = room().mesh.areas.sum()
    assert sum(group.area_m2 for group in twin.groups) == pytest.approx(area, rel=1e-6)
    assert sorted(path.name for path in (twin.xml.parent / "meshes").iterdir()) == [
        "block_top__1_.ply",
        "walls.ply",
    ]
    with pytest.raises(ValueError, match="140 GHz"):  # fitted at one frequency, known near it alone
        twin.groups[0].material.permittivity(140e9)


def test_sionna_opens_the_scene_as_it_is_and_our_loader_sets_the_scattering_patterns_too(twin, rt):
    bare = rt.load_scene(str(twin.xml), merge_shapes=False)
    loaded = wr.interop.load_sionna_scene(twin.xml, frequency_hz=F)
    assert loaded.frequency.numpy()[0] == pytest.approx(F)
    assert set(bare.objects) == set(loaded.objects) == {"surface_walls", "surface_block_top__1_"}
    for group, alpha_r in zip(twin.groups, (4, None), strict=True):
        radio = bare.radio_materials[group.material.name]
        assert radio.relative_permittivity.numpy()[0] == pytest.approx(group.permittivity.real, rel=1e-6)
        assert radio.conductivity.numpy()[0] == pytest.approx(group.material.conductivity(F), rel=1e-6)
        assert radio.scattering_coefficient.numpy()[0] == pytest.approx(group.scattering, rel=1e-6)
        assert isinstance(radio.scattering_pattern, rt.LambertianPattern)
        pattern = loaded.radio_materials[group.material.name].scattering_pattern
        assert isinstance(pattern, rt.DirectivePattern if alpha_r else rt.LambertianPattern)
        assert getattr(pattern, "alpha_r", None) == alpha_r
    with pytest.raises(ValueError, match="140 GHz"):
        wr.interop.load_sionna_scene(twin.xml, frequency_hz=140e9)


@pytest.mark.usefixtures("rt")
def test_sionna_scatters_and_mirrors_as_the_field(twin, field):
    found = spectra(twin, [SEES], engine="sionna", depth=1, samples=400_000).path_gain[0]
    ours = field.spectrum(SEES).path_gain
    assert found.sum() == pytest.approx(ours.sum(), rel=0.01)
    gap = to_db(found, 1e-12) - to_db(ours, 1e-12)  # what sampling leaves dark lies below
    assert np.sqrt(np.mean(gap**2)) < 1.0


def test_the_error_of_a_mix_is_that_of_random_directions():
    exponents, weight = (0, 12), np.array([0.3, 0.5])
    best, error = twins.project_lobes(exponents, weight)
    rng = np.random.default_rng(0)
    ci, cs, turn = rng.random(200_000), np.sqrt(rng.random(200_000)), 2 * np.pi * rng.random(200_000)
    psi = ci * cs + np.sqrt((1 - ci**2) * (1 - cs**2)) * np.cos(turn)
    mix = sum(w * lobe(n, ci, cs, psi) for n, w in zip(exponents, weight, strict=True)) / weight.sum()

    def miss(n):
        lost = twins.LOST_IN_NOISE
        return np.sqrt(np.mean((10 * np.log10((lobe(n, ci, cs, psi) + lost) / (mix + lost))) ** 2))

    assert error == pytest.approx(miss(best), rel=0.01)
    assert error > 1.0
    assert all(miss(best) <= miss(n) for n in range(61))


def test_where_shares_do_not_sum_to_one_the_mirror_gives_way():
    lost = twins.project_reflection(np.log(4.0), 0.04, 0.001)
    assert lost.scattering_error_db < 1.0
    assert lost.mirror_error_db > 20.0
    # The stated error, by other means: S^2 |Gamma|^2 against W F over the cosine, weighted by it.
    c = (np.arange(4000) + 0.5) / 4000
    curve = [
        np.mean([np.abs(r) ** 2 for r in slab_reflection(c, eps, np.inf, 1.0)], axis=0)
        for eps in (lost.relative_permittivity * (1 - 1j * twins.LOSS_TANGENT), 5.0)
    ]
    gap = 10 * np.log10(lost.scattering**2 * curve[0] / (0.04 * curve[1]))
    assert lost.scattering_error_db == pytest.approx(np.sqrt(np.average(gap**2, weights=c)), abs=0.02)


def test_shares_at_the_ends_of_the_family():
    found = twins.project_reflection(np.log(1e9), 1.0, 2.0)  # the family ends at 201: 0.75 of the power
    assert found.relative_permittivity > 1e5 and 0 <= found.scattering <= 1
    assert found.scattering_error_db + found.mirror_error_db > 1.0
    assert twins.project_reflection(np.log(2.0), 0.7, 0.0).scattering == 1.0
    assert twins.project_reflection(np.log(2.0), 0.0, 0.7).scattering < 1e-6


@pytest.mark.parametrize("thickness", [0.4, 3.3, 40.0])
def test_a_slabs_curve_is_the_mean_over_its_fringes(thickness):
    cosine, _, family = twins._slabs(thickness)
    share = (np.arange(400)[:, None] + 0.5) / 400 - 0.5
    for k in np.flatnonzero((twins._EXCESS > 0.5) & (twins._EXCESS < 20))[::40]:
        eta = (1 + twins._EXCESS[k]) * (1 - 1j * twins.LOSS_TANGENT)
        fringe = 0.5 / np.sqrt(eta.real - 1 + cosine**2)
        powers = np.abs(slab_reflection(cosine, eta, thickness + share * fringe, 1.0)) ** 2
        np.testing.assert_allclose(10 * np.log10(powers.mean(axis=(0, 1))), family[:, k], atol=0.1)


def test_slabs_are_as_thick_as_the_scene_or_the_caller_says_and_else_let_nothing_through(field, tmp_path):
    assert np.isinf(field.surface.thickness_m).all()  # the room's
    unknown = replace(field, surface=replace(field.surface, thickness_m=np.array([0.02, np.nan, np.nan])))
    found = wr.interop.write_twin(unknown, tmp_path / "scene")
    assert [group.thickness_m for group in found.groups] == [0.02, np.inf]
    assert "block/top <1>" in found.left_out[0] and "walls" not in found.left_out[0]
    assert wr.Scene.load(found.xml).materials[0].thickness_m == pytest.approx(0.02)
    nowhere = replace(unknown, surface=replace(field.surface, thickness_m=np.full(3, np.nan)))
    # One material is one slab, however little is known.
    alike = replace(nowhere, material=np.array([0, 0, 1]))
    assert [group.name for group in wr.interop.write_twin(alike, tmp_path / "alike").groups] == ["walls"]
    given = wr.interop.write_twin(unknown, tmp_path / "given", thickness_m={"block/top <1>": 0.3})
    assert [group.thickness_m for group in given.groups] == [0.02, 0.3] and given.left_out == ()
    unknown.save(tmp_path / "field.safetensors")
    words = ["twin", str(tmp_path / "field.safetensors"), "-o", str(tmp_path / "cli"), "--thickness", "0.3"]
    assert cli.main(words) == 0
    assert [m.thickness_m for m in wr.Scene.load(tmp_path / "cli" / "scene.xml").materials] == [0.3, 0.3]
    for wrong in ({"door": 0.1}, -1.0, {"walls": 0.0}):
        with pytest.raises(ValueError, match="thickness_m"):
            wr.interop.write_twin(unknown, tmp_path / "x", thickness_m=wrong)


def test_names_of_groups_that_files_cannot_tell_apart_stay_apart():
    assert twins._identifiers(["a_b", "a_b_2", "a b", "a/b", "c"]) == ["a_b", "a_b_2", "a_b_", "a_b__", "c"]


def test_what_no_material_can_hold_is_said(field, tmp_path):
    assert wr.interop.write_twin(field, tmp_path / "plain").left_out == ()
    residual = np.full((2, len(field.surface.cells)), np.log(10**0.1))
    parameters = replace(field.parameters, log_gain=np.log(10**0.35))
    rich = replace(
        field, parameters=parameters, residual=residual, effects=replace(field.effects, residual=True)
    )
    gain, elements = wr.interop.write_twin(rich, tmp_path / "rich").left_out
    assert "3.50 dB" in gain
    assert "1.00 dB" in elements
    about = json.loads((tmp_path / "rich" / "materials.json").read_text())["about"]
    assert gain in about
    through = replace(field.parameters, log_through=np.full(3, np.log(0.1)))
    passing = replace(
        field, parameters=through, effects=replace(field.effects, transmissions=1, diffractions=1)
    )
    slabs, edges = wr.interop.write_twin(passing, tmp_path / "passing").left_out
    assert "10.00 dB" in slabs and "edges" in edges
    (air,) = wr.interop.write_twin(field.with_gas(True), tmp_path / "air").left_out
    assert "absorption by the air, 0.00525 dB/m" in air
    alike = replace(field, parameters=replace(field.parameters, reciprocal=True))
    assert "reciprocity" in wr.interop.write_twin(alike, tmp_path / "alike").left_out[0]


def test_a_reciprocal_lobe_becomes_the_nearest_of_the_other_kind():
    assert twins.project_lobes((0,), np.ones(1), reciprocal=True) == (0, 0.0)  # Lambertian lobes are both
    found, error = twins.project_lobes((0, 12), np.array([0.0, 0.3]), reciprocal=True)
    assert 6 < found < 24
    assert 0.3 < error < 2.0


def test_an_earlier_twin_is_replaced_and_nothing_else(field, tmp_path):
    folder = tmp_path / "twin"
    folder.mkdir()
    wr.interop.write_twin(field, folder)
    darker = replace(field.parameters, log_excess=field.parameters.log_excess - 1.0)
    wr.interop.write_twin(replace(field, parameters=darker), folder)
    again = wr.Scene.load(folder / "scene.xml")
    assert again.materials[0].permittivity(F).real == pytest.approx(1 + 2 / np.e, rel=2e-3)
    assert [path.name for path in tmp_path.iterdir()] == ["twin"]
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"folder.*notes\.txt"):
        wr.interop.write_twin(field, folder)
    (folder / "notes.txt").unlink()
    (folder / "materials.json").write_text("{")
    with pytest.raises(ValueError, match="no earlier twin"):
        wr.interop.write_twin(field, folder)
    with pytest.raises(ValueError, match=r"file .*materials\.json"):
        wr.interop.write_twin(field, folder / "materials.json")


@pytest.mark.parametrize("what", ["disk full", "stale handle"])
def test_a_failed_write_leaves_the_earlier_twin(what, field, tmp_path, monkeypatch):
    folder, rename = tmp_path / "twin", Path.rename
    wr.interop.write_twin(field, folder)
    before = (folder / "scene.xml").read_bytes()

    def failing(self, target, *_):
        if what == "disk full" or (Path(target) == folder and "earlier" not in self.name):
            raise OSError(what)
        return rename(self, target)

    monkeypatch.setattr(*((twins, "write_mesh") if what == "disk full" else (Path, "rename")), failing)
    with pytest.raises(OSError, match=what):
        wr.interop.write_twin(field, folder)
    assert (folder / "scene.xml").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["twin"]


def test_fields_without_materials_are_refused(field, tmp_path):
    with pytest.raises(TypeError, match="field.*RadioField"):
        wr.interop.write_twin(object(), tmp_path / "twin")
    with pytest.raises(ValueError, match="line of sight alone"):
        wr.interop.write_twin(replace(field, effects=Effects(mirrors=0, scatterings=0)), tmp_path / "x")
    assert list(tmp_path.iterdir()) == []

"""Absorption by the air in simulated spectra and in fields: closed forms of every path's length, files, and fits.

At 380.2 GHz, on a line of water vapour, standard air takes 0.3 dB a metre: enough to see in any total.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from furnished import RECEIVERS, SHAPE, TX
from radio_scenes import RadioScene, SlabMaterial, joined

from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.exact import ExactEngine
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.paths.trace import trace_paths
from warprrf.rf.relevance.model import full_field
from warprrf.rf.simulate import simulate
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.metrics import evaluate
from warprrf.rf.spectra.spectrum import to_db
from warprrf.rf.tracing.model import SETS, Effects, Parameters
from warprrf.rf.tracing.records import Materials
from warprrf.rf.tracing.surface import Surface

F = 380.2e9
WAVELENGTH = SPEED_OF_LIGHT / F
AIR = Air()
LOSS = AIR.attenuation_db_per_m(F)  # dB a metre
RECEIVERS = RECEIVERS[:8]
BLOCKED, SEEN = RECEIVERS[0], RECEIVERS[4]
SINGLE = replace(SETS["single"], residual=False)


def spectra(scene, **options):
    return simulate(
        scene, transmitter=TX, frequency_hz=F, shape=SHAPE, beam_sigma_rad=np.radians(5.0), floor=1e-14,
        **({"receivers": RECEIVERS} | options),
    )  # fmt: skip


@pytest.fixture(scope="module")
def dry(scene):
    return spectra(scene)


@pytest.fixture(scope="module")
def humid(scene):
    return spectra(scene, gas=True)


def passed(length_m):
    return 10.0 ** (-LOSS * np.asarray(length_m) / 10.0)


def friis(place):
    return (WAVELENGTH / (4.0 * np.pi * np.linalg.norm(place - TX))) ** 2


def engine(scene, gas):
    return ExactEngine(scene, transmitter=TX, frequency_hz=F, shape=SHAPE, gas=gas)


def test_line_of_sight_is_friis_times_gas_and_mirrors_have_their_images_length(scene):
    distance = np.linalg.norm(SEEN - TX)
    with_air, without = engine(scene, True), engine(scene, False)
    direct = with_air.mirrors.trace(SEEN, 0).with_gas(with_air.air).power.sum()
    assert direct == pytest.approx(friis(SEEN) * passed(distance), rel=1e-12)
    mirrors = without.mirrors.trace(SEEN, 1)
    mirrors = mirrors.select(mirrors.kind == "mirror")
    assert len(mirrors.gain) >= 6
    expected = direct + (mirrors.power * passed(mirrors.length_m)).sum() + with_air.diffuse(SEEN).power.sum()
    assert with_air.receive(SEEN).path_gain.sum() == pytest.approx(expected, rel=1e-9)


def test_every_scattered_path_has_its_own_length(scene):
    with_air, without = engine(scene, True).diffuse(BLOCKED), engine(scene, False).diffuse(BLOCKED)
    np.testing.assert_array_equal(with_air.direction, without.direction)
    point = TX + without.departure
    length = np.linalg.norm(point - TX, axis=1) + np.linalg.norm(point - BLOCKED, axis=1)
    assert np.ptp(length) > 3.0
    np.testing.assert_allclose(with_air.power, without.power * passed(length), rtol=1e-12)


def test_off_is_off_and_files_say_which(scene, dry, humid, tmp_path):
    some: dict = {"receivers": RECEIVERS[:2], "workspace": tmp_path}
    off = spectra(scene, gas=False, **some)
    np.testing.assert_array_equal(off.path_gain, dry.path_gain[:2])
    assert off.air is None
    assert not [name for name in off.attributes if name.startswith("air")]
    # finished receivers of dry air are not taken for those of another
    thick = Air(water_vapour_g_m3=15.0)
    on = spectra(scene, gas=thick, **some)
    assert (on.path_gain.sum(axis=(1, 2)) < humid.path_gain[:2].sum(axis=(1, 2))).all()
    again = spectra(scene, gas=thick, **some | {"receivers": RECEIVERS[1::-1]})  # order plays no part
    np.testing.assert_array_equal(again.path_gain[::-1], on.path_gain)
    on.save(tmp_path / "on.nc")
    assert SpectrumDataset.load(tmp_path / "on.nc").air == thick == on.subset([1, 0]).air


def test_a_slab_delays_waves_but_is_no_longer_way_through_air():
    """A pane of 5 cm makes the path 6 cm longer in time, not in space; nor do paths given the air later, or other frequencies."""
    pane = np.array([[0.0, -2.0, -2.0], [0.0, 2.0, -2.0], [0.0, 2.0, 2.0], [0.0, -2.0, 2.0]])
    scene = RadioScene(
        Mesh(pane, [[0, 1, 2], [0, 2, 3]]), np.zeros(2, int), [SlabMaterial("pane", 5.0, 0.0, 0.05)]
    )
    ends = {
        "transmitter": [-1.0, 0.1, 0.2],
        "receivers": [[1.5, -0.2, 0.0], [2.0, 0.0, 0.1]],
        "frequency_hz": F,
    }
    off, on = (trace_paths(scene, **ends, mirror_order=0, transmissions=1, gas=gas) for gas in (False, True))
    length_m = np.linalg.norm(np.subtract(ends["receivers"], ends["transmitter"]), axis=1, keepdims=True)
    assert (off.kind == "slab").all() and (off.length_m > length_m + 0.05).all()
    np.testing.assert_allclose(on.power, off.power * passed(length_m), rtol=1e-9)
    np.testing.assert_allclose(off[0].with_gas(True).gain, on[0].gain, rtol=1e-9)
    other = np.abs(on.cfr([F - 1e9]) / off.cfr([F - 1e9])).reshape(2, 1) ** 2
    loss = AIR.attenuation_db_per_m(F - 1e9) * length_m
    np.testing.assert_allclose(-10.0 * np.log10(other), loss, rtol=1e-9)


def test_sionnas_paths_lose_by_their_delay(tmp_path):
    from sionna_room import sionna_or_skip, write_scene

    sionna = sionna_or_skip()
    from warprrf.rf.interop.sionna_engine import Sampling

    common = {
        "transmitter": [-5.0, 3.5, 2.7], "frequency_hz": F, "shape": SHAPE,
        "sampling": Sampling(depth=2, samples=20_000),
    }  # fmt: skip
    room = write_scene(tmp_path)
    off, on = (sionna(room, gas=gas, **common).solve([3.0, 4.0, 1.4]) for gas in (False, True))
    np.testing.assert_allclose(on.tau, off.tau, rtol=1e-12)
    assert np.isfinite(off.vertices[..., 0]).sum(axis=1).max() == 2
    np.testing.assert_allclose(on.power, off.power * passed(off.length_m), rtol=1e-9)


def test_a_field_of_line_of_sight_is_friis_times_gas(scene, humid):
    field = BistaticField.prior(scene, humid, effects=Effects(mirrors=0, scatterings=0))
    assert field.air == AIR
    distance = np.linalg.norm(SEEN - TX)
    expected = friis(SEEN) * passed(distance)
    assert field.spectrum(SEEN).path_gain.sum() == pytest.approx(expected, rel=1e-5)  # the beam is float32
    assert field.links(SEEN[None]).total_path_gain[0] == pytest.approx(expected, rel=1e-12)
    paths = field.paths(SEEN)
    assert paths.power.sum() == pytest.approx(expected, rel=1e-5)
    assert paths.air == AIR
    bare = paths.with_gas(False).power.sum()
    assert bare == pytest.approx(expected / passed(distance), rel=1e-5)


def test_single_bounces_of_a_field_have_their_rays_lengths(scene, dry):
    field = BistaticField.prior(scene, dry, effects=replace(SINGLE, mirrors=2))
    humid = field.with_gas()
    view = field.view(BLOCKED)
    before, after = field.path_gains(view), humid.path_gains(humid.view(BLOCKED))
    lit = before.single > 0
    point = view.hits.points(np.flatnonzero(lit))
    length = np.linalg.norm(point - TX, axis=1) + np.linalg.norm(point - BLOCKED, axis=1)
    np.testing.assert_allclose(after.single[lit], before.single[lit] * passed(length), rtol=1e-5)
    np.testing.assert_allclose(after.specular, before.specular * passed(view.paths.length_m), rtol=1e-12)
    # off again, nothing is left of it
    np.testing.assert_array_equal(
        humid.with_gas(False).spectrum(BLOCKED).path_gain, field.spectrum(BLOCKED).path_gain
    )


def dry_and_humid(field, shape):
    """Views without air and with it, without mirrors, one ray a pixel."""
    each = field, field.with_gas()
    return [one.tracer().on_grid(shape, 1).view(SEEN, Effects(mirrors=0)) for one in each]


def powers_by_ray(view, name, materials):
    """Power of a table's records by the ray that sees them."""
    records = view.traced(Effects())[name]
    return np.bincount(records.ray, records.powers(materials), minlength=len(view.hits.face))


def test_scattered_light_seen_in_a_mirror_has_all_three_legs(scene, dry):
    """And what elements send on evenly has the two from them; with one ray a pixel every ray goes on at mirrors."""
    field = BistaticField.prior(scene, dry)
    mesh, sides = field.surface.mesh, field.surface.side_group
    views = dry_and_humid(field, (12, 24))
    d = views[0].tracer.grid.directions
    first = mesh.cast(SEEN, d)
    normal = mesh.face_normals[first.face]
    turned = d - 2.0 * (d * normal).sum(axis=1, keepdims=True) * normal
    second = mesh.cast(first.point + 1e-4 * turned, turned)
    last = np.linalg.norm(second.point - TX, axis=1)
    materials = Materials(field.parameters, views[0].tracer.slabs, None, sides, np.ones(len(sides)))
    for name, length in (("SM", first.t + second.t + last), ("EM", first.t + second.t)):
        before, after = (powers_by_ray(view, name, materials) for view in views)
        lit = before > 0
        assert lit.sum() > 0.5 * len(lit)
        # the second ray starts 2 cm off the mirror, which moves few of the points that it meets
        ratio = after[lit] / (before[lit] * passed(length[lit]))
        assert np.abs(10.0 * np.log10(ratio)).max() < 0.06 * LOSS


def test_light_that_mirrors_throw_has_its_images_length(dry):
    """Under a lid above a floor each is lit by the other's image: what a ray sees of that, and what elements get."""

    def sheet(z, up):
        corners = np.array([[-4.0, -4, z], [4, -4, z], [4, 4, z], [-4, 4, z]])
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        return corners, faces if up else faces[:, ::-1]

    mesh, part = joined(sheet(0.0, True), sheet(4.0, False))
    field = BistaticField.prior(RadioScene(mesh, part, [SlabMaterial("floor"), SlabMaterial("lid")]), dry)
    views = dry_and_humid(field, (16, 32))
    materials = Materials(field.parameters, views[0].tracer.slabs)

    def by_image(point):
        lid = point[:, 2:] > 2.0
        return np.linalg.norm(point - np.where(lid, TX * [1, 1, -1], TX * [1, 1, -1] + [0, 0, 8.0]), axis=1)

    before, after = (powers_by_ray(view, "MS", materials) for view in views)
    lit = np.flatnonzero(before)
    assert len(lit) > 300
    point = views[0].hits.points(lit)
    length = by_image(point) + np.linalg.norm(point - SEEN, axis=1)
    np.testing.assert_allclose(after[lit], before[lit] * passed(length), rtol=1e-5)
    onto = [view.tracer.mirrored().onto for view in views]
    before, after = (np.bincount(r.ray, r.powers(materials), field.surface.element_sides) for r in onto)
    lit = np.flatnonzero(before)
    assert len(lit) > 40
    tiles = field.surface.tiles
    centre = np.tile(
        tiles.centre[tiles.middles(field.surface.cells.element[tiles.cell])], (2, 1)
    )  # of both sides
    np.testing.assert_allclose(after[lit] / before[lit], passed(by_image(centre[lit])), rtol=0.02)


def test_two_and_three_bounces_in_a_sphere_have_the_chords_lengths():
    """Chords of a sphere of radius R that a Lambertian surface sees are distributed as c / (2 R^2), and of them
    exp(-a c) has the mean (1 - exp(-2 a R) (1 + 2 a R)) / (2 a^2 R^2); without air the sphere integrates."""
    radius = 2.0
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    surface = Surface.of(Mesh(ball.vertices, ball.faces[:, ::-1]))
    groups = surface.groups
    parameters = Parameters(
        np.full((groups, 1), np.log(0.9)), np.full(groups, np.log(50.0)), np.full(groups, -60.0), lobes=(0,)
    )
    field = BistaticField(
        surface=surface, transmitter=np.array([0.02, 0.0, 0.0]), frequency_hz=F, shape=SHAPE, floor=1e-20,
        range_db=(-200.0, -80.0), beam_sigma_rad=np.radians(5.0), parameters=parameters, material=np.zeros(groups, int),
        residual=np.zeros((2, len(surface.cells))),
        effects=Effects(False, 0, 2, mirror_scatter=False, scatter_mirror=False),
    )  # fmt: skip
    thrice = replace(field, effects=replace(field.effects, scatterings=3))
    receiver = np.array([-0.02, 0.0, 0.0])

    def further(one):
        return float(one.path_gains(one.view(receiver)).by_ray(["E"]).sum())

    two = further(field.with_gas()) / further(field)
    three = (further(thrice.with_gas()) - further(field.with_gas())) / (further(thrice) - further(field))
    a = LOSS * np.log(10.0) / 10.0
    chord = (1.0 - np.exp(-2 * a * radius) * (1.0 + 2 * a * radius)) / (2.0 * (a * radius) ** 2)
    ends = passed(2.0 * radius)
    assert two == pytest.approx(ends * chord, rel=0.01)
    assert three == pytest.approx(ends * chord**2, rel=0.015)
    # Of even light each scattering keeps the share of the surface.
    once = field.path_gains(field.view(receiver)).single.sum()
    kept = further(field) / once, (further(thrice) - further(field)) / further(field)
    np.testing.assert_allclose(kept, parameters.scattered_share[0], rtol=0.015)


def test_a_fit_takes_the_air_out_of_what_it_learns(scene, dry, humid, tmp_path):
    train = humid.subset(np.arange(6))
    field = RadioField.fit(scene, train, effects=SINGLE)
    test = np.arange(6, 8)
    assert field.air == AIR
    assert evaluate(humid.subset(test), field.spectrum)["psnr_db"] > 40
    # materials are those of the scene: without the air they hold for measurements without it
    bare = field.with_gas(False)
    assert evaluate(dry.subset(test), bare.spectrum)["psnr_db"] > 40
    assert evaluate(dry.subset(test), field.spectrum)["psnr_db"] < 37
    field.save(tmp_path / "field.safetensors")
    again = RadioField.load(tmp_path / "field.safetensors")
    assert again.air == AIR
    np.testing.assert_array_equal(again.spectrum(SEEN).path_gain, field.spectrum(SEEN).path_gain)
    bare.save(tmp_path / "bare.safetensors")
    assert RadioField.load(tmp_path / "bare.safetensors").air is None


def test_relevance_judges_the_air_by_itself(scene, humid):
    field = BistaticField.prior(scene, humid)
    assert full_field(field, humid)[0].air is None


@pytest.mark.parametrize("line_of_sight", [None, "explicit"])
def test_a_harmonic_field_has_its_lengths_in_the_law(scene, dry, line_of_sight):
    field = RadioField.fit(
        scene, dry.subset([0, 1]), model="rf3dgs+", iterations=2, line_of_sight=line_of_sight
    )
    humid = field.with_gas()
    before, after = field.spectrum(SEEN), humid.spectrum(SEEN)
    length = before.delay_s * SPEED_OF_LIGHT
    distance = np.linalg.norm(SEEN - TX)
    if line_of_sight is None:
        # around the transmitter delays are the line of sight's, power is the surface's behind it
        own = (np.abs(length - distance) > 1e-9) & (before.path_gain > 0)
        np.testing.assert_allclose(after.path_gain[own], (before.path_gain * passed(length))[own], rtol=1e-5)
    else:
        paths = humid.paths(SEEN)
        assert paths.power[paths.kind == "los"][0] == pytest.approx(friis(SEEN) * passed(distance), rel=1e-9)
        assert paths.air == AIR


def test_a_harmonic_fit_starts_from_gains_without_air(scene, dry, humid):
    chosen = np.arange(6)
    fields = [RadioField.fit(scene, ds.subset(chosen), model="rf3dgs+", iterations=60) for ds in (dry, humid)]
    assert fields[1].air == AIR
    there, here = (to_db(f.with_gas(False).spectrum(BLOCKED).path_gain, dry.floor) for f in fields)
    with_air = to_db(fields[1].spectrum(BLOCKED).path_gain, dry.floor)
    assert np.sqrt(np.mean((there - here) ** 2)) < 0.5 * np.sqrt(np.mean((there - with_air) ** 2))


def test_a_field_without_lengths_keeps_the_air_that_it_learned(scene, humid):
    field = RadioField.fit(scene, humid.subset([0, 1]), model="rf3dgs", iterations=2)
    assert field.air == AIR
    assert field.with_gas(AIR).air == AIR
    with pytest.raises(ValueError, match="rf3dgs field knows no lengths"):
        field.with_gas(False)

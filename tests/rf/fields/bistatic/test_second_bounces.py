"""What follows a first bounce: mirrors of mirrors, surfaces lit by mirrors; and materials that spectra tell apart."""

from dataclasses import replace

import numpy as np
import pytest
from furnished import RECEIVERS, ROOM, SHAPE, TX, F, spectra
from radio_scenes import RadioScene, SlabMaterial, box_mesh, joined, mirror_paths
from warprrf.rf.fields.bistatic.grouping import regroup
from warprrf.rf.fields.bistatic.response import (
    predict,
    respond,
    with_further_bounces,
)
from warprrf.rf.fields.bistatic.scattering import send
from warprrf.rf.fields.bistatic.training import trace
from warprrf.rf.fields.bistatic.transport import Transport

from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.fresnel import fresnel_curves
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.fit import Reading, Target, fit_groups
from warprrf.rf.fields.bistatic.materials import Parameters, Terms
from warprrf.rf.fields.bistatic.measured import SpectrumPixels
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.spectra.beam import BeamOperator
from warprrf.rf.spectra.spectrum import to_db

WAVELENGTH = SPEED_OF_LIGHT / F
RECEIVERS = RECEIVERS[:6]


def test_a_surface_too_small_for_a_mirror_has_line_of_sight_alone() -> None:
    vertices = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    mesh, part = joined((vertices, np.array([[0, 1, 2]])))
    surface = Surface.of(RadioScene(mesh, part, [SlabMaterial()]))
    assert len(surface.plane_offset) == 0
    assert len(mirror_paths(surface, TX, np.array([[1.0, 1, 1]]), WAVELENGTH, 3)) == 1


def plane(z: float, up: bool) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[-4.0, -4, z], [4, -4, z], [4, 4, z], [-4, 4, z]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return corners, faces if up else faces[:, ::-1]


def test_light_that_a_mirror_throws_on_a_floor_comes_from_the_image() -> None:
    """A rough floor under a mirror: besides the transmitter's own light, that of its image behind the mirror."""
    mesh, part = joined(plane(0.0, True), plane(3.0, False))
    both = Surface.of(RadioScene(mesh, part, [SlabMaterial("floor"), SlabMaterial("mirror")]))
    mesh, part = joined(
        plane(0.0, True), plane(6.0, False)
    )  # a black lid far above, to have room for the image
    alone = Surface.of(RadioScene(mesh, part, [SlabMaterial("floor"), SlabMaterial("lid")]))
    receiver, transmitter = np.array([1.0, -0.5, 1.2]), np.array([-0.7, 0.4, 1.6])
    image = np.array([-0.7, 0.4, 4.4])
    nothing = -60.0
    lobes = (0, 5)
    weight = np.array([[np.log(0.2), np.log(0.3)], [nothing, nothing]])

    def field(surface: Surface, source: np.ndarray, **terms: object) -> BistaticField:
        return BistaticField(
            surface=surface, transmitter=source, frequency_hz=F, shape=SHAPE, floor=1e-20, range_db=(-200.0, -80.0),
            beam_sigma_rad=np.radians(5.0), terms=Terms(mirror_order=0, line_of_sight=False, lobes=lobes, **terms),
            parameters=Parameters(
                weight, np.array([np.log(4.0), np.log(199.0)]), np.array([nothing, 0.0]), np.full(2, -np.inf)
            ),
            material=np.arange(2), residual=np.zeros((2, surface.cells)),
        )  # fmt: skip

    lit = field(both, transmitter, mirror_scatter=True)
    dark = field(both, transmitter)
    seen = lit.view(receiver)
    extra = lit.render(seen).image - dark.render(seen).image
    wanted = field(alone, image).spectrum(receiver).path_gain
    # The mirror keeps what its Fresnel curve says, which hardly depends on the angle up to 60 degrees.
    reflected = fresnel_curves().value(np.full(2, np.log(199.0)), np.array([0.5, 1.0]))[0]
    below = slice(17, None)  # rows that look down steeply: their pixels' four rays meet the floor well inside
    ratio = extra[below] / wanted[below]
    assert 0.97 * reflected.min() < np.median(ratio) < 1.03 * reflected.max()
    assert 0.9 * reflected.min() < ratio.min() and ratio.max() < 1.1 * reflected.max()
    assert 0.97 * reflected.min() < extra.sum() / wanted.sum() < 1.03 * reflected.max()
    assert lit.render(seen).further.sum() == pytest.approx(extra.sum(), rel=1e-6)


@pytest.mark.usefixtures("device")
def test_what_groups_send_on_adds_up(scene: RadioScene) -> None:
    surface = Surface.of(scene)
    ds = spectra(scene, RECEIVERS[:1])
    terms = Terms(mirror_scatter=True, diffuse_order=3)
    field = BistaticField.prior(surface, ds, terms=terms)
    view, beam = field.view(RECEIVERS[0]), BeamOperator(SHAPE, np.radians(5.0))
    measured = SpectrumPixels(beam, np.arange(SHAPE[0] * SHAPE[1]))
    bare, sent = respond(view, measured, terms, ds.floor), field.sent_radiance(view.transport)
    follows, held = (
        with_further_bounces(bare, view, measured, field.materials, sent, ds.floor, follow=follow)
        for follow in (True, False)
    )
    whole = beam(field.render(view).further).ravel() / ds.floor
    assert not follows.offset.any()
    share = field.parameters.scattered_share[follows.sender]
    assert np.allclose(share @ follows.sent, whole, rtol=1e-4, atol=1e-7 * whole.max())
    assert np.allclose(held.offset, whole, rtol=1e-4, atol=1e-7 * whole.max())


MATERIALS = [
    SlabMaterial("walls", 3.0, 0.5, np.inf, 0.4, "directive", 5),
    SlabMaterial("one", 6.0, 0.5, np.inf, 0.8),
    SlabMaterial("two", 6.0, 0.5, np.inf, 0.8),
]


@pytest.fixture(scope="module")
def scene() -> RadioScene:
    mesh, part = joined(
        ROOM,
        box_mesh([2.2, 1.6, 0.0], [3.0, 2.4, 1.4]),
        box_mesh([3.4, 0.8, 0.0], [4.0, 1.4, 1.0]),
    )
    return RadioScene(mesh, part, MATERIALS)


@pytest.fixture(scope="module")
def readings(scene: RadioScene) -> list[Reading]:
    ds = spectra(scene, RECEIVERS)
    target = to_db(ds.path_gain, ds.floor) - 10 * np.log10(ds.floor)
    measured = SpectrumPixels(BeamOperator(SHAPE, np.radians(5.0)), np.arange(SHAPE[0] * SHAPE[1]))
    return [
        Reading(respond(view, measured, Terms(), ds.floor), Target(t.ravel()))
        for view, t in zip(trace(scene, ds).views, target, strict=True)
    ]


def test_spectra_join_groups_of_one_material_and_no_others(
    readings: list[Reading], scene: RadioScene
) -> None:
    area = np.bincount(scene.face_material, scene.mesh.areas)
    separate = fit_groups(readings, Parameters.prior(3, 5), area)
    alike = np.zeros((3, 4))  # all look the same
    material, parameters = regroup(readings, separate.parameters, np.arange(3), alike, area)
    assert material[1] == material[2] != material[0]
    assert len(parameters.log_excess) == 2
    # and a group that was put with the wrong material goes over
    mixed = np.array([0, 1, 0])
    again = fit_groups([r.tied(mixed) for r in readings], parameters, np.bincount(mixed, area))
    moved, _ = regroup(readings, again.parameters, mixed, alike, area)
    assert moved[2] == moved[1] != moved[0]


def test_looks_that_differ_keep_apart_what_spectra_cannot_tell(
    readings: list[Reading], scene: RadioScene
) -> None:
    dark = [
        Reading(replace(r.response, bounce=0 * r.response.bounce), Target(np.zeros_like(r.target.db)))
        for r in readings
    ]
    area = np.bincount(scene.face_material, scene.mesh.areas)
    look = np.array([[0.0, 0, 0, 0], [0.1, 0, 0, 0], [9.0, 0, 0, 0]])
    material, _ = regroup(dark, Parameters.prior(3, 5), np.arange(3), look, area)
    assert material[0] == material[1]  # nothing speaks against it


def test_tied_responses_predict_the_same(readings: list[Reading]) -> None:
    rng = np.random.default_rng(0)
    owner = np.array([0, 1, 1])
    p = Parameters(
        rng.normal(-2, 0.5, (2, 5)), rng.normal(1, 0.3, 2), rng.normal(-1, 0.3, 2), rng.normal(-3, 0.2, 2)
    )
    for reading in readings:
        light = rng.uniform(0, 5, (2, len(reading.response.offset))).astype(np.float32)
        response = replace(reading.response, sender=np.array([0, 2]), sent=light)
        assert np.allclose(predict(response, p.take(owner)), predict(response.tied(owner), p), rtol=1e-5)


def test_an_even_radiance_all_around_arrives_from_the_whole_sphere() -> None:
    """In a closed room whose surfaces send L evenly, the sum over pixels is (lambda / 4 pi)^2 4 pi L."""
    surface, shape = Surface.of(Mesh(*ROOM)), (12, 24)
    radiance = 0.7
    for sub_pixels in (1, 3):
        transport = Transport.of(surface, TX, F, shape, sub_pixels)
        view = transport.view(RECEIVERS[0], Terms(mirror_order=0))
        power = send(transport, view.hits, np.full(surface.element_sides, radiance))
        assert power.sum() == pytest.approx(
            (WAVELENGTH / (4.0 * np.pi)) ** 2 * 4.0 * np.pi * radiance, rel=1e-6
        )
        assert (power.reshape(-1, sub_pixels**2).sum(axis=1) > 0).all()

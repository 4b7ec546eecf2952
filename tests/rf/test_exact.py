"""Single-bounce scattering against closed forms, the formula written out in NumPy, and conservation laws."""

import numpy as np
import pytest
from radio_scenes import RadioScene, SlabMaterial, box_mesh, square

from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.fresnel import lobe, slab_reflection
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.exact import ExactEngine
from warprrf.rf.spectra.spectrum import pixel_of, pixel_solid_angles

F = 300e9
WAVELENGTH = SPEED_OF_LIGHT / F
SHAPE = (60, 120)
LOW, HIGH = np.array([-7.0, -6, 0]), np.array([8.0, 6, 4])
TX, RX = np.array([-5.0, 3.5, 2.7]), np.array([3.0, -2.0, 1.4])


def engine(scene, transmitter=TX, **options):
    return ExactEngine(scene, **{"transmitter": transmitter, "frequency_hz": F, "shape": SHAPE, **options})


def one_material(mesh, material):
    return RadioScene(mesh, np.zeros(len(mesh.faces), dtype=int), [material])


def conductor(**options):
    return SlabMaterial(relative_permittivity=1.0, conductivity=1e13, **options)


def room(material):
    return one_material(Mesh(*box_mesh(LOW, HIGH, inward=True)), material)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize(("h1", "h2", "apart"), [(1.5, 1.0, 3.0), (2.5, 1.0, 8.0), (0.5, 3.0, 0.0)])
def test_infinite_lambertian_conductor(h1, h2, apart):
    # Total diffuse power: (lambda / 4 pi D)^2 S^2 2 cos(theta_img), D the image distance, cos = (h1 + h2) / D.
    scene = one_material(Mesh(*square(3000.0)), conductor(scattering=0.7))
    power = engine(scene, [0.0, 0.0, h1]).diffuse(np.array([apart, 0.3, h2])).power.sum()
    d = np.linalg.norm([apart, 0.3, h1 + h2])
    assert power == pytest.approx((WAVELENGTH / (4 * np.pi * d)) ** 2 * 0.49 * 2 * (h1 + h2) / d, rel=1e-3)


def test_a_surface_close_to_the_transmitter_scatters_all_that_it_gets():
    scene, near_m = one_material(Mesh(*square(3000.0)), conductor(scattering=1.0)), 0.02
    power = engine(scene, [0.0, 0.0, near_m]).diffuse(np.array([1.0, 0.3, 1.0])).power.sum()
    d = np.linalg.norm([1.0, 0.3, 1.0 + near_m])
    expected = (WAVELENGTH / (4 * np.pi * d)) ** 2 * 2 * (1.0 + near_m) / d
    assert power == pytest.approx(expected, rel=0.05)  # some tens of rays meet what is lit most


@pytest.mark.parametrize(
    "material",
    [
        SlabMaterial(scattering=0.6),
        SlabMaterial("glass", 6.0, 5.0, 0.01, 0.3, "directive", 10),
        SlabMaterial("board", 1.5, 1.0, 0.002, 0.9, "directive", 5),
        SlabMaterial("thick", 2.0, 0.0, np.inf, 0.9, "directive", 1),
        SlabMaterial("metal", 1.0, 1e7, 0.002, 0.25, "directive", 10),
        SlabMaterial("both ways", 3.0, 0.5, 0.02, 0.5, "directive", 12, reciprocal=True),
    ],
)
def test_every_path_follows_the_scattering_formula(material):
    e = engine(room(material))
    found = e.diffuse(RX)
    assert len(found.power) == 64 * SHAPE[0] * SHAPE[1]  # all of an empty convex room is lit
    some = slice(None, None, 29 if material.reciprocal else 1)  # that lobe's norm takes its time
    index, d, power = (x[some] for x in (np.arange(len(found.power)), found.direction, found.power))
    length = np.linalg.norm(found.departure[some] + TX - RX, axis=1)  # of the last leg
    point = RX + length[:, None] * d
    with np.errstate(divide="ignore"):
        exits = np.where(d > 0, (HIGH - RX) / d, (LOW - RX) / d)
    np.testing.assert_allclose(length, exits.min(axis=1), rtol=1e-12)
    normal = -np.sign(d) * np.eye(3)[exits.argmin(axis=1)]
    to_tx = TX - point
    d1 = np.linalg.norm(to_tx, axis=1)
    cos_i, cos_s = (normal * to_tx).sum(axis=1) / d1, -(normal * d).sum(axis=1)
    mirror = 2 * cos_i[:, None] * normal - to_tx / d1[:, None]
    cosines = (cos_i, cos_s) if material.reciprocal else (cos_i,)
    gamma = np.mean(
        [
            np.abs(r) ** 2
            for c in cosines
            for r in slab_reflection(c, material.permittivity(F), material.thickness_m, WAVELENGTH)
        ],
        axis=0,
    )
    alpha = 0 if material.pattern == "lambertian" else material.alpha_r
    f_s = lobe(alpha, cos_i, cos_s, -(mirror * d).sum(axis=1), reciprocal=material.reciprocal)
    omega = np.repeat(pixel_solid_angles(SHAPE), SHAPE[1])[index // 64] / 64
    free = (WAVELENGTH / (4 * np.pi * d1)) ** 2
    expected = free * material.scattering**2 * gamma * f_s * cos_i / cos_s * omega
    # Away from grazing, where the average of 1 / cos over the sub-pixel is 1 / cos.
    clear = cos_s > 0.2
    np.testing.assert_allclose(power[clear], expected[clear], rtol=2e-4 if alpha else 1e-9)
    assert (power < 3 * expected.max()).all()


def wall_integral(material, rx):
    """Diffuse path gain of the empty room, integrated over its walls, finer towards the foot of ``rx``."""
    total = 0.0
    for axis in range(3):
        for wall, sign in ((LOW, 1.0), (HIGH, -1.0)):
            u, v = (k for k in range(3) if k != axis)
            height = abs(wall[axis] - rx[axis])
            points, weights = np.zeros((700, 700, 3)), np.ones((700, 700))
            points[..., axis] = wall[axis]
            for k, form in ((u, (700, 1)), (v, (1, 700))):
                ends = np.arcsinh((np.array([LOW[k], HIGH[k]]) - rx[k]) / height)
                step = (ends[1] - ends[0]) / 700
                grade = (ends[0] + (np.arange(700) + 0.5) * step).reshape(form)
                points[..., k] = rx[k] + height * np.sinh(grade)
                weights *= height * np.cosh(grade) * step
            normal = sign * np.eye(3)[axis]
            to_tx, to_rx = TX - points, rx - points
            d1, d2 = np.linalg.norm(to_tx, axis=-1), np.linalg.norm(to_rx, axis=-1)
            cos_i = to_tx @ normal / d1
            mirror = 2 * cos_i[..., None] * normal - to_tx / d1[..., None]
            te, tm = slab_reflection(cos_i, material.permittivity(F), material.thickness_m, WAVELENGTH)
            f_s = lobe(material.alpha_r, cos_i, to_rx @ normal / d2, (mirror * to_rx).sum(axis=-1) / d2)
            gamma = 0.5 * (np.abs(te) ** 2 + np.abs(tm) ** 2)
            total += (gamma * f_s * cos_i / (d1 * d2) ** 2 * weights).sum()
    return (WAVELENGTH / (4 * np.pi)) ** 2 * material.scattering**2 * total


@pytest.mark.parametrize("rx", [RX, [3.0, -2.0, 0.02], [7.97, 3.0, 1.0]])
def test_directive_power_is_the_integral_over_the_walls_even_2_cm_from_one(rx):
    material = SlabMaterial(scattering=0.9, pattern="directive", alpha_r=10)
    power = engine(room(material)).diffuse(np.array(rx)).power.sum()
    assert power == pytest.approx(wall_integral(material, np.array(rx)), rel=1e-3)


def test_the_spectrum_holds_all_power_and_exact_delays():
    e = engine(room(SlabMaterial(scattering=0.5)))
    got = e.receive(RX)
    assert got.line_of_sight
    specular, d = e.mirrors.trace(RX, 1), np.linalg.norm(TX - RX)
    assert got.path_gain.sum() == pytest.approx(specular.power.sum() + e.diffuse(RX).power.sum(), rel=1e-12)
    assert specular.power[0] == pytest.approx((WAVELENGTH / (4 * np.pi * d)) ** 2, rel=1e-12)
    row, column = pixel_of(TX - RX, SHAPE)
    assert got.delay_s[row, column] == pytest.approx(d / SPEED_OF_LIGHT, rel=1e-12)
    departure = RX - TX
    expected = np.arccos(departure[2] / d), np.arctan2(departure[1], departure[0])
    np.testing.assert_allclose(got.aod[row, column], expected, atol=1e-12)
    image = TX * [1, 1, -1]
    row, column = pixel_of(image - RX, SHAPE)
    assert got.delay_s[row, column] == pytest.approx(np.linalg.norm(image - RX) / SPEED_OF_LIGHT, rel=1e-12)
    np.testing.assert_array_equal(np.isnan(got.delay_s), got.path_gain == 0)


def test_nothing_arrives_where_nothing_scatters():
    scene = one_material(Mesh(*square(50.0, -2.0)), SlabMaterial(scattering=0.5))
    got = engine(scene, [0.0, 0, 5]).receive([3.0, 0, 5])
    assert got.path_gain[: SHAPE[0] // 3].sum() == 0 and np.isnan(got.delay_s[0, 0])

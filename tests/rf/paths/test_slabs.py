"""Ways through slabs: sheets and solids, however they are drawn, and what surfaces scatter before and behind them."""

from dataclasses import replace

import numpy as np
import pytest
from radio_scenes import box_mesh, joined
from scipy.spatial.transform import Rotation
from trimesh.remesh import subdivide

from warprrf.geometry.mesh import Mesh
from warprrf.kernels.radio.records import EDGE, MIRROR
from warprrf.rf.em.fresnel import slab_passage, slab_reflection, slab_transmission
from warprrf.rf.em.materials import Material, itu_material
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.exact import ExactEngine, together
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.paths.trace import trace_paths
from warprrf.rf.relevance.model import full_field
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.tracing.model import Effects
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import Tracer

F, TX, RX = 28e9, np.array([-2.0, 0.0, 1.5]), np.array([2.0, 0.4, 1.2])
FLOOR = np.array([[-6, -6, 0], [6, -6, 0], [6, 6, 0], [-6, 6, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]])
FLOORING = Material.custom("floor", relative_permittivity=3.0, conductivity=0.5, scattering=0.8)
GLASS = itu_material("glass", thickness_m=0.01)


def pane(x):
    corners = [[x, y, z] for y, z in ((-6, 0.001), (6, 0.001), (6, 6), (-6, 6))]
    return np.array(corners), np.array([[0, 1, 2], [0, 2, 3]])


def room(wall, glass=GLASS):
    """A floor that scatters, and a wall across it."""
    mesh, part = joined(FLOOR, wall)
    return Scene(mesh, [FLOORING, glass], part)


def paths(scene, ends=(TX, RX), most=3, **options):
    return trace_paths(
        scene,
        transmitter=ends[0],
        receivers=ends[1],
        frequency_hz=F,
        mirror_order=1,
        transmissions=most,
        **options,
    )


pytestmark = [
    pytest.mark.filterwarnings("ignore:28 GHz"),  # that diffraction is not asked for
    pytest.mark.filterwarnings("ignore:mesh"),  # that faces lie on others
]


SHEET = room(pane(1.0))
thick = replace(GLASS, thickness_m=0.3)  # said of a solid, it does not count
CORNERS, FACES = box_mesh([1.0, -6.0, 0.001], [1.01, 6.0, 6.0])
EAST = Mesh(CORNERS, FACES).face_normals[:, :1] > 0.5
CUT = np.concatenate(
    [[[0, 1, 9], [0, 9, 8], [8, 9, 3], [8, 3, 2]], FACES[2:]]
)  # the west side, of another one's edges
AGAIN, PART = joined(FLOOR, (CORNERS, FACES), (CORNERS, FACES[:, ::-1]))


def sides():
    """The solid, its sides cut into pieces whose corners do not meet."""
    parts = []
    for k in range(6):
        parts.append((CORNERS, FACES[2 * k : 2 * k + 2]))
        for _ in range(k // 2):
            parts[-1] = subdivide(*parts[-1])
    mesh = joined(*parts)[0]
    return mesh.vertices, mesh.faces


FINER, PART_OF_FINER = joined(FLOOR, subdivide(CORNERS, np.roll(FACES, 1, axis=0)), (CORNERS, FACES[::-1]))
WALLS = {
    "solid": room((CORNERS, FACES), thick),
    "solid, wound either way": room((CORNERS, np.where(EAST, FACES[:, ::-1], FACES)), thick),
    "solid, cut on one side": room((np.vstack([CORNERS, [[1.0, 0.0, 0.001], [1.0, 0.0, 6.0]]]), CUT), thick),
    "solid, each side cut by itself": room(sides(), thick),
    "solid, doubled": Scene(AGAIN, [FLOORING, thick], np.minimum(PART, 1)),
    "solid, doubled of another material": Scene(AGAIN, [FLOORING, thick], PART % 2),
    "solid, covered by finer faces": Scene(FINER, [FLOORING, thick], np.minimum(PART_OF_FINER, 1)),
    "turned": room((pane(1.0)[0], pane(1.0)[1][:, ::-1])),
    "doubled": room((pane(1.0)[0], np.concatenate([pane(1.0)[1], pane(1.0)[1][:, ::-1]]))),
    "cut up": room(
        (np.vstack([pane(1.0)[0], [[1.0, 0, 3]]]), np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]))
    ),
}  # fmt: skip


@pytest.mark.parametrize("how", WALLS)
def test_one_wall_lets_the_same_through_however_it_is_drawn(how):
    expected, found = paths(SHEET), paths(WALLS[how])
    assert found.kind.tolist() == expected.kind.tolist() == ["slab", "slab"]
    np.testing.assert_allclose(found.gain, expected.gain, rtol=1e-9)
    np.testing.assert_allclose(found.tau, expected.tau, rtol=1e-12)


@pytest.mark.parametrize("thickness_m", [1.2e-4, 2.5e-4, 4e-4])
def test_a_solid_thinner_than_a_ray_s_step_is_as_thick_as_it_is(thickness_m):
    """What is 0.3 mm thick or less was taken for a sheet as thick as its material is said to be, 0.3 m here."""
    vertices, faces = box_mesh([1.0, -6.0, 0.001], [1.0 + thickness_m, 6.0, 6.0])
    turned = Rotation.from_rotvec([0.2, 0.1, 0.7]).as_matrix()
    sheet = Mesh(pane(1.0)[0] @ turned.T, pane(1.0)[1])
    lossy = Material.custom("film", relative_permittivity=4.0, conductivity=0.5, thickness_m=thickness_m)
    found, expected = (
        trace_paths(
            Scene(mesh, [material], np.zeros(len(mesh.faces), int)), transmitter=turned @ TX, receivers=turned @ RX,
            frequency_hz=F, mirror_order=0, transmissions=1,
        )
        for mesh, material in ((Mesh(vertices @ turned.T, faces), replace(lossy, thickness_m=0.3)), (sheet, lossy))
    )  # fmt: skip
    assert found.kind.tolist() == expected.kind.tolist() == ["slab"]
    np.testing.assert_allclose(found.gain, expected.gain, rtol=1e-6)


@pytest.mark.parametrize("how", ["solid", "doubled"])
def test_a_wall_of_unknown_material_is_as_late_however_it_is_drawn(how):
    """A field assumes what such a wall absorbs; of its delay it knows nothing."""
    effects = Effects(mirrors=0, scatterings=0, transmissions=1, diffractions=0)
    frame = SpectrumDataset.empty(transmitter=TX, frequency_hz=F, shape=(12, 24))
    found = []
    for scene in SHEET, WALLS[how]:
        nameless = Scene(scene.mesh, [FLOORING, Material("partition", ())], scene.face_material)
        found.append(BistaticField.prior(nameless, frame, effects=effects).paths(RX))
    assert found[0].kind.tolist() == found[1].kind.tolist() == ["slab"]
    np.testing.assert_allclose(found[1].tau, found[0].tau, rtol=1e-9)
    np.testing.assert_allclose(found[1].power, found[0].power, rtol=1e-6)


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("turn", [0.0, 1e-3, -1e-3, 0.4])
def test_a_corner_lets_the_same_through_however_it_is_turned(turn, swapped):
    """Faces at right angles are two sheets: rounding of the angle between them does not decide."""
    vertices, faces = box_mesh([-0.1, -2.0, 0.0], [0.1, 0.01, 3.0])
    turned = Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
    scene = Scene(Mesh(vertices @ turned.T, faces), [GLASS], np.zeros(len(faces), np.int32))
    ends = np.array([[-2.0, -1.0, 1.5], [2.0, 1.0, 1.5]])[:: -1 if swapped else 1] @ turned.T
    found = trace_paths(
        scene, transmitter=ends[0], receivers=ends[1], frequency_hz=F, mirror_order=0, transmissions=2
    )
    assert found.interactions[:, :2].tolist() == [[4, 4]]
    eta, wavelength_m = GLASS.permittivity(F), SPEED_OF_LIGHT / F
    front, side = (slab_transmission(c / 5**0.5, eta, 0.01, wavelength_m) for c in (2.0, 1.0))
    power = 0.5 * sum(np.abs(a * b) ** 2 for a, b in zip(front, side, strict=True))
    free = SPEED_OF_LIGHT / F / (4 * np.pi * np.linalg.norm(ends[1] - ends[0]))
    assert found.power[0] == pytest.approx(power * free**2, rel=1e-6)


def test_a_solid_one_metre_thick_is_one_slab_wherever_it_stands():
    """More is two sheets: rounding of coordinates does not decide."""
    rng, (vertices, faces) = np.random.default_rng(0), box_mesh([-0.5, -2.0, -2.0], [0.5, 2.0, 2.0])
    for turn, shift in zip(Rotation.random(8, rng=0).as_matrix(), rng.uniform(-50, 50, (8, 3)), strict=True):
        scene = Scene(Mesh(vertices @ turn.T + shift, faces), [GLASS], np.zeros(len(faces), np.int32))
        ends = np.array([[-2.0, 0.3, 0.1], [2.0, -0.2, 0.4]]) @ turn.T + shift
        assert paths(scene, ends).interactions[0].tolist() == [4, 0, 0, 0]


def test_five_panes_let_through_what_each_does():
    """A floor of offices has as many between two ends; one of them asked for too few, and nothing arrives."""
    panes, part = joined(*(pane(x) for x in np.linspace(-1.0, 1.0, 5)))
    row = Scene(panes, [GLASS], np.zeros(len(panes.faces), np.int32))
    straight, once = (
        p.select(p.interactions.max(axis=1) == 4) for p in (paths(row, most=5), paths(SHEET, most=1))
    )
    straight, once = (p.select(p.vertices[:, 0, 2] > 0.5) for p in (straight, once))
    free = SPEED_OF_LIGHT / F / (4 * np.pi * np.linalg.norm(RX - TX))
    assert straight.interactions[0, :5].tolist() == [4] * 5 and len(straight.tau) == 1
    through, of_one = (np.linalg.svd(p.jones[0] / free, compute_uv=False) for p in (straight, once))
    np.testing.assert_allclose(through, of_one**5, rtol=1e-9)
    assert len(paths(row, most=4).tau) == 0
    with pytest.raises(ValueError, match="transmissions"):
        paths(row, most=9)


def test_a_path_through_a_slab_is_what_the_slab_transmits_and_later():
    """Amplitude, and the phase of the whole way: that of air but over the slab, and of the slab's transmission."""
    found = paths(SHEET)
    way = RX - TX
    length, cosine = np.linalg.norm(way), way[0] / np.linalg.norm(way)
    eta, wavelength_m = GLASS.permittivity(F), SPEED_OF_LIGHT / F
    te, tm = slab_transmission(cosine, eta, 0.01, wavelength_m)
    k = 2 * np.pi / wavelength_m
    rest = np.exp(-1j * k * (length - 0.01 * cosine)) * wavelength_m / (4 * np.pi * length)
    assert found.gain[0] == pytest.approx(
        rest * te / abs(te) * np.sqrt((abs(te) ** 2 + abs(tm) ** 2) / 2), rel=1e-9
    )
    assert found.tau[0] - length / SPEED_OF_LIGHT == pytest.approx(
        slab_passage(cosine, eta, 0.01, wavelength_m)[2] / SPEED_OF_LIGHT
    )
    assert found.tau[0] > length / SPEED_OF_LIGHT


def test_ways_through_slabs_are_the_same_both_ways_and_as_many_as_asked_for():
    mesh, part = joined(FLOOR, pane(0.5), pane(1.0))
    scene = Scene(mesh, [FLOORING, GLASS], np.minimum(part, 1))
    there, back = paths(scene), paths(scene, (RX, TX))
    np.testing.assert_allclose(there.gain, back.gain, rtol=1e-9)
    assert (there.interactions == 4).sum(axis=1).tolist() == [2, 2]
    assert len(paths(scene, most=1).tau) == 0
    metal = replace(itu_material("metal"), thickness_m=0.001)
    assert len(paths(room(pane(1.0), metal)).tau) == 0


def test_free_paths_come_first_then_those_through_slabs_each_by_order_and_length():
    """Slabs delay: by their delays paths of one order stand otherwise."""
    scene, order = room(pane(1.0), replace(GLASS, thickness_m=0.05)), []
    mesh = joined(FLOOR, pane(1.0), pane(3.0))
    found = paths(Scene(mesh[0], scene.materials, np.minimum(mesh[1], 1)), (TX, RX), diffractions=1)
    for over, met, *way in zip(found.kind == "edge", found.interactions, found.vertices, strict=True):
        points = np.vstack([TX, way[0][met > 0], RX])
        length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        order.append((over, (met == 4).any() and not over, (met == 1).sum() * (not over), round(length, 9)))
    assert order == sorted(order) and {o[:2] for o in order} == {(False, True), (True, False)}


def test_what_scatters_before_and_behind_a_slab_is_the_integral_over_the_floor():
    """Lambertian scattering of a floor, lit through the pane, from a metal ceiling too, or seen through it."""
    effects = Effects(mirrors=1, scatterings=1, mirror_scatter=True, diffractions=0, residual=False)
    ceiling = FLOOR[0] + [0, 0, 6.0], FLOOR[1][:, ::-1]
    mesh, part = joined(FLOOR, pane(1.0), ceiling)
    scene = Scene(mesh, [FLOORING, GLASS, itu_material("metal")], part)
    engine = ExactEngine(scene, transmitter=TX, frequency_hz=F, shape=(90, 180), effects=effects)
    found = {p.sequence: p.power.sum() for p in engine.sequences(RX)}
    tracer = Tracer.of(Surface.of(scene), TX, F, (90, 180), 3)
    by_field = tracer.view(RX, effects).traced(effects)["MTS3"].powers(engine.materials)
    step = 0.02
    x, y = np.meshgrid(*2 * [np.arange(-6 + step / 2, 6, step)], indexing="ij")
    point = np.stack([x, y, 0 * x], axis=-1)
    into, out, image = (end - point for end in (TX, RX, TX * [1, 1, -1] + [0, 0, 12]))
    d1, d2, d3 = (np.linalg.norm(way, axis=-1) for way in (into, out, image))
    table = engine.mirrors.table
    cos_i, cos_s, cos_m = into[..., 2] / d1, out[..., 2] / d2, image[..., 2] / d3
    eta, thick = table.permittivity[0], table.thickness_m[0]
    wavelength_m = engine.mirrors.wavelength_m

    def even(cosine):
        return 0.5 * sum(np.abs(r) ** 2 for r in slab_reflection(cosine, eta, thick, wavelength_m))

    passed = []
    for way, d in ((into, d1), (out, d2), (image, d3)):
        waves = slab_transmission(np.abs(way[..., 0]) / d, table.permittivity[1], 0.01, wavelength_m)
        passed.append(0.5 * sum(np.abs(t) ** 2 for t in waves))
    power = (wavelength_m / (4 * np.pi)) ** 2 * 0.8**2 / np.pi * cos_s / d2**2 * step**2
    power = np.where(np.hypot(*np.moveaxis(point[..., :2], -1, 0)) < 9, power, 0.0)
    direct, mirrored = (power * even(c) * c / d**2 for c, d in ((cos_i, d1), (cos_m, d3)))
    assert found["TS"] == pytest.approx((direct * passed[0])[x > 1.0].sum(), rel=0.01)
    assert found["ST"] == pytest.approx((direct * passed[1])[x < 1.0].sum(), rel=0.01)
    assert found["MTS"] == pytest.approx((mirrored * passed[2])[x > 1.0].sum(), rel=0.02)
    assert by_field.sum() == pytest.approx(found["MTS"], rel=0.02)


def test_what_is_lit_through_a_slab_is_as_late_as_in_the_exact_engine():
    """Behind a wall nothing is lit in the air: a pixel's strongest path is still one of single scattering."""
    effects = Effects(mirrors=0, scatterings=1, mirror_scatter=False, scatter_mirror=False, diffractions=0)
    effects, shape = replace(effects, residual=False), (18, 36)
    frame = SpectrumDataset.empty(
        transmitter=TX, frequency_hz=F, shape=shape, beam_sigma_rad=0.1, floor=1e-20
    )
    found = BistaticField.prior(SHEET, frame, effects=effects).spectrum(RX)
    engine = ExactEngine(
        SHEET, transmitter=TX, frequency_hz=F, shape=shape, beam_sigma_rad=0.1, effects=effects
    )
    known, power = engine.receive(RX), found.path_gain
    bright = power > 1e-4 * power.max()
    assert bright.sum() > 50 and np.isfinite(found.delay_s[bright]).all()
    apart = np.abs(found.delay_s - known.delay_s)[bright]  # lobes and rays are others
    assert np.median(apart) < 0.3e-9 and np.mean(apart < 1e-9) > 0.9


METAL = itu_material("metal")
SCREEN = Material.custom("screen", relative_permittivity=6.0, conductivity=0.01, thickness_m=0.004)
WALL = Material.custom("wall", relative_permittivity=2.0, conductivity=0.005, thickness_m=0.2)


def test_a_pane_of_nearly_air_makes_nothing_later():
    """Delays, departures and points of what is seen through it are those of what lies behind, not of the pane."""
    air = Material.custom("air", relative_permittivity=1.0001, conductivity=0.0, thickness_m=0.01)
    effects = Effects(mirrors=0, scatterings=1, mirror_scatter=False, diffractions=0, residual=False)
    frame = SpectrumDataset.empty(
        transmitter=TX, frequency_hz=F, shape=(18, 36), beam_sigma_rad=0.1, floor=1e-20
    )
    spectra, paths, spreads = [], [], []
    for scene in Scene(Mesh(*FLOOR), [FLOORING], np.zeros(2, np.int32)), room(pane(1.0), air):
        field = BistaticField.prior(scene, frame, effects=effects)
        dark = field.parameters.log_weight - 40.0 * (np.arange(field.surface.groups) > 0)[:, None]
        field = replace(field, parameters=replace(field.parameters, log_weight=dark))
        spectra.append(field.spectrum(RX))
        paths.append(field.paths(RX))
        spreads.append(field.links(RX).delay_spread_s)
    power, diffuse = spectra[0].path_gain, [p.select(p.kind == "diffuse") for p in paths]
    bright = power > 1e-4 * power.max()
    apart = np.abs(spectra[1].delay_s - spectra[0].delay_s)[bright]
    assert np.mean(apart < 1e-10) > 0.97
    assert spreads[1] == pytest.approx(spreads[0], rel=0.01)
    later = [(p.power * p.tau).sum() / p.power.sum() for p in diffuse]
    assert later[1] == pytest.approx(later[0], rel=0.002)


@pytest.mark.parametrize("material", [METAL, SCREEN, WALL], ids=lambda material: material.name)
def test_spectra_do_not_jump_at_a_shadow_s_boundary(material):
    """The receiver rises past the shadow of a half plane, which may let a part through: the total is that of the fields, on both
    sides."""
    corners = np.array([[0, -50, -50], [0, -50, 0], [0, 50, 0], [0, 50, -50.0]])
    scene = Scene(Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]])), [material], np.zeros(2, np.int32))
    start, total = np.array([-10.0, 0, -1]), []
    for z in (0.9, 0.98, 0.999, 1.001, 1.02, 1.1, 1.3):
        found = trace_paths(
            scene,
            transmitter=start,
            receivers=[10, 0.1, z],
            frequency_hz=10e9,
            transmissions=1,
            diffractions=1,
            mirror_order=0,
        )
        whole = 0.5 * (np.abs(found.jones.sum(axis=0)) ** 2).sum()
        assert together(found).power.sum() == pytest.approx(whole, rel=0.01)  # other edges are far
        total.append(10 * np.log10(whole))
    assert np.abs(np.diff(total)[2]) < 0.05
    assert material is not METAL or np.all(np.diff(total) > 0)


@pytest.mark.parametrize("carrier_hz", [3.5e9, 28e9, 300e9])
@pytest.mark.parametrize(("permittivity", "most_db"), [(1.0001, 0.01), (2.0, 0.4)])
def test_a_pane_beside_a_path_stops_no_more_of_its_zone_than_it_does(permittivity, most_db, carrier_hz):
    """Line of sight and a mirror path that pass by its border: what goes through it arrives too."""
    corners = np.array([[0, -50, 0.1], [0, -50, 1.35], [0, 50, 1.35], [0, 50, 0.1]])
    thin = Material.custom(
        "thin", relative_permittivity=permittivity, conductivity=0.0, thickness_m=0.02 * 3e8 / carrier_hz
    )
    effects = Effects(mirrors=1, scatterings=0, transmissions=1, diffractions=0, residual=False)
    frame = SpectrumDataset.empty(transmitter=TX, frequency_hz=carrier_hz, shape=(12, 24))
    found = []
    for scene in Scene(Mesh(*FLOOR), [FLOORING], np.zeros(2, np.int32)), room((corners, pane(0)[1]), thin):
        field = BistaticField.prior(scene, frame, effects=effects)
        view = field.view(RX + [0, 0, 0.001])
        assert view.paths.kind.tolist().count("los") == 1
        found.append(np.sort(field.path_gains(view).specular))
    assert len(found[0]) == len(found[1]) == 2
    assert np.abs(10 * np.log10(found[1] / found[0])).max() < most_db


def test_what_goes_through_a_pane_beside_a_path_adds_in_its_phase():
    """Nearly at a right angle all of it has the field of one slab, over that of the same way in air."""
    ends = np.array([[-6.0, 0.0, 1.4], [6.0, 0.0, 1.4]])
    corners = np.array([[0, -50, -50], [0, -50, 1.35], [0, 50, 1.35], [0, 50, -50.0]])
    wavelength_m = SPEED_OF_LIGHT / F
    thick_m = 0.625 * wavelength_m / np.sqrt(20.0)  # what echoes within comes a quarter of a wave late
    dense = Material.custom("dense", relative_permittivity=20.0, thickness_m=thick_m)
    frame = SpectrumDataset.empty(transmitter=ends[0], frequency_hz=F, shape=(12, 24))
    scene, share = Scene(Mesh(corners, pane(0)[1]), [dense], np.zeros(2, np.int32)), []
    for most in (0, 1):
        effects = Effects(mirrors=0, scatterings=0, transmissions=most, diffractions=0, residual=False)
        share.append(BistaticField.prior(scene, frame, effects=effects).view(ends[1]).paths.share[0])
    free, through = share[0], slab_transmission(1.0, dense.permittivity(F), thick_m, wavelength_m)[0]
    through *= np.exp(2j * np.pi * thick_m / wavelength_m)
    assert 0.2 < free < 0.9
    assert share[1] == pytest.approx(abs(free + (1.0 - free) * through), rel=0.005)


def test_what_passes_a_path_s_wall_is_the_same_however_it_is_drawn():
    """A screen of unknown material beside line of sight: as a solid it is no thicker than what is assumed of it."""
    corners = np.array([[0, -50, 0.1], [0, -50, 1.35], [0, 50, 1.35], [0, 50, 0.1]])
    effects = Effects(mirrors=0, scatterings=0, transmissions=1, diffractions=0, residual=False)
    frame, shares = SpectrumDataset.empty(transmitter=TX, frequency_hz=F, shape=(12, 24)), []
    for screen in (corners, pane(0)[1]), box_mesh([0.0, -50.0, 0.1], [0.1, 50.0, 1.35]):
        scene = room(screen)
        scene = Scene(scene.mesh, [FLOORING, Material("screen", ())], scene.face_material)
        paths = BistaticField.prior(scene, frame, effects=effects).view(RX + [0, 0, 0.03]).paths
        assert paths.kind.tolist() == ["los"]
        shares.append(paths.share[0])
    assert 0.8 < shares[0] < 0.99
    assert shares[1] == pytest.approx(shares[0], abs=0.05)  # a few rays of the zone meet its upper corner


@pytest.mark.parametrize(("kind", "most"), [("edge", 0), ("edge", 2), ("slab", 2)])
def test_a_field_s_paths_through_slabs_and_over_edges_are_those_that_are_traced(kind, most):
    """Points, what happens there, and delays, those of slabs included."""
    frame = SpectrumDataset.empty(
        transmitter=TX, frequency_hz=F, shape=(18, 36), beam_sigma_rad=0.1, floor=1e-20
    )
    effects = Effects(mirrors=1, transmissions=most, diffractions=1)
    own = BistaticField.prior(SHEET, frame, effects=effects).paths(RX)
    mine, known = (
        p.select(np.flatnonzero(p.kind == kind)) for p in (own, paths(SHEET, most=most, diffractions=1))
    )
    assert 0 < len(mine.gain) == len(known.gain)
    order = np.linalg.norm(mine.departure[:, None] - known.departure, axis=2).argmin(axis=1)
    deep = known.vertices.shape[1]
    np.testing.assert_array_equal(mine.interactions[:, :deep], known.interactions[order])
    np.testing.assert_allclose(mine.vertices[:, :deep], known.vertices[order], atol=1e-6)
    np.testing.assert_allclose(mine.tau, known.tau[order], rtol=1e-9)


@pytest.mark.parametrize("fewer", [{"mirrors": 0}, {"transmissions": 0}, {"diffractions": 0}])
def test_what_counts_of_more_paths_is_what_is_traced_for_fewer(fewer):
    frame = SpectrumDataset.empty(
        transmitter=TX, frequency_hz=F, shape=(18, 36), beam_sigma_rad=0.1, floor=1e-20
    )
    every = Effects(mirrors=1, transmissions=2, diffractions=1)
    view, few = BistaticField.prior(SHEET, frame, effects=every).view(RX), replace(every, **fewer)
    known = BistaticField.prior(SHEET, frame, effects=few).view(RX).paths
    kept = view.counted_paths(few)
    assert 0 < len(known) == kept.sum() < len(kept)
    np.testing.assert_allclose(np.sort(view.paths.delay_m[kept]), np.sort(known.delay_m), rtol=1e-12)


def test_a_mirror_beside_an_edge_loses_what_its_surface_scatters():
    """Where materials are known: of the field that the floor mirrors sqrt(1 - 0.8^2) is left, glass scatters nothing."""
    frame = SpectrumDataset.empty(
        transmitter=TX, frequency_hz=F, shape=(18, 36), beam_sigma_rad=0.1, floor=1e-20
    )
    found = []
    for floor in (FLOORING, replace(FLOORING, scattering=0.0)):
        scene = Scene(SHEET.mesh, [floor, GLASS], SHEET.face_material)
        paths = full_field(scene, frame)[0].view(RX).paths
        beside = (paths.code == EDGE).any(axis=1) & (paths.code == MIRROR).any(axis=1)
        found.append(paths.share[beside])
    left = np.round(found[0] / found[1], 9)
    assert 0.6 in left and set(left.tolist()) <= {0.6, 1.0}

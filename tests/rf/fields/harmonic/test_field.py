"""Radio fields: the paper's equations by brute force, their scaling laws, paths, files, and resumed fits."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from furnished import ROOM
from radio_scenes import box_mesh, joined

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.reconstruction import Reconstruction
from warprrf.geometry.splats.gaussians import Gaussians, discs_on_mesh
from warprrf.rf.fields.harmonic.field import HarmonicField
from warprrf.rf.fields.harmonic.fitting import FieldOptions
from warprrf.rf.fields.harmonic.paths import BEAM_REACH
from warprrf.rf.fields.harmonic.transport import transport
from warprrf.rf.spectra.metrics import psnr, unit_image
from warprrf.rf.spectra.spectrum import angles_from_directions, pixel_directions, pixel_solid_angles

LIGHT = 299_792_458.0
FREQUENCY = 300e9
WAVELENGTH = LIGHT / FREQUENCY
SHAPE = (16, 32)
SIGMA = np.radians(6.0)
TRANSMITTER = np.array([0.9, 1.0, 2.3])
FLOOR, RANGE_DB = 1e-16, (-160.0, -80.0)


@pytest.fixture(scope="module")
def room():
    """A closed room with a block that hides the transmitter from behind it, covered with discs."""
    mesh, _ = joined(ROOM, box_mesh([2, 0.2, 0.1], [2.4, 2.9, 2.9]))
    return SimpleNamespace(mesh=mesh, gaussians=discs_on_mesh(mesh, 1500, seed=1))


RECEIVERS = np.random.default_rng(3).uniform([0.5, 0.5, 0.8], [4.5, 3.5, 2.2], (60, 3))
RECEIVERS = RECEIVERS[(RECEIVERS[:, 0] < 1.7) | (RECEIVERS[:, 0] > 2.7)][:16]
VISIBLE, BLOCKED = np.array([1.5, 2.4, 1.2]), np.array([3.6, 1.2, 1.3])


def field_with(room, layers, parts=None, **options):
    """A field on the room, or with other ``parts``, of known coefficients."""
    given = {
        "gaussians": room and room.gaussians, "mesh": room and room.mesh, "transmitter": TRANSMITTER,
        "gain_unit": 0.1, "delay_unit": 1e-8,
        "frequency_hz": FREQUENCY, "shape": SHAPE, "floor": FLOOR, "range_db": RANGE_DB, "beam_sigma_rad": SIGMA,
    }  # fmt: skip
    return HarmonicField(**(given | (parts or {})), options=FieldOptions(**options), layers=layers)


def smooth_layers(gaussians, seed=0):
    rng = np.random.default_rng(seed)
    table = np.zeros((len(gaussians), 16), np.float32)
    table[:, 0] = 3.0 * np.sin(gaussians.means @ rng.normal(0, 0.7, 3))
    table[:, 1:4] = 0.5 * np.cos(gaussians.means @ rng.normal(0, 0.5, (3, 3)))
    return {"gain": table}


def dataset(field, receivers):
    spectra = [field.spectrum(r) for r in receivers]
    gain = np.stack([s.path_gain for s in spectra])
    return SimpleNamespace(
        receivers=receivers, transmitter=field.transmitter, frequency_hz=field.frequency_hz, path_gain=gain,
        delay_s=np.stack([s.delay_s for s in spectra]), aod=np.stack([s.aod for s in spectra]), floor=FLOOR,
        range_db=(10 * np.log10(FLOOR), 10 * np.log10(gain.max() + FLOOR)), beam_sigma_rad=SIGMA,
        line_of_sight=np.array([True] * len(receivers)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def truth(room):
    return field_with(room, smooth_layers(room.gaussians))


@pytest.fixture(scope="module")
def spectra(truth):
    return dataset(truth, RECEIVERS)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("rule", ["product", "exp"])
@pytest.mark.parametrize("gain", ["exp", "linear"])
def test_a_pixel_is_the_papers_equations(rule, gain):
    """Eq. (2)-(4) by hand: discs across one ray, harmonics of degree 0 and 1 written out."""
    row, column = 7, 20
    d = pixel_directions(SHAPE)[row, column]
    receiver, transmitter = np.array([0.2, -0.1, 0.3]), np.array([1.0, 2.0, 0.5])
    depth, opacity = np.array([2.0, 3.0, 4.5]), np.array([0.3, 0.8, 0.5])
    scale = 0.4
    table = np.zeros((3, 16), np.float32)
    table[:, :4] = np.random.default_rng(5).uniform(0.2, 1.5, (3, 4))
    balls = Gaussians(
        receiver + depth[:, None] * d, np.tile([1.0, 0, 0, 0], (3, 1)), np.full((3, 3), scale), opacity,
        np.zeros((3, 1, 3)),
    )  # fmt: skip
    parts = {"gaussians": balls, "mesh": None, "transmitter": transmitter, "gain_unit": 0.25}
    field = field_with(None, {"gain": table}, parts, transmittance=rule, gain=gain)
    alpha = opacity  # the ray passes through all three centres
    passed = (
        np.cumprod(np.r_[1.0, 1 - alpha[:-1]])
        if rule == "product"
        else np.exp(-np.cumsum(np.r_[0.0, alpha[:-1]]))
    )
    weight = alpha * passed
    c0, c1 = 0.5 / np.sqrt(np.pi), np.sqrt(3 / (4 * np.pi))
    harmonic = np.array([c0, -c1 * d[1], c1 * d[2], -c1 * d[0]])
    exponent = table[:, :4] @ harmonic
    amplitude = 0.25 * (np.exp(exponent) if gain == "exp" else np.maximum(exponent, 0.0))
    centre = balls.means[np.argmax(weight)].astype(float)
    length = np.linalg.norm(centre - transmitter) + np.linalg.norm(centre - receiver)
    solid_angle = pixel_solid_angles(SHAPE)[row]
    expected = solid_angle * (weight @ amplitude) * (WAVELENGTH / (4 * np.pi * length)) ** 2
    spectrum = field.spectrum(receiver)
    assert spectrum.path_gain[row, column] == pytest.approx(expected, rel=2e-4)
    assert spectrum.delay_s[row, column] == pytest.approx(length / LIGHT, rel=1e-9)


@pytest.mark.parametrize(("model", "power_ratio"), [("rf3dgs+", 0.25), ("rf3dgs", 1.0)])
def test_doubling_every_distance_quarters_the_power_only_with_lengths(room, model, power_ratio):
    layers = smooth_layers(room.gaussians)
    small = field_with(room, layers, model=model)
    g = room.gaussians
    twice = {
        "gaussians": Gaussians(2 * g.means, g.quaternions, 2 * g.scales, g.opacities, g.sh),
        "mesh": Mesh(2 * room.mesh.vertices, room.mesh.faces),
        "transmitter": 2 * TRANSMITTER,
    }
    large = field_with(room, layers, twice, model=model)
    a, b = small.spectrum(VISIBLE), large.spectrum(2 * VISIBLE)
    assert b.path_gain == pytest.approx(power_ratio * a.path_gain, rel=1e-3)
    if model == "rf3dgs+":
        assert b.delay_s == pytest.approx(2 * a.delay_s, rel=1e-9)


def test_moving_the_transmitter_changes_power_by_the_squared_ratio_of_lengths(truth):
    elsewhere = np.array([1.4, 3.2, 0.9])
    here, there = truth.spectrum(BLOCKED), truth.spectrum(BLOCKED, transmitter=elsewhere)
    paths = [truth.paths(BLOCKED), truth.paths(BLOCKED, elsewhere)]
    assert all((p.kind == "diffuse").all() for p in paths)
    ratio = (here.delay_s / there.delay_s) ** 2
    assert there.path_gain == pytest.approx(ratio * here.path_gain, rel=1e-4)
    moved = angles_from_directions(paths[1].vertices[:, 0] - elsewhere)
    assert paths[1].theta_t == pytest.approx(moved[0])
    assert paths[1].phi_t == pytest.approx(moved[1])


@pytest.mark.parametrize("kind", ["mesh", "peak", "expected"])
def test_interaction_points_give_lengths_to_the_walls(room, kind):
    """Rays to the walls of an axis-aligned box, by the slab formula in float64: exact of its mesh, nearly of discs."""
    mesh = Mesh(*ROOM)
    discs = discs_on_mesh(mesh, 1500, seed=1)
    parts = {"mesh": mesh, "gaussians": discs, "beam_sigma_rad": 1e-3}
    field = field_with(room, smooth_layers(discs), parts, interaction_point=kind)
    d = pixel_directions(SHAPE)
    walls = np.where(d > 0, np.array([5.0, 4.0, 3.0]) - VISIBLE, -VISIBLE)
    distance = (walls / d).min(axis=-1)
    point = VISIBLE + distance[..., None] * d
    expected = distance + np.linalg.norm(point - TRANSMITTER, axis=-1)
    delay = field.spectrum(VISIBLE).delay_s
    surface = delay != np.linalg.norm(VISIBLE - TRANSMITTER) / LIGHT  # the line of sight's pixels apart
    assert surface.sum() > 0.98 * surface.size
    error = np.abs(LIGHT * delay - expected)[surface]
    assert error.max() < 1e-8 if kind == "mesh" else np.median(error) < 0.01


def test_a_field_is_recovered_from_spectra_of_its_own_kind(room, spectra):
    each = ("receivers", "path_gain", "delay_s", "aod", "line_of_sight")
    train = SimpleNamespace(**(vars(spectra) | {name: getattr(spectra, name)[:13] for name in each}))
    found = HarmonicField.fit(room, train, iterations=150, seed=0)
    untrained = HarmonicField.fit(room, train, iterations=0, seed=0)

    def score(field, index):
        image = unit_image(field.spectrum(spectra.receivers[index]).path_gain, FLOOR, spectra.range_db)
        return psnr(image, unit_image(spectra.path_gain[index], FLOOR, spectra.range_db))

    assert np.mean([score(found, i) for i in range(13)]) > 45
    held_out = [score(found, i) for i in (13, 14, 15)]
    assert np.mean(held_out) > 35
    assert np.mean(held_out) > np.mean([score(untrained, i) for i in (13, 14, 15)]) + 5
    assert found.report["losses"]["gain"][-1] < 0.3 * found.report["losses"]["gain"][0]


def test_rf3dgs_learns_delay_and_departure_of_its_training_spectra(room, spectra):
    found = HarmonicField.fit(room, spectra, "rf3dgs", iterations=100)
    blocked = [i for i, r in enumerate(spectra.receivers) if r[0] > 2.7]
    delay = np.stack([found.spectrum(spectra.receivers[i]).delay_s for i in blocked])
    spread_s = np.std(spectra.delay_s[blocked])
    assert np.median(np.abs(delay - spectra.delay_s[blocked])) < 0.05 * spread_s
    zenith = np.stack([found.spectrum(spectra.receivers[i]).aod[..., 0] for i in blocked])
    assert np.median(np.abs(zenith - spectra.aod[blocked][..., 0])) < np.radians(3)


def test_rf3dgs_learns_delays_where_departures_were_not_measured_and_the_other_way_round(room, spectra):
    apart = {"delay_s": spectra.delay_s.copy(), "aod": spectra.aod.copy()}
    apart["aod"][0, 3, 4] = apart["delay_s"][1, 5, 6] = np.nan  # one pixel
    both = HarmonicField.fit(room, SimpleNamespace(**(vars(spectra) | apart)), "rf3dgs", iterations=2)
    whole = HarmonicField.fit(room, spectra, "rf3dgs", iterations=2)
    assert list(both.layers) == list(whole.layers) == ["gain", "delay", "aod_x", "aod_y", "aod_z"]
    for lacking, other in (("aod", "delay_s"), ("delay_s", "aod")):
        none = {lacking: np.full_like(getattr(spectra, lacking), np.nan)}
        found = HarmonicField.fit(room, SimpleNamespace(**(vars(spectra) | none)), "rf3dgs", iterations=2)
        blocked = found.spectrum(BLOCKED)
        assert np.isnan(getattr(blocked, lacking)).all()
        np.testing.assert_array_equal(getattr(blocked, other), getattr(whole.spectrum(BLOCKED), other))


def test_gaussians_that_nobody_saw_keep_the_median_gain(room, spectra):
    g = room.gaussians
    parts = (g.means, g.quaternions, g.scales, g.opacities, g.sh)
    outside = Gaussians(*(np.concatenate([part, part[:1]]) for part in parts))
    outside.means[-1], outside.opacities[-1] = 50.0, 0.0
    found = HarmonicField.fit(SimpleNamespace(gaussians=outside, mesh=room.mesh), spectra, iterations=3)
    assert not found.layers["gain"][-1].any()
    seen = found.layers["gain"][:-1].any(axis=1)
    assert seen.mean() > 0.9


def test_a_killed_fit_goes_on_and_ends_with_the_same_bits_and_refuses_another_fits_checkpoint(
    room, spectra, tmp_path
):
    def killer(stage, done, total):
        if stage == "fit" and done == 70:
            raise KeyboardInterrupt

    file, steps = tmp_path / "fit.safetensors", []
    fit = partial(HarmonicField.fit, room, spectra, iterations=80, batch=4)
    whole = fit()
    with pytest.raises(KeyboardInterrupt):
        fit(checkpoint=file, progress=killer)
    with pytest.raises(ValueError, match="another fit|other data"):
        fit(checkpoint=file, gain="linear")
    assert file.exists()
    resumed = fit(checkpoint=file, progress=lambda s, d, t: steps.append((s, d)))
    assert min(d for s, d in steps if s == "fit") == 51
    assert np.array_equal(whole.layers["gain"], resumed.layers["gain"])
    assert whole.report["losses"] == resumed.report["losses"]
    assert not file.exists()


@pytest.mark.parametrize("line_of_sight", [None, "explicit"])
@pytest.mark.parametrize("floor", [1e-16, 1e-3])
def test_paths_sum_to_the_spectrum_to_which_an_explicit_line_of_sight_adds_friis_gain(
    room, truth, line_of_sight, floor
):
    field = field_with(room, truth.layers, line_of_sight=line_of_sight)
    field = replace(field, floor=floor)
    for receiver, seen in ((VISIBLE, True), (BLOCKED, False)):
        paths, spectrum = field.paths(receiver), field.spectrum(receiver)
        total = np.sum(spectrum.path_gain, dtype=np.float64)
        assert (np.abs(paths.gain) ** 2).sum() == pytest.approx(total, rel=1e-12)
        friis = (WAVELENGTH / (4 * np.pi * np.linalg.norm(receiver - TRANSMITTER))) ** 2
        more = spectrum.total_path_gain - truth.spectrum(receiver).total_path_gain
        assert more == pytest.approx(seen * friis if line_of_sight else 0.0, rel=1e-5, abs=1e-6 * friis)


def test_line_of_sight_path_is_exact(room, truth):
    outward = VISIBLE - TRANSMITTER
    distance = np.linalg.norm(outward)
    for option in (None, "explicit"):
        paths = field_with(room, truth.layers, line_of_sight=option).paths(VISIBLE)
        i = np.flatnonzero(paths.kind == "los")
        assert len(i) == 1
        assert paths.tau[i[0]] == pytest.approx(distance / LIGHT, rel=1e-12)
        assert paths.departure[i[0]] == pytest.approx(outward / distance, abs=1e-12)
        assert paths.arrival[i[0]] == pytest.approx(-outward / distance, abs=1e-12)
        if option is None:
            near = pixel_directions(SHAPE) @ (-outward / distance) >= np.cos(BEAM_REACH * SIGMA)
            image = truth.spectrum(VISIBLE).path_gain.astype(np.float64)
            assert paths.power[i[0]] == pytest.approx(image[near].sum(), rel=1e-6)
    assert not (truth.paths(BLOCKED).kind == "los").any()


@pytest.mark.parametrize(("line_of_sight", "receiver"), [(None, BLOCKED), ("explicit", VISIBLE)])
def test_phase_and_delay_of_a_path_follow_from_its_vertices(room, truth, line_of_sight, receiver):
    paths = field_with(room, truth.layers, line_of_sight=line_of_sight).paths(receiver)
    paths = paths.select(paths.kind == "diffuse")
    point = paths.vertices[:, 0]
    length = np.linalg.norm(point - TRANSMITTER, axis=1) + np.linalg.norm(point - receiver, axis=1)
    assert paths.tau == pytest.approx(length / LIGHT, rel=1e-12)
    out = (point - TRANSMITTER) / np.linalg.norm(point - TRANSMITTER, axis=1, keepdims=True)
    np.testing.assert_allclose(paths.departure, out, atol=1e-6)
    turned = paths.gain * np.exp(2j * np.pi * np.mod(FREQUENCY * paths.tau, 1.0))
    assert np.abs(np.angle(turned)).max() < 1e-6


def test_max_paths_keeps_the_strongest(truth):
    everything, few = truth.paths(VISIBLE), truth.paths(VISIBLE, max_paths=5)
    assert few.gain == pytest.approx(everything.gain[np.argsort(-everything.power)[:5]])


def test_gaussians_are_enough_by_themselves_or_in_a_reconstruction(room, spectra):
    """One of splats alone was refused for want of a mesh, which an implicit line of sight does not need."""
    fields = [
        HarmonicField.fit(one, spectra, iterations=2)
        for one in (room.gaussians, Reconstruction(room.gaussians))
    ]
    a, b = (field.spectrum(VISIBLE).path_gain for field in fields)
    np.testing.assert_array_equal(a, b)
    with pytest.raises(TypeError, match="geometry: got int, expected a Mesh, a Scene or anything else"):
        HarmonicField.fit(3, spectra)


def test_options_that_do_not_exist_are_refused(room, spectra):
    for name in ("transmittance", "interaction_point", "gain", "line_of_sight", "sh_degree"):
        with pytest.raises((ValueError, TypeError), match=name):
            HarmonicField.fit(room, spectra, **{name: 7})
    with pytest.raises(ValueError, match="mesh"):
        HarmonicField.fit(room.gaussians, spectra, line_of_sight="explicit")


def test_rf3dgs_refuses_a_transmitter_that_it_does_not_know(room, truth):
    fixed = field_with(room, truth.layers, model="rf3dgs")
    assert np.array_equal(
        fixed.spectrum(VISIBLE, transmitter=TRANSMITTER).path_gain, fixed.spectrum(VISIBLE).path_gain
    )
    with pytest.raises(ValueError, match="rf3dgs"):
        fixed.spectrum(VISIBLE, transmitter=[1.0, 3.0, 1.0])


def test_transport_of_other_receivers_or_gaussians_is_refused(room, spectra):
    fewer = discs_on_mesh(Mesh(*ROOM), 100, seed=1)
    for gaussians, receivers in ((room.gaussians, BLOCKED[None]), (fewer, spectra.receivers)):
        other = transport(gaussians, receivers, SHAPE, range_db=spectra.range_db)
        with pytest.raises(ValueError, match="transport"):
            HarmonicField.fit(room, spectra, transport=other)

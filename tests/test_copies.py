"""What crosses between the host and a GPU: pixels and rays, but no Gaussians and no surfaces once they are there."""

from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from copies import counted_copies
from furnished import ROOM

import warprrf as wr
from warprrf.device import launch
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.geometry.splats.rasterizer import RADIO, Rasterizer
from warprrf.kernels.radio.transport import mark_seen
from warprrf.rf.fields.harmonic.transport import transport

pytestmark = [pytest.mark.cuda, pytest.mark.parametrize("device", ["cuda:0"], indirect=True)]
SHAPE = (12, 24)
SIZES = (150, 600)
"""Gaussians: what is the same for both does not grow with them."""
RECEIVERS = np.random.default_rng(0).uniform([0.8, 0.8, 0.8], [4.2, 3.2, 2.2], (9, 3))
TRANSMITTER = np.array([0.8, 0.9, 2.2])


@pytest.fixture(scope="module")
def box():
    return wr.Mesh(*ROOM)


@pytest.fixture(scope="module")
def spectra():
    """Spectra of power somewhere near that of surfaces: what a fit makes of them is of no concern here."""
    gain = 10 ** np.random.default_rng(1).uniform(-14, -12, (len(RECEIVERS), *SHAPE))
    return wr.SpectrumDataset.from_spectra(
        receivers=RECEIVERS, transmitter=TRANSMITTER, frequency_hz=300e9, path_gain=gain, beam_sigma_rad=0.1
    )


def test_copies_are_counted_both_ways(device):
    with counted_copies(device) as counted:
        there = wp.array(np.zeros(10, np.float32), dtype=float, device=device)
        there.assign(np.ones(10, np.float32))
        there.numpy()
        wp.array(np.zeros(10), dtype=wp.float64, device="cpu").numpy()  # these stay where they are
        launch(mark_seen, 5, [wp.zeros(5, dtype=int, device=device) for _ in range(2)], device=device)
    assert counted == {"up": 80, "up, copies": 2, "down": 40, "down, copies": 1}


def test_a_view_moves_no_more_with_more_gaussians(box, device):
    """A photo with its gradients, and the strongest weights of a panorama: the number of entries."""
    photo = wr.Camera.pinhole(40, 30, fx=20.0, fy=20.0, cx=20.0, cy=15.0, world_to_camera=np.eye(4))
    panorama = wr.Camera.spherical(*SHAPE[::-1], position=RECEIVERS[0])
    moved = []
    for count in SIZES:
        g, raster = discs_on_mesh(box, count), Rasterizer(device=device)
        inputs = raster.upload(g)
        features = wp.ones((len(g), 3), dtype=float, device=device, requires_grad=True)
        with counted_copies(device) as counted:
            image, adjoint = raster.blend_with_adjoint(raster.prepare(*inputs, photo), features)
            adjoint()
            Rasterizer(device=device, blending=RADIO).strongest(raster.prepare(*inputs, panorama), 4)
        moved.append(dict(counted))
    assert moved[0] == moved[1]
    assert moved[0].get("up", 0) + moved[0]["down"] <= 64


def test_another_receiver_moves_no_more_with_more_gaussians(box, device):
    """Weights: two numbers a receiver, which say how much room its lists take."""
    for count in SIZES:
        with counted_copies(device) as few:
            transport(discs_on_mesh(box, count), RECEIVERS[:3], SHAPE)
        with counted_copies(device) as more:
            transport(discs_on_mesh(box, count), RECEIVERS, SHAPE)
        assert more["up"] == few["up"] > 40 * count  # the Gaussians, once
        assert more["down"] - few["down"] == 6 * (8 + 4)


@pytest.mark.parametrize("model", ["rf3dgs+", "rf3dgs"])
def test_another_spectrum_moves_no_more_with_more_gaussians(box, spectra, device, model):
    moved = []
    for count in SIZES:
        room = wr.Reconstruction(discs_on_mesh(box, count), box)
        field = wr.RadioField.fit(room, spectra.subset(range(3)), model, iterations=1, device=device)
        with counted_copies(device) as first:
            field.spectrum(RECEIVERS[3])
        with counted_copies(device) as second:
            field.spectrum(RECEIVERS[4])
        assert first["up"] > second["up"] + 40 * count  # Gaussians and layers come once
        moved.append(dict(second))
    assert moved[0] == moved[1]


@pytest.mark.parametrize("opacity", [False, True])
def test_more_receivers_and_steps_of_a_fit_move_no_more_with_more_gaussians(box, spectra, device, opacity):
    """More receivers at the same places, so that they see the same Gaussians."""
    moved = []
    for count in SIZES:
        room, counts = wr.Reconstruction(discs_on_mesh(box, count), box), []
        for receivers, steps in ((3, 2), (3, 2), (9, 2), (9, 6)):  # the mesh comes with the first
            how = {"iterations": steps, "batch": 3, "train_opacity": opacity, "device": device}
            with counted_copies(device) as counted:
                wr.RadioField.fit(room, spectra.subset(np.arange(receivers) % 3), "rf3dgs+", **how)
            counts.append(counted)
        moved.append([{way: b[way] - a[way] for way in b} for a, b in pairwise(counts[1:])])
    assert moved[0] == moved[1]


def test_rays_move_their_ends_and_what_they_met(box, device):
    """24 bytes an end, 12 a hit, 1 a line of sight; the mesh comes with the first ones."""
    a, b = np.random.default_rng(2).uniform(0.5, 2.5, (2, 100, 3))
    box.cast(a, b - a, device=device)
    with counted_copies(device) as counted:
        box.cast(a, b - a, device=device)
    assert counted["up"] == 100 * 48 + 8 and counted["down"] == 100 * 12  # and how far to look
    with counted_copies(device) as counted:
        box.visible(a, b, device=device)
    assert counted["up"] == 100 * 48 and counted["down"] == 100


def test_weights_made_on_the_cpu_are_copied_and_give_the_same_field(box, spectra, device):
    """But for rounding: a CPU blends blocks of pixels, a GPU each of its own."""
    g, train = discs_on_mesh(box, SIZES[0]), spectra.subset(range(3))
    room, how = wr.Reconstruction(g, box), {"iterations": 5, "device": device}
    seen = transport(g, train.receivers, SHAPE, range_db=train.range_db, device="cpu")
    here, copied = (
        wr.RadioField.fit(room, train, "rf3dgs+", transport=given, **how).layers["gain"]
        for given in (None, seen)
    )
    assert np.abs(here).max() > 1.0
    assert np.allclose(here, copied, atol=1e-3)

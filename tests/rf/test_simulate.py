"""Receivers are drawn from the air, evenly and the same ones for a seed."""

import numpy as np
import pytest
from radio_scenes import box_mesh, joined

from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.materials import Material
from warprrf.rf.scene import Scene
from warprrf.rf.simulate import sample_receivers, simulate

LOW, HIGH = np.array([-7.0, -6, 0]), np.array([8.0, 6, 4])
BOX = np.array([-1.0, -1, 0]), np.array([0.5, 1.5, 2.2])


def test_receivers_are_drawn_from_the_air():
    mesh, part = joined(box_mesh(LOW, HIGH, inward=True), box_mesh(*BOX))
    s = Scene(mesh, [Material.conductor()] * 2, part)
    places = sample_receivers(s, 500, seed=4, clearance=0.3)
    assert (
        (places >= LOW + [0.3, 0.3, 0.8]).all() and (places <= HIGH - 0.3).all() and places[:, 2].max() <= 2.2
    )
    outside = np.linalg.norm(np.maximum(np.maximum(BOX[0] - places, places - BOX[1]), 0), axis=1)
    assert outside.min() >= 0.3 - 1e-6
    np.testing.assert_array_equal(sample_receivers(s, 50, seed=4), places[:50])
    # Uniform: the share in the western half of the room is the share of its free volume.
    west = places[:, 0] < -1.3
    free = (5.4 * 11.4) / (14.4 * 11.4 - 2.1 * 3.1)
    assert west.mean() == pytest.approx(free, abs=0.07)


def test_a_transmitter_that_few_rays_look_at_is_warned_of():
    plaster = Material.custom("plaster", relative_permittivity=2.0, conductivity=0.1, scattering=0.5)
    s = Scene(Mesh(*box_mesh(LOW, HIGH, inward=True)), [plaster], np.zeros(12, int))
    ask = {"receivers": [3.0, -2.0, 1.4], "frequency_hz": 300e9, "shape": (6, 12)}
    with pytest.warns(
        UserWarning, match="transmitter: it stands 0.1 m off a surface, where rays .* 0.23 m apart"
    ):
        simulate(s, transmitter=[1.0, 1.0, 3.9], **ask)

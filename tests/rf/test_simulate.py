"""simulate: bad places are refused, a killed run goes on, receivers are drawn from the air."""

import numpy as np
import pytest
from radio_scenes import box_mesh, joined

from warprrf.rf.em.materials import Band, Material
from warprrf.rf.scene import Scene
from warprrf.rf.simulate import sample_receivers, simulate

F = 300e9
TX = np.array([-5.0, 3.5, 2.7])
LOW, HIGH = np.array([-7.0, -6, 0]), np.array([8.0, 6, 4])
BOX = np.array([-1.0, -1, 0]), np.array([0.5, 1.5, 2.2])


def scene(material=None):
    mesh, part = joined(box_mesh(LOW, HIGH, inward=True), box_mesh(*BOX))
    stuff = material or Material.custom("stone", relative_permittivity=5.0, conductivity=0.5, scattering=0.5)
    return Scene(
        mesh,
        [stuff],
        np.zeros(len(mesh.faces), int),
        face_object=part,
        object_names=[str(k) for k in range(7)],
    )


def run(receivers, s=None, **options):
    return simulate(
        s or scene(), transmitter=TX, receivers=receivers, frequency_hz=F, **{"shape": (20, 40), **options}
    )


def test_a_frequency_outside_the_band_names_material_and_band():
    stuff = Material("stone", (Band(1e9, 100e9, 5.0, 0.0, 0.1, 0.8),))
    with pytest.raises(ValueError, match=r"300 GHz.*'stone'.*1 to 100 GHz"):
        run([[3.0, 0, 1]], scene(stuff))


def test_receivers_are_drawn_from_the_air():
    s = scene()
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

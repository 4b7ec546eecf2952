"""A measured place: rivals find the law that made the links, noise of means is that of their halves."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.measured import flat, links, rivals

RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def made():
    """Links in the flat whose power falls with the distance and with each wall, between four anchors and sixty places."""
    scene, anchors = flat.scene(), np.array([[1, 1, 2.0], [5, 1, 2.2], [1, 6, 2.4], [8, 6, 2.1]])
    places = np.column_stack([RNG.uniform(0.2, 6.1, 60), RNG.uniform(0.2, 7.0, 60), np.full(60, 1.3)])
    anchor, cell = np.divmod(np.arange(240), 60)
    walls = links.crossings(scene, anchors[anchor], places[cell], scene.face_material)[:, :3]
    one = links.Links(anchors[anchor], places[cell], np.zeros(240), anchor, cell, np.full(240, "room"), walls)
    return replace(one, level_db=-40 - 20 * np.log10(one.distance_m) - walls @ [3.0, 7.0, 11.0])


def test_a_wall_is_crossed_where_it_hides_the_other_end(made):
    seen = flat.scene().mesh.visible(made.senders, made.receivers)
    assert (made.behind == ~seen).all() and made.behind.any()


@pytest.mark.parametrize("name", ["multi-wall (COST 231)", "multi-wall, exponent fitted"])
def test_the_multi_wall_law_is_found(made, name):
    out = made.anchor == 2
    found = rivals.RIVALS[name](made.subset(~out), made.subset(out))
    np.testing.assert_allclose(found, made.level_db[out], atol=1e-9)


def test_noise_of_means_is_the_readings_over_the_root_of_their_number():
    readings = [RNG.normal(-60.0, 0.5, 25) for _ in range(2000)]
    noise = links.noise_db(readings, 0)
    for name in ("halves_by_time", "halves_by_chance"):
        assert noise[name] == pytest.approx(0.5 / 5, rel=0.06)
    assert noise["single_reading"] == pytest.approx(0.5, rel=0.02)

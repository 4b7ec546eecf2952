"""The measured hall: a file of its form, made of one wall's image, is read, traced and met; what does not fit is named."""

from functools import partial

import numpy as np
import pytest
from places import ROOT
from scipy.io import loadmat, savemat

import warprrf as wr
from benchmarks.measured import beams, command, hall
from benchmarks.runner import Job
from warprrf.steps import Steps

FROM = np.array(hall.TRANSMITTER)
WALL_X = 8.0  # of a wall from y = -9 to 9, which all receivers see
HEADING = -np.pi / 2  # of the transmitter, before it is turned by -1.6 degrees


def drawn(*ends, **more):
    return {"type": "graph2d.lineseries", "properties": {"XData": ends[0::2], "YData": ends[1::2], **more}}


@pytest.fixture
def source(tmp_path):
    """A wall, drawn twice, a column, a dashed line in the way, and line of sight and the wall's image as measured."""
    ring = np.arange(20) * np.pi / 10
    lines = [
        drawn(WALL_X, -9.0, WALL_X, 9.0),
        drawn(WALL_X + 0.01, -5.0, WALL_X + 0.01, 5.0),
        drawn(-9, 0, 9, 0, LineStyle="--"),
    ]
    lines += [
        drawn(*(-3 + 0.2 * np.array([np.cos(a), np.sin(a), np.cos(b), np.sin(b)])).tolist())
        for a, b in zip(ring, np.roll(ring, -1), strict=True)
    ]
    figure = {"type": "figure", "children": {"type": "axes", "children": lines}}
    savemat(tmp_path / hall.PLAN, {"hgS_070000": figure}, appendmat=False)
    x = np.concatenate([3.0 + np.arange(9) * 0.5, np.full(9, 7.0)])
    y = np.concatenate([np.full(9, 1.0), 0.4 + np.arange(9) * 0.2])
    paths, powers = [], []
    for place in np.column_stack([x, y]):
        found = []
        for end in (FROM, [2 * WALL_X - FROM[0], FROM[1]]):
            way = place - end  # from the transmitter or its image
            sent = way if end is FROM else way * [-1, 1]
            turned = np.arctan2(sent[1], sent[0]) - HEADING - np.radians(-1.6)
            found.append((np.hypot(*way), turned, np.arctan2(-way[1], -way[0])))
        length = np.array(found)[:, 0]
        paths.append(np.array(found).T)
        powers.append(-13.0 - 20 * np.log10(length) - [0.0, 6.0])
    cells = [np.empty(18, object), np.empty(18, object)]
    for cell, values in zip(cells, (paths, powers), strict=True):
        cell[:] = values
    ends = {"tx": np.tile([[*FROM, HEADING]], (18, 1)).T, "rx": np.stack([x, y, np.zeros(18)])}
    savemat(tmp_path / hall.PATHS, {"sim": ends | dict(zip(("y", "power"), cells, strict=True))})
    return tmp_path


def test_what_is_measured_is_where_geometry_has_it(source):
    walk = hall.measured(source)
    assert all((nlos == [False, True]).all() for nlos in walk.nlos)
    place = hall.place(source, 0)
    sight, rows = place.noise["rows"][0], {row["model"]: row for row in place.more["paths"]}
    assert (sight["found"], sight["gain_db"]) == (18, pytest.approx(55.0, abs=0.1))
    for name in ("length_m", "departure_deg", "arrival_deg", "gain_db_spread"):
        assert abs(sight[name]) < 1e-6
    one = rows["traced, one mirror"]
    assert (one["met"], one["found"], rows["straight ray in air"]["met"]) == (1.0, 1.0, 0.0)
    assert one["met_by_chance"] < 0.2
    assert max(one["length_m"], one["departure_deg"], one["arrival_deg"]) < 0.01


def test_the_plan_has_a_wall_once_and_a_column_and_nothing_dashed(source):
    found = hall.plan(source)
    np.testing.assert_allclose(found["wall"], [[[WALL_X, -9.0], [WALL_X, 9.0]]])
    assert len(found["column"]) == hall.SIDES
    np.testing.assert_allclose(np.linalg.norm(found["column"] + 3.0, axis=2), 0.2, atol=0.01)
    assert not hall.scene(source, "wall", "column").mesh.visible([6, 2.0, 1.5], [9, 2.0, 1.5])


def test_pairs_of_beams_see_a_path_as_their_widths_say():
    one = beams.Rays(
        np.array([2.0]), np.array([5.0]), beams.level(np.array([-1.0])), beams.level(np.array([3.1]))
    )
    half_sent, half_received = np.radians([5.0, 4.0])
    asked = np.array([-1.0, -1.0 + half_sent, -1.0]), np.array([3.1, 3.1, 3.1 - half_received])
    np.testing.assert_allclose(one.pairs(*asked), [2.0, 1.0, 1.0], rtol=1e-3)
    assert one.own == pytest.approx([2.0])
    departure, arrival, power = one.strongest
    assert abs(departure + 1.0) < 0.03 and abs(arrival - 3.1) < 0.03 and 1.8 < power <= 2.0


def test_pointing_elsewhere_loses_what_the_beams_do_not_hear():
    one = beams.Rays(
        np.array([1.0, 0.1]),
        np.array([5.0, 9.0]),
        beams.level(np.array([-1.0, -2.0])),
        beams.level(np.array([1.0, 2.0])),
    )
    walk = beams.Walk(np.zeros(3), np.array([[2.7, -4.2, 0.0]]), [one], 1e-3, 60e9)
    said = [beams.pointing(walk, np.array([at])) for at in ([-1.0, 1.0], [-2.0, 2.0], [0.5, 0.5])]
    assert [row["found"] for row in said] == [1.0, 0.0, 0.0]
    np.testing.assert_allclose([row["lost_db"] for row in said], [0.0, 10.0, 30.0], atol=0.2)


def test_pairs_at_which_nothing_was_found_are_away_from_the_others(source):
    walk = hall.measured(source)
    readings = walk.readings(np.array([3]))
    assert (readings.power[:2] > walk.floor).all() and (readings.power[2:] == 0).all() and len(readings) > 200
    apart = [
        np.abs(beams.turn(side[2:, None, 1] - side[:2, 1])) for side in (readings.departure, readings.arrival)
    ]
    assert (np.maximum(*apart) > np.radians(15.0)).all()


def test_receivers_one_after_the_other_are_held_out_together(source):
    held = list(hall.place(source, 0).links.held_out(("block",)))
    assert [which for _, which, _ in held] == ["1 to 9", "10 to 18"] and all(
        out.sum() == 9 for *_, out in held
    )


def test_what_is_missing_or_of_another_place_is_named(source, tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"svd_p999\.mat: there is no such file; --source is a folder"
    ):
        hall.measured(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="hold_out: got room, expected some of block of the hall"):
        command.run(command.Options("hall", str(source), ("room",)), Job(tmp_path))
    held = loadmat(source / hall.PATHS, simplify_cells=True)["sim"]
    savemat(source / hall.PATHS, {"sim": held | {"tx": held["tx"] + 1.0}})
    with pytest.raises(ValueError, match=r"got a transmitter at \[3\.25 3\.5 \], expected \(2\.25, 2\.5\)"):
        hall.measured(source)
    savemat(source / hall.PATHS, {"other": 1})
    with pytest.raises(ValueError, match=r"KeyError\('sim'\): expected sim with"):
        hall.measured(source)


def test_the_measured_hall_is_as_it_was():
    """On the files themselves, where they are: 45 links, of which all in sight have their line of sight."""
    folder = ROOT / command.SOURCES["hall"]
    if not (folder / hall.PATHS).is_file():
        pytest.skip(
            f"{folder}: the measured files are not there; python -m benchmarks measured --help says where they are"
        )
    walk = hall.measured(folder)
    assert len(walk.receivers) == 45 and sum(len(one.power) for one in walk.rays) == 362
    assert sum(not nlos.all() for nlos in walk.nlos) == 41


def test_pairs_of_links_held_out_are_predicted_from_the_others(source):
    """A field learns from nine links how the wall mirrors, which traced paths of metal have 6 dB too strong."""
    walk, seen = hall.measured(source), hall.scene(source, "wall", wall=("metal", 0.001))
    ends = {"transmitter": walk.transmitter, "receivers": walk.receivers}
    paths = beams.Rays.of(wr.trace_paths(seen, **ends, frequency_hz=60e9, mirror_order=1))
    effects = wr.Effects(mirrors=1, scatterings=0, transmissions=0, diffractions=0, mirror_scatter=False)
    models = {
        "traced": (partial(beams.straight, walk, paths), ""),
        "nearest": (partial(beams.nearest, walk), ""),
        "field": (partial(beams.fitted, walk, seen, effects=effects), ""),
    }
    with Steps(source / "steps") as steps:
        rows = {row["model"]: row for row in beams.predicted(walk, models, hall.BLOCK, steps)}
    for model in ("traced", "field"):
        assert rows[model]["found"] == 1.0 and rows[model]["sight_db"] < 0.6 and rows[model]["lit"] < 0.05
    assert rows["traced"]["nlos_mean_db"] == pytest.approx(6.0, abs=0.7)
    assert abs(rows["field"]["nlos_mean_db"]) < 1.0
    assert rows["nearest"]["sight_db"] > 1.0

"""The table of beams: true channels against sums by hand, the search with pilots, and a whole run on a small room."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

import warprrf as wr
from benchmarks.beams import report
from benchmarks.beams.links import BANDWIDTH_HZ, FREQUENCIES, Ends, Link, Links, ends, gains
from benchmarks.beams.run import BENCHMARKS, Options, _over, straight
from benchmarks.beams.search import hierarchical
from benchmarks.beams.users import several_users
from benchmarks.beams.users import table as users_table
from benchmarks.runner import Job, execute

SCENE = ROOT / "data" / "lobby" / "scene.xml"
TRANSMITTER = np.array([13.6, 11.2, 2.5])


@pytest.fixture(scope="module")
def scene() -> wr.Scene:
    return wr.Scene.load(SCENE)


@pytest.fixture(scope="module")
def spectra(scene: wr.Scene) -> wr.SpectrumDataset:
    """Six receivers of the lobby on a coarse grid, two of them for test."""
    places = np.array(
        [
            [10.0, 9.0, 1.5],
            [8.0, 6.0, 1.5],
            [5.0, 9.0, 1.6],
            [3.0, 3.0, 1.4],
            [11.0, 5.0, 1.5],
            [7.0, 8.5, 1.2],
        ]
    )
    assert scene.is_free(places, clearance_m=0.05).all()
    return wr.simulate(
        scene, transmitter=TRANSMITTER, receivers=places, frequency_hz=300e9, shape=(30, 60),
        roles=["train"] * 4 + ["test"] * 2,
    )  # fmt: skip


def test_array_in_the_middle_of_a_larger_one_has_its_part_of_the_channel(
    scene: wr.Scene, spectra: wr.SpectrumDataset
) -> None:
    between = ends(spectra, (4, 8), (2, 4))
    link = Links(scene, spectra, seed=3).link(1)
    for e, h in zip(between, link.channels(between), strict=True):
        assert h.shape == (FREQUENCIES, e.rx.elements, e.tx.elements)
        np.testing.assert_allclose(h, link._channel(e), atol=1e-12 * np.abs(h).max())


def test_channel_is_the_sum_over_its_paths(scene: wr.Scene, spectra: wr.SpectrumDataset) -> None:
    """Against the channel of all paths as plane waves, summed path by path: arrays are small, so waves are plane."""
    link = Links(scene, spectra, seed=3).link(1)
    e = ends(spectra, (2,), (2, 2))[-1]
    everything = link.everything()
    specular = len(link.specular.gain)
    turned = everything.gain.copy()
    turned[specular:] = np.sqrt(link.power) * link.phase
    offset = ((np.arange(FREQUENCIES) + 0.5) / FREQUENCIES - 0.5) * BANDWIDTH_HZ
    h = replace(everything, gain=turned).cfr(
        everything.carrier_hz + offset,
        tx_array=e.tx,
        rx_array=e.rx,
        diffuse="given",
        squint=False,
        method="dense",
    )
    found = link.channels([e])[0]
    np.testing.assert_allclose(np.moveaxis(found, 0, -1), h, atol=2e-3 * np.abs(h).max())


def test_scattering_carries_the_power_of_the_spectrum(scene: wr.Scene, spectra: wr.SpectrumDataset) -> None:
    link = Links(scene, spectra).link(0)
    total = link.power.sum() + link.specular.power.sum()
    # The coarser rays and the weakest left out cost 2 % at most.
    assert total == pytest.approx(float(spectra.path_gain[0].sum()), rel=0.02)
    assert link.line_of_sight == bool(spectra.line_of_sight[0])


def test_spectrum_of_another_engine_gives_the_same_scattered_power(
    scene: wr.Scene, spectra: wr.SpectrumDataset
) -> None:
    other = Links(scene, replace(spectra, engine="sionna")).link(0)
    twice = other.specular.power[np.isfinite(other.specular.vertices[:, 1, 0])].sum()
    total = other.power.sum() + other.specular.power.sum() - twice
    assert total == pytest.approx(float(spectra.path_gain[0].sum()), rel=0.05)


@pytest.mark.parametrize("swept", ["rx", "tx", "both"])
def test_search_without_noise_finds_a_lone_path_in_the_fewest_pilots(
    spectra: wr.SpectrumDataset, swept: str
) -> None:
    between: list[Ends] = [e for e in ends(spectra, (16,), (8, 8)) if e.swept == swept]
    path = straight(spectra, spectra.receivers[2])
    nothing = np.zeros((0, 3))
    link = Link(path, nothing, nothing, np.zeros(0), np.zeros(0), np.zeros(0, complex))
    channel = link.channels(between)[0]
    found = hierarchical(between[0], channel, 1e12, np.random.default_rng(0))
    worth = gains(between[0], channel).mean(axis=0)
    chosen = wr.select_beams(path, between[0].tx_book, between[0].rx_book)
    assert worth[chosen.rx[0], chosen.tx[0]] == pytest.approx(worth.max(), rel=1e-6)
    assert worth[found.rx, found.tx] > 0.8 * worth.max()
    # Four pilots a level; 2, 4, 8, 16 elements a side and one level of oversampling.
    assert found.pilots == {"rx": 20, "tx": 20, "both": 32}[swept]


def test_figures_of_a_loss_are_those_of_their_definition() -> None:
    loss = np.array([0.0, 0.5, 3.0, 8.0])
    names = ("loss_db", "tone_loss_db", "snr_db", "efficiency", "efficiency_without_pilots")
    found = _over(dict.fromkeys(names, loss))
    assert found["within"] == 0.5 and found["loss_db"] == 1.75 and found["efficiency"] == 2.875
    assert set(_over(dict.fromkeys(names, loss[:0])).values()) == {None}


def test_bad_sizes_are_named() -> None:
    with pytest.raises(ValueError, match=r"sides: got \(4, 6\)"):
        Options(sides=(4, 6))
    with pytest.raises(ValueError, match="every: got 0"):
        Options(every=0)


@pytest.mark.slow
def test_whole_run_on_a_small_data_set(tmp_path: Path, scene: wr.Scene, spectra: wr.SpectrumDataset) -> None:
    spectra.save(tmp_path / "spectra.nc")
    wr.Reconstruction(gaussians=_dots(scene), mesh=scene.mesh).save(tmp_path / "room")
    options = Options(
        data=(str(tmp_path / "spectra.nc"),), geometry=str(tmp_path / "room"), scene=str(SCENE), counts=(2,),
        truths=("exact",), sides=(4, 8), both=(2, 4),
    )  # fmt: skip
    found = execute(BENCHMARKS["beams"], options, Job(tmp_path / "out", seed=1))
    rows = found["truths"]["exact"]["links"]
    assert {r["ends"] for r in rows} == {"rx 16", "rx 64", "tx 16", "tx 64", "tx 4, rx 16"}
    for row in rows:
        assert min(row["losses_db"]) > -1e-9
        if row["method"] == "exhaustive":
            assert row["within"] == 1.0 and row["efficiency"] < row["efficiency_without_pilots"]
    assert (
        json.loads((tmp_path / "out/beams.json").read_text())["truths"]["exact"]["links"][0]["ends"]
        == "rx 16"
    )
    assert "our field" in (tmp_path / "out/beams.md").read_text()


def _dots(scene: wr.Scene) -> wr.Gaussians:
    """Gaussians on the scene's larger faces."""
    middle = scene.mesh.triangles.mean(axis=1)[np.argsort(-scene.mesh.areas)[:500]]
    count = len(middle)
    return wr.Gaussians(
        middle, np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 0.2), np.full(count, 0.9),
        np.zeros((count, 1, 3)),
    )  # fmt: skip


def test_several_users_of_one_path_each_are_parted_by_whoever_knows_their_directions(
    spectra: wr.SpectrumDataset,
) -> None:
    e = next(x for x in ends(spectra, (8,), (2, 2)) if x.swept == "tx")
    rng = np.random.default_rng(2)
    middle = spectra.receivers.mean(axis=0)
    places = middle + rng.uniform([-3, -3, -0.5], [3, 3, 0.5], (5, 3))
    aimed = [straight(spectra, p) for p in places]
    amplitude = 1e-5
    channels = [
        amplitude * np.broadcast_to(e.tx.response(p.departure, 1.0), (FREQUENCIES, 1, 64)) for p in aimed
    ]
    worth = [gains(e, c).mean(axis=0) for c in channels]
    noise = 1e-12
    rows = several_users(
        e, channels, worth, [{("transmitter", None): p} for p in aimed], noise, 0, counts=(2, 4, 8)
    )
    assert {r["users"] for r in rows} == {2, 4}  # eight there are not
    assert {r["groups"] for r in rows if r["users"] == 2} == {2}
    rate = {(r["users"], r["method"], r["choice"]): r["efficiency"] for r in rows}
    assert ("alone" in {r["choice"] for r in rows if r["method"] == "channel"}) is False
    for users in (2, 4):
        # a path's direction is all that there is to know of a channel of one path
        for how in ("mr", "zf", "slnr"):
            tolerance = {"rel": 1e-6} if how != "slnr" else {"rel": 0.01}
            assert rate[users, "transmitter", how] == pytest.approx(rate[users, "channel", how], **tolerance)
        assert rate[users, "transmitter", "zf"] > rate[users, "transmitter", "mr"]
    order = np.random.default_rng(0).permutation(5)[:4]
    h = np.stack([channels[u][0, 0] for u in order])
    own = 1.0 / np.diag(np.linalg.inv(h @ h.conj().T)).real
    assert rate[4, "channel", "zf"] == pytest.approx(np.log2(1.0 + own / (4 * noise)).sum(), rel=1e-6)
    text = "\n".join(
        users_table(rows, {m: name for m, (name, _) in report.METHODS.items()} | {"channel": "true channel"})
    )
    assert "### 4 users at once, tx 64 elements" in text
    assert f"{rate[4, 'channel', 'zf']:.2f}" in text

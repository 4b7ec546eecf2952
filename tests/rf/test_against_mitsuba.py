"""Path gains and images of every sequence against Mitsuba's path tracer, and against quadrature where a scene has one."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from mitsuba_reference import (
    MIRROR,
    SCATTER,
    Estimate,
    Link,
    closed_forms,
    floor_and_mirror,
    mitsuba_sequences,
)
from places import LOBBY
from radio_scenes import RadioScene, SlabMaterial, box_mesh
from rooms import rms_change_db
from sionna_room import sionna_or_skip

import warprrf as wr
from warprrf.geometry.mesh import Mesh
from warprrf.rf.exact import ExactEngine
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.spectra.beam import beam_operator
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import pixel_of
from warprrf.rf.tracing.model import Effects, Parameters
from warprrf.rf.tracing.render import PathGains

BEAM_RAD = np.radians(2.0)
MIRRORED = Effects(mirrors=0, scatterings=1, residual=False, transmissions=0, diffractions=0)


def sequences(link: Link) -> dict[str, np.ndarray]:
    """Ours: path gain of specular paths, shape ``(L,)``, and of others per pixel, before any beam, shape ``(H, W)``."""
    scene = wr.Scene(link.mesh, [wr.Material(name, ()) for name in ("scatter", "mirror", "black")], link.does)
    frame = SpectrumDataset.empty(
        transmitter=link.transmitter,
        frequency_hz=link.frequency_hz,
        shape=link.shape,
        beam_sigma_rad=BEAM_RAD,
        floor=1e-17,
    )
    no = -40.0  # ln of what is not there
    shares = (
        np.array([[0.0], [no], [no]]),
        np.full(3, np.log(link.permittivity - 1.0)),
        np.array([no, 0.0, no]),
    )

    def traced(**effects: Any) -> PathGains:
        made = BistaticField.prior(
            scene, frame, lobes=(0,), effects=Effects(residual=False, transmissions=0, **effects)
        )
        made = replace(made, parameters=Parameters(*shares, lobes=(0,)))
        return made.path_gains(made.view(link.receiver))

    def binned(gains: PathGains, name: str) -> np.ndarray:
        return gains.by_ray([name]).reshape(*link.shape, -1).sum(axis=2)

    once = traced(mirrors=1, scatterings=1)
    twice, thrice = (binned(traced(scatterings=n, mirror_scatter=False, mirrors=0), "E") for n in (2, 3))
    mirrored = binned(traced(scatterings=2, mirrors=0), "E") - twice
    order = once.view.paths.order
    return {
        "LOS": once.specular[order == 0], "M": once.specular[order == 1], "SS": twice, "SSS": thrice - twice, "MSS": mirrored,
        **{name: binned(once, name) for name in ("S", "MS", "SM", "MSM")},
    }  # fmt: skip


def exact_runs(link: Link, effects: Effects, sub_pixels: int, seeds: int) -> dict[str, np.ndarray]:
    """Path gain of each sequence per pixel by the exact engine, before any beam, shape ``(seeds, H, W)``."""
    materials = [
        SlabMaterial(name, eta, 0.0, np.inf, s)
        for name, s, eta in (
            ("scatter", 1.0, link.permittivity),
            ("mirror", 0.0, link.permittivity),
            ("black", 0.0, 1.0 + 1e-9),
        )
    ]
    scene = RadioScene(link.mesh, np.asarray(link.does), materials)
    known = {"transmitter": link.transmitter, "frequency_hz": link.frequency_hz, "shape": link.shape}
    found: dict[str, np.ndarray] = {}
    for seed in range(seeds):
        engine = ExactEngine(scene, **known, effects=effects, sub_pixels=sub_pixels, seed=seed)
        for paths in engine.sequences(np.asarray(link.receiver, float)):
            own = found.setdefault(paths.sequence, np.zeros((seeds, *link.shape)))
            np.add.at(own[seed], pixel_of(paths.direction, link.shape), paths.power)
    return found


def lobby(receiver: int = 0) -> Link:
    """The lobby, all Lambertian but for its western wall."""
    scene, ds = wr.Scene.load(LOBBY / "scene.xml"), wr.SpectrumDataset.load(LOBBY / "spectra.nc")
    does = np.where(scene.face_object == scene.object_names.index("wall_west"), MIRROR, SCATTER)
    return Link(scene.mesh, does, ds.transmitter, ds.receivers[receiver], ds.frequency_hz)


@cache
def ours_in(room: str) -> dict[str, np.ndarray]:
    return sequences(ROOMS[room][0]())


@cache
def mitsubas(room: str) -> dict[str, Estimate]:
    make, scatterings = ROOMS[room]
    return mitsuba_sequences(make(), 64, scatterings)


def compared(room: str, sequence: str) -> tuple[np.ndarray, Estimate]:
    """Path gain of a sequence, ours and Mitsuba's."""
    return ours_in(room)[sequence], mitsubas(room)[sequence]


def beamed(power: np.ndarray) -> np.ndarray:
    """What a receiver's beam makes of it, shape ``(1, H, W)``; differences of noisy images may be below zero."""
    return np.moveaxis(beam_operator(power.shape, BEAM_RAD)(np.maximum(power, 0.0)[:, :, None].copy()), -1, 0)


def noise_db(found: Estimate) -> float:
    """Of the mean of runs, through a receiver's beam, rms."""
    return rms_change_db(*(beamed(found.runs[k::2].mean(axis=0)) for k in (0, 1))) / 2.0


ROOMS = {"floor": (floor_and_mirror, 1), "lobby": (lobby, 3)}  # and scatterings that are compared
LOOK = "9 rays a pixel where a mirror shows the ceiling beside the transmitter: 0.14 dB where 0.10 are asked"
FEW = "3 rays a pixel see what mirrors light: 0.36 dB where 0.14 are asked"
LIT = "mirrors light whole pieces of cells, or none of them: 1.5 dB where 0.18 are asked"
ELEMENTS = "elements are half a metre wide and have 128 rays: 0.57 dB of SS where 0.20 are asked, SSS 0.29 where 0.22"


def cases(**wrong: str) -> list[object]:
    """Rooms and sequences; marked are those that are known to be ``wrong``, and why."""
    found = []
    for case in "floor_S floor_SM floor_MS lobby_S lobby_SM lobby_MS lobby_SS lobby_SSS".split():
        room, sequence = case.split("_")
        why = wrong.get(case, "")
        known = [pytest.mark.xfail(bool(why), strict=True, raises=AssertionError, reason=why)]
        found.append(pytest.param(room, sequence, marks=known + [pytest.mark.long] * (room == "lobby")))
    return found


@pytest.mark.parametrize(
    "known",
    ["LOS M S MS SM", "MSM"],
)  # fmt: skip
def test_sequences_over_a_floor_and_a_mirror_follow_closed_forms(known):
    ours, exact = ours_in("floor"), closed_forms(floor_and_mirror())
    for sequence in known.split():
        assert abs(10.0 * np.log10(ours[sequence].sum() / exact[sequence])) < 0.05, sequence


def test_the_exact_engine_follows_closed_forms():
    ours, exact = exact_runs(floor_and_mirror(), Effects(), 4, 1), closed_forms(floor_and_mirror())
    for sequence in "S MS SM MSM".split():
        assert abs(10.0 * np.log10(ours[sequence].sum() / exact[sequence])) < 0.05, sequence


@pytest.mark.parametrize("rays", [4, 16])
def test_how_many_of_a_pixel_s_rays_go_on_changes_no_total(rays):
    """With two squared all go on, with four half of them are scattered; with sixteen a quarter is lit by mirrors."""
    link = replace(floor_and_mirror(), shape=(24, 48))
    once = exact_runs(link, replace(MIRRORED, scatter_mirror=False), rays, 1)["MS"]
    assert abs(10.0 * np.log10(once.sum() / closed_forms(link)["MS"])) < 0.05
    both = replace(link, does=np.full(4, SCATTER))
    alone = replace(MIRRORED, scatterings=2, mirror_scatter=False, scatter_mirror=False)
    some, every = (Estimate(exact_runs(both, alone, n, seeds)["SS"]) for n, seeds in ((rays, 4), (2, 40)))
    assert some.total == pytest.approx(every.total, rel=0.0, abs=4.0 * np.hypot(some.error, every.error))
    assert every.error < 0.02 * every.total


def test_what_is_scattered_twice_was_reflected_as_its_angle_has_it():
    """As the mean of |Gamma|^2 over all angles has it there is 5.6 % too much in a box, 6.4 % too little in the lobby; of what a
    mirror lights, 11 % too little here."""
    room, ends = (
        Mesh(*box_mesh([0, 0, 0], [6, 5, 3], inward=True)),
        np.array([[1.2, 1.5, 2.2], [4.3, 3.1, 1.3]]),
    )
    does = np.where(room.face_normals[:, 0] > 0.5, MIRROR, SCATTER)
    link = Link(room, does, *ends, 60e9, permittivity=3.0, shape=(24, 48))
    exact = exact_runs(link, replace(MIRRORED, scatterings=2, scatter_mirror=False), 4, 60)
    ours = sequences(link)
    for sequence, most in (("SS", 0.01), ("MSS", 0.015)):
        found = Estimate(exact[sequence])
        assert found.error < 0.004 * found.total
        assert ours[sequence].sum() == pytest.approx(found.total, rel=most, abs=0.0), sequence


@pytest.mark.long
@pytest.mark.parametrize(
    ("known", "effects", "sub_pixels", "seeds"),
    [
        ("S SM", replace(MIRRORED, mirror_scatter=False), 16, 1),
        ("MS", replace(MIRRORED, scatter_mirror=False), 16, 1),
        ("SS SSS", replace(MIRRORED, scatterings=3, mirror_scatter=False, scatter_mirror=False), 4, 80),
    ],
)
def test_the_exact_engine_follows_mitsuba_in_totals_and_images(known, effects, sub_pixels, seeds):
    sionna_or_skip()
    ours, found = exact_runs(lobby(), effects, sub_pixels, seeds), mitsubas("lobby")
    for sequence in known.split():
        own, theirs = Estimate(ours[sequence]), found[sequence]
        assert own.total == pytest.approx(theirs.total, rel=0.01, abs=0.0), sequence
        allowed_db = np.linalg.norm([0.1, noise_db(theirs), noise_db(own) if seeds > 1 else 0.0])
        assert rms_change_db(beamed(own.image), beamed(theirs.image)) < allowed_db, sequence


def test_mitsuba_follows_closed_forms():
    sionna_or_skip()
    exact = closed_forms(floor_and_mirror())
    for sequence in ("S", "SM", "MS"):
        found = mitsubas("floor")[sequence]
        assert found.error < 2e-3 * found.total
        assert found.total == pytest.approx(exact[sequence], rel=1e-4, abs=4.0 * found.error)


@pytest.mark.parametrize(("room", "sequence"), cases())
def test_totals_are_those_of_mitsuba(room, sequence):
    sionna_or_skip()
    ours, found = compared(room, sequence)
    assert found.error < 5e-3 * found.total
    assert ours.sum() == pytest.approx(found.total, rel=0.01, abs=0.0)


@pytest.mark.parametrize(
    ("room", "sequence"),
    cases(floor_MS=FEW, lobby_SM=LOOK, lobby_MS=LIT, lobby_SS=ELEMENTS, lobby_SSS=ELEMENTS),
)  # fmt: skip
def test_images_are_those_of_mitsuba(room, sequence):
    sionna_or_skip()
    ours, found = compared(room, sequence)
    assert rms_change_db(beamed(ours), beamed(found.image)) < np.hypot(0.1, noise_db(found))

"""Small inputs to public verbs without a closed form, and what came out of them when the goldens were written.

``python tests/golden/make.py [CASE ...]`` writes ``tests/golden/CASE.npz``, ``tests/test_golden.py`` compares. A case
uses public names alone, so that it holds however the library is arranged inside. It returns named arrays, each with the
check that fits what it is: to the bit where nothing depends on how a kernel was compiled, else a tolerance with its
reason. Write goldens anew only where a result is meant to change, and say so in the change's message.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import warprrf as wr

HERE = Path(__file__).parent
CARRIER_HZ = 300e9
TRANSMITTER = np.array([1.1, 1.3, 2.4])
BEAM_RAD = np.deg2rad(6.0)
SHAPE = (18, 36)


@dataclass(frozen=True)
class Check:
    """How a value is compared with its golden.

    Attributes:
        rtol, atol: of :func:`numpy.isclose`; both zero means to the bit.
        decibels: compare 10 log10 of the values, ``atol`` in dB, where the golden is above 1e-6 of its maximum.
        psnr_db: instead of element by element, the least PSNR of the dB image over 60 dB below the golden's maximum.
    """

    rtol: float = 0.0
    atol: float = 0.0
    decibels: bool = False
    psnr_db: float | None = None

    def failure(self, now: np.ndarray, golden: np.ndarray) -> str | None:
        """What is wrong with ``now``, or None."""
        if now.shape != golden.shape:
            return f"shape {now.shape}, golden {golden.shape}"
        if now.dtype.kind != golden.dtype.kind:
            return f"dtype {now.dtype}, golden {golden.dtype}"
        if self.psnr_db is not None:
            found = _psnr_db(now, golden)
            return None if found >= self.psnr_db else f"PSNR {found:.1f} dB, at least {self.psnr_db} wanted"
        if now.dtype.kind in "USbiu" or (self.rtol == 0 and self.atol == 0):
            wrong = (now != golden) & ((now == now) | (golden == golden))  # two NaN are alike
        elif self.decibels:
            counts = golden > 1e-6 * golden.max()
            with np.errstate(divide="ignore", invalid="ignore"):
                wrong = counts & ~(np.abs(10 * np.log10(now) - 10 * np.log10(golden)) <= self.atol)
        else:
            wrong = ~np.isclose(now, golden, rtol=self.rtol, atol=self.atol, equal_nan=True)
        if not wrong.any():
            return None
        first = tuple(np.argwhere(wrong)[0]) if wrong.ndim else ()
        return f"{np.mean(wrong):.2%} of the elements differ, first at {first}: {now[first]!r}, golden {golden[first]!r}"


def _psnr_db(now: np.ndarray, golden: np.ndarray) -> float:
    high = golden.max()
    with np.errstate(divide="ignore"):
        images = [np.clip(10 * np.log10(x / high) / 60 + 1, 0, 1) for x in (now, golden)]
    return float(-10 * np.log10(max(np.mean((images[0] - images[1]) ** 2), 1e-12)))


BITS = Check()
FLOAT64 = Check(rtol=1e-9, atol=1e-15)  # float64 arithmetic in whatever order
PHASE = Check(rtol=1e-6, atol=1e-16)  # 2 pi f tau is 1e5 rad here: what 1e-12 of a delay makes of it
# Fits stop where a step no longer pays: rounding moves their parameters, hardly what they predict.
FITTED = Check(psnr_db=45.0)
FITTED_DB = Check(atol=0.3, decibels=True)

Values = dict[str, tuple[object, Check]]
CASES: dict[str, Callable[[], Values]] = {}


def case(function: Callable[[], Values]) -> Callable[[], Values]:
    """Enter a case under its name."""
    CASES[function.__name__] = function
    return function


def values(name: str) -> dict[str, tuple[np.ndarray, Check]]:
    """The arrays of a case, each with its check."""
    return {key: (np.asarray(value), check) for key, (value, check) in CASES[name]().items()}


Part = tuple[np.ndarray, np.ndarray]
"""Vertices and faces."""


def box_mesh(low: ArrayLike, high: ArrayLike, inward: bool = False) -> Part:
    """A closed box, 6 sides of 2 faces, wound so that normals point outward, or inward."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return low + corners * (high - low), faces[:, ::-1] if inward else faces


def joined(*parts: Part) -> tuple[wr.Mesh, np.ndarray]:
    """One mesh of several parts, and the part each face came from."""
    shift = np.cumsum([0] + [len(v) for v, _ in parts])
    mesh = wr.Mesh(
        np.concatenate([v for v, _ in parts]),
        np.concatenate([f + s for (_, f), s in zip(parts, shift, strict=False)]),
    )
    return mesh, np.repeat(np.arange(len(parts)), [len(f) for _, f in parts])


def room_mesh() -> tuple[wr.Mesh, np.ndarray]:
    """A room of 6 x 5 x 3 m with a cupboard and a screen, and the part each face belongs to."""
    return joined(
        box_mesh((0, 0, 0), (6, 5, 3), inward=True),
        box_mesh((2.5, 2.0, 0.0), (3.4, 3.2, 1.9)),
        box_mesh((4.6, 1.0, 0.4), (4.7, 2.6, 2.2)),
    )


@cache
def room() -> wr.Scene:
    """The room with three materials."""
    mesh, part = room_mesh()
    materials = [
        wr.Material.custom("plaster", relative_permittivity=2.7, conductivity=0.5, scattering=0.6),
        wr.Material.custom("wood", relative_permittivity=2.0, conductivity=1.5, scattering=0.8),
        wr.Material.conductor(scattering=0.3, pattern="directive", alpha_r=10),
    ]
    return wr.Scene(mesh, materials, part, face_object=part, object_names=("room", "cupboard", "screen"))


def places(count: int) -> np.ndarray:
    """Receivers in the room's free space, some behind the cupboard."""
    x = np.linspace(0.7, 5.5, count)
    y = np.where(np.arange(count) % 2 == 0, 4.2, 0.7)
    return np.stack([x, y, np.linspace(1.0, 1.8, count)], axis=1)


def links(count: int) -> dict[str, Any]:
    """The transmitter, ``count`` receivers and the carrier."""
    return {"transmitter": TRANSMITTER, "receivers": places(count), "frequency_hz": CARRIER_HZ}


@cache
def spectra() -> wr.SpectrumDataset:
    """Spectra of eight receivers by the exact engine."""
    return wr.simulate(room(), **links(8), shape=SHAPE, beam_sigma_rad=BEAM_RAD)


@cache
def bistatic() -> wr.RadioField:
    """A bistatic field fitted to three of them: nothing held out."""
    return wr.RadioField.fit(room(), spectra().subset([0, 3, 6]), model="bistatic")


def pinhole() -> wr.Camera:
    """A camera at (0, -4, 0) that looks along +y."""
    pose = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 4], [0, 0, 0, 1]])
    return wr.Camera.pinhole(48, 32, fx=40.0, fy=42.0, cx=23.5, cy=16.5, world_to_camera=pose)


def _paths(paths: wr.Paths, gain: Check = PHASE, length: Check = FLOAT64) -> Values:
    """Paths of one receiver, by kind and delay, so that the order in which they are found does not count."""
    order = np.lexsort((np.round(paths.theta_r, 6), np.round(paths.tau * 1e15), paths.kind))
    order = order[np.asarray(paths.valid)[order]]
    return {
        "kind": (np.asarray(paths.kind)[order], BITS),
        "tau": (paths.tau[order], length),
        "gain": (paths.gain[order], gain),
        "arrival": (np.stack([paths.theta_r, paths.phi_r])[:, order], Check(rtol=1e-7, atol=1e-7)),
        "departure": (np.stack([paths.theta_t, paths.phi_t])[:, order], Check(rtol=1e-7, atol=1e-7)),
        "vertices": (paths.vertices[order], Check(rtol=1e-6, atol=1e-6)),
    }


def _each(paths: Iterable[wr.Paths], prefix: str) -> Values:
    """:func:`_paths` of several, numbered."""
    found = {f"{prefix}_{i}": _paths(one) for i, one in enumerate(paths)}
    return {f"{name}_{key}": value for name, of_one in found.items() for key, value in of_one.items()}


@case
def paths_of_a_scene() -> Values:
    paths = wr.trace_paths(room(), **links(4), mirror_order=2, gas=True)
    return _each(paths.each(), "receiver")


def _asked(field: wr.RadioField, ds: wr.SpectrumDataset, last: np.ndarray) -> Values:
    """What a fitted field answers at a receiver that it has not seen, and how it scores there."""
    spectrum = field.spectrum(last)
    score = wr.evaluate(ds.subset([1, 4]), field.spectrum)
    return {
        "path_gain": (spectrum.path_gain, FITTED),
        "total": (spectrum.path_gain.sum(), FITTED_DB),
        "delay_s": (np.nanmedian(spectrum.delay_s), Check(rtol=0.01)),
        "psnr_db": (score["psnr_db"], Check(atol=0.25)),
        "rmse_db": (score["rmse_db"], Check(atol=0.1)),
    }


@case
def bistatic_field() -> Values:
    field, ds = bistatic(), spectra()
    rx = ds.receivers[2]
    moved = field.spectrum(rx, transmitter=(4.0, 4.0, 2.2))
    paths = field.paths(rx)
    with tempfile.TemporaryDirectory() as folder:
        field.save(Path(folder) / "field.safetensors")
        back = wr.RadioField.load(Path(folder) / "field.safetensors").spectrum(rx)
    sharp = np.asarray(paths.kind) != "diffuse"
    some = field.paths(rx, max_paths=5)
    return {
        **_asked(field, ds, rx),
        "moved": (moved.path_gain, FITTED),
        "model": (field.model, BITS),
        "back": (np.allclose(back.path_gain, field.spectrum(rx).path_gain, rtol=1e-6), BITS),
        "sum": (abs(np.sum(np.abs(paths.gain) ** 2) / field.spectrum(rx).path_gain.sum() - 1) < 1e-5, BITS),
        "mirror_tau": (np.sort(paths.tau[sharp]), FLOAT64), "kinds": (np.unique(paths.kind), BITS),
        "mirror_power": (np.sort(np.abs(paths.gain[sharp]) ** 2), Check(rtol=0.05)),
        "some": (len(some.gain), BITS),
        "air": (field.with_gas(True).spectrum(rx).path_gain, FITTED),
    }  # fmt: skip


@case
def bistatic_field_with_held_out_receivers() -> Values:
    ds = spectra()
    field = wr.RadioField.fit(room(), ds.subset([0, 2, 3, 5, 6, 7]), model="bistatic", sub_pixels=1)
    doubtful = field.spectrum(ds.receivers[4], uncertainty=True)
    return {
        **_asked(field, ds, ds.receivers[4]),
        "std_db": (np.median(doubtful.std_db), Check(rtol=0.1)),
    }


@case
def bistatic_field_of_a_bare_mesh() -> Values:
    ds = spectra()
    field = wr.RadioField.fit(room().mesh, ds.subset([0, 3, 6]))
    return _asked(field, ds, ds.receivers[4])


@case
def rf3dgs_plus() -> Values:
    ds = spectra()
    field = wr.RadioField.fit(room(), ds.subset([0, 3, 6]), model="rf3dgs+", iterations=40)
    paths = field.paths(ds.receivers[1])
    return {**_asked(field, ds, ds.receivers[1]), "power": (np.sum(np.abs(paths.gain) ** 2), FITTED_DB)}


@case
def rf3dgs() -> Values:
    ds = spectra()
    field = wr.RadioField.fit(room(), ds.subset([0, 3, 6]), model="rf3dgs", iterations=40)
    return _asked(field, ds, ds.receivers[1])


@case
def coverage() -> Values:
    field = bistatic()
    links = field.links(places(5), beam_sigma_rad=BEAM_RAD)
    chart = field.radio_map(1.4, cell=1.0, beam_sigma_rad=BEAM_RAD)
    with tempfile.TemporaryDirectory() as folder:
        chart.save(Path(folder) / "map.nc")
        back = wr.RadioMap.load(Path(folder) / "map.nc")
    return {
        "link_total": (links.total_path_gain, FITTED_DB), "link_best": (links.best_path_gain, FITTED_DB),
        "link_spread_s": (links.delay_spread_s, Check(rtol=0.05)), "link_beam": (links.best_beam_gain, FITTED_DB),
        "x": (chart.x, FLOAT64), "y": (chart.y, FLOAT64), "free": (chart.free, BITS),
        "total": (np.nan_to_num(chart.total_path_gain), FITTED_DB),
        "back": (np.array_equal(back.total_path_gain, chart.total_path_gain, equal_nan=True), BITS),
    }  # fmt: skip


@case
def relevance() -> Values:
    found = wr.relevance(
        room(), transmitter=TRANSMITTER, receivers=places(3)[1:], frequency_hz=CARRIER_HZ, tolerance_db=1.0,
        shape=SHAPE, beam_sigma_rad=BEAM_RAD,
    )  # fmt: skip
    told = found.to_dict()
    effects = {e["name"]: e for e in told["effects"]} if "effects" in told else {}
    return {
        "names": (sorted(effects), BITS),
        "image_db": (found.image_db, Check(atol=0.2)), "total_db": (found.total_db, Check(atol=0.2)),
    }  # fmt: skip


def main(names: list[str]) -> None:
    """Write the goldens of ``names``, or all."""
    for name in names or CASES:
        np.savez_compressed(HERE / f"{name}.npz", **{k: v for k, (v, _) in values(name).items()})
        print(name)


if __name__ == "__main__":
    main(sys.argv[1:])

"""Coherent arrays: normalised angular spectra of 4 x 4 elements, predicted from twenty places on the true mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.fits import FitOptions, Fits, experiment
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.rf.channel.array_spectra import UP, hemisphere
from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine

HELP = """\
An array of 4 x 4 vertical elements lies flat at receivers of the lobby and hears the complex paths of Sionna RT (three bounces);
scattered ones get random phases. Its spectra |a^H h|^2 over the upper hemisphere are normalised to their peak and stored with 8
bits, as NeRF2 does. A field on the true mesh is fitted to those at training receivers and predicts those at test receivers.

examples:
  python -m benchmarks arrays
  python -m benchmarks arrays --every 4 --carriers-ghz 2.4     a first look
"""

SHAPE = (90, 360)
ARRAY = wr.PlanarArray(4, 4, orientation=UP)
SCATTERING = 0.3
"""Assumed of every surface: what stands on walls and behind them, of which no mesh knows."""
NO_PHASES_M = 1e3  # lengths of paths that are known so badly let mirrors add up in power
COLUMNS = {
    "rows": (
        ("carrier_ghz", "carrier [GHz]", "{:g}"), ("method", "", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
        ("gained_db", "over the nearest [dB]", "{:+.2f}"), ("psnr_db_blocked", "blocked [dB]", "{:.2f}"),
    )
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(FitOptions):
    """Options of the comparison.

    Attributes:
        carriers_ghz: carriers.
        samples: rays of Sionna RT.
    """

    truths: tuple[str, ...] = ("sionna",)
    counts: tuple[int, ...] = option((20,), "training receivers")
    carriers_ghz: tuple[float, ...] = option((2.4, 28.0), "carriers [GHz]")
    samples: int = option(300_000, "rays of Sionna RT")


def at_low_carriers(scene: wr.Scene) -> wr.Scene:
    """``scene`` with what P.2040 says below 100 GHz, and :data:`SCATTERING`."""

    def known(material: wr.Material) -> wr.Material:
        name = material.itu or material.name
        added = () if name == "metal" else wr.em.itu_material(name).bands
        return replace(material, bands=(*added, *material.bands), scattering=SCATTERING)

    return scene.with_materials([known(material) for material in scene.materials])


def heard(
    scene: wr.Scene, transmitter: Any, places: np.ndarray, carrier_hz: float, samples: int
) -> np.ndarray:
    """Spectra of the array at each of ``places`` (R, 3), normalised to their peak, in steps of 8 bits."""
    engine = SionnaEngine(
        scene, transmitter=transmitter, frequency_hz=carrier_hz, shape=(18, 36), sampling=Sampling(3, samples, seed=7)
    )  # fmt: skip
    rng, steering, found = np.random.default_rng(7), ARRAY.response(hemisphere(SHAPE), 1.0).conj(), []
    for place in places:
        paths = engine.solve(place)
        random = np.exp(2j * np.pi * rng.random(len(paths.tau)))
        amplitude = np.asarray(paths.jones)[:, 0, 0] * np.where(paths.kind == "diffuse", random, 1.0)
        found.append(np.abs(steering @ (ARRAY.response(paths.arrival, 1.0).T @ amplitude)) ** 2)
    return np.asarray(np.round(255.0 * normalised(np.stack(found))), np.uint8)


def normalised(power: np.ndarray) -> np.ndarray:
    """Pictures (..., H, W) over their peaks."""
    return np.asarray(power / power.max(axis=(-2, -1), keepdims=True))


def psnr(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """PSNR of normalised pictures (R, H, W) with values from 0 to 1 [dB], shape ``(R,)``."""
    return np.asarray(-10.0 * np.log10(((prediction - truth) ** 2).mean(axis=(1, 2))))


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """A row for each carrier and way to predict what is heard at the test receivers."""
    scene = wr.Scene.load(options.xml)
    (truth,) = options.load()
    train, test = truth.train(truth.few), truth.test
    places = np.concatenate([train.receivers, test.receivers])
    near = np.linalg.norm(test.receivers[:, None] - train.receivers, axis=2).argmin(axis=1)
    for carrier in options.carriers_ghz:

        def hear(hz: float = 1e9 * carrier) -> dict[str, np.ndarray]:
            low = at_low_carriers(scene)
            return {"spectra": heard(low, train.transmitter, places, hz, options.samples)}

        inputs = [fits.key, truth.few, options.samples]
        kept = fits.steps.arrays(f"spectra-{carrier:g}", hear, version=1, inputs=inputs)["spectra"] / 255.0
        known, asked = kept[: len(train)], kept[len(train) :]
        measured = wr.channel.ArraySpectra(
            train.transmitter, train.receivers, known, carrier * 1e9, ARRAY, hemisphere(SHAPE)
        )
        make = partial(_fields, fits, scene, measured, asked, test)
        found = fits.row(f"{carrier:g} GHz", make, truth.few, options.samples)
        mean = np.broadcast_to(normalised(known.mean(axis=0)), asked.shape)
        base = psnr(known[near], asked)
        each = {"nearest training receiver": base, "mean picture": psnr(mean, asked), **found["psnr_db"]}
        for method, values in each.items():
            blocked = float(np.mean(np.asarray(values)[~np.asarray(test.line_of_sight)]))
            row = {"carrier_ghz": carrier, "method": method, "psnr_db": float(np.mean(values))}
            yield {**row, "gained_db": row["psnr_db"] - float(base.mean()), "psnr_db_blocked": blocked}


def _fields(fits: Fits, scene: wr.Scene, measured: Any, asked: np.ndarray, test: wr.SpectrumDataset) -> Row:
    """PSNR [dB] of every test receiver, of a fitted field with and without phases of mirrors, and of its start."""
    fitted = fits.fit(scene, measured)
    p = fitted.parameters
    prior = type(p).prior(len(p.log_weight), p.lobes, reciprocal=p.reciprocal)
    start = replace(fitted, parameters=prior, residual=0.0 * fitted.residual)

    def scored(field: Any, length_std_m: float = 0.0) -> list[float]:
        asking = ARRAY, hemisphere(SHAPE), measured.transmitters[0]
        pictures = [field.array_spectrum(rx, *asking, length_std_m=length_std_m) for rx in test.receivers]
        return [float(value) for value in psnr(normalised(np.stack(pictures)), asked)]

    return {
        "psnr_db": {
            "field, no readings": scored(start),
            "field, powers of mirrors added": scored(fitted, NO_PHASES_M),
            "field": scored(fitted),
        }
    }


ABOUT = "Normalised spectra of 4 x 4 elements, true mesh, Sionna RT's complex paths."
BENCHMARKS = {"arrays": experiment("arrays", Options, rows, COLUMNS, ABOUT, HELP)}

"""Coherent arrays: normalised angular spectra of 4 x 4 elements, predicted from twenty places on the true mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import DATA, Truth
from benchmarks.machine import machine
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf import tensor_files
from warprrf.rf.channel.array_spectra import UP, hemisphere
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine
from warprrf.steps import Attempt, Steps

HELP = """\
An array of 4 x 4 vertical elements lies flat at receivers of the lobby and hears the complex paths of Sionna RT (three bounces);
scattered ones get random phases. Its spectra |a^H h|^2 over the upper hemisphere are normalised to their peak and stored with 8
bits, as NeRF2 does. A field on the true mesh is fitted to those at training receivers and predicts those at test receivers.

examples:
  python -m benchmarks arrays
  python -m benchmarks arrays --every 4 --carriers-ghz 2.4     a first look
"""

KIND = "channels of arrays from Sionna RT's paths 1"
ELEMENTS, SHAPE = 4, (90, 360)
SCATTERING = 0.3
"""Assumed of every surface: what stands on walls and behind them, of which no mesh knows."""
COLUMNS = (
    ("carrier_ghz", "carrier [GHz]", "{:g}"), ("method", "", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
    ("gained_db", "over the nearest [dB]", "{:+.2f}"), ("psnr_db_blocked", "blocked [dB]", "{:.2f}"),
    ("fit_s", "fit [s]", "{:.0f}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        scene: true scene (XML).
        spectra: data set whose receivers are used (NetCDF).
        carriers_ghz: carriers.
        train: training receivers.
        every: each how-manieth test receiver counts.
        samples: rays of Sionna RT.
    """

    scene: str = option(str(Path(DATA) / "scene.xml"), "true scene (XML)")
    spectra: str = option(str(Path(DATA) / "spectra_sionna.nc"), "data set whose receivers are used (NetCDF)")
    carriers_ghz: tuple[float, ...] = option((2.4, 28.0), "carriers [GHz]")
    train: int = option(20, "training receivers")
    every: int = option(1, "each how-manieth test receiver counts")
    samples: int = option(300_000, "rays of Sionna RT")


def at_low_carriers(scene: wr.Scene) -> wr.Scene:
    """``scene`` with what P.2040 says below 100 GHz, and :data:`SCATTERING`."""

    def known(material: wr.Material) -> wr.Material:
        name = material.itu or material.name
        added = () if name == "metal" else wr.em.itu_material(name).bands
        return replace(material, bands=(*added, *material.bands), scattering=SCATTERING)

    return scene.with_materials([known(material) for material in scene.materials])


def array() -> wr.PlanarArray:
    """The array, flat."""
    return wr.PlanarArray(ELEMENTS, ELEMENTS, orientation=UP)


def channels(
    scene: wr.Scene,
    transmitter: np.ndarray,
    places: np.ndarray,
    carrier_hz: float,
    options: Options,
    attempt: Attempt,
) -> dict[str, np.ndarray]:
    """What the array hears at each of ``places`` (R, 3), real and imaginary, shape ``(R, M)``."""
    engine = SionnaEngine(
        scene, transmitter=transmitter, frequency_hz=carrier_hz, shape=(18, 36), sampling=Sampling(3, options.samples, seed=7)
    )  # fmt: skip
    rng, heard = np.random.default_rng(7), []
    for k, place in enumerate(places):
        attempt.progress("paths", k, len(places))
        paths = engine.solve(place)
        phase = np.exp(-2j * np.pi * np.mod(carrier_hz * paths["tau"], 1.0))
        random = np.exp(2j * np.pi * rng.random(len(phase)))
        amplitude = paths["jones"][:, 0, 0] * np.where(paths["diffuse"], random, phase)
        heard.append(array().response(paths["arrival"], 1.0).T @ amplitude)
    attempt.progress("paths", len(places), len(places))
    return {"real": np.real(heard), "imag": np.imag(heard)}


def pictures(heard: np.ndarray) -> np.ndarray:
    """Spectra of channels (R, M), normalised to their peak, in steps of 8 bits."""
    steering = array().response(hemisphere(SHAPE), 1.0).conj()
    power = np.stack([np.abs(steering @ h) ** 2 for h in heard])
    return np.asarray(np.round(255.0 * normalised(power)) / 255.0)


def normalised(power: np.ndarray) -> np.ndarray:
    """Pictures (..., H, W) over their peaks."""
    return np.asarray(power / power.max(axis=(-2, -1), keepdims=True))


def psnr(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """PSNR of normalised pictures (R, H, W) with values from 0 to 1 [dB], shape ``(R,)``."""
    return np.asarray(-10.0 * np.log10(((prediction - truth) ** 2).mean(axis=(1, 2))))


def run(options: Options, job: Job) -> Report:
    """Hear, fit and score.

    Raises:
        FileNotFoundError, ValueError: as the scene and the data set do.
    """
    scene = wr.Scene.load(options.scene)
    truth = Truth.load(Path(options.spectra), (options.train,), options.every)
    train, test = truth.train(options.train), truth.test
    places = np.concatenate([train.receivers, test.receivers])
    rows: list[dict[str, Any]] = []
    for carrier in options.carriers_ghz:
        file = f"channels_{carrier:g}.safetensors"

        def hear(attempt: Attempt, carrier: float = carrier, file: str = file) -> dict[str, Any]:
            low = at_low_carriers(scene)
            found = channels(low, train.transmitter, places, carrier * 1e9, options, attempt)
            tensor_files.write(job.out / file, found, {}, KIND)
            return {}

        with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
            inputs = [
                truth.key,
                Path(options.scene).read_text(),
                options.every,
                options.train,
                options.samples,
            ]
            steps.run(f"channels at {carrier:g} GHz", hear, version=1, inputs=inputs, outputs=[file])
        parts = tensor_files.read(job.out / file, KIND)[0]
        seen = pictures(parts["real"] + 1j * parts["imag"])
        rows += compare(scene, train, test, seen, carrier, job)
    text = (
        f"Normalised spectra of {ELEMENTS} x {ELEMENTS} elements, {len(train)} training and {len(test)} test receivers, true "
        f"mesh, Sionna RT's complex paths.\n\n{columns_table(COLUMNS, rows)}"
    )
    return Report("arrays", {"machine": machine(job.device), "scattering": SCATTERING, "rows": rows}, text)


def compare(
    scene: wr.Scene,
    train: wr.SpectrumDataset,
    test: wr.SpectrumDataset,
    seen: np.ndarray,
    carrier: float,
    job: Job,
) -> list[dict[str, Any]]:
    """A row for each way to predict the pictures ``seen`` of the test receivers, which follow those of training."""
    known, asked = seen[: len(train)], seen[len(train) :]
    blocked = ~np.asarray(test.line_of_sight)
    measured = wr.channel.ArraySpectra(
        train.transmitter, train.receivers, known, carrier * 1e9, array(), hemisphere(SHAPE)
    )
    nearest = known[np.linalg.norm(test.receivers[:, None] - train.receivers, axis=2).argmin(axis=1)]
    fitted = BistaticField.fit(scene, measured, device=job.device, progress=job.progress)
    without = replace(
        fitted, parameters=type(fitted.parameters).prior(*fitted.parameters.log_weight.shape), residual=0.0 * fitted.residual
    )  # fmt: skip

    def drawn(field: BistaticField, length_std_m: float = 0.0) -> np.ndarray:
        return normalised(
            np.stack(
                [
                    field.array_spectrum(
                        place, array(), hemisphere(SHAPE), train.transmitter, length_std_m=length_std_m
                    )
                    for place in test.receivers
                ]
            )
        )

    predictions = {
        "nearest training receiver": nearest,
        "mean picture": np.broadcast_to(normalised(known.mean(axis=0)), asked.shape),
        "field, no readings": drawn(without),
        "field, powers of mirrors added": drawn(fitted, 1e3),
        "field": drawn(fitted),
    }
    rows = []
    base = float(psnr(nearest, asked).mean())
    for method, prediction in predictions.items():
        each = psnr(prediction, asked)
        rows.append(
            {
                "carrier_ghz": carrier, "method": method, "psnr_db": float(each.mean()),
                "gained_db": float(each.mean()) - base, "psnr_db_blocked": float(each[blocked].mean()),
                "fit_s": fitted.report["fit_time_s"] + fitted.report["transport_time_s"] if method == "field" else None,
            }
        )  # fmt: skip
    return rows


BENCHMARKS = {"arrays": Benchmark("arrays", Options, run, HELP)}

"""What the bistatic field's parts are worth, how often errors lie within the stated uncertainty, and delays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import Geometry, Truth
from benchmarks.fits import FitOptions, Fits, experiment
from benchmarks.report import Row
from warprrf.rf.spectra import metrics
from warprrf.rf.spectra.spectrum import pixel_directions, to_db

HELP = """\
Fields on the reconstruction of `make lobby`: with one part of the model left out at a time; the share of errors within the
stated uncertainty; delays of mirrors and of scattering, path by path. Beside other methods the field stands in
`python -m benchmarks paper`. Each row is kept as soon as it is finished.

examples:
  python -m benchmarks bistatic
  python -m benchmarks bistatic --truths exact --counts 10 --every 4 --out runs/quick     a first look, in minutes
"""

ABLATION: dict[str, dict[str, Any]] = {
    "no line of sight": {"effects": {"line_of_sight": False}},
    "no mirrors": {"effects": {"mirrors": 0, "mirror_scatter": False, "scatter_mirror": False}},
    "no scattering": {"effects": {"scatterings": 0}},
    "Lambertian lobe alone": {"lobes": (0,)},
    "nothing after the first bounce": {
        "effects": {"mirror_scatter": False, "scatter_mirror": False, "scatterings": 1}
    },
    "no residual per element": {"effects": {"residual": False}},
}  # fmt: skip
"""Options of the fit that leave a part of the model out; of the effects that the whole field chose, what is changed."""
MATCH_DEG = 3.0  # a path of ours within this angle of a true one is that path
AWAY_SIGMA = 5.0  # a pixel further than this from every sharp path holds scattering: its beam is 54 dB down
COLUMNS = {
    "ablation": (
        ("truth", "truth", "{}"), ("n_train", "spectra", "{}"), ("model", "model", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
        ("psnr_db_blocked", "blocked", "{:.2f}"), ("rmse_db", "RMSE [dB]", "{:.2f}"),
        ("direction_within_3deg", "within 3 degrees", "{:.0%}"), ("direction_within_3deg_blocked", "blocked", "{:.0%}"),
    ),
    "calibration": (
        ("truth", "truth", "{}"), ("n_train", "spectra", "{}"), ("rms_error_db", "rms error [dB]", "{:.2f}"),
        ("within_1_sigma", "within one standard deviation", "{:.1%}"), ("within_2_sigma", "within two", "{:.1%}"),
    ),
    "delays": (
        ("truth", "truth", "{}"), ("n_train", "spectra", "{}"), ("found", "mirror paths found", "{:.0%}"),
        ("mirror_ns", "their delay error, median [ns]", "{:.4f}"), ("scattering_ns", "scattering's [ns]", "{:.3f}"),
    ),
}  # fmt: skip


def rows(options: FitOptions, fits: Fits) -> Iterator[Row]:
    """The whole field at every number of spectra; with parts left out, on the true mesh, and unfitted at the smallest."""
    place = options.place(fits.job.device)
    for truth in options.load():
        about = {"truth": truth.name, "n_train": truth.few}
        for count in truth.counts:
            row = fits.row(f"{truth.name} {count}", partial(_whole, fits, place, truth, count))
            own = about | {"n_train": count}
            yield own | {"part": "calibration", **row["calibration"]}
            yield own | {"part": "delays", **row["delays"]}
            if count == truth.few:
                whole = wr.Effects(**row["effects"])
                yield own | {"part": "ablation", "model": "everything", **row["scores"]}
        train = truth.train(truth.few)
        others: dict[str, tuple[Any, dict[str, Any]]] = {}
        for name, left_out in ABLATION.items():
            effects = replace(whole, **left_out.get("effects", {}))
            others[name] = place.reconstruction, left_out | {"effects": effects}
        others["true mesh, its materials as groups"] = place.scene, {}
        for name, (geometry, given) in others.items():
            make = partial(fits.scored, geometry, train, truth.test, **given)
            row = fits.row(f"{truth.name} {truth.few} {name}", make, given)
            yield about | {"part": "ablation", "model": name, **row}
        make = partial(fits.scored, place.reconstruction, truth.data.subset([]), truth.test)
        row = fits.row(f"{truth.name} zero", make)
        yield about | {"part": "ablation", "model": "zero spectra", **row, "n_train": 0}


def _whole(fits: Fits, place: Geometry, truth: Truth, count: int) -> Row:
    field = fits.fit(place.reconstruction, truth.train(count))
    return {
        "effects": asdict(field.effects),
        "scores": fits.score(field, truth.test),
        "calibration": calibration(field, truth.test),
        "delays": delays(field, place.scene, truth.test),
    }


def calibration(field: Any, test: wr.SpectrumDataset) -> Row:
    """Rms error of the dB image, and how often the truth lies as near to the prediction as its standard deviation says."""
    errors, deviations = [], []
    for receiver, truth in zip(test.receivers, test.path_gain, strict=True):
        found = field.spectrum(receiver, uncertainty=True)
        errors.append(np.abs(to_db(found.path_gain, test.floor) - to_db(truth, test.floor)))
        deviations.append(found.std_db)
    error, deviation = np.stack(errors), np.stack(deviations)
    within = {f"within_{k}_sigma": float(np.mean(error <= k * deviation)) for k in (1, 2)}
    return {"rms_error_db": float(np.sqrt(np.mean(error**2))), **within}


def delays(field: Any, scene: wr.Scene, test: wr.SpectrumDataset) -> Row:
    """Share of the true scene's mirror paths above the floor that the field has within 3 degrees, the median error of their
    delays [ns], and that of pixels away from sharp paths, weighted by power (a missing delay counts as infinite)."""
    link: dict[str, Any] = {"transmitter": test.transmitter, "frequency_hz": test.frequency_hz}
    traced = wr.trace_paths(scene, receivers=test.receivers, mirror_order=1, **link)
    directions, paths = pixel_directions(test.shape), 0
    mirrors: list[float] = []
    scattered: list[tuple[np.ndarray, np.ndarray]] = []
    for i, receiver in enumerate(test.receivers):
        true, ours = traced[i], field.paths(receiver)
        mine = np.flatnonzero(ours.kind == "mirror")
        for k in np.flatnonzero((true.kind == "mirror") & (true.power > test.floor)):
            paths += 1
            apart = metrics.angle_deg(ours.arrival[mine], true.arrival[k])
            if len(mine) and apart.min() <= MATCH_DEG:
                mirrors.append(1e9 * float(abs(ours.tau[mine[apart.argmin()]] - true.tau[k])))
        near = [metrics.angle_deg(directions, arrival) for arrival in true.arrival]
        away = np.min([np.full(test.shape, 180.0), *near], axis=0) > AWAY_SIGMA * np.degrees(
            test.beam_sigma_rad
        )
        away &= (test.path_gain[i] > test.floor) & np.isfinite(test.delay_s[i])
        error = 1e9 * np.abs(np.asarray(field.spectrum(receiver).delay_s) - test.delay_s[i])[away]
        scattered.append(
            (np.where(np.isnan(error), np.inf, error), test.path_gain[i][away].astype(np.float64))
        )
    by_power = metrics.weighted_median(*(np.concatenate(parts) for parts in zip(*scattered, strict=True)))
    known = {"found": len(mirrors) / paths, "mirror_ns": float(np.median(mirrors))} if mirrors else {}
    return {"found": None, "mirror_ns": None, **known, "scattering_ns": by_power}


ABOUT = "Fields on the lobby reconstructed from photos, test receivers that none has seen."
BENCHMARKS = {"bistatic": experiment("bistatic", FitOptions, rows, COLUMNS, ABOUT, HELP)}

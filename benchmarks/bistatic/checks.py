"""What the table of methods does not say: which term is worth what, how sure the field is, delays, another transmitter.

Each function makes one row from a fitted field or from a fit of its own, and returns plain figures.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import Geometry, Truth
from benchmarks.report import Row
from warprrf.device import Progress
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.uncertainty import OUTLIERS
from warprrf.rf.spectra import metrics
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import pixel_directions, to_db
from warprrf.steps import Attempt

ABLATION: dict[str, dict[str, Any]] = {
    "no line of sight": {"line_of_sight": False},
    "no mirrors": {"mirror_order": 0, "mirror_scatter": False, "scatter_mirror": False},
    "no scattering": {"diffuse": False},
    "Lambertian lobe alone": {"lobes": (0,)},
    "nothing after the first bounce": {
        "mirror_scatter": False,
        "scatter_mirror": False,
        "diffuse_order": 1,
        "indirect": False,
    },
    "no residual per element": {"residual": False},
    "true mesh, its materials as groups": {},
}
"""Options of the fit that leave a part of the model out. The last one fits on the true scene instead."""
TRUE_MESH = "true mesh, its materials as groups"

LEVELS = (*np.round(np.arange(0.05, 1.0, 0.05), 2).tolist(), 0.99)
"""Shares of pixels at which the reliability curve is read."""
MATCH_DEG = 3.0  # a path of ours within this angle of a true one is that path
NEAR_A_PATH_SIGMA = (
    5.0  # a pixel further than this from every specular path holds scattering: its beam is 54 dB down
)


def ablation(name: str, truth: Truth, count: int, geometry: Geometry, progress: Progress) -> Row:
    """Figures of a bistatic field fitted with the options of :data:`ABLATION` on ``count`` receivers."""
    place = geometry.scene if name == TRUE_MESH else geometry.reconstruction
    field: Any = wr.RadioField.fit(
        place,
        truth.train(count),
        model="bistatic",
        device=geometry.device,
        progress=progress,
        **ABLATION[name],
    )
    found = metrics.evaluate(truth.test, field.spectrum, progress=progress)
    return {"fit_s": field.report["fit_time_s"], "choices": field.report["choices"], **found}


def calibration(field: BistaticField, truth: Truth, progress: Progress) -> Row:
    """How often the truth lies as near to the prediction as its standard deviation says, over the test pixels.

    Returns ``within_1_sigma`` and ``within_2_sigma`` (also ``..._blocked``, and ``..._lit`` of pixels whose truth or
    prediction exceeds N0: the others are easy, and many); negative log likelihood of a pixel [nat] of the stated
    standard deviations and of the best constant one, both with the field's share of outliers, and as pure Gaussians
    (``..._gaussian``); the reliability curve
    ``levels`` (stated share) and ``shares`` (found). ``{}`` if the field was fitted to too few receivers to know it.
    """
    if field.errors is None:
        return {}
    test = truth.test
    errors, deviations, levels = [], [], []
    for i, receiver in enumerate(test.receivers):
        found = field.spectrum(receiver, uncertainty=True)
        errors.append(to_db(found.path_gain, test.floor) - to_db(test.path_gain[i], test.floor))
        deviations.append(np.asarray(found.std_db, np.float64))
        levels.append(np.maximum(found.path_gain, test.path_gain[i]))
        progress("uncertainty", i + 1, len(test))
    e, s = np.stack(errors), np.stack(deviations)
    blocked = ~test.line_of_sight
    lit = np.stack(levels) > test.floor
    rms = float(np.sqrt(np.mean(e**2)))
    normal, outlier = NormalDist(), float(np.asarray(field.errors.outlier_db).item())
    row: Row = {
        "sigma_median_db": float(np.median(s)),
        "rms_error_db": rms,
        "nll": negative_log_likelihood(e, s, outlier),
        "nll_constant": min(
            negative_log_likelihood(e, c, outlier) for c in np.geomspace(0.01, 3.0, 200) * rms
        ),
        "nll_gaussian": float(0.5 * np.log(2.0 * np.pi) + np.mean(np.log(s) + 0.5 * (e / s) ** 2)),
        "nll_gaussian_constant": float(0.5 * np.log(2.0 * np.pi) + np.log(rms) + 0.5),
        "outlier_db": outlier,
        "levels": list(LEVELS),
        "shares": [float(np.mean(np.abs(e) <= normal.inv_cdf(0.5 * (1.0 + p)) * s)) for p in LEVELS],
    }
    for k in (1, 2):
        inside = np.abs(e) <= k * s
        row[f"within_{k}_sigma"] = float(inside.mean())
        row[f"within_{k}_sigma_lit"] = float(inside[lit].mean()) if lit.any() else None
        row[f"within_{k}_sigma_blocked"] = float(inside[blocked].mean()) if blocked.any() else None
    return row


def delays(field: BistaticField, truth: Truth, geometry: Geometry, progress: Progress) -> Row:
    """Delay errors [ns] of line of sight and mirror paths, and of the pixels that hold scattering.

    True specular paths are those of the image method on the true scene, one reflection at most (the exact engine's;
    Sionna's agree with them), where their path gain exceeds N0. A pixel is compared with the data set's delay there.

    Returns for ``line_of_sight`` and ``mirror``: ``paths``, the share ``found`` within 3 degrees, and ``median_ns`` and
    ``p90_ns`` of those; for ``scattering``: ``pixels``, ``median_ns``, ``p90_ns`` and the power-weighted
    ``median_by_power_ns``, a missing delay counted as infinite.
    """
    test = truth.test
    traced = wr.trace_paths(
        geometry.scene, transmitter=test.transmitter, receivers=test.receivers, frequency_hz=test.frequency_hz
    )
    directions = pixel_directions(test.shape)
    names = {"los": "line_of_sight", "mirror": "mirror"}
    errors: dict[str, list[float]] = {kind: [] for kind in names}
    paths = dict.fromkeys(names, 0)
    scattered: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    for i, receiver in enumerate(test.receivers):
        true, ours = traced[i], field.paths(receiver)
        for kind in names:
            mine = np.flatnonzero(ours.kind == kind)
            for k in np.flatnonzero((true.kind == kind) & (true.power > test.floor)):
                paths[kind] += 1
                apart = metrics.angle_deg(ours.arrival[mine], true.arrival[k])
                if len(mine) and apart.min() <= MATCH_DEG:
                    errors[kind].append(1e9 * float(abs(ours.tau[mine[apart.argmin()]] - true.tau[k])))
        away = np.ones(test.shape, dtype=bool)
        for arrival in true.arrival:
            away &= np.radians(metrics.angle_deg(directions, arrival)) > (
                NEAR_A_PATH_SIGMA * test.beam_sigma_rad
            )
        away &= (test.path_gain[i] > test.floor) & np.isfinite(test.delay_s[i])
        predicted = np.asarray(field.spectrum(receiver).delay_s)
        error = 1e9 * np.abs(predicted - test.delay_s[i])[away]
        scattered.append(np.where(np.isnan(error), np.inf, error))
        weights.append(test.path_gain[i][away].astype(np.float64))
        progress("delays", i + 1, len(test))
    row: dict[str, Any] = {
        name: {
            "paths": paths[kind],
            "found": len(errors[kind]) / paths[kind] if paths[kind] else None,
            **_quantiles(np.array(errors[kind])),
        }
        for kind, name in names.items()
    }
    everywhere = np.concatenate(scattered)
    by_power = metrics.weighted_median(everywhere, np.concatenate(weights))
    return row | {
        "scattering": {"pixels": len(everywhere), **_quantiles(everywhere), "median_by_power_ns": by_power}
    }


def _quantiles(errors_ns: np.ndarray) -> dict[str, float | None]:
    if len(errors_ns) == 0:
        return {"median_ns": None, "p90_ns": None}
    median, p90 = np.quantile(errors_ns, (0.5, 0.9), method="inverted_cdf")
    return {"median_ns": float(median), "p90_ns": float(p90)}


def second_spectra(truth: Truth, transmitter: Any, geometry: Geometry, attempt: Attempt) -> SpectrumDataset:
    """Spectra of all test receivers under another transmitter, by the exact engine."""
    test = truth.data.split(truth.few)[1]
    return wr.simulate(
        geometry.scene,
        transmitter=transmitter,
        receivers=test.receivers,
        frequency_hz=test.frequency_hz,
        shape=test.shape,
        beam_sigma_rad=test.beam_sigma_rad,
        roles=["test"] * len(test),
        workspace=attempt.folder,
        progress=attempt.progress,
        device=geometry.device,
    )


def second_transmitter(
    field: Any, ds: SpectrumDataset, truth: Truth, geometry: Geometry, progress: Progress
) -> Row:
    """A field asked for a transmitter that it was not fitted for.

    Returns figures by the range of ``ds`` itself, and under ``first_range`` by floor and range of the data set that it
    was fitted to, which its PSNR on the first transmitter has.

    Raises:
        ValueError: if ``ds`` lacks a test receiver.
    """
    other = _same_receivers(ds, truth.test)
    if isinstance(field, BistaticField):
        found = {rx.tobytes(): field.spectrum(rx, other.transmitter) for rx in other.receivers}
    else:
        seen = geometry.weights(truth.test, slot=truth.name, progress=progress)[0]
        found = {
            rx.tobytes(): field.spectrum(rx, other.transmitter, transport=seen.at(rx))
            for rx in truth.test.receivers
        }

    def predict(receiver: Any) -> Any:
        return found[np.asarray(receiver).tobytes()]

    progress("evaluate", 0, 2)
    first = metrics.evaluate(_in_range_of(other, truth.test), predict)
    progress("evaluate", 1, 2)
    own = metrics.evaluate(other, predict)
    return {**own, "seconds_per_spectrum": None, "first_range": {**first, "seconds_per_spectrum": None}}


def _same_receivers(ds: SpectrumDataset, test: SpectrumDataset) -> SpectrumDataset:
    """The receivers of ``test`` in ``ds``, at exactly the positions of ``test``."""
    apart = np.linalg.norm(ds.receivers[None] - test.receivers[:, None], axis=-1)
    nearest = apart.argmin(axis=1)
    if apart.min(axis=1).max() > 1e-6:
        lacking = test.receivers[int(apart.min(axis=1).argmax())]
        raise ValueError(
            f"second: the data set of the second transmitter lacks the test receiver {lacking.tolist()}; expected all "
            "test receivers of the first"
        )
    return replace(ds.subset(nearest), receivers=test.receivers)


def _in_range_of(ds: SpectrumDataset, other: SpectrumDataset) -> SpectrumDataset:
    return replace(ds, floor=other.floor, range_db=other.range_db)


def negative_log_likelihood(error_db: np.ndarray, std_db: np.ndarray | float, outlier_db: float) -> float:
    """Mean negative log likelihood of errors [dB] under standard deviations and a share ``OUTLIERS`` of outliers."""
    near = np.log1p(-OUTLIERS) - 0.5 * (error_db / std_db) ** 2 - np.log(std_db)
    far = np.log(OUTLIERS) - 0.5 * (error_db / outlier_db) ** 2 - np.log(outlier_db)
    return float(0.5 * np.log(2.0 * np.pi) - np.logaddexp(near, far).mean())

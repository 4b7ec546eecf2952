"""How wrong a predicted spectrum is, in the terms a radio engineer asks for, and how long it took.

PSNR and SSIM are those of the dB image ``y = 10 log10(P + N0)`` mapped to [0, 1] by the data set's stated range; the
mean of the per-view values is quoted. RMSE is in dB, weighted by solid angle. Directions are compared where a spectrum
is densest *per solid angle*, so that the answer does not depend on how the grid thins out towards the poles. Beam gain
loss steers a von Mises-Fisher beam of stated width to the predicted peak and asks what the true spectrum loses against
the best steering. ToF and AoD errors are weighted by the true power of each pixel.

Figures for receivers without line of sight alone carry the suffix ``_blocked``.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Annotated, Any, TypeAlias

import numpy as np
from scipy.ndimage import uniform_filter

from warprrf.checks import NotNegative, Shaped, check_alike, check_array, checked, warn, within
from warprrf.device import Progress, with_progress
from warprrf.rf.em.waves import check_carrier
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.deembedding import respond, scanned_kernel
from warprrf.rf.spectra.spectrum import (
    NARROWEST_BEAM_RAD,
    Spectrum,
    check_whole,
    directions_from_angles,
    pixel_directions,
    pixel_solid_angles,
    to_db,
    unit_vectors,
)

SSIM_WINDOW = 7  # pixels; scikit-image's default, so that figures compare with other work
BeamWidth: TypeAlias = Annotated[float, within(NARROWEST_BEAM_RAD, 2 * np.pi)]
Directions: TypeAlias = Annotated[np.ndarray, Shaped("... 3", finite=False)]
Image: TypeAlias = Annotated[np.ndarray, lambda name, value: _image(name, value)]
PSNR_CEILING_DB = 150.0  # what two equal images score, instead of infinity


@checked
def unit_image(
    path_gain: Annotated[np.ndarray, Shaped("...", finite=False, least=0.0)],
    floor: NotNegative,
    range_db: tuple[float, float],
) -> np.ndarray:
    """The dB image of a spectrum mapped to [0, 1] by the data set's range, shape of ``path_gain``, float64."""
    low, high = check_array("range_db", range_db, (2,))
    if not high > low:
        raise ValueError(f"range_db: got ({low}, {high}), expected (lowest, highest), the latter above")
    return np.clip((to_db(path_gain, floor) - low) / (high - low), 0.0, 1.0)


@checked
def psnr(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio [dB] of two images in [0, 1]; equal images score :data:`PSNR_CEILING_DB`."""
    a, b = _pair(prediction=prediction, truth=truth)
    error = float(np.mean((a - b) ** 2))
    return PSNR_CEILING_DB if error <= 10 ** (-PSNR_CEILING_DB / 10) else -10.0 * np.log10(error)


@checked
def ssim(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity of two images in [0, 1], shape ``(height, width)`` of at least 7 x 7 pixels.

    Wang et al. 2004 with a uniform 7 x 7 window, sample covariance and the border left out: the defaults of
    ``skimage.metrics.structural_similarity(..., data_range=1)``, without needing scikit-image.
    """
    a, b = _pair(prediction=prediction, truth=truth)
    if a.shape != b.shape or a.ndim != 2 or min(a.shape) < SSIM_WINDOW:
        raise ValueError(
            f"prediction, truth: got shapes {a.shape} and {b.shape}, expected two equal (height, width) images of at "
            f"least {SSIM_WINDOW} x {SSIM_WINDOW} pixels"
        )
    count, border = SSIM_WINDOW**2, SSIM_WINDOW // 2
    inner = slice(border, -border)

    def mean(image: np.ndarray) -> np.ndarray:
        return uniform_filter(image, SSIM_WINDOW)[inner, inner]

    sample = count / (count - 1)
    mean_a, mean_b = mean(a), mean(b)
    var_a = sample * (mean(a * a) - mean_a**2)
    var_b = sample * (mean(b * b) - mean_b**2)
    covariance = sample * (mean(a * b) - mean_a * mean_b)
    c1, c2 = 0.01**2, 0.03**2
    score = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return float(np.mean(score / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))))


@checked
def rmse_db(prediction_db: np.ndarray, truth_db: Image) -> float:
    """Root mean square difference [dB] of two dB images ``(height, width)``, weighted by solid angle."""
    predicted, truth_db = _pair(prediction_db=prediction_db, truth_db=truth_db)
    weight = pixel_solid_angles(truth_db.shape)[:, None]
    error = (predicted - truth_db) ** 2
    return float(np.sqrt(np.sum(weight * error) / (np.sum(weight) * truth_db.shape[1])))


@checked
def strongest_direction(path_gain: Image) -> np.ndarray:
    """Unit direction ``(3,)`` of the pixel with the most path gain per solid angle.

    Of equal pixels the first is taken (an empty or constant density has no direction: this is the first row's).
    """
    density = path_gain / pixel_solid_angles(path_gain.shape)[:, None]
    row, column = np.unravel_index(np.argmax(density), density.shape)
    return pixel_directions(path_gain.shape)[row, column]


@checked
def angle_deg(a: Directions, b: Directions) -> np.ndarray:
    """Angle [degrees] between unit vectors ``(..., 3)``; accurate for small angles too."""
    check_alike(a=a, b=b)
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


@checked
def beam_kappa(width_rad: BeamWidth) -> float:
    """Concentration of the von Mises-Fisher beam whose power falls to half at ``width_rad / 2`` off its axis."""
    return float(np.log(2.0) / (2.0 * np.sin(width_rad / 4) ** 2))


@checked
def beam_response(path_gain: Image, width_rad: BeamWidth) -> np.ndarray:
    """Power a beam collects when steered to each pixel centre, shape ``(height, width)``.

    The beam's power pattern is ``exp(kappa (cos(angle) - 1))``, one on its axis, with :func:`beam_kappa`. The sum over
    the sphere is exact on the grid: rows are convolved in azimuth by FFT.
    """
    return respond(path_gain, _beam_kernel(path_gain.shape, beam_kappa(width_rad)))


@lru_cache(maxsize=2)
def _beam_kernel(shape: tuple[int, int], kappa: float) -> np.ndarray:
    return scanned_kernel(lambda angle: np.exp(-2.0 * kappa * np.sin(0.5 * angle) ** 2), shape)


@checked
def beam_gain_loss_db(path_gain: Image, direction: np.ndarray, width_rad: BeamWidth) -> float:
    """Loss [dB] of a beam steered to ``direction`` (3,), of any length, on the spectrum ``path_gain`` against its best steering.

    The best is sought over pixel centres, so steering between them can score slightly below zero.
    """
    best = float(np.max(beam_response(path_gain, width_rad)))
    if best <= 0:
        return 0.0
    cosine = pixel_directions(path_gain.shape) @ unit_vectors("direction", direction, (3,))
    got = float(np.sum(path_gain * np.exp(beam_kappa(width_rad) * (cosine - 1.0))))
    return float(10.0 * np.log10(best / max(got, best * 1e-30)))


@checked
def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Smallest value at which the cumulated weight reaches one half.

    Raises:
        ValueError: if no weight is positive, or one negative.
    """
    values, weights = (np.ravel(one) for one in _pair(values=values, weights=weights))
    if not np.any(weights > 0) or not np.all(weights >= 0):
        raise ValueError("weights: got none above zero, or one below, expected some above zero")
    order = np.argsort(values, kind="stable")
    cumulated = np.cumsum(weights[order], dtype=np.float64)
    return float(values[order][np.searchsorted(cumulated, 0.5 * cumulated[-1])])


@checked
def evaluate(
    test: SpectrumDataset,
    predict: Callable[[np.ndarray], Any],
    *,
    beam_width_rad: BeamWidth = np.pi / 18.0,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Score ``predict`` on every receiver of ``test``.

    Args:
        test: truth: held-out receivers.
        predict: from a receiver position ``(3,)`` [m] to a :class:`Spectrum`, or to a path gain array
            ``(height, width)`` alone (then there is no ToF or AoD error). A field's ``spectrum`` is asked on the grid and
            under the transmitter of ``test``, whatever the field's own.
        beam_width_rad: full width at half maximum of the beam in ``beam_gain_loss_db``.
        progress: called once a receiver with the stage ``"evaluate"``.

    Returns:
        Means over receivers: ``psnr_db``, ``ssim``, ``rmse_db``, ``beam_gain_loss_db``; ``direction_median_deg`` and
        the shares ``direction_within_1deg``, ``direction_within_3deg``; medians over receivers of each one's
        power-weighted median over the pixels whose truth is above the floor: ``tof_error_median_ns``,
        ``aod_error_median_deg`` (None if nothing was predicted, or for most of the power; a pixel without a
        prediction counts as infinitely wrong); all of them again as ``..._blocked`` for receivers without line of
        sight (None if there are none); ``lpips`` with ``lpips_reason``; ``seconds_per_spectrum`` (median),
        ``receivers``, ``receivers_blocked``, ``beam_width_deg``, and ``per_receiver``: the arrays ``(R,)`` behind them.

        Where ``predict`` belongs to a field or a lookup, which know what they were fitted on,
        ``receivers_fitted_on`` is how many of ``test`` are among those; else None.

    Warns:
        UserWarning: if there are any: their scores say how well they were learned by heart.

    Raises:
        ValueError: if a prediction has another shape than the truth, or holds NaN, infinite or negative path gain; for a field
            of another carrier.
    """
    count = len(test.receivers)
    if count == 0:
        raise ValueError("test: got no receivers, expected at least one")
    check_whole("test.path_gain", test.path_gain)
    fitted_on = _fitted_on(predict, test)
    if fitted_on:
        warn(
            f"test: {fitted_on} of its {count} receivers are among those that the predictor was fitted on: these are "
            "no errors of prediction; score receivers that were held out (ds.split)"
        )
    predict = _asked_alike(predict, test)
    floor, range_db = test.floor, test.range_db
    rows = defaultdict[str, np.ndarray](lambda: np.full(count, np.nan))
    seconds = np.zeros(count)
    for i, receiver in enumerate(with_progress(test.receivers, "evaluate", progress)):
        start = time.perf_counter()
        prediction = predict(receiver)
        seconds[i] = time.perf_counter() - start
        truth = np.asarray(test.path_gain[i], dtype=np.float64)
        given = getattr(prediction, "path_gain", prediction)
        gain = check_array(f"predict (receiver {i})", given, truth.shape, least=0.0)
        truth_unit, unit = unit_image(truth, floor, range_db), unit_image(gain, floor, range_db)
        rows["psnr_db"][i] = psnr(unit, truth_unit)
        rows["ssim"][i] = ssim(unit, truth_unit) if min(truth.shape) >= SSIM_WINDOW else np.nan
        rows["rmse_db"][i] = rmse_db(to_db(gain, floor), to_db(truth, floor))
        if truth.any():
            peak = strongest_direction(gain)
            rows["direction_error_deg"][i] = angle_deg(peak, strongest_direction(truth))
            rows["beam_gain_loss_db"][i] = beam_gain_loss_db(truth, peak, beam_width_rad)
        if isinstance(prediction, Spectrum):
            weight = np.where((truth > floor) & np.isfinite(test.delay_s[i]), truth, 0.0)
            if weight.any() and _predicts(prediction.delay_s):
                error = np.abs(np.asarray(prediction.delay_s, np.float64) - test.delay_s[i]) * 1e9
                rows["tof_error_ns"][i] = weighted_median(np.where(np.isnan(error), np.inf, error), weight)
            if weight.any() and _predicts(prediction.aod):
                error = angle_deg(_unit(prediction.aod), _unit(test.aod[i]))
                rows["aod_error_deg"][i] = weighted_median(np.where(np.isnan(error), np.inf, error), weight)
    line_of_sight = np.asarray(test.line_of_sight, dtype=bool)
    report: dict[str, Any] = _summary(rows, np.ones(count, dtype=bool), "")
    report.update(_summary(rows, ~line_of_sight, "_blocked"))
    report.update(
        lpips=None,
        lpips_reason="needs the lpips package and its weights, which are no dependency",
        seconds_per_spectrum=float(np.median(seconds)),
        receivers=count,
        receivers_blocked=int(np.count_nonzero(~line_of_sight)),
        receivers_fitted_on=fitted_on,
        beam_width_deg=float(np.degrees(beam_width_rad)),
        per_receiver={**rows, "line_of_sight": line_of_sight, "seconds": seconds},
    )
    return report


def _pair(**given: np.ndarray) -> list[np.ndarray]:
    """Two arrays of one shape with something in them, float64."""
    (name, one), (other, two) = given.items()
    found = check_array(name, one, finite=False)
    if not found.size:
        raise ValueError(f"{name}: got shape {found.shape}, expected numbers")
    return [found, check_array(other, two, found.shape, finite=False)]


def _image(name: str, value: np.ndarray) -> np.ndarray:
    """An image of at least 2 x 2 pixels, float64."""
    image = check_array(name, value, (None, None), finite=False)
    if min(image.shape) < 2:
        raise ValueError(f"{name}: got shape {image.shape}, expected at least 2 x 2 pixels")
    return image


def _predicts(values: np.ndarray | None) -> bool:
    return values is not None and bool(np.isfinite(values).any())


def _fitted_on(predict: Callable[[np.ndarray], Any], test: SpectrumDataset) -> int | None:
    """How many receivers of ``test`` the field or lookup that predicts was fitted on; None for anything else."""
    owner = getattr(predict, "__self__", predict)
    return int(np.count_nonzero(owner.was_fitted_on(test))) if hasattr(owner, "was_fitted_on") else None


def _asked_alike(predict: Callable[[np.ndarray], Any], test: SpectrumDataset) -> Callable[[np.ndarray], Any]:
    """``predict``, with spectra of the grid and the transmitter of ``test`` if they are a field's."""
    owner: Any = getattr(predict, "__self__", None)
    if not hasattr(owner, "on_grid") or getattr(predict, "__name__", "") != "spectrum":
        return predict
    check_carrier("test", test.frequency_hz, owner.frequency_hz)
    spectrum: Callable[..., Any] = owner.on_grid(test.shape).spectrum
    same_m = 1e-3  # a transmitter this near is the same one
    if np.linalg.norm(owner.transmitter - test.transmitter) <= same_m:
        return spectrum
    return partial(spectrum, transmitter=test.transmitter)


def _unit(angles: np.ndarray | None) -> np.ndarray:
    return directions_from_angles(np.asarray(angles)[..., 0], np.asarray(angles)[..., 1])


def _summary(rows: dict[str, np.ndarray], where: np.ndarray, suffix: str) -> dict[str, float | None]:
    def over(name: str, reduce: Callable[[np.ndarray], Any]) -> float | None:
        values = rows[name][where]
        values = values[~np.isnan(values)]
        result = float(reduce(values)) if len(values) else float("nan")
        return result if np.isfinite(result) else None

    return {
        f"psnr_db{suffix}": over("psnr_db", np.mean),
        f"ssim{suffix}": over("ssim", np.mean),
        f"rmse_db{suffix}": over("rmse_db", np.mean),
        f"direction_median_deg{suffix}": over("direction_error_deg", np.median),
        f"direction_within_1deg{suffix}": over("direction_error_deg", lambda e: np.mean(e <= 1.0 + 1e-9)),
        f"direction_within_3deg{suffix}": over("direction_error_deg", lambda e: np.mean(e <= 3.0 + 1e-9)),
        f"beam_gain_loss_db{suffix}": over("beam_gain_loss_db", np.mean),
        f"tof_error_median_ns{suffix}": over("tof_error_ns", np.median),
        f"aod_error_median_deg{suffix}": over("aod_error_deg", np.median),
    }

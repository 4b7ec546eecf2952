"""Baselines that know no geometry: copy, average or ignore the training spectra.

Every table of results carries them, because published radio fields have been seen to lose to them. Each function takes
the training set and returns a :class:`Lookup`: a callable from a receiver position to a
:class:`~warprrf.rf.spectra.spectrum.Spectrum`, the interface that :func:`warprrf.rf.spectra.metrics.evaluate` expects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import Positive, check_array, checked, one_of
from warprrf.rf.spectra.dataset import SpectrumDataset, measured_at
from warprrf.rf.spectra.metrics import psnr, unit_image
from warprrf.rf.spectra.spectrum import Spectrum, check_whole, to_db


@checked
@dataclass(frozen=True)
class Lookup:
    """A baseline's prediction.

    Attributes:
        name: ``"nearest"``, ``"idw"``, ``"constant"`` or ``"mean"``.
        note: what was chosen while building it, in words (empty if nothing was).
        train: what it was built from.
    """

    name: str
    note: str
    train: SpectrumDataset = field(repr=False)
    _predict: Callable[[np.ndarray], Spectrum] = field(repr=False)

    def __call__(self, receivers: ArrayLike) -> Spectrum:
        """The predicted spectrum at ``receivers`` (3,) or (R, 3) [m].

        Raises:
            ValueError: if a position is not three finite numbers, or there is none.
        """
        places = check_array("receivers", receivers, (..., 3))
        if places.size == 0:
            raise ValueError(f"receivers: got shape {places.shape}, expected (3,) or (R, 3), R at least 1")
        found = [self._predict(place) for place in places.reshape(-1, 3)]
        return found[0] if places.ndim == 1 else Spectrum.stack(found)

    spectrum = __call__

    def was_fitted_on(self, ds: SpectrumDataset) -> np.ndarray:
        """Which receivers of ``ds`` it was built from, shape ``(R,)`` bool."""
        return measured_at(ds, self.train.receivers, self.train.transmitter)


@checked
def nearest(train: SpectrumDataset) -> Lookup:
    """The spectrum of the nearest training receiver, with its delays and angles of departure."""
    return Lookup("nearest", "", _whole(train), partial(_nearest, train))


@checked
def idw(
    train: SpectrumDataset,
    *,
    power: Positive = 2.0,
    domain: Annotated[str, one_of("db", "linear", "auto")] = "auto",
) -> Lookup:
    """Inverse-distance weighting of all training spectra.

    Args:
        train: training set.
        power: exponent p of the weights ``1 / distance**p``.
        domain: average the dB images (``"db"``), linear path gain (``"linear"``), or whichever has the higher PSNR
            when each training receiver in turn is left out (``"auto"``; the choice is in ``.note``).

    Raises:
        ValueError: for a power that is not positive, or an unknown domain.
    """
    receivers, floor, range_db = _whole(train).receivers, train.floor, train.range_db
    images = np.asarray(train.path_gain, dtype=np.float64)
    tables = {"db": to_db(images, floor), "linear": images}
    note = f"averaged in {domain}"
    if domain == "auto":
        everyone = np.arange(len(receivers))
        score = {"db": 0.0, "linear": 0.0}
        for i in everyone if len(everyone) > 1 else []:
            truth = unit_image(images[i], floor, range_db)
            for how in score:
                others, known = receivers[everyone != i], tables[how][everyone != i]
                left_out = _average(others, known, how, floor, power, receivers[i])
                score[how] += psnr(unit_image(left_out, floor, range_db), truth) / len(everyone)
        domain = max(score, key=lambda how: score[how])
        note = (
            f"averaged in {domain}: leave-one-out PSNR {score['db']:.2f} dB in dB, {score['linear']:.2f} dB in linear "
            "power"
        )
    return Lookup("idw", note, train, partial(_idw, train, tables[domain], domain, power))


@checked
def constant(train: SpectrumDataset) -> Lookup:
    """One number for every pixel and receiver: the mean of the training dB images."""
    level = float(np.mean(_whole(train).path_gain_db))
    gain = np.full(train.shape, max(10 ** (level / 10) - train.floor, 0.0))
    return Lookup("constant", f"{level:.2f} dB", train, partial(_same, _bare(gain, train)))


@checked
def mean(train: SpectrumDataset) -> Lookup:
    """The mean of the training dB images, wherever the receiver is."""
    gain = np.maximum(10 ** (np.mean(_whole(train).path_gain_db, axis=0) / 10) - train.floor, 0.0)
    return Lookup("mean", "", train, partial(_same, _bare(gain, train)))


def _nearest(train: SpectrumDataset, at: np.ndarray) -> Spectrum:
    return train[int(np.argmin(np.linalg.norm(train.receivers - at, axis=-1)))]


def _idw(train: SpectrumDataset, table: np.ndarray, domain: str, power: float, at: np.ndarray) -> Spectrum:
    return _bare(_average(train.receivers, table, domain, train.floor, power, at), train)


def _average(
    receivers: np.ndarray, table: np.ndarray, domain: str, floor: float, power: float, at: np.ndarray
) -> np.ndarray:
    """Path gain at ``at`` (3,), averaged over a table of spectra (R, H, W) in its domain."""
    distance = np.linalg.norm(receivers - at, axis=-1)
    same_place_m = 1e-9  # a receiver nearer than this to a training one is that one
    same = distance < same_place_m
    weight = same.astype(np.float64) if same.any() else (distance / distance.min()) ** -power
    average = np.tensordot(weight / weight.sum(), table, axes=1)
    return np.maximum(10 ** (average / 10) - floor, 0.0) if domain == "db" else average


def _same(spectrum: Spectrum, _: np.ndarray) -> Spectrum:
    return spectrum


def _whole(train: SpectrumDataset) -> SpectrumDataset:
    if len(train) == 0:
        raise ValueError("train: got no receivers, expected at least one")
    check_whole("train.path_gain", train.path_gain)
    return train


def _bare(path_gain: np.ndarray, train: SpectrumDataset) -> Spectrum:
    """A spectrum without delays or angles of departure."""
    return Spectrum(path_gain=path_gain.astype(np.float32), floor=train.floor, range_db=train.range_db)

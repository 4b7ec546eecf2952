"""What a field's layers are fitted to: dB images for the gain, delay and AoD spectra for ``rf3dgs``' channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warprrf.rf.fields.harmonic.fitting import Target
from warprrf.rf.fields.harmonic.single_bounce import SingleBounce
from warprrf.rf.fields.harmonic.transport import Transport
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import directions_from_angles, to_db

Y00 = 0.28209479177387814  # harmonic of degree 0
DARK = 0.1  # a pixel below the floor counts as this share of it where logarithms are averaged


@dataclass(frozen=True)
class Targets:
    """Layers to fit, in order.

    Attributes:
        layers: target of each layer: ``gain`` first, then ``delay``, ``aod_x``, ``aod_y``, ``aod_z`` for ``rf3dgs``.
        unseen: degree-0 coefficient of each layer for Gaussians that no training receiver sees: the median.
        gain_unit: linear factor of the gain: its median over the lit pixels.
        delay_unit: seconds per unit of the delay layer: the longest delay.
    """

    layers: dict[str, Target]
    unseen: dict[str, float]
    gain_unit: float
    delay_unit: float


def targets(law: SingleBounce, ds: SpectrumDataset, images: np.ndarray, seen: Transport) -> Targets:
    """What to fit the spectra ``images`` (R, H, W) of ``ds`` with.

    Raises:
        ValueError: if no pixel above the floor meets a Gaussian.
    """
    transmitter, floor = np.asarray(ds.transmitter, np.float64), float(ds.floor)
    lengths = law.lengths(seen, transmitter)
    factor = law.factor(lengths)
    extra = np.zeros_like(images)
    for i, receiver in enumerate(seen.receivers):
        beam = law.beam(receiver, transmitter)
        extra[i] = 0.0 if beam is None else beam
    blended = factor * seen.pixel_weight
    lit = (images - extra > floor) & (blended > 0)
    if not lit.any():
        raise ValueError(
            "ds: got no pixel above the floor where a ray meets a Gaussian; expected spectra with power and "
            "geometry around the receivers"
        )
    gain_unit = float(np.median((images - extra)[lit] / blended[lit]))
    # Each Gaussian starts from the mean gain, in dB, of the pixels that see it: shadows lie 14 nepers below the median.
    met = blended > 0
    floored = np.maximum(images - extra, DARK * floor)
    relative = np.log(floored / np.where(met, blended * gain_unit, 1.0))
    start = np.nan_to_num(weighted_means(seen, relative, met)[1])
    exponential = law.options.gain == "exp"
    low, high = (float(v) for v in ds.range_db)
    layers = {
        "gain": Target(
            image=np.clip((to_db(images, floor) - low) / (high - low), 0.0, 1.0),
            kind=law.options.gain,
            initial=start / Y00 if exponential else np.full(len(start), 1.0 / Y00),
            unit=None if exponential else np.exp(start),
            # in units of the floor, so that float32 works near one
            factor=factor * (gain_unit / floor),
            extra=extra / floor,
            floor=1.0,
            low=low - 10 * np.log10(floor),
            high=high - 10 * np.log10(floor),
        )
    }
    unseen = {"gain": 0.0 if exponential else 1.0 / Y00}
    delay_unit = 1.0
    delays = None if ds.delay_s is None else np.asarray(ds.delay_s, np.float64)
    if law.options.model == "rf3dgs" and delays is not None:
        mask = (images > floor) & np.isfinite(delays) & (seen.dominant >= 0)
        if mask.any():
            delay_unit = float(delays[mask].max())
            departure = directions_from_angles(*np.moveaxis(np.asarray(ds.aod, np.float64), -1, 0))
            channels = {"delay": delays / delay_unit}
            channels.update({f"aod_{axis}": departure[..., k] for k, axis in enumerate("xyz")})
            for name, image in channels.items():
                middle = float(np.median(image[mask]))
                mean = weighted_means(seen, image, mask)[1]
                layers[name] = Target(
                    kind="signed",
                    image=np.where(mask, image, 0.0),
                    initial=np.where(np.isnan(mean), middle, mean) / Y00,
                    mask=mask,
                )
                unseen[name] = middle / Y00
    return Targets(layers, unseen, gain_unit, delay_unit)


def weighted_means(
    transport: Transport, values: np.ndarray, where: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Per Gaussian seen by ``transport``: its index, and the mean of ``values`` over the pixels ``where`` that see it.

    Both images have shape ``(R, H, W)``; the mean is weighted by blending weight, NaN if it is seen in none of them.
    """
    seen = transport.seen
    total, summed = np.zeros(len(seen)), np.zeros(len(seen))
    for r in range(len(transport.receivers)):  # one at a time: what lies between is as large as the weights
        part = transport.subset([r])
        local, met = np.searchsorted(seen, part.gaussian), where[r].ravel()[part.pixel]
        weight = part.weight * met
        value = np.where(met, values[r].ravel()[part.pixel], 0.0)
        total += np.bincount(local, weights=weight, minlength=len(seen))
        summed += np.bincount(local, weights=weight * value, minlength=len(seen))
    return seen, np.divide(summed, total, out=np.full(len(seen), np.nan), where=total > 0)

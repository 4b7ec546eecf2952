"""What several benches compare, fitted in one way: fields on the reconstruction, lookups, and what needs no data.

What receivers see of the geometry is computed once and shared by the methods that need it (:class:`Geometry`); its time
is counted to every one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks import setting
from benchmarks.setting import Geometry
from benchmarks.stages import fingerprint
from warprrf.device import Progress
from warprrf.marks import code_mark
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.training import TrainingViews
from warprrf.rf.fields.bistatic.transport import ReceiverView
from warprrf.rf.fields.harmonic.field import HarmonicField
from warprrf.rf.spectra import lookups
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import Spectrum, angles_from_directions, spread

METRICS_CODE = ("warprrf.rf.spectra.metrics", "warprrf.rf.spectra.dataset")
LOOKUPS_CODE = ("warprrf.rf.spectra.lookups", *METRICS_CODE)
HARMONIC_CODE = ("warprrf.rf.fields.harmonic", "warprrf.geometry.geometry_files", *METRICS_CODE)
BISTATIC_CODE = ("warprrf.rf.fields.bistatic", "warprrf.geometry.geometry_files", *METRICS_CODE)
"""Modules that the figures of a method depend on, for :func:`warprrf.marks.code_mark`."""


def method_mark(modules: Sequence[str], *files: str) -> str:
    """Fingerprint of the code of a method's figures: ``modules``, and of the benches what is shared and ``files``.

    What the benches import belongs to other methods too: their files count alone.
    """
    return fingerprint([code_mark(*modules), *(Path(file) for file in (__file__, setting.__file__, *files))])


@dataclass(frozen=True)
class Fitted:
    """A method after it has learned what it can.

    Attributes:
        predict: from a receiver position (3,) [m] to a :class:`Spectrum`.
        transport_s: seconds that tracing the training receivers took; None where nothing is traced.
        fit_s: seconds that learning took; None where nothing is learned.
        before_s: seconds that each prediction took beforehand, for all test receivers together.
        field: what can be saved (anything with ``.save(path)``), or None.
        size_bytes: what a prediction needs, where there is nothing to save.
        losses: loss by step, where there is one.
        details: whatever else belongs into the row.
    """

    predict: Callable[[Any], Spectrum] = field(repr=False)
    transport_s: float | None = None
    fit_s: float | None = None
    before_s: float = 0.0
    field: Any = None
    size_bytes: int | None = None
    losses: list[float] | None = None
    details: dict[str, Any] | None = None


def fit_bistatic(
    geometry: Geometry,
    train: SpectrumDataset,
    *,
    quick: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Fitted:
    """The bistatic field on the reconstruction; a quick one traces its own, fewer rays."""
    rays = None if quick else geometry.rays(train, progress=progress)
    found = wr.RadioField.fit(
        geometry.reconstruction, train, transport=rays, quick=quick, device=geometry.device, progress=progress,
        **options,
    )  # fmt: skip
    spent = found.report
    return Fitted(
        found.spectrum, transport_s=spent["transport_time_s"], fit_s=spent["fit_time_s"], field=found
    )


def fit_harmonic(
    geometry: Geometry,
    train: SpectrumDataset,
    test: SpectrumDataset,
    model: str,
    *,
    slot: str = "test",
    progress: Progress | None = None,
    **options: Any,
) -> Fitted:
    """RF-3DGS+ or RF-3DGS on the reconstruction.

    Blending weights of the test receivers are computed beforehand for all variants; the time of a spectrum from nothing
    includes them. Where opacity was trained they are the field's own, computed as it is asked.

    Args:
        test: receivers that will be asked for.
        slot: where the geometry keeps their weights.
        options: of :meth:`HarmonicField.fit`.
    """
    weights, seconds = geometry.weights(train, progress=progress)
    learned = HarmonicField.fit(
        geometry.reconstruction, train, model, transport=weights, device=geometry.device, progress=progress,
        **options,
    )  # fmt: skip
    losses = learned.report["losses"]["gain"]
    timed = {
        "transport_s": seconds,
        "fit_s": learned.report["fit_time_s"],
        "field": learned,
        "losses": losses,
    }
    if learned.report["train_opacity"]:
        return Fitted(learned.spectrum, **timed)
    seen, seconds = geometry.weights(test, slot=slot, progress=progress)
    return Fitted(
        lambda rx: learned.spectrum(rx, transport=seen.at(rx)), before_s=seconds / len(test), **timed
    )


def fit_lookup(name: str, variant: str, train: SpectrumDataset) -> Fitted:
    """A lookup of :mod:`warprrf.rf.spectra.lookups`; ``variant`` is what inverse-distance weighting averages."""
    options = {"domain": variant} if variant else {}
    size = {"constant": 4, "mean": train.path_gain[0].nbytes if len(train) else 0}
    return Fitted(
        getattr(lookups, name)(train, **options), size_bytes=size.get(name, int(train.path_gain.nbytes))
    )


def untaught(name: str, geometry: Geometry, test: SpectrumDataset) -> Fitted:
    """``"zero"``: our model on the reconstruction before any spectrum; ``"transmitter"``: its direction alone.

    Of ``test`` only transmitter, carrier, grid, beam, floor and range are looked at.
    """
    if name == "zero":
        prior = BistaticField.prior(geometry.reconstruction, test, device=geometry.device)
        return Fitted(prior.spectrum, field=prior)
    if name != "transmitter":
        raise ValueError(f'name: got {name!r}, expected "zero" or "transmitter"')
    return Fitted(point_at_transmitter(test, geometry.device), size_bytes=24)


def point_at_transmitter(ds: SpectrumDataset, device: Any = None) -> Callable[[Any], Spectrum]:
    """A predictor that knows where the transmitter is and nothing of the room: its beam, with Friis' gain."""

    def predict(receiver: Any) -> Spectrum:
        toward = ds.transmitter - np.asarray(receiver, np.float64)
        distance = float(np.linalg.norm(toward))
        friis = (SPEED_OF_LIGHT / ds.frequency_hz / (4.0 * np.pi * distance)) ** 2
        gain = spread(toward[None], np.array([friis]), ds.shape, ds.beam_sigma_rad, device=device)
        departure = np.stack(angles_from_directions(-toward)).astype(np.float32)
        lit = gain > 0
        return Spectrum(
            path_gain=gain.astype(np.float32),
            delay_s=np.where(lit, distance / SPEED_OF_LIGHT, np.nan),
            aod=np.where(lit[..., None], departure, np.float32(np.nan)),
            floor=ds.floor,
            range_db=ds.range_db,
        )

    return predict


def view_of(rays: TrainingViews) -> Callable[[Any], ReceiverView]:
    """What was traced for a receiver, by its position."""
    known = {v.receivers[0].tobytes(): v for v in rays.views}
    return lambda receiver: known[np.asarray(receiver, np.float64).tobytes()]

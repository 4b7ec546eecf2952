"""The panel of what arrives at the receiver: spectrum, truth, error, delays, the strongest paths; and what is asked."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.tracing.model import Effects
from warprrf.viewer import answers, pictures
from warprrf.viewer.answers import Answer, Asked
from warprrf.viewer.page import Page, Setting
from warprrf.viewer.subject import Subject

CARRIERS_GHZ = (100.0, 1000.0)
"""Over which ITU-R P.2040 has permittivities constant, so that a field carries over."""
TRACED = Effects(mirrors=2, diffractions=0)  # of paths traced without a field, at first
LISTED = 8
MARKED = 60  # paths with a ring in the spectrum, where no stronger one is near
APART_RAD = np.deg2rad(8.0)
BANDWIDTH_HZ = 2e9  # of the delays shown: a tap every 0.5 ns
ERROR_DB = 10.0


class Channel:
    """Spectrum and figures of the last answer, and the settings that a new one takes: ``changed`` is called with each.

    Attributes:
        images: the panoramas shown.
        spectra, table: them and the strongest paths in HTML.
        range_db, carrier: sliders.
    """

    def __init__(self, page: Page, subject: Subject, changed: Callable[[], None]) -> None:
        gui, field, self._subject = page.gui, subject.field, subject
        self.images: list[pictures.Image] = []
        self.spectra = gui.add_html("")
        self._profile = gui.add_uplot(
            (np.arange(2.0), np.zeros(2)),
            ({"label": "delay [ns]"}, {"label": "path gain [dB]", "stroke": "#1e6edc", "width": 1}),
            scales={"x": {"time": False, "auto": True}, "y": {"auto": True}}, aspect=2.2,
            axes=({"label": "delay [ns]", "labelSize": 20, "size": 30}, {"label": "path gain [dB]", "labelSize": 20}),
        )  # fmt: skip
        self.table = gui.add_html("")
        first, most = (field.effects,) * 2 if isinstance(field, BistaticField) else (TRACED, Effects())
        carrier, step = subject.carrier_hz / 1e9, answers.CARRIER_STEP_HZ / 1e9
        low, high = min(carrier, 1.0 if field is None else CARRIERS_GHZ[0]), max(carrier, CARRIERS_GHZ[1])
        with gui.add_folder("What is asked", expand_by_default=False):
            range_db = gui.add_slider("dynamic range [dB]", min=10, max=100, step=1, initial_value=60)
            mirrors = gui.add_slider(
                "mirrors on a path", min=0, max=max(most.mirrors, 1), step=1, initial_value=first.mirrors
            )
            slabs = gui.add_slider(
                "walls on a path",
                min=0,
                max=max(most.transmissions, 1),
                step=1,
                initial_value=first.transmissions,
            )
            edges = gui.add_checkbox("round edges", first.diffractions > 0)
            slabs.disabled, edges.disabled = most.transmissions == 0, most.diffractions == 0
            slid = gui.add_slider("carrier [GHz]", min=low, max=high, step=step, initial_value=carrier)
            slid.disabled = isinstance(field, RadioField) and not isinstance(field, BistaticField)
            uncertainty = gui.add_checkbox("expected error", False, visible=hasattr(field, "gain_std_db"))
            uncertainty.disabled = getattr(field, "errors", None) is None
        self.range_db, self._mirrors, self._slabs, self._edges, self.carrier, self._uncertainty = (
            Setting(handle, changed) for handle in (range_db, mirrors, slabs, edges, slid, uncertainty)
        )

    @property
    def asked(self) -> Asked:
        """What the settings ask for."""
        mirrors, slabs, edges = (int(setting.value) for setting in (self._mirrors, self._slabs, self._edges))
        return Asked(
            self.carrier.value * 1e9, mirrors, slabs, edges, uncertainty=bool(self._uncertainty.value)
        )

    def show(self, found: Answer) -> None:
        """Show an answer."""
        listed = answers.strongest(found.paths, MARKED)
        rows = [answers.described(*path) for path in listed]
        marks: list[tuple[float, float, str]] = []
        for (paths, k), row in zip(listed, rows, strict=True):
            zenith, azimuth = float(paths.theta_r[k]), float(paths.phi_r[k])
            if all(np.hypot(zenith - z, azimuth - a) > APART_RAD for z, a, _ in marks):
                marks.append((zenith, azimuth, "{}: {}, {}, from {}, departs towards {}".format(*row)))
        self.images, note = self._panoramas(found)
        scales = [image[2:] for image in self.images]
        drawn = [
            pictures.panorama(image, () if k else marks, scale=scales[k] not in scales[k + 1 :])
            for k, image in enumerate(self.images)
        ]
        self.spectra.content = pictures.figure("", "".join(drawn) + note)
        self.table.content = pictures.figure("strongest paths", _table(rows[:LISTED]))
        delay, power = answers.delay_profile(found.paths, BANDWIDTH_HZ)
        self._profile.data = (delay, np.maximum(power, power.max() - self.range_db.value))

    def _panoramas(self, found: Answer) -> tuple[list[pictures.Image], str]:
        """Images of the spectrum and what is known to compare with, and a note on how wrong it is."""
        spectrum, ds, field = found.spectrum, self._subject.spectra, self._subject.field
        if spectrum is None:
            return [], ""
        index, truth, note = answers.measured_here(ds, found.receiver), None, ""
        if ds is not None and index is not None:
            same = abs(ds.frequency_hz - found.frequency_hz) < 0.5 * answers.CARRIER_STEP_HZ
            truth = ds[index] if same else None
            note = "" if same else f"What was measured here is of {ds.frequency_hz / 1e9:g} GHz."
        known = [s.path_gain_db for s in (spectrum, truth) if s is not None]
        top = max(float(image.max()) for image in known)
        low = top - self.range_db.value
        images = [(n, i, low, top, "viridis") for n, i in zip(("spectrum", "truth"), known, strict=False)]
        if truth is not None and ds is not None and field is not None:
            difference = np.maximum(known[0], low) - np.maximum(known[1], low)
            images.append(("spectrum less truth", difference, -ERROR_DB, ERROR_DB, "RdBu_r"))
            wrong = answers.errors(spectrum, truth)
            note = (
                f"PSNR {wrong['psnr_db']:.1f} dB, strongest direction off by {wrong['direction_deg']:.1f}°, total by "
                f"{wrong['total_db']:+.2f} dB"
                + (" (fitted to this place)" if field.was_fitted_on(ds)[index] else "")
            )
        if spectrum.std_db is not None:
            images.append(("expected error (standard deviation)", spectrum.std_db, 0.0, ERROR_DB, "magma"))
        return images, note


def _table(rows: Sequence[tuple[str, ...]]) -> str:
    """HTML of paths."""
    head = "".join(
        f"<th>{name}</th>" for name in ("kind", "gain", "delay", "arrives from", "departs towards")
    )
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    note = "Directions: zenith, azimuth. Point at a ring in the spectrum, or click on a path in the room."
    return f"<table><tr>{head}</tr>{body}</table>{note}"

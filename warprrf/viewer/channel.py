"""The panel of what arrives at the receiver: spectrum, truth, error, delays, the strongest paths; and what is asked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.viewer import answers, pictures
from warprrf.viewer.answers import Answer, Asked
from warprrf.viewer.page import Page
from warprrf.viewer.subject import Subject

CARRIERS_GHZ = (100.0, 1000.0)
"""Over which ITU-R P.2040 has permittivities constant, so that a field carries over."""
MIRRORS = 2  # of paths traced without a field, at first
LISTED = 8
MARKED = 60  # paths with a ring in the spectrum, where no stronger one is near
APART_RAD = np.deg2rad(8.0)
BANDWIDTH_HZ = 2e9  # of the delays shown: a tap every 0.5 ns
ERROR_DB = 10.0


class Channel:
    """Spectrum and figures of the last answer, and the settings that a new one takes.

    Args:
        page: that it is on.
        subject: that is asked.
        changed: called when a setting changes.

    Attributes:
        images: titles, dB images, ranges and colour maps of the panoramas shown.
    """

    def __init__(self, page: Page, subject: Subject, changed: Callable[[], None]) -> None:
        gui, self._subject = page.gui, subject
        self.images: list[tuple[str, np.ndarray, float, float, str]] = []
        self._spectra = gui.add_html(pictures.STYLE)
        self._profile = gui.add_uplot(
            (np.arange(2.0), np.zeros(2)),
            ({"label": "delay [ns]"}, {"label": "path gain [dB]", "stroke": "#1e6edc", "width": 1}),
            scales={"x": {"time": False, "auto": True}, "y": {"auto": True}}, aspect=2.2,
            axes=({"label": "delay [ns]", "labelSize": 20, "size": 30}, {"label": "path gain [dB]", "labelSize": 20}),
        )  # fmt: skip
        self._table = gui.add_html("")
        field = subject.field
        most = field.terms.mirror_order if isinstance(field, BistaticField) else 3
        carrier = subject.carrier_hz / 1e9
        low, high = CARRIERS_GHZ if field is not None else (1.0, CARRIERS_GHZ[1])
        with gui.add_folder("What is asked", expand_by_default=False):
            self.range_db = gui.add_slider("dynamic range [dB]", min=10, max=100, step=1, initial_value=60)
            self._mirrors = gui.add_slider(
                "mirrors on a path",
                min=0,
                max=max(most, 1),
                step=1,
                initial_value=MIRRORS if field is None else most,
            )
            self._carrier = gui.add_slider(
                "carrier [GHz]", min=min(low, carrier), max=max(high, carrier), step=answers.CARRIER_STEP_HZ / 1e9,
                initial_value=carrier,
            )  # fmt: skip
            self._carrier.disabled = isinstance(field, RadioField) and not isinstance(field, BistaticField)
            self._uncertainty = gui.add_checkbox(
                "expected error", False, visible=getattr(field, "errors", None) is not None
            )
        for handle in (self.range_db, self._mirrors, self._carrier, self._uncertainty):
            handle.on_update(lambda _: changed())

    @property
    def asked(self) -> Asked:
        """What the settings ask for."""
        return Asked(
            float(self._carrier.value) * 1e9, int(self._mirrors.value), bool(self._uncertainty.value)
        )

    @property
    def html(self) -> str:
        """What is shown, but for the delays."""
        return f"{self._spectra.content}{self._table.content}"

    def show(self, found: Answer) -> None:
        """Show an answer."""
        listed = answers.strongest(found.paths, MARKED)
        rows = [answers.described(*path) for path in listed]
        marks: list[tuple[float, float, str]] = []
        for (paths, k), row in zip(listed, rows, strict=True):
            zenith, azimuth = float(paths.theta_r[k]), float(paths.phi_r[k])
            if all(np.hypot(zenith - z, azimuth - a) > APART_RAD for z, a, _ in marks):
                marks.append((zenith, azimuth, "{}: {}, {}, from {}, sent to {}".format(*row)))
        self.images, note = self._panoramas(found)
        scales = [image[2:] for image in self.images]
        figures = [
            pictures.panorama(*image, marks=() if k else marks, scale=image[2:] not in scales[k + 1 :])
            for k, image in enumerate(self.images)
        ]
        self._spectra.content = f'{pictures.STYLE}<div class="wr">{"".join(figures)}{note}</div>'
        self._table.content = _table(rows[:LISTED])
        delay, power = answers.delay_profile(found.paths, BANDWIDTH_HZ)
        self._profile.data = (delay, np.maximum(power, power.max() - float(self.range_db.value)))

    def _panoramas(self, found: Answer) -> tuple[list[tuple[str, np.ndarray, float, float, str]], str]:
        """Images of the spectrum and what is known to compare with, and a note on how wrong it is."""
        spectrum, truth, note = found.spectrum, None, ""
        if spectrum is None:
            return [], ""
        ds, field = self._subject.spectra, self._subject.field
        index = answers.measured_here(ds, found.receiver)
        if ds is not None and index is not None:
            if abs(ds.frequency_hz - found.frequency_hz) < 0.5 * answers.CARRIER_STEP_HZ:
                truth = ds[index]
            else:
                note = f"What was measured here is of {ds.frequency_hz / 1e9:g} GHz."
        images = [s.path_gain_db for s in (spectrum, truth) if s is not None]
        top = max(float(image.max()) for image in images)
        low = top - float(self.range_db.value)
        shown = [
            (title, image, low, top, "viridis")
            for title, image in zip(("spectrum", "truth"), images, strict=False)
        ]
        if truth is not None and ds is not None and field is not None:
            difference = np.maximum(images[0], low) - np.maximum(images[1], low)
            shown.append(("spectrum - truth", difference, -ERROR_DB, ERROR_DB, "RdBu_r"))
            wrong = answers.errors(spectrum, truth)
            note = (
                f"PSNR {wrong['psnr_db']:.1f} dB, strongest direction off by {wrong['direction_deg']:.1f}°, total by "
                f"{wrong['total_db']:+.2f} dB"
                + (" (fitted to this place)" if field.was_fitted_on(ds)[index] else "")
            )
        if spectrum.std_db is not None:
            shown.append(("expected error (standard deviation)", spectrum.std_db, 0.0, ERROR_DB, "magma"))
        return shown, note


def _table(rows: list[Any]) -> str:
    """HTML of the strongest paths."""
    head = "".join(f"<th>{name}</th>" for name in ("path", "gain", "delay", "arrives from", "sent to"))
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    note = "Directions are zenith, azimuth. Point at a ring in the spectrum, or click on a path in the room."
    return f'<div class="wr"><table><tr>{head}</tr>{body}</table>{note}</div>'

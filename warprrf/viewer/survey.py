"""The panel of what is computed for many places: radio map, errors where it was measured, where to measure next, and where what
was read was read."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.maps.radio_map import QUANTITIES
from warprrf.rf.positions import is_free
from warprrf.rf.spectra.antenna import horn
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.metrics import evaluate
from warprrf.rf.spectra.readings import Readings
from warprrf.viewer import answers, pictures
from warprrf.viewer.page import Page, Setting
from warprrf.viewer.subject import Subject

MEASURED, SUGGESTED, LOCATED = (240, 160, 30), (190, 30, 200), (30, 160, 90)
PSNR_DB = (15.0, 40.0)
READING_DB = 10.0
WORST = 5
CANDIDATE_M = 1.0  # between places that could be measured next
CLEAR_M = 0.3  # of them to a transmitter
FLOOR_DB = -150.0  # of readings, at first
HEIGHT_M = 1.5  # of a map where nothing was measured, at first
_OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
_OCTAHEDRON_FACES = np.array(
    [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
)


class Survey:
    """Map, errors, suggestions and places of readings, each computed in the background when its button is pressed.

    Args:
        asked: gives the field as the settings ask for it.
        transmitters: gives where they stand.
        go_to: puts the receiver at a place (3,).

    Attributes:
        map, suggest, errors, reading_errors: what the buttons do, as far as the subject allows.
        height: of map and suggestions [m].
        legend, listed: what was computed last in HTML, and buttons of the places that it named.
    """

    def __init__(
        self,
        page: Page,
        subject: Subject,
        asked: Callable[[], Any],
        transmitters: Callable[[], list[np.ndarray]],
        go_to: Callable[[np.ndarray], None],
    ) -> None:
        self._page, self._subject, self._asked = page, subject, asked
        self._transmitters, self._go_to = transmitters, go_to
        gui, self.legend = page.gui, page.gui.add_html("")
        self.listed: list[Any] = []
        self._meanings: dict[str, str] = {}
        if len(subject.places):
            self._mark("measured", subject.places, MEASURED)
        if subject.field is None:
            gui.add_markdown("A map needs a field.")
            return
        height = np.median(subject.places[:, 2]) if len(subject.places) else subject.bounds[0, 2] + HEIGHT_M
        self.height = Setting(gui.add_number("height [m]", round(float(height), 2), step=0.1))
        self._cell = Setting(gui.add_number("cell [m]", 0.5, min=0.05, step=0.05))
        self._quantity = Setting(gui.add_dropdown("quantity", tuple(QUANTITIES.values())))
        self.map = self._add("compute the map", self._map)
        if subject.field.model == "bistatic":
            self._count = Setting(gui.add_slider("places", min=1, max=10, step=1, initial_value=3))
            self.suggest = self._add("suggest where to measure next", self._suggest)
            self._floor_db = Setting(gui.add_number("noise floor of a table [dB]", FLOOR_DB, step=1.0))
            self._width_deg = Setting(
                gui.add_number("its horn's width [degrees], 0 for none", 0.0, min=0.0, max=120.0, step=1.0)
            )
            table = gui.add_upload_button("find a receiver by its table (.csv)", mime_type=".csv,text/csv")
            table.on_upload(lambda _: self.locate(table.value.name, table.value.content))
        truth, readings = subject.spectra, subject.readings
        if truth is not None:
            self.errors = self._add("errors at measured places", partial(self._spectrum_errors, truth))
        if readings is not None:
            self.reading_errors = self._add("errors of readings", partial(self._reading_errors, readings))
        self._folder = gui.add_folder("Places", visible=False)

    def _add(self, label: str, work: Callable[[Any, Progress], None]) -> Callable[[], None]:
        """A button for ``work``; returns what it does."""

        def run() -> None:
            self._page.in_background(lambda progress: work(self._asked(), progress))

        self._page.gui.add_button(label).on_click(lambda _: run())
        return run

    def _mark(self, name: str, places: np.ndarray, colours: Any, size_m: float = 0.1) -> None:
        """A small octahedron at each of ``places`` (K, 3) in ``colours`` (K, 3) or (3,); a click puts the receiver there."""
        shades = np.broadcast_to(np.asarray(colours, dtype=np.uint8), places.shape)
        turns = np.broadcast_to(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (len(places), 4))
        handle = self._page.scene.add_batched_meshes_simple(
            f"/{name}", size_m * _OCTAHEDRON, _OCTAHEDRON_FACES, turns, (places - self._page.origin).astype(np.float32),
            batched_colors=shades, visible=name not in self._page.hidden,
        )  # fmt: skip

        @handle.on_click
        def _(event: Any) -> None:
            if event.instance_index is not None:
                self._go_to(places[event.instance_index])

    def _explain(self, title: str, bar: str, about: str = "places") -> None:
        self._meanings[about] = pictures.figure(title, bar)
        self.legend.content = "".join(self._meanings.values())

    def _list(self, places: np.ndarray, labels: list[str]) -> None:
        for button in self.listed:
            button.remove()
        names = [
            f"{label} at {', '.join(f'{x:.2f}' for x in at)} m"
            for label, at in zip(labels, places, strict=True)
        ]
        with self._folder:
            self.listed = [self._page.gui.add_button(name, color="gray") for name in names]
        self._folder.visible = True
        for button, place in zip(self.listed, places, strict=True):
            button.on_click(lambda _, place=place: self._go_to(place))

    def _map(self, field: RadioField, progress: Progress) -> None:
        found = field.radio_map(
            self.height.value, self._cell.value, self._transmitters()[0], progress=progress
        )
        quantity = next(name for name, text in QUANTITIES.items() if text == self._quantity.value)
        value = found.plot_values(quantity)
        known = value[np.isfinite(value)]
        low, high = np.percentile(known, (2.0, 98.0)) if len(known) else (0.0, 1.0)
        picture = pictures.coloured(value, low, high)[::-1]
        seen = np.where(np.isnan(value), 0, 255).astype(np.uint8)[::-1]
        width, height = found.cell_m * value.shape[1], found.cell_m * value.shape[0]
        floor = 0.0
        if self._subject.mesh is not None:  # a little above what is drawn
            below = self._subject.mesh.cast(found.positions[found.free], [0.0, 0.0, -1.0]).point[:, 2]
            floor = 0.03 + float(np.nanmedian(below))
        self._page.scene.add_image(
            "/map", np.dstack([picture, seen]), width, height,
            position=np.array([found.x.mean(), found.y.mean(), floor]) - self._page.origin, wxyz=(0.0, 1.0, 0.0, 0.0),
            visible="map" not in self._page.hidden,
        )  # fmt: skip
        several = ", of the first transmitter" if len(self._transmitters()) > 1 else ""
        title = f"{self._quantity.value} at {found.height_m:g} m{several}"
        self._explain(title, pictures.colour_bar(low, high, ""), "map")

    def candidates(self, field: BistaticField) -> np.ndarray:
        """Places (C, 3) in the air, at the height that is set."""
        mesh = field.mesh
        axes = [np.arange(a + 0.5 * CANDIDATE_M, b, CANDIDATE_M) for a, b in mesh.bounds[:, :2].T]
        places = np.stack(np.meshgrid(*axes, [self.height.value]), axis=-1).reshape(-1, 3)
        places = places[is_free(mesh, places, field.transmitter, device=field.device)]
        return places[np.linalg.norm(places - field.transmitter, axis=1) > CLEAR_M]

    def _suggest(self, field: BistaticField, progress: Progress) -> None:
        places = self.candidates(field)
        if not len(places):
            raise ValueError(f"height: no place at {self.height.value:g} m is in the air")
        count = min(int(self._count.value), len(places))
        chosen = places[field.suggest(places, count, progress=progress)]
        self._mark("suggested", chosen, SUGGESTED, 0.2)
        for k, place in enumerate(chosen):
            self._page.scene.add_label(
                f"/suggested/{k}", f"measure {k + 1}", position=place - self._page.origin
            )
        self._explain("to measure next, best first", "")
        self._list(chosen, [str(k + 1) for k in range(count)])

    def locate(self, name: str, content: bytes) -> None:
        """Put the receiver where the readings of a CSV file of that ``name`` were read; what it says of that is not looked at."""
        self._page.in_background(lambda progress: self._locate(self._asked(), name, content, progress))

    def _locate(self, field: RadioField, name: str, content: bytes, progress: Progress) -> None:
        width = np.radians(self._width_deg.value)
        floor = 10.0 ** (self._floor_db.value / 10.0)
        with TemporaryDirectory() as folder:
            file = Path(folder) / "readings.csv"
            file.write_bytes(content)
            readings = Readings.load(
                file,
                frequency_hz=field.frequency_hz,
                floor=floor,
                receive_pattern=horn(width) if width else None,
            )
        found = field.locate(readings, progress=progress)
        self._mark("located", found.candidates, LOCATED, 0.2)
        self._list(found.candidates, [f"likely by {one:.0%}" for one in found.likelihoods])
        at = ", ".join(f"{x:.2f}" for x in found.position)
        sure = "" if found.known else "; not known, see the other places"
        self._explain(f"{name}: at {at} m, give or take {found.std_m:.2f} m{sure}", "", "located")
        self._go_to(found.position)

    def _spectrum_errors(self, truth: SpectrumDataset, field: RadioField, progress: Progress) -> None:
        _check_carrier(field, truth)
        predict = partial(field.spectrum, transmitter=truth.transmitter)
        found = evaluate(truth, predict, progress=progress)  # fitted ones are marked
        psnr, fitted = found["per_receiver"]["psnr_db"], field.was_fitted_on(truth)
        worst = np.argsort(psnr)[:WORST]
        labels = [f"{psnr[k]:.1f} dB{' (fitted)' if fitted[k] else ''}" for k in worst]
        self._mark("measured", truth.receivers, pictures.coloured(psnr, *PSNR_DB, "RdYlGn"))
        self._explain(
            f"PSNR at {len(psnr)} measured places, mean {found['psnr_db']:.1f} dB; worst first",
            pictures.colour_bar(*PSNR_DB, "dB", "RdYlGn"),
        )
        self._list(truth.receivers[worst], labels)

    def _reading_errors(self, readings: Readings, field: RadioField, progress: Progress) -> None:
        _check_carrier(field, readings)
        error = answers.reading_errors(field, readings, progress)
        places, own = np.unique(readings.receivers, axis=0, return_inverse=True)
        each = [error[own.reshape(-1) == k] for k in range(len(places))]
        rms = np.array([_rms(e) for e in each])
        worst = np.argsort(-np.abs(error))[: min(WORST, np.isfinite(error).sum())]  # NaN come last
        labels = [f"{error[k]:+.1f} dB" for k in worst]
        if readings.arrival is not None:
            turned = np.degrees(readings.arrival[worst])
            labels = [
                f"{label} from {z:.0f}°, {a:.0f}°" for label, (z, a) in zip(labels, turned, strict=True)
            ]
        self._mark("measured", places, pictures.coloured(rms, 0.0, READING_DB, "RdYlGn_r"))
        self._explain(
            f"Error of {np.isfinite(error).sum()} readings, rms {_rms(error):.1f} dB, by place; worst first",
            pictures.colour_bar(0.0, READING_DB, "dB", "RdYlGn_r"),
        )
        self._list(readings.receivers[worst], labels)


def _check_carrier(field: RadioField, measured: SpectrumDataset | Readings) -> None:
    if abs(field.frequency_hz - measured.frequency_hz) > 0.5 * answers.CARRIER_STEP_HZ:
        asked, known = (f"{one.frequency_hz / 1e9:g} GHz" for one in (field, measured))
        raise ValueError(f"carrier: got {asked}, expected that of what was measured, {known}")


def _rms(error: np.ndarray) -> float:
    known = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")

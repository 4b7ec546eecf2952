"""The panel of what arrives at the receiver: spectrum, truth, error, delays, the strongest paths; what is asked; and, drawn in the
room, paths coloured by gain, the one that was clicked with its figures, and the best beam."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.spectra.spectrum import to_db
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
DRAWN = 60
COLOURS = "YlOrRd"  # the strongest are the darkest: they stand out on a light room
CHOSEN = (20, 60, 200)
CLICK_RAD = np.deg2rad(1.5)  # a click farther from every path means none
ARRAYS = {"no array": 0, "4 x 4": 4, "8 x 8": 8, "16 x 16": 16}


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
            off = [np.linalg.norm(p.transmitter - ds.transmitter) for p in found.paths]
            same = abs(ds.frequency_hz - found.frequency_hz) < 0.5 * answers.CARRIER_STEP_HZ
            if same and len(off) == 1 and off[0] <= answers.AT_M:
                truth = ds[index]
            else:
                place = ", ".join(f"{x:.2f}" for x in ds.transmitter)
                note = f"Measured here: {ds.frequency_hz / 1e9:g} GHz, one transmitter at {place} m."
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


class Rays:
    """Paths and beam of the last answer; ``changed`` is called when another array is chosen.

    Attributes:
        label: what is written at the chosen path.
        legend: what the colours of the paths mean, and what the beam gains, in HTML.
    """

    def __init__(self, page: Page, changed: Callable[[], None]) -> None:
        self._page, self.label = page, ""
        self._rows: list[tuple[str, ...]] = []
        self._legs: list[np.ndarray] = []
        self.legend = page.gui.add_html("")
        array = page.gui.add_dropdown("receiving array", tuple(ARRAYS))
        facing = page.gui.add_slider("array faces [degrees]", min=-180, max=180, step=1, initial_value=0)
        self._array, self._facing = Setting(array, changed), Setting(facing, changed)

    def show(self, found: Answer, range_db: float) -> None:
        """Draw an answer, gains over ``range_db``; its strongest path is the chosen one."""
        listed, scene = answers.strongest(found.paths, DRAWN), self._page.scene
        self._legs = [answers.legs(*path) - self._page.origin for path in listed]
        self._rows = [answers.described(*path) for path in listed]
        beam = self._show_beam(found)
        if not listed:
            scene.remove_by_name("/paths")
            self.legend.content = ""
            return
        gain = to_db([p.power[k] for p, k in listed], 1e-300)
        shades = pictures.coloured(gain, gain[0] - range_db, gain[0], COLOURS)
        each = np.repeat(shades, [len(own) for own in self._legs], axis=0)[::-1, None]
        scene.add_line_segments(
            "/paths", np.concatenate(self._legs)[::-1], np.repeat(each, 2, axis=1), thickness=2.0,
            thickness_units="screen", visible="paths" not in self._page.hidden,
        )  # fmt: skip
        self.legend.content = pictures.figure(
            f"the {len(listed)} strongest paths in the room",
            pictures.colour_bar(gain[0] - range_db, gain[0], "dB", COLOURS) + beam,
        )
        self.choose(0)

    def click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Choose the path that is seen nearest to where a ray points, if it is near."""
        index, angle = answers.nearest_path(self._legs, origin, direction)
        if angle < CLICK_RAD:
            self.choose(index)

    def choose(self, index: int) -> None:
        """Mark the path of rank ``index``, with its gain, delay and angles beside it."""
        legs, scene = self._legs[index], self._page.scene
        scene.add_line_segments("/paths/chosen", legs, CHOSEN, thickness=4.0, thickness_units="screen")
        longest = np.linalg.norm(legs[:, 1] - legs[:, 0], axis=1).argmax()
        self.label = "{} {}, {}\nfrom {}\nto {}".format(*self._rows[index])
        scene.add_label("/paths/chosen/figures", self.label, position=legs[longest].mean(axis=0))

    def _show_beam(self, found: Answer) -> str:
        """Draw the best beam of the array that is chosen; returns what it gains."""
        size = ARRAYS[self._array.value]
        if size == 0 or not self._legs:
            self._page.scene.remove_by_name("/beam")
            return ""
        gain_db, lobe, directions = answers.best_beam(
            found.paths, size, float(np.deg2rad(self._facing.value))
        )
        vertices, faces = pictures.lobe_mesh(found.receiver - self._page.origin, directions, lobe)
        self._page.scene.add_mesh_simple(
            "/beam", vertices, faces, color=(60, 170, 90), opacity=0.6, side="double"
        )
        return f"best beam: {gain_db:+.1f} dB over one antenna"


def _table(rows: Sequence[tuple[str, ...]]) -> str:
    head = "".join(
        f"<th>{name}</th>" for name in ("kind", "gain", "delay", "arrives from", "departs towards")
    )
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    note = "Directions: zenith, azimuth. Point at a ring in the spectrum, or click on a path in the room."
    return f"<table><tr>{head}</tr>{body}</table>{note}"

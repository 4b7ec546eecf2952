"""The page: what can be dragged, chosen and read, and the thread that answers."""

from __future__ import annotations

import base64
import html
import io
import os
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf import device as _device
from warprrf.checks import check_array, check_count, check_type
from warprrf.files import write_atomically
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.maps.radio_map import QUANTITIES
from warprrf.rf.spectra.metrics import evaluate
from warprrf.rf.spectra.spectrum import Spectrum
from warprrf.viewer import answers, layers, pictures
from warprrf.viewer.answers import Answer
from warprrf.viewer.subject import Subject

CARRIER_HZ = 300e9  # of paths traced where nothing says another
MIRRORS = 2  # of paths traced without a field, at first
DRAWN_PATHS = 60
TABLE_ROWS = 8
KEPT_TIMES = 1000
BANDWIDTH_HZ = 2e9  # of the delays shown: a tap every 0.5 ns
RED, BLUE = (215, 38, 61), (30, 110, 220)
ARRAYS = {"no array": 0, "4 x 4": 4, "8 x 8": 8, "16 x 16": 16}


class _GivenUp(Exception):  # noqa: N818
    """Raised in background work that nobody waits for any more."""


class Viewer:
    """A page in the browser; :func:`warprrf.view` makes one.

    Attributes:
        subject: what it shows.
        url: where the page is.
        last: the last answer; None before the first, and where there is none.
        message: what the page says about it.
        times: seconds from a drag or a slider to its answer being sent, of the last thousand.
    """

    def __init__(self, subject: Subject, *, host: str, port: int) -> None:
        check_type("host", host, str)
        check_count("port", port, 1, 65535)
        try:
            with socket.create_server((host, 0)):
                pass
        except OSError as error:
            raise ValueError(f"host: got {host!r}, expected an address of this machine ({error})") from error
        viser = _device.require("viser", extra="view")
        self.subject, self.message = subject, ""
        self.last: Answer | None = None
        self.times: deque[float] = deque(maxlen=KEPT_TIMES)
        with redirect_stdout(io.StringIO()):  # viser prints where it is
            self._server = viser.ViserServer(host=host, port=port, verbose=False)
        self.url = f"http://{host}:{self._server.get_port()}"
        self._changed = threading.Condition()
        self._wished_at: float | None = None
        self._answering = self._closed = False
        self._background: threading.Thread | None = None
        self._low, self._high = subject.bounds
        self._measured = _measured_places(subject)
        self._hidden = {"cameras"} | ({"splats"} if subject.mesh is not None else set())
        self._set_up_page()
        self._add_gizmos()
        self._add_panel()
        self._redraw()
        self._worker = threading.Thread(target=self._answer_forever, name="warprrf-view", daemon=True)
        self._worker.start()
        self.refresh()

    def __repr__(self) -> str:
        return f"Viewer({self.url})"

    def _repr_html_(self) -> str:
        return f'<iframe src="{html.escape(self.url)}" width="100%" height="640" frameborder="0"></iframe>'

    @property
    def receiver(self) -> np.ndarray:
        """Where the receiver stands (3,) [m]; may be set."""
        return np.asarray(self._receiver.position, dtype=np.float64)

    @receiver.setter
    def receiver(self, position: ArrayLike) -> None:
        self._receiver.position = check_array("receiver", position, (3,))
        self.refresh()

    @property
    def transmitters(self) -> list[np.ndarray]:
        """Where the transmitters stand, each (3,) [m]; their powers are added."""
        return [np.asarray(t.position, dtype=np.float64) for t in self._transmitters]

    def add_transmitter(self, position: ArrayLike) -> None:
        """Put one more transmitter at ``position`` (3,) [m]."""
        place = check_array("position", position, (3,))
        self._transmitters.append(self._gizmo(f"/transmitter {len(self._transmitters) + 1}", place, RED))
        self.refresh()

    @property
    def clients(self) -> list[Any]:
        """Browsers that show the page now, as viser's handles."""
        return list(self._server.get_clients().values())

    def refresh(self) -> None:
        """Ask for a new answer; of several wishes the newest alone is answered."""
        with self._changed:
            if self._wished_at is None:
                self._wished_at = time.perf_counter()
            self._changed.notify_all()

    def wait(self, timeout_s: float = 60.0) -> Answer | None:
        """The answer to what was wished for until now.

        Raises:
            TimeoutError: if it takes longer.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._wished_at is None and not self._answering, timeout_s):
                raise TimeoutError(f"timeout_s: no answer within {timeout_s:g} s")
            return self.last

    def serve(self) -> None:
        """Keep the page up until :meth:`close`, or Ctrl-C."""
        while self._worker.is_alive():
            self._worker.join(0.5)

    def close(self) -> None:
        """Take the page down."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._worker.join()
        if self._background is not None:
            self._background.join()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write what is shown: as one HTML file that needs nothing else, or the spectrum as a PNG.

        Raises:
            ValueError: for another kind of file.
            OSError: if it cannot be written.
        """
        suffix = Path(path).suffix.lower()
        if suffix not in (".html", ".png"):
            raise ValueError(f"path: got {os.fspath(path)!r}, expected a name that ends in .html or .png")
        data = self._html() if suffix == ".html" else _png(self._spectrum.image)
        write_atomically(path, lambda name: Path(name).write_bytes(data))

    # ------------------------------------------------------------------------------------------ the page

    def _set_up_page(self) -> None:
        server, middle = self._server, 0.5 * (self._low + self._high)
        size = float(np.linalg.norm(self._high - self._low))
        server.scene.set_up_direction("+z")
        # Its share button would send the scene through somebody else's machine.
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        server.initial_camera.position = tuple(middle + size * np.array([-0.2, -0.5, 0.55]))
        server.initial_camera.look_at = tuple(middle)
        if self.subject.cameras:
            layers.draw_cameras(server, self.subject)
        if len(self._measured):
            layers.draw_measured(server, self._measured, None, self._go_to)

    def _add_gizmos(self) -> None:
        middle = 0.5 * (self._low + self._high)
        first = self.subject.transmitter
        if first is None:
            first = middle + 0.25 * (self._high - self._low) * [1.0, 1.0, 0.5]
        self._transmitters = [self._gizmo("/transmitter", first, RED)]
        self._receiver = self._gizmo("/receiver", self._measured[0] if len(self._measured) else middle, BLUE)

    def _gizmo(self, name: str, position: np.ndarray, colour: tuple[int, int, int]) -> Any:
        scene, size = self._server.scene, min(1.0, 0.05 * float(np.linalg.norm(self._high - self._low)))
        handle = scene.add_transform_controls(
            name, scale=size, disable_rotations=True, depth_test=False, position=position
        )
        scene.add_icosphere(f"{name}/ball", radius=0.12 * size, color=colour)
        scene.add_label(f"{name}/name", name.strip("/"))
        handle.on_update(lambda _: self.refresh())
        return handle

    def _add_panel(self) -> None:
        gui = self._server.gui
        self._status = gui.add_markdown("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Channel"):
            self._add_channel()
        with tabs.add_tab("Room"):
            self._add_room()
        with tabs.add_tab("Map"):
            self._add_map()
        with tabs.add_tab("Save"):
            self._add_save()

    def _add_channel(self) -> None:
        gui, empty = self._server.gui, np.full((90, 180, 3), 255, dtype=np.uint8)
        field = self.subject.field
        self._spectrum = gui.add_image(
            empty, label="spectrum: azimuth 180° to -180°, zenith down", visible=field is not None
        )
        self._truth = gui.add_image(empty, label="truth", visible=False)
        self._wrong = gui.add_markdown("")
        self._profile = gui.add_uplot(
            (np.arange(2.0), np.zeros(2)),
            ({"label": "delay [ns]"}, {"label": "path gain [dB]", "stroke": "#1e6edc", "width": 1}),
            scales={"x": {"time": False, "auto": True}, "y": {"auto": True}}, aspect=2.2,
        )  # fmt: skip
        self._table = gui.add_markdown("")
        most = field.terms.mirror_order if isinstance(field, BistaticField) else 3
        with gui.add_folder("What is asked", expand_by_default=False):
            self._range = gui.add_slider("dynamic range [dB]", min=10, max=100, step=1, initial_value=60)
            self._mirrors = gui.add_slider(
                "mirrors on a path",
                min=0,
                max=max(most, 1),
                step=1,
                initial_value=most if field is not None else MIRRORS,
            )
            self._array = gui.add_dropdown("receiving array", tuple(ARRAYS))
            self._facing = gui.add_slider("array faces [degrees]", min=-180, max=180, step=1, initial_value=0)
            add = gui.add_button("add a transmitter", hint="then click where it shall hang")
            self._carrier = gui.add_number("carrier [GHz]", self._carrier_hz() / 1e9, min=0.1, max=3000.0)
            self._carrier.disabled = field is not None
        for handle in (self._range, self._mirrors, self._array, self._facing, self._carrier):
            handle.on_update(lambda _: self.refresh())
        add.on_click(lambda _: self._await_click())

    def _add_room(self) -> None:
        gui, subject = self._server.gui, self.subject
        self._cut = gui.add_slider(
            "show up to [m]", min=float(self._low[2]), max=float(self._high[2]) + 0.01, step=0.01,
            initial_value=float(self._high[2] - 0.02 * (self._high[2] - self._low[2])),
        )  # fmt: skip
        ways = tuple(layers.colourings(subject))
        self._colouring = gui.add_dropdown("colour the mesh by", ways)
        for handle in (self._cut, self._colouring):
            handle.on_update(lambda _: self._redraw())
        names = ["mesh", "splats", "cameras", "measured", "paths"]
        held = [
            subject.mesh,
            subject.gaussians,
            subject.cameras or None,
            self._measured if len(self._measured) else None,
            0,
        ]
        for name, thing in zip(names, held, strict=True):
            if thing is not None:
                shown = gui.add_checkbox(name, name not in self._hidden)
                shown.on_update(lambda event, name=name: self._show(name, event.target.value))

    def _show(self, name: str, visible: bool) -> None:
        (self._hidden.discard if visible else self._hidden.add)(name)
        handle = self._server.scene.get_handle_by_name(f"/{name}")
        if handle is not None:
            handle.visible = visible
        elif visible:
            self._redraw()

    def _redraw(self) -> None:
        """Mesh and splats anew; what is hidden is not sent, for browsers sort splats even so."""
        cut = float(self._cut.value)
        with self._server.atomic():
            if "mesh" not in self._hidden:
                layers.draw_mesh(self._server, self.subject, self._colouring.value, cut)
            if "splats" not in self._hidden:
                layers.draw_splats(self._server, self.subject, cut)

    def _go_to(self, place: np.ndarray) -> None:
        self.receiver = place

    def _await_click(self) -> None:
        """The next click on a surface hangs a transmitter 0.2 m in front of it."""
        scene = self._server.scene

        @scene.on_click()
        def _(event: Any) -> None:
            scene.remove_click_callback()
            mesh = self.subject.mesh
            if mesh is None:
                return
            origin, direction = np.asarray(event.ray_origin), np.asarray(event.ray_direction)
            hit = mesh.cast(origin[None], direction[None])
            if np.isfinite(hit.t[0]):
                self.add_transmitter(hit.point[0] - 0.2 * direction)

    # ------------------------------------------------------------------------------------------ answers

    def _carrier_hz(self) -> float:
        for known in (self.subject.field, self.subject.spectra, self.subject.readings):
            if known is not None:
                return float(known.frequency_hz)
        return CARRIER_HZ

    def _answer_forever(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wished_at is not None or self._closed)
                if self._closed:
                    return
                since, self._wished_at, self._answering = self._wished_at, None, True
            try:
                self._answer()
            finally:
                with self._changed:
                    self._answering = False
                    self.times.append(time.perf_counter() - float(since or 0.0))
                    self._changed.notify_all()

    def _answer(self) -> None:
        """Ask, and send what came to the page."""
        source = self.subject.field or self.subject.scene or self.subject.mesh
        if source is None:
            self._say("Nothing to ask: give a field, a scene or a mesh.")
            return
        try:
            found = answers.answer(
                source, self.receiver, self.transmitters, mirror_order=int(self._mirrors.value),
                frequency_hz=float(self._carrier.value) * 1e9,
            )  # fmt: skip
        except ValueError as error:  # a place in a wall, outside the room, too near: the page says so
            self.last = None
            self._say(f"No answer here: {error}")
            return
        self.last = found
        with self._server.atomic():
            self._draw_spectrum(found)
            self._draw_paths(found)
        self._server.flush()
        self._say(
            f"**{found.total_db:.1f} dB** path gain at {', '.join(f'{x:.2f}' for x in found.receiver)} m, "
            f"{sum(len(p.gain) for p in found.paths)} paths, {1e3 * found.seconds:.0f} ms"
        )

    def _say(self, message: str) -> None:
        self.message = self._status.content = message

    def _draw_spectrum(self, found: Answer) -> None:
        index = answers.measured_here(self.subject.spectra, found.receiver)
        truth = (
            self.subject.spectra[index] if index is not None and self.subject.spectra is not None else None
        )
        self._truth.visible = truth is not None
        if found.spectrum is None:
            self._wrong.content = ""
            return
        shown = [s for s in (found.spectrum, truth) if s is not None]
        top = max(float(s.path_gain_db.max()) for s in shown)
        low = top - float(self._range.value)
        self._spectrum.image = pictures.panorama(_seen_from_inside(found.spectrum), low, top)
        self._wrong.content = f"{low:.0f} dB (dark) to {top:.0f} dB (bright)"
        if truth is not None:
            self._truth.image = pictures.panorama(_seen_from_inside(truth), low, top)
            wrong = answers.errors(found.spectrum, truth)
            fitted = (
                self.subject.field is not None
                and self.subject.spectra is not None
                and bool(self.subject.field.was_fitted_on(self.subject.spectra)[index])
            )
            self._wrong.content += (
                f". Beside the truth: PSNR {wrong['psnr_db']:.1f} dB, strongest direction off by "
                f"{wrong['direction_deg']:.1f}°, total by {wrong['total_db']:+.2f} dB"
                + (" (the field was fitted to this place)" if fitted else "")
            )

    def _draw_paths(self, found: Answer) -> None:
        """Paths as lines coloured by gain, a table of the strongest, their delays and the beam of the array."""
        scene, gains, legs = self._server.scene, [], []
        for paths in found.paths:
            kept = np.argsort(-paths.power, kind="stable")[:DRAWN_PATHS]
            gains.append(10.0 * np.log10(np.maximum(paths.power[kept], 1e-300)))
            legs.append(answers.segments(paths)[kept])
        every = np.concatenate(gains) if gains else np.zeros(0)
        top = float(every.max()) if len(every) else 0.0
        lines, colours = [], []
        for gain, leg in zip(gains, legs, strict=True):
            whole = np.isfinite(leg).all(axis=(2, 3))
            lines.append(leg[whole])
            shade = pictures.coloured(gain, top - float(self._range.value), top, "plasma")
            colours.append(np.repeat(shade, whole.sum(axis=1), axis=0))
        drawn = np.concatenate(lines) if lines else np.zeros((0, 2, 3))
        shades = np.concatenate(colours) if lines else np.zeros((0, 3), dtype=np.uint8)
        if len(drawn) == 0:  # viser wants at least one
            drawn, shades = np.tile(found.receiver, (1, 2, 1)), np.zeros((1, 3), dtype=np.uint8)
        scene.add_line_segments(
            "/paths", drawn, np.repeat(shades[:, None], 2, axis=1), thickness=2.0, thickness_units="screen",
            visible="paths" not in self._hidden,
        )  # fmt: skip
        self._table.content = (
            "\n".join(
                f"- {answers.described(paths, k)}"
                for paths in found.paths
                for k in np.argsort(-paths.power)[:TABLE_ROWS]
            )
            + "\n\nArrival and departure: zenith / azimuth."
        )
        delay, power = answers.delay_profile(found.paths, BANDWIDTH_HZ)
        self._profile.data = (delay, np.maximum(power, power.max() - float(self._range.value)))
        self._draw_lobe(found)

    def _draw_lobe(self, found: Answer) -> None:
        size = ARRAYS[self._array.value]
        old = self._server.scene.get_handle_by_name("/beam")
        if size == 0 or not any(len(p.gain) for p in found.paths):
            if old is not None:
                old.remove()
            return
        beam = answers.best_beam(found.paths, size, float(np.deg2rad(self._facing.value)))
        vertices, faces = pictures.lobe_mesh(found.receiver, beam["directions"], beam["lobe"])
        self._server.scene.add_mesh_simple(
            "/beam", vertices, faces, color=(60, 170, 90), opacity=0.6, side="double"
        )
        self._table.content = (
            f"Best beam: {beam['gain_db']:+.1f} dB over one antenna.\n\n" + self._table.content
        )

    # ------------------------------------------------------------------------------------------ slow work

    def _in_background(self, work: Callable[[Callable[[str, int, int], None]], None]) -> None:
        """Run ``work(progress)`` in a thread of its own, with a bar; one at a time."""
        if self._background is not None and self._background.is_alive():
            self._say("The bar shows what is still computed; try again when it is gone.")
            return
        bar = self._server.gui.add_progress_bar(0.0, order=0.0)

        def progress(_stage: str, done: int, total: int) -> None:
            if self._closed:
                raise _GivenUp
            bar.value = 100.0 * done / max(total, 1)

        def run() -> None:
            try:
                work(progress)
            except _GivenUp:
                return
            except ValueError as error:
                self._say(f"**{error}**")
            finally:
                if not self._closed:
                    bar.remove()

        self._background = threading.Thread(target=run, name="warprrf-view-slow", daemon=True)
        self._background.start()

    def _add_map(self) -> None:
        gui, field = self._server.gui, self.subject.field
        if field is None:
            gui.add_markdown("A map needs a field.")
            return
        self._height = gui.add_number("height [m]", 1.5, step=0.1)
        self._cell = gui.add_number("cell [m]", 0.5, min=0.05, step=0.05)
        self._quantity = gui.add_dropdown("quantity", tuple(QUANTITIES.values()))
        gui.add_button("compute the map").on_click(lambda _: self._in_background(self._map))
        if self.subject.spectra is not None:
            gui.add_markdown("Errors of the field at every measured place; green is good:")
            gui.add_button("errors at measured places").on_click(lambda _: self._in_background(self._errors))

    def _map(self, progress: Callable[[str, int, int], None]) -> None:
        field = self.subject.field
        if field is None:
            return
        found = field.radio_map(
            float(self._height.value),
            float(self._cell.value),
            transmitter=self.transmitters[0],
            progress=progress,
        )
        quantity = next(name for name, text in QUANTITIES.items() if text == self._quantity.value)
        value = found.shown(quantity)
        low, high = (float(np.nanpercentile(value, q)) for q in (2, 98))
        picture = pictures.coloured(value, low, high)[::-1]
        seen = np.where(np.isnan(value), 0, 255).astype(np.uint8)[::-1]
        width, height = found.cell_m * value.shape[1], found.cell_m * value.shape[0]
        self._server.scene.add_image(
            "/map", np.dstack([picture, seen]), width, height,
            position=(float(found.x.mean()), float(found.y.mean()), float(self._low[2]) + 0.03), wxyz=(0.0, 1.0, 0.0, 0.0),
        )  # fmt: skip
        self._say(f"Map of {self._quantity.value}: {low:.1f} (dark) to {high:.1f} (bright)")

    def _errors(self, progress: Callable[[str, int, int], None]) -> None:
        field, truth = self.subject.field, self.subject.spectra
        if field is None or truth is None:
            return
        found = evaluate(truth, field.spectrum, progress=progress)
        psnr = found["per_receiver"]["psnr_db"]
        layers.draw_measured(
            self._server, truth.receivers, pictures.coloured(psnr, 15.0, 40.0, "RdYlGn"), self._go_to
        )
        self._say(
            f"PSNR at {len(psnr)} measured places: mean {found['psnr_db']:.1f} dB; red 15 dB, green 40 dB"
        )

    # ------------------------------------------------------------------------------------------ saving

    def _add_save(self) -> None:
        gui = self._server.gui
        gui.add_markdown("One file that opens in any browser, or a picture.")
        page, picture = gui.add_button("page (.html)"), gui.add_button("view (.png)")
        page.on_click(lambda event: event.client.send_file_download("warprrf.html", self._html()))

        @picture.on_click
        def _(event: Any) -> None:
            image = event.client.get_render(900, 1200, transport_format="jpeg")
            event.client.send_file_download("warprrf.png", _png(image))

    def _html(self) -> bytes:
        """The scene as it stands, with spectrum and figures in a corner."""
        page = self._server.get_scene_serializer().as_html()
        rows = [
            f"<p>{html.escape(text.replace('**', ''))}</p>" for text in (self.message, self._wrong.content)
        ]
        images = [image for image in (self._spectrum, self._truth) if image.visible]
        rows += [
            f'<img style="width:100%" src="data:image/png;base64,{base64.b64encode(_png(i.image)).decode()}">'
            for i in images
        ]
        corner = (
            '<div style="position:fixed;right:1em;top:1em;width:24em;padding:0.5em 1em;background:#ffffffe0;'
            f'font:13px sans-serif;z-index:9">{"".join(rows)}</div>'
        )
        return page.replace("</body>", corner + "</body>").encode()


def _measured_places(subject: Subject) -> np.ndarray:
    """Places (R, 3) that were measured [m]."""
    for known in (subject.spectra, subject.readings):
        if known is not None:
            return np.unique(np.atleast_2d(np.asarray(known.receivers, dtype=np.float64)), axis=0)
    return np.zeros((0, 3))


def _seen_from_inside(spectrum: Spectrum) -> np.ndarray:
    """The dB image as one who stands there sees it: azimuth grows to the left."""
    return spectrum.path_gain_db[:, ::-1]


def _png(image: np.ndarray) -> bytes:
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(image).save(data, format="PNG")
    return data.getvalue()

"""The viewer: what is dragged, the thread that answers, and what is shared."""

from __future__ import annotations

import html
import os
import threading
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.cache import Cache
from warprrf.checks import check_array
from warprrf.files import write_bytes
from warprrf.viewer import answers, pictures
from warprrf.viewer.answers import Answer
from warprrf.viewer.channel import Channel, Rays
from warprrf.viewer.page import Page
from warprrf.viewer.room import Room
from warprrf.viewer.subject import Subject
from warprrf.viewer.survey import Survey

KEPT_TIMES = 1000
KEPT_FIELDS = 4  # at other carriers, with fewer mirrors
RED, BLUE = (215, 38, 61), (30, 110, 220)


class Viewer:
    """A page in the browser; :func:`warprrf.view` makes one.

    Attributes:
        subject: what it shows.
        url: where the page is.
        last: the last answer; None before the first, and where there is none.
        times: seconds from a drag or a slider to its answer being sent, of the last thousand.
    """

    def __init__(self, subject: Subject, *, host: str, port: int) -> None:
        self._page = page = Page(host, port, subject.bounds)
        self.subject, self.url = subject, page.url
        self.last: Answer | None = None
        self.times: deque[float] = deque(maxlen=KEPT_TIMES)
        self._changed = threading.Condition()
        self._wished_at: float | None = None
        self._answering = self._closed = self._hanging = False
        self._fields = Cache(KEPT_FIELDS)
        self._add_gizmos()
        with page.tabs.add_tab("Channel"):
            self._channel = Channel(page, subject, self.refresh)
            self._rays = Rays(page, self.refresh)
            page.gui.add_button("add a transmitter", hint="then click where it shall hang").on_click(
                self._hang
            )
        with page.tabs.add_tab("Room"):
            self._room = Room(page, subject)
        with page.tabs.add_tab("Survey"):
            self._survey = Survey(page, subject, self._asked, lambda: self.transmitters, self._go_to)
        with page.tabs.add_tab("Share"):
            self._add_share()
        page.scene.on_click()(self._click)
        self._worker = threading.Thread(target=self._answer_forever, name="warprrf-view", daemon=True)
        self._worker.start()
        self.refresh()

    def __repr__(self) -> str:
        return f"Viewer({self.url})"

    def _repr_html_(self) -> str:
        return f'<iframe src="{html.escape(self.url)}" width="100%" height="640" frameborder="0"></iframe>'

    @property
    def message(self) -> str:
        """What the page says about the last answer."""
        return self._page.message

    @property
    def receiver(self) -> np.ndarray:
        """Where the receiver stands (3,) [m]; may be set."""
        return self._receiver.position + self._page.origin

    @receiver.setter
    def receiver(self, position: ArrayLike) -> None:
        self._receiver.position = check_array("receiver", position, (3,)) - self._page.origin
        self.refresh()

    @property
    def transmitters(self) -> list[np.ndarray]:
        """Where the transmitters stand, each (3,) [m]; their powers are added."""
        return [t.position + self._page.origin for t in self._transmitters]

    def add_transmitter(self, position: ArrayLike) -> None:
        """Put one more transmitter at ``position`` (3,) [m]."""
        place = check_array("position", position, (3,))
        self._transmitters.append(self._gizmo(f"/transmitter {len(self._transmitters) + 1}", place, RED))
        self.refresh()

    @property
    def clients(self) -> list[Any]:
        """Browsers that show the page now, as viser's handles."""
        return list(self._page.server.get_clients().values())

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
        self._page.close()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write what is shown: as one HTML file that needs nothing else, or spectrum, truth and error as a PNG.

        Raises:
            ValueError: for another kind of file.
            OSError: if it cannot be written.
        """
        kinds = {".html": self._html, ".png": self._png}
        suffix = Path(path).suffix.lower()
        if suffix not in kinds:
            raise ValueError(f"path: got {os.fspath(path)!r}, expected a name that ends in .html or .png")
        write_bytes(path, kinds[suffix]())

    def _add_gizmos(self) -> None:
        low, high = self.subject.bounds
        middle, first, places = 0.5 * (low + high), self.subject.transmitter, self.subject.places
        if first is None:
            first = middle + 0.25 * (high - low) * [1.0, 1.0, 0.5]
        self._transmitters = [self._gizmo("/transmitter", first, RED)]
        self._receiver = self._gizmo("/receiver", places[0] if len(places) else middle, BLUE)

    def _gizmo(self, name: str, position: np.ndarray, colour: tuple[int, int, int]) -> Any:
        low, high = self.subject.bounds
        scene, size = self._page.scene, min(1.0, 0.05 * float(np.linalg.norm(high - low)))
        handle = scene.add_transform_controls(
            name, scale=size, disable_rotations=True, depth_test=False, position=position - self._page.origin
        )
        scene.add_icosphere(f"{name}/ball", radius=0.12 * size, color=colour)
        scene.add_label(f"{name}/name", name.strip("/"))
        handle.on_update(lambda _: self.refresh())
        return handle

    def _go_to(self, place: np.ndarray) -> None:
        self.receiver = place

    def _hang(self, _: Any) -> None:
        self._hanging = True
        self._page.say("Click on the surface that the transmitter shall hang at.")

    def _click(self, event: Any) -> None:
        """Hang a transmitter 0.2 m in front of the surface that was clicked, if one shall be; else choose a path."""
        origin, direction = np.asarray(event.ray_origin), np.asarray(event.ray_direction)
        if not self._hanging or self.subject.mesh is None:
            self._rays.click(origin, direction)
            return
        self._hanging = False
        hit = self.subject.mesh.cast(origin[None] + self._page.origin, direction[None])
        if np.isfinite(hit.t[0]):
            self.add_transmitter(hit.point[0] - 0.2 * direction)

    def _asked(self) -> answers.Source | None:
        source, asked = self.subject.field or self.subject.scene or self.subject.mesh, self._channel.asked
        if source is None:
            return None
        key = replace(asked, uncertainty=False)
        return self._fields.get(key, lambda: answers.as_asked(source, asked))

    def _answer_forever(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wished_at is not None or self._closed)
                if self._closed:
                    return
                since, self._wished_at, self._answering = self._wished_at, None, True
            found = None
            with self._page.telling():
                found = self._answer()
            with self._changed:
                self.last, self._answering = found, False
                self.times.append(time.perf_counter() - float(since or 0.0))
                self._changed.notify_all()

    def _answer(self) -> Answer | None:
        """Ask, and send what came to the page."""
        page = self._page
        source = self._asked()
        if source is None:
            page.say("Nothing to ask: give a field, a scene or a mesh.")
            return None
        try:
            found = answers.answer(source, self.receiver, self.transmitters, self._channel.asked)
        except ValueError as error:  # a place in a wall, outside the room, too near
            raise ValueError(f"No answer here: {error}") from error
        with page.server.atomic():
            self._channel.show(found)
            self._rays.show(found, self._channel.range_db.value)
        page.server.flush()
        carried = abs(found.frequency_hz - self.subject.carrier_hz) > 0.5 * answers.CARRIER_STEP_HZ
        gain = (
            f"**{found.total_db:.1f} dB** path gain" if np.isfinite(found.total_db) else "**nothing** arrives"
        )
        page.say(
            f"{gain} at {', '.join(f'{x:.2f}' for x in found.receiver)} m"
            + (f", carried over to {found.frequency_hz / 1e9:g} GHz" if carried else "")
            + f" ({1e3 * found.seconds:.0f} ms)"
        )
        return found

    def _add_share(self) -> None:
        gui = self._page.gui
        gui.add_markdown("One file that opens in any browser, or a picture of the view and the spectrum.")
        page, picture = gui.add_button("page (.html)"), gui.add_button("picture (.png)")
        page.on_click(
            lambda event: event.client.send_file_download("warprrf.html", self._html(), save_immediately=True)
        )

        @picture.on_click
        def _(event: Any) -> None:
            view = event.client.get_render(900, 1200, transport_format="jpeg")
            event.client.send_file_download("warprrf.png", self._png(view), save_immediately=True)

    def _png(self, view: np.ndarray | None = None) -> bytes:
        return pictures.combined(self.message.replace("**", ""), self._channel.images, view)

    def _html(self) -> bytes:
        said = html.escape(self.message.replace("**", ""))
        shown = (
            self._channel.spectra, self._channel.table, self._rays.legend, self._room.legend, self._survey.legend
        )  # fmt: skip
        corner = (
            '<div style="position:fixed;right:1em;top:1em;bottom:1em;width:26em;overflow:auto;padding:0.5em 0;'
            f'background:#fff;z-index:9"><p class="wr">{said}</p>{"".join(part.content for part in shown)}</div>'
        )
        page: str = self._page.server.get_scene_serializer().as_html()
        return page.replace("</body>", corner + "</body>").encode()

"""The page itself: its server, its lines of text, what is hidden, and slow work with a bar."""

from __future__ import annotations

import io
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from typing import Any

import numpy as np

from warprrf.checks import check_count, check_type
from warprrf.device import Progress, TimeLeft, require


class _GivenUp(Exception):
    """Raised in background work that nobody waits for any more."""


class Setting:
    """An input of the page: its value is one that it offers, whatever a message says. ``changed`` is called with each."""

    def __init__(self, handle: Any, changed: Callable[[], None] = lambda: None) -> None:
        self._handle = handle
        handle.on_update(lambda _: changed())

    @property
    def value(self) -> Any:
        """The number within its bounds, or the option; may be set."""
        said, options = self._handle.value, getattr(self._handle, "options", None)
        if options is not None:
            return said if said in options else options[0]
        if isinstance(said, bool | str):
            return said
        low, high = (getattr(self._handle, end, None) for end in ("min", "max"))
        return min(max(said, said if low is None else low), said if high is None else high)

    @value.setter
    def value(self, value: Any) -> None:
        self._handle.value = value


class Page:
    """One page of one server.

    Attributes:
        server, gui, scene: viser's.
        tabs: that panels put their elements in.
        url: where it is.
        origin: what is taken off all that is drawn [m], shape ``(3,)``: whole kilometres, for browsers draw in single precision.
        message: what its first line says.
        hidden: names of what is not shown.
    """

    def __init__(self, host: str, port: int, bounds: np.ndarray) -> None:
        check_type("host", host, str)
        if not host:  # which sockets take for every address of the machine
            raise ValueError("host: got '', expected an address of this machine; 0.0.0.0 means all of them")
        check_count("port", port, 1, 65535)
        try:
            with socket.create_server((host, 0)):
                pass
        except OSError as error:
            raise ValueError(f"host: got {host!r}, expected an address of this machine ({error})") from error
        free = next((p for p in range(port, 65536) if _is_free(host, p)), None)
        if free is None:  # for which viser would wait for ever
            raise ValueError(f"port: got {port}, which is taken as are all above it; expected a lower one")
        require("viser", extra="view")
        from warprrf.viewer.connections import open_server

        dropped = "**A message of a page was dropped: {}**"
        self.server, self.url = open_server(host, free, lambda wrong: self.say(dropped.format(wrong)))
        self.gui, self.scene = self.server.gui, self.server.scene
        self.message = ""
        self.hidden = {"cameras"}
        self._closed = False
        self._background: threading.Thread | None = None
        middle, size = bounds.mean(axis=0), float(np.linalg.norm(bounds[1] - bounds[0]))
        self.origin = 1e3 * np.round(1e-3 * middle)
        middle -= self.origin
        self.scene.set_up_direction("+z")
        # Its share button would send the scene through somebody else's machine.
        self.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        self.gui.main_panel.dock_right()
        self.server.initial_camera.position = tuple(middle + size * np.array([-0.15, -0.42, 0.5]))
        self.server.initial_camera.look_at = tuple(middle)
        self._status = self.gui.add_markdown("")
        self.tabs = self.gui.add_tab_group()

    def say(self, message: str) -> None:
        """Write ``message`` (Markdown) at the top of the page."""
        self.message = self._status.content = message

    @contextmanager
    def telling(self) -> Iterator[None]:
        """Say on the page what goes wrong within; what is no ValueError is reported as any thread's end, too."""
        try:
            yield
        except ValueError as error:
            self.say(f"**{error}**")
        except Exception as error:  # noqa: BLE001 - reported here and there, and whoever asks next is answered
            self.say(f"**{type(error).__name__}: {error}**")
            threading.excepthook(threading.ExceptHookArgs([*sys.exc_info(), threading.current_thread()]))

    def show(self, name: str, visible: bool) -> bool:
        """Show or hide what is drawn under ``name``; False if nothing is drawn there yet."""
        (self.hidden.discard if visible else self.hidden.add)(name)
        handle = self.scene.get_handle_by_name(f"/{name}")
        if handle is not None:
            handle.visible = visible
        return handle is not None

    def in_background(self, work: Callable[[Progress], None]) -> None:
        """Run ``work(progress)`` in a thread of its own, with a bar; one at a time."""
        if self._background is not None and self._background.is_alive():
            self.say("The bar shows what is still computed; try again when it is gone.")
            return
        bar, note = self.gui.add_progress_bar(0.0, order=0.0), self.gui.add_markdown("", order=0.0)
        left = TimeLeft()

        def progress(stage: str, done: int, total: int) -> None:
            if self._closed:
                raise _GivenUp
            seconds = left(stage, done, total)
            bar.value = 100.0 * done / max(total, 1)
            note.content = stage if seconds is None else f"{stage}: {seconds:.0f} s left"

        def run() -> None:
            with self.telling(), suppress(_GivenUp):
                work(progress)
            if not self._closed:
                bar.remove()
                note.remove()

        self._background = threading.Thread(target=run, name="warprrf-view-slow", daemon=True)
        self._background.start()

    def wait(self) -> None:
        """Wait for work in the background."""
        if self._background is not None:
            self._background.join()

    def close(self) -> None:
        """Give up what is computed, and take the page down."""
        self._closed = True
        self.wait()
        with redirect_stdout(io.StringIO()):
            self.server.stop()


def _is_free(host: str, port: int) -> bool:
    try:
        with socket.create_server((host, port)):
            return True
    except OSError:
        return False

"""A viewer in the browser: drag a receiver and see what arrives, beside the truth where it is known.

:func:`warprrf.view` opens it, ``warprrf view`` does on the command line. It stands on viser, an extra: ``pip install
"warprrf[view]"``.
"""

from __future__ import annotations

from typing import Any

from warprrf.viewer.subject import Subject
from warprrf.viewer.viewer import Viewer


def view(*things: Any, host: str = "127.0.0.1", port: int = 8080) -> Viewer:
    """Show things in the browser; returns at once.

    A receiver and a transmitter are dragged; spectrum, paths, delays, best beam and errors follow. In a notebook the
    result shows the page itself.

    Args:
        things: any of a Reconstruction (or Gaussians, Mesh, Scene), a RadioField, a SpectrumDataset with the truth, and
            Readings; or files of them: ``wr.view("runs/lobby", "data/lobby/spectra.nc")``.
        host: address that is listened on; by default this machine alone can connect.
        port: of the page; the next free one if it is taken.

    Returns:
        The viewer: ``.url``, ``.save("picture.html")``, ``.close()``.

    Raises:
        TypeError: for things of another kind, or none.
        ValueError: for a file that cannot be read, two things of one kind, or a host or port that is none.
        ImportError: if viser is not installed.

    Example::

        viewer = wr.view(rec, field, ds)
        viewer.receiver = [7.0, 4.0, 1.5]
    """
    return Viewer(Subject.of(things), host=host, port=port)

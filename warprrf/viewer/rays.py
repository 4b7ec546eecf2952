"""What arrives, drawn in the room: paths coloured by gain, the one that was clicked with its figures, the best beam."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warprrf.viewer import answers, pictures
from warprrf.viewer.answers import Answer
from warprrf.viewer.page import Page

DRAWN = 60
COLOURS = "YlOrRd"  # the strongest are the darkest: they stand out on a light room
CHOSEN = (20, 60, 200)
CLICK_RAD = np.deg2rad(1.5)  # a click farther from every path means none
ARRAYS = {"no array": 0, "4 x 4": 4, "8 x 8": 8, "16 x 16": 16}


class Rays:
    """Paths and beam of the last answer.

    Args:
        page: that they are on.
        changed: called when the array changes.

    Attributes:
        label: what is written at the chosen path.
    """

    def __init__(self, page: Page, changed: Callable[[], None]) -> None:
        self._page = page
        self._found: Answer | None = None
        self.label = ""
        self._legs = np.zeros((0, 1, 2, 3))
        self._bar = page.gui.add_html("")
        self._array = page.gui.add_dropdown("receiving array", tuple(ARRAYS))
        self._facing = page.gui.add_slider(
            "array faces [degrees]", min=-180, max=180, step=1, initial_value=0
        )
        self._beam = page.gui.add_html("")
        for handle in (self._array, self._facing):
            handle.on_update(lambda _: changed())

    @property
    def html(self) -> str:
        """What the colours of the paths mean."""
        return f"{self._bar.content}{self._beam.content}"

    def show(self, found: Answer, range_db: float) -> None:
        """Draw an answer, gains over ``range_db``; its strongest path is the chosen one."""
        self._found, scene = found, self._page.scene
        listed = answers.strongest(found.paths, DRAWN)
        each = [answers.segments(p) for p in found.paths]
        depth = max((legs.shape[1] for legs in each), default=1)
        every = {
            id(p): np.pad(legs, ((0, 0), (0, depth - legs.shape[1]), (0, 0), (0, 0)), constant_values=np.nan)
            for p, legs in zip(found.paths, each, strict=True)
        }
        self._legs = np.array([every[id(p)][k] for p, k in listed]).reshape(-1, depth, 2, 3)
        gain = np.array([10.0 * np.log10(max(float(p.power[k]), 1e-300)) for p, k in listed])
        top = float(gain.max(initial=-300.0))
        whole = np.isfinite(self._legs).all(axis=(2, 3))
        lines = self._legs[whole]
        shades = np.repeat(pictures.coloured(gain, top - range_db, top, COLOURS), whole.sum(axis=1), axis=0)
        if len(lines) == 0:  # viser wants at least one
            lines, shades = np.tile(found.receiver, (1, 2, 1)), np.zeros((1, 3), dtype=np.uint8)
        scene.add_line_segments(
            "/paths", lines[::-1], np.repeat(shades[::-1, None], 2, axis=1), thickness=2.0, thickness_units="screen",
            visible=self._page.visible("paths"),
        )  # fmt: skip
        self._bar.content = (
            f'<div class="wr"><div class="title">the {len(listed)} strongest paths in the room</div>'
            + pictures.colour_bar(top - range_db, top, "dB", COLOURS)
            + "</div>"
        )
        self.choose(0 if len(listed) else None)
        self._draw_beam(found)

    def click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Choose the path that is seen nearest to where a ray points, if it is near."""
        index, angle = answers.nearest_path(self._legs, origin, direction)
        if angle < CLICK_RAD:
            self.choose(index)

    def choose(self, index: int | None) -> None:
        """Mark the path of rank ``index``, with its gain, delay and angles beside it; None for none."""
        if index is None or self._found is None:
            self._page.remove("paths/chosen")
            return
        legs = self._legs[index][np.isfinite(self._legs[index]).all(axis=(1, 2))]
        kind, gain, delay, arrival, departure = answers.described(
            *answers.strongest(self._found.paths, index + 1)[index]
        )
        self._page.scene.add_line_segments(
            "/paths/chosen", legs, CHOSEN, thickness=4.0, thickness_units="screen"
        )
        longest = np.linalg.norm(legs[:, 1] - legs[:, 0], axis=1).argmax()
        self.label = f"{kind} {gain}, {delay}\nfrom {arrival}\nto {departure}"
        self._page.scene.add_label("/paths/chosen/figures", self.label, position=legs[longest].mean(axis=0))

    def _draw_beam(self, found: Answer) -> None:
        size = ARRAYS[self._array.value]
        if size == 0 or not any(len(p.gain) for p in found.paths):
            self._page.remove("beam")
            self._beam.content = ""
            return
        beam = answers.best_beam(found.paths, size, float(np.deg2rad(self._facing.value)))
        vertices, faces = pictures.lobe_mesh(found.receiver, beam["directions"], beam["lobe"])
        self._page.scene.add_mesh_simple(
            "/beam", vertices, faces, color=(60, 170, 90), opacity=0.6, side="double"
        )
        self._beam.content = f'<div class="wr">best beam: {beam["gain_db"]:+.1f} dB over one antenna</div>'

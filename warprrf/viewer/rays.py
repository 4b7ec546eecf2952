"""What arrives, drawn in the room: paths coloured by gain, the one that was clicked with its figures, the best beam."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warprrf.viewer import answers, pictures
from warprrf.viewer.answers import Answer
from warprrf.viewer.page import Page, Setting

DRAWN = 60
COLOURS = "YlOrRd"  # the strongest are the darkest: they stand out on a light room
CHOSEN = (20, 60, 200)
CLICK_RAD = np.deg2rad(1.5)  # a click farther from every path means none
ARRAYS = {"no array": 0, "4 x 4": 4, "8 x 8": 8, "16 x 16": 16}


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
        self._legs = [answers.legs(*path) for path in listed]
        self._rows = [answers.described(*path) for path in listed]
        beam = self._show_beam(found)
        if not listed:
            scene.remove_by_name("/paths")
            self.legend.content = ""
            return
        gain = 10.0 * np.log10(np.maximum([p.power[k] for p, k in listed], 1e-300))
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
        vertices, faces = pictures.lobe_mesh(found.receiver, directions, lobe)
        self._page.scene.add_mesh_simple(
            "/beam", vertices, faces, color=(60, 170, 90), opacity=0.6, side="double"
        )
        return f"best beam: {gain_db:+.1f} dB over one antenna"

"""Leaving effects out of a full model: in which order, how far, and what the table says of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.render import render
from warprrf.rf.fields.harmonic.transport import transport
from warprrf.rf.relevance.model import FURTHER, FullModel

ALL_LAYERS = 128  # Gaussians that may share a pixel and count as seen: more have no weight left
ALIKE_DB = 0.01  # losses that round to the same hundredth of a dB are alike: then cost decides
NEEDS = {"mirror_1": ("mirror_2",), "diffuse_1": (*FURTHER, "residual")}
"""What goes with an effect, because it rests on it."""
OPEN = {
    "lobes": "only known materials or a fit tell which lobes matter",
    "residual": "only a fit tells",
    "indirect": "only a fit tells",
}
"""Effects that only a fit can tell about, and why."""
COSTLY = (
    "scatter_mirror", "diffuse_2", "mirror_scatter", "mirror_2", "diffuse_1", "mirror_1", "diffraction", "transmission",
    "line_of_sight",
)  # fmt: skip
"""From the costliest down, as measured on the lobby: fixed, so that a choice does not hang on the clock."""


@dataclass(frozen=True)
class Effect:
    """One row of the table.

    Attributes:
        name: key of the effect.
        image_db, total_db: changes of the dB image and of the total path gain without it [dB], rms over receivers.
        image_blocked_db, total_blocked_db: those of the receivers without line of sight; None if there are none.
        kept: whether the smallest model has it; None if only a fit can tell.
        reason: why, in a few words.
    """

    name: str
    image_db: float | None
    total_db: float | None
    image_blocked_db: float | None
    total_blocked_db: float | None
    kept: bool | None
    reason: str

    @property
    def worth_db(self) -> float | None:
        """The larger of both changes."""
        return None if self.image_db is None or self.total_db is None else max(self.image_db, self.total_db)


def rms(change: np.ndarray) -> float:
    """Root mean square over receivers [dB]."""
    return float(np.sqrt(np.mean(change**2)))


def decisive(loss: tuple[np.ndarray, np.ndarray]) -> float:
    """What decides [dB]: the larger of both changes, rms over receivers, the mean square raised by its standard error.

    A handful of receivers stands for all of a room: one place that an effect matters at tells of others like it.
    """
    return max(float(np.sqrt(np.mean(x**2) + np.std(x**2) / np.sqrt(len(x)))) for x in loss)


def leave_out(model: FullModel, candidates: frozenset[str], tolerance_db: float) -> list[str]:
    """Effects to leave out, in order; every beginning of the list is a model within the tolerance, too."""
    kept = model.all
    order: list[str] = []
    while True:
        trials = []
        for name in sorted(candidates & kept):
            if not _needed(name, kept):
                loss = decisive(model.loss(kept - {name}))
                trials.append((round(loss / ALIKE_DB), _rank(name), name, loss))
        if not trials or min(trials)[-1] > tolerance_db:
            return order
        name = min(trials)[2]
        kept = kept - {name}
        order.append(name)


def _rank(name: str) -> int:
    return COSTLY.index(name) if name in COSTLY else len(COSTLY)


def _needed(name: str, kept: frozenset[str]) -> bool:
    """Whether other effects in ``kept`` rest on ``name``."""
    if name.startswith("lobe_"):
        return sum(k.startswith("lobe_") for k in kept) == 1
    return any(k in kept for k in NEEDS.get(name, ()))


def effect_row(model: FullModel, name: str, kept: frozenset[str]) -> Effect:
    """The row of one effect in a model with the effects ``kept``."""
    lost = frozenset({name, *NEEDS.get(name, ())})
    lobe = name.startswith("lobe_")
    if lobe and len(model.field.terms.lobes) == 1:
        lost = frozenset(
            {"diffuse_1", *NEEDS["diffuse_1"]}
        )  # without its only lobe a surface scatters nothing
    loss = model.loss(model.all - lost)
    image, total = (rms(x) for x in loss)
    dark = [rms(x[model.blocked]) if model.blocked.any() else None for x in loss]
    stays = name in kept and not (lobe and "diffuse_1" not in kept)
    return Effect(name, image, total, dark[0], dark[1], stays, _reason(model, name, lost))


def open_rows(known: set[str]) -> list[Effect]:
    """Rows of the effects that are not ``known`` here."""
    rows = {k: v for k, v in OPEN.items() if k not in known}
    return [Effect(name, None, None, None, None, None, reason) for name, reason in rows.items()]


def _reason(model: FullModel, name: str, lost: frozenset[str]) -> str:
    if name == "gas":
        return f"{1e3 * model.gas_db_per_m:.2g} dB/km"
    if name == "unseen":
        return f"{model.unseen.sum()} of {len(model.unseen)}; they matter to further bounces alone"
    if name.startswith("lobe_"):
        return "the only lobe" if len(model.field.terms.lobes) == 1 else "its neighbours stand in for it"
    share = f"{_percent(model.power(lost))} of the received power"
    assumed = name == "transmission" and model.walls.assumed
    return f"{share}; walls of 12.5 mm and permittivity 4 assumed" if assumed else share


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share >= 1e-4 or share == 0 else f"{100 * share:.0e} %"


def change_of_unseen(
    gaussians: Gaussians, receivers: np.ndarray, shape: tuple[int, int], device: Any
) -> tuple[float, str]:
    """What Gaussians with no blending weight at any of ``receivers`` (R, 3) could change [dB], and a few words on them.

    It is rendered, not assumed.
    """
    weights = transport(gaussians, receivers, shape, top_k=ALL_LAYERS, device=device)
    unseen = np.ones(len(gaussians.means), bool)
    unseen[weights.gaussian] = False
    marked, share = unseen.astype(np.float32)[:, None], 0.0
    for receiver in receivers:
        camera = Camera.spherical(shape[1], shape[0], position=receiver)
        share = max(share, float(render(gaussians, camera, marked, device=device).features.max()))
    change = float(-10.0 * np.log10(max(1.0 - share, 1e-12)))
    return (
        change,
        f"{unseen.sum()} of {len(unseen)}; blending gives them at most {_percent(share)} of a pixel",
    )

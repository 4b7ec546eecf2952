"""Leaving effects out of a full model: in which order, how far, and what the table says of each."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from warprrf.checks import checked
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.render import render
from warprrf.rf.fields.harmonic.transport import transport
from warprrf.rf.relevance.model import FURTHER, FullModel

ALL_LAYERS = 128  # Gaussians that may share a pixel and count as seen: more have no weight left
ALIKE_DB = 0.01  # losses that round to the same hundredth of a dB are alike: then cost decides
NEEDS = {"mirror_1": ("mirror_2",), "diffuse_1": (*FURTHER, "residual")}
"""What goes with an effect, because it rests on it."""
COSTLY = (
    "scatter_mirror", "diffuse_2", "mirror_scatter", "mirror_2", "diffuse_1", "mirror_1", "diffraction", "transmission",
    "line_of_sight",
)  # fmt: skip
"""From the costliest down, as measured on the lobby: fixed, so that a choice does not hang on the clock."""


@checked
@dataclass(frozen=True)
class Effect:
    """One row of the table.

    Attributes:
        name: key of the effect.
        image_db, total_db: changes of the dB image and of the total path gain without it [dB], rms over receivers.
        image_blocked_db, total_blocked_db: those of the receivers without line of sight; None if there are none.
        seconds: what it takes by itself, per spectrum; None if it takes no time of its own.
        kept: whether the smallest model has it; None if only a fit can tell.
        reason: why, in a few words.
    """

    name: str
    image_db: float | None
    total_db: float | None
    image_blocked_db: float | None
    total_blocked_db: float | None
    seconds: float | None
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
    seconds, reason = model.seconds.get(name), _reason(model, name, lost)
    return Effect(name, image, total, dark[0], dark[1], seconds, stays, reason)


def open_row(name: str, reason: str) -> Effect:
    """The row of an effect that only a fit can tell about."""
    return Effect(name, None, None, None, None, None, None, reason)


def _reason(model: FullModel, name: str, lost: frozenset[str]) -> str:
    if name == "gas":
        return _gas(model)
    if name == "unseen":
        return _elements(model)
    if name in model.side:
        return _beside(model, name)
    if name.startswith("lobe_"):
        return _lobe(model, int(name.removeprefix("lobe_")))
    share = f"{_percent(model.power(lost))} of the received power"
    if name == "line_of_sight":
        return f"{int((~model.blocked).sum())} of {len(model.blocked)} receivers see the transmitter; {share}"
    return share


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share >= 1e-4 or share == 0 else f"{100 * share:.0e} %"


def _gas(model: FullModel) -> str:
    longest = max(
        [float(np.max(x, initial=0.0)) for x in model.bounce_length_m]
        + [float(np.max(v.paths.length_m, initial=0.0)) for v in model.views]
    )
    rate = model.gas_db_per_m
    return f"{1e3 * rate:.2g} dB/km, longest path {longest:.1f} m: at most {rate * longest:.2g} dB"


def _beside(model: FullModel, name: str) -> str:
    found, blocked = model.side[name], model.blocked
    if not blocked.any():
        return "no receiver is blocked"
    power = np.bincount(found.receiver, found.power, minlength=len(blocked))[blocked]
    rest = model.image(model.all - set(model.side)).sum(axis=(1, 2))[blocked]
    reached = power > 0
    assumed = (
        "; walls of 12.5 mm and permittivity 4 assumed"
        if name == "transmission" and model.walls.assumed
        else ""
    )
    if not reached.any():
        over = "over one edge (ways over two are not sought) " if name == "diffraction" else ""
        return f"no such path {over}to any blocked receiver{assumed}"
    dark = int((rest[reached] == 0).sum())
    if dark:
        return f"nothing else reaches {dark} of {len(rest)} blocked receivers{assumed}"
    nearest = float(np.min(10.0 * np.log10(rest[reached] / power[reached])))
    where = f"{nearest:.0f} dB below" if nearest >= 0 else f"{-nearest:.0f} dB above"
    return f"at its strongest {where} the rest of a blocked receiver's power{assumed}"


def _lobe(model: FullModel, n: int) -> str:
    others = [k for k in model.field.terms.lobes if k != n]
    if not others:
        return "the only lobe"
    surface, weight = model.field.surface, model.field.parameters.weight
    area = np.bincount(surface.element_group, surface.element_area, minlength=surface.groups)
    share = area @ weight[:, model.field.terms.lobes.index(n)] / max(float(area @ weight.sum(axis=1)), 1e-300)
    return f"{_percent(float(share))} of the lobes' weight; its neighbours stand in for it"


def _elements(model: FullModel) -> str:
    unseen, area = model.unseen, model.field.surface.element_area
    share = _percent(float(area[unseen].sum() / area.sum()))
    return f"{int(unseen.sum())} of {len(unseen)}, {share} of the area; they matter to further bounces alone"


def gaussians_row(
    gaussians: Gaussians, receivers: np.ndarray, shape: tuple[int, int], tolerance_db: float, device: Any
) -> Effect:
    """Gaussians with no blending weight at any receiver; what they could change is rendered, not assumed."""
    start = time.perf_counter()
    weights = transport(gaussians, receivers, shape, top_k=ALL_LAYERS, device=device)
    seen = np.zeros(len(gaussians.means), bool)
    seen[weights.gaussian] = True
    seconds = (time.perf_counter() - start) / len(receivers)
    marked = (~seen).astype(np.float32)[:, None]
    share = 0.0
    for receiver in receivers:
        camera = Camera.spherical(shape[1], shape[0], position=receiver)
        share = max(share, float(render(gaussians, camera, marked, device=device).features.max()))
    change = float(-10.0 * np.log10(max(1.0 - share, 1e-12)))
    return Effect(
        "gaussians", change, change, None, None, seconds, change > tolerance_db,
        f"{int((~seen).sum())} of {len(seen)}; blending gives them at most {_percent(share)} of a pixel",
    )  # fmt: skip

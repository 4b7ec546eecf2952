"""Which effects a scene needs, in a band and to a tolerance: what each is worth, and the smallest model that is enough.

The full model (:mod:`warprrf.rf.relevance.model`) is evaluated at a handful of receivers with and without each effect.
What an effect is worth is the larger of two changes that leaving it out makes, both root mean squares over receivers:
that of the dB image 10 log10(P + N0), over the sphere, and that of the total path gain. The smallest model is found by
leaving out effects one after another, each time the one whose loss hurts least together with all that went before (the
costliest of those that hurt alike, to a hundredth of a dB), while the model stays within the tolerance of the full one.
There the mean squares count with one standard error more, because few receivers stand for many.
The order does not depend on the tolerance, so a larger one never keeps more.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import numpy as np

from warprrf.checks import NotNegative, checked, one_line, positive
from warprrf.device import Progress, silent
from warprrf.files import read_json, write_json
from warprrf.geometry.mesh import as_mesh
from warprrf.rf.em.waves import SPEED_OF_LIGHT, check_frequency
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.options import OPTIONAL
from warprrf.rf.positions import check_positions, check_receivers, question_unit
from warprrf.rf.relevance.model import FullModel, effects_of, full_field, lobe_name
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import BEAM_SIGMA_RAD
from warprrf.rf.tracing.model import Effects

TITLES = {
    "line_of_sight": "line of sight",
    "mirrors_1": "mirrors, order 1",
    "mirrors_2": "mirrors, order 2",
    "scatterings_1": "scattering, order 1",
    "scatterings_2": "scattering, order 2 and more",
    "mirror_scatter": "surfaces lit by mirrors",
    "scatter_mirror": "lit surfaces seen in mirrors",
    "residual": "residual of elements",
    "lobes": "scattering lobes",
    "gas": "gas absorption (ITU-R P.676)",
    "diffraction": "diffraction (one edge, Kouyoumjian and Pathak)",
    "transmission": "transmission through walls (ITU-R P.2040)",
}
NEEDS = {
    "mirrors_1": ("mirrors_2",), "scatterings_1": ("mirror_scatter", "scatter_mirror", "scatterings_2", "residual"),
}  # fmt: skip
"""What goes with an effect, because it rests on it."""
COSTLY = (
    "scatter_mirror", "scatterings_2", "mirror_scatter", "mirrors_2", "scatterings_1", "mirrors_1", "diffraction",
    "transmission", "line_of_sight",
)  # fmt: skip
"""From the costliest down, as measured on the lobby: fixed, so that a choice does not hang on the clock."""
MATERIALS = {
    "scene": "materials of the scene",
    "fit": "fitted parameters",
    "assumed": "no materials known: half scattered, half mirrored, permittivity 4 assumed",
}


@checked
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
    image_db: float | None = None
    total_db: float | None = None
    image_blocked_db: float | None = None
    total_blocked_db: float | None = None
    kept: bool | None = None
    reason: str = ""

    @property
    def worth_db(self) -> float | None:
        """The larger of both changes."""
        return None if self.image_db is None or self.total_db is None else max(self.image_db, self.total_db)


@checked
@dataclass(frozen=True)
class Relevance:
    """What a scene needs; made by :func:`relevance`.

    Attributes:
        materials: ``"scene"``, ``"fit"`` or ``"assumed"``: where they come from.
        frequency_hz: carrier [Hz].
        tolerance_db: what leaving effects out may change [dB].
        floor: N0 of the dB images.
        receivers, blocked: how many, and how many of them without line of sight.
        effects: rows of the table.
        model: what the smallest bistatic model has.
        lobes: exponents of its scattering lobes.
        image_db, total_db: its changes against the full model [dB], rms over receivers, all effects left out at once.
    """

    __repr__ = one_line

    materials: str
    frequency_hz: float
    tolerance_db: float
    floor: float
    receivers: int
    blocked: int
    effects: tuple[Effect, ...]
    model: Effects
    lobes: tuple[int, ...]
    image_db: float
    total_db: float

    def __getitem__(self, name: str) -> Effect:
        """The effect ``name``; KeyError if there is none."""
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise KeyError(f"{name!r}: expected one of {', '.join(e.name for e in self.effects)}")

    @property
    def kept(self) -> tuple[str, ...]:
        """Names of the effects in the smallest model."""
        return tuple(e.name for e in self.effects if e.kept)

    def needs(self, frequency_hz: float) -> tuple[Effects, tuple[int, ...] | None]:
        """What a fit to spectra at ``frequency_hz`` may need, and its lobes; None for those of a fit.

        Raises:
            ValueError: if the carrier is another than the one that this was made for.
        """
        if abs(frequency_hz / self.frequency_hz - 1.0) > 0.05:  # materials hardly change within it
            raise ValueError(
                f"frequency_hz: got spectra of {frequency_hz / 1e9:g} GHz, but this relevance is for "
                f"{self.frequency_hz / 1e9:g} GHz; expected the same band, call warprrf.relevance for it"
            )
        m, out = self.model, [e.name for e in self.effects if e.kept is False]
        most = replace(
            m,
            mirrors=3 if m.mirrors == 2 else m.mirrors,
            residual="residual" not in out and m.scatterings > 0,
        )
        return most, None if self.materials == "assumed" and m.scatterings else self.lobes

    def table(self) -> str:
        """The effects as a Markdown table, with what was chosen below it."""

        def cell(value: float | None) -> str:
            return "" if value is None else f"{value:.2g}" if value < 10 else f"{value:.0f}"

        lines = [
            f"{self.frequency_hz / 1e9:g} GHz, tolerance {self.tolerance_db:g} dB, {self.receivers} receivers, "
            f"{self.blocked} of them blocked; {MATERIALS[self.materials]}.",
            "",
            "| effect | image [dB] | total [dB] | blocked: image [dB] | total [dB] | in the model | why |",
            "|---|---|---|---|---|---|---|",
        ]
        for e in self.effects:
            chosen = "left to the fit" if e.kept is None else "yes" if e.kept else "no"
            numbers = [cell(v) for v in (e.image_db, e.total_db, e.image_blocked_db, e.total_blocked_db)]
            lines.append(f"| {title(e.name)} | {' | '.join(numbers)} | {chosen} | {e.reason} |")
        lines += [
            "",
            f"All that is left out, together: {self.image_db:.3f} dB of the image, {self.total_db:.3f} dB of the "
            "total.",
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """All of it, in terms of JSON."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        values["effects"] = [{**asdict(e), "worth_db": e.worth_db} for e in self.effects]
        return {**values, "model": asdict(self.model)}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it as JSON, in one go."""
        write_json(path, self.to_dict(), seal=True)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Relevance:
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is something else.
        """
        values = read_json(path)
        try:
            rows = [{k: v for k, v in row.items() if k != "worth_db"} for row in values.pop("effects")]
            model, lobes = Effects(**values.pop("model")), tuple(values.pop("lobes"))
            return cls(effects=tuple(Effect(**row) for row in rows), model=model, lobes=lobes, **values)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{os.fspath(path)}: expected what Relevance.save wrote: {error!r}") from error


def title(name: str) -> str:
    """What an effect is called in tables."""
    return TITLES.get(name) or f"scattering lobe of exponent {name.removeprefix('lobe_')}"


@checked
@dataclass(frozen=True)
class Setting:
    """What relevance is judged for.

    Attributes:
        transmitter: position [m], shape ``(3,)``; a field's own by default.
        frequency_hz: carrier [Hz]; a field's own by default.
        floor: N0 of the dB images; by default a field's own, else 60 dB below the median peak of the full model.
        shape, beam_sigma_rad: of the spectra; a field's own if it is one.
        gas_db_per_m: attenuation of the air; None for that of a field's own air, else of standard air
            (:func:`gas_attenuation_db_per_m`).
    """

    transmitter: Any = None
    frequency_hz: float | None = None
    floor: Annotated[float, positive("path gain")] | None = None
    shape: tuple[int, int] = (60, 120)
    beam_sigma_rad: float = BEAM_SIGMA_RAD
    gas_db_per_m: NotNegative | None = None

    def of(self, geometry: Any) -> Setting:
        """The same with what a fitted field knows itself.

        Raises:
            TypeError: for a field of another model.
            ValueError: for a carrier that is not the field's, a bad floor, a missing transmitter or carrier.
        """
        found = self
        if isinstance(geometry, BistaticField):
            own, gas = geometry.frequency_hz, self.gas_db_per_m
            if self.frequency_hz not in (None, own):
                raise ValueError(
                    f"frequency_hz: got {self.frequency_hz!r}, but the field was fitted at {own!r}"
                )
            if gas is None and geometry.air is not None:
                gas = geometry.air.attenuation_db_per_m(own)
            found = Setting(
                geometry.transmitter if self.transmitter is None else self.transmitter, own,
                geometry.floor if self.floor is None else self.floor, geometry.shape, geometry.beam_sigma_rad, gas,
            )  # fmt: skip
        elif isinstance(geometry, RadioField):
            raise TypeError(f"geometry: got a field of model {geometry.model!r}, expected a bistatic one")
        for name in ("transmitter", "frequency_hz"):
            if getattr(found, name) is None:
                raise ValueError(f"{name}: got None, expected it for anything but a fitted field")
        return found


@checked
def relevance(
    geometry: Any,
    *,
    receivers: Any,
    tolerance_db: Annotated[float, positive("number of decibels")] = 0.1,
    device: Any = None,
    progress: Progress | None = None,
    **setting: Any,
) -> Relevance:
    """What each effect is worth in a scene and a band, and the smallest model within a tolerance.

    Args:
        geometry: a Scene (its materials count), a fitted bistatic field (its parameters count, also for terms that its
            fit left out), or a Reconstruction or Mesh (materials are assumed, and the table says so).
        receivers: some positions [m], shape ``(R, 3)``, blocked ones among them: a dozen or more, since a mirror may
            matter much to few.
        tolerance_db: what all that is left out may change together [dB].
        device: where rays are cast.
        progress: called with the stage ``"relevance"``.
        setting: attributes of :class:`Setting`: ``transmitter``, ``frequency_hz`` (both needed for anything but a
            field), ``floor``, ``shape``, ``beam_sigma_rad``, ``gas_db_per_m``.

    Raises:
        ValueError: for a missing transmitter or carrier, one outside a material's band or another than a field's own,
            receivers on a surface or outside the scene, or a tolerance that is not positive.
        TypeError: for a geometry without a mesh, a field of another model, or an unknown setting.
    """
    tick = progress or silent
    model, source = full_model(geometry, receivers, device=device, progress=tick, **setting)
    found = choose(model, source, tolerance_db)
    tick("relevance", len(model.receivers) + 1, len(model.receivers) + 1)
    return found


def full_model(
    geometry: Any, receivers: Any, *, device: Any = None, progress: Progress, **setting: Any
) -> tuple[FullModel, str]:
    """What :func:`choose` takes, for the arguments of :func:`relevance`; errors as there."""
    asked = Setting(**setting).of(geometry)
    at, frequency_hz = asked.transmitter, check_frequency(asked.frequency_hz)
    frame = SpectrumDataset.empty(
        transmitter=at, frequency_hz=frequency_hz, shape=asked.shape, beam_sigma_rad=asked.beam_sigma_rad
    )
    question_unit(as_mesh(geometry, "geometry"), SPEED_OF_LIGHT / frequency_hz)
    full, source = full_field(geometry, frame, device)
    places = np.atleast_2d(check_receivers("receivers", receivers))
    known = geometry.transmitter if isinstance(geometry, BistaticField) else None
    check_positions(full.mesh, full.transmitter, places, full.wavelength_m, known=known, device=device)
    model = FullModel(full, places, floor=asked.floor, gas_db_per_m=asked.gas_db_per_m, progress=progress)
    return model, source


def choose(model: FullModel, source: str, tolerance_db: float) -> Relevance:
    """What to keep of a model whose materials are of ``source``, within a tolerance."""
    full = model.field
    known = model.all if source != "assumed" else model.all - set(map(lobe_name, full.parameters.lobes))
    kept = model.all - frozenset(leave_out(model, known, tolerance_db))
    effects = [effect_row(model, name, kept) for name in model.effects if name in known]
    if source == "assumed":
        effects.append(Effect("lobes", reason="only known materials or a fit tell which lobes matter"))
    if "residual" not in model.all:
        effects.append(Effect("residual", reason="only a fit tells"))
    loss, least = model.loss(kept), model.reduced(kept)
    lobes = least.parameters.lobes if least.effects.scatterings else least.parameters.lobes[:1]
    return Relevance(
        source, full.frequency_hz, tolerance_db, model.floor, len(model.receivers), int(model.blocked.sum()),
        tuple(effects), effects_of(kept), lobes, rms(loss[0]), rms(loss[1]),
    )  # fmt: skip


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
                # Losses that round to the same hundredth of a decibel are alike: then cost decides.
                trials.append((round(loss / 0.01), (*COSTLY, name).index(name), name, loss))
        if not trials or min(trials)[-1] > tolerance_db:
            return order
        name = min(trials)[2]
        kept = kept - {name}
        order.append(name)


def _needed(name: str, kept: frozenset[str]) -> bool:
    """Whether other effects in ``kept`` rest on ``name``."""
    if name.startswith("lobe_"):
        return sum(k.startswith("lobe_") for k in kept) == 1
    return any(k in kept for k in NEEDS.get(name, ()))


def effect_row(model: FullModel, name: str, kept: frozenset[str]) -> Effect:
    """The row of one effect in a model with the effects ``kept``."""
    lost = frozenset({name, *NEEDS.get(name, ())})
    lobe = name.startswith("lobe_")
    if lobe and len(model.field.parameters.lobes) == 1:  # without its only lobe a surface scatters nothing
        lost = frozenset({"scatterings_1", *NEEDS["scatterings_1"]})
    loss = model.loss(model.all - lost)
    image, total = (rms(x) for x in loss)
    dark = [rms(x[model.blocked]) if model.blocked.any() else None for x in loss]
    stays = name in kept and not (lobe and "scatterings_1" not in kept)
    return Effect(name, image, total, dark[0], dark[1], stays, _reason(model, name, lost))


def _reason(model: FullModel, name: str, lost: frozenset[str]) -> str:
    if name == "gas":
        rate, longest = model.gas_db_per_m, model.longest_m
        return f"{1e3 * rate:.2g} dB/km, longest path {longest:.1f} m: at most {rate * longest:.2g} dB"
    if name in OPTIONAL:
        return _rare(model, name)
    if name.startswith("lobe_"):
        return _lobe(model, int(name.removeprefix("lobe_")))
    share = f"{_percent(model.power(lost))} of the received power"
    if name == "line_of_sight":
        return f"{int((~model.blocked).sum())} of {len(model.blocked)} receivers see the transmitter; {share}"
    return share


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share >= 1e-4 or share == 0 else f"{100 * share:.0e} %"


def _rare(model: FullModel, name: str) -> str:
    blocked = model.blocked
    if not blocked.any():
        return "no receiver is blocked"
    both = model.all, model.all - {name}
    with_it, without = (model.image(kept).sum(axis=(1, 2))[blocked] for kept in both)
    share = float(np.mean(1.0 - without / np.maximum(with_it, 1e-300)))
    return f"{_percent(share)} of the power of a blocked receiver, in the mean"


def _lobe(model: FullModel, n: int) -> str:
    others = [k for k in model.field.parameters.lobes if k != n]
    if not others:
        return "the only lobe"
    surface, p = model.field.surface, model.field.parameters
    area = np.bincount(surface.element_group, surface.element_area, minlength=surface.groups)
    share = area @ p.weight[:, p.lobes.index(n)] / max(float(area @ p.weight.sum(axis=1)), 1e-300)
    return f"{_percent(float(share))} of the lobes' weight; its neighbours stand in for it"

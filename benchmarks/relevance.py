"""What each effect is worth in the lobby, at two carriers and with surfaces rougher and smoother than assumed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import warprrf as wr
from benchmarks.fits import FitOptions, Fits, experiment
from benchmarks.report import Row
from benchmarks.runner import option

HELP = """\
Leaves out one effect at a time (wr.relevance) at 140 and 300 GHz, with the surfaces' assumed roughness, three times it and a
third of it, at receivers of which half are blocked.

examples:
  python -m benchmarks relevance
  python -m benchmarks relevance --carriers-ghz 300 --receivers 4       a first look
"""

ROUGHNESS = {"as assumed": 1.0, "rough (x3)": 3.0, "smooth (x1/3)": 1.0 / 3.0}
"""Factors of the rms roughness."""
COLUMNS = {
    "rows": (
        ("ghz", "carrier [GHz]", "{:g}"), ("roughness", "roughness", "{}"), ("name", "effect left out", "{}"),
        ("worth_db", "worth [dB]", "{:.2g}"), ("kept", "kept", "{}"),
    )
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(FitOptions):
    """Options of the judgement.

    Attributes:
        carriers_ghz: carriers; each inside the bands of all materials.
        receivers: how many, half of them blocked; with 8 the few that a mirror lights strongly may be missed.
        tolerance_db: of the choice what to keep.
    """

    truths: tuple[str, ...] = ("exact",)
    carriers_ghz: tuple[float, ...] = option((140.0, 300.0), "carriers [GHz]")
    receivers: int = option(12, "receivers, half of them blocked")
    tolerance_db: float = option(0.1, "of the choice what to keep [dB]")


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """A row for each carrier, roughness and effect."""
    scene, ds = wr.Scene.load(options.xml), options.load()[0].data
    order = np.random.default_rng(fits.job.seed).permutation(len(ds))
    seen = np.asarray(ds.line_of_sight, bool)[order]
    half = options.receivers // 2
    chosen = np.concatenate([order[~seen][:half], order[seen][: options.receivers - half]])
    for ghz in options.carriers_ghz:
        for name, factor in ROUGHNESS.items():
            other = [replace(m, roughness_m=factor * m.roughness_m) for m in scene.materials]

            def judged(ghz: float = ghz, other: list[wr.Material] = other) -> Row:
                found = wr.relevance(
                    scene.with_materials(other), transmitter=ds.transmitter, receivers=ds.receivers[chosen],
                    frequency_hz=1e9 * ghz, shape=ds.shape, beam_sigma_rad=ds.beam_sigma_rad,
                    tolerance_db=options.tolerance_db, device=fits.job.device,
                )  # fmt: skip
                return {"effects": found.to_dict()["effects"]}

            found = fits.row(f"{ghz:g} GHz {name}", judged, options.receivers, options.tolerance_db)
            for effect in found["effects"]:
                yield {"ghz": ghz, "roughness": name, **effect}


ABOUT = "What each effect is worth in the lobby: larger of the changes of the dB image and the total path gain, rms."
BENCHMARKS = {"relevance": experiment("relevance", Options, rows, COLUMNS, ABOUT, HELP)}

"""Tables of the documentation and of the README, from the files in ``benchmarks/results``.

``python tools/docs/results.py readme`` writes README's table anew, ``python tools/docs/results.py keep FOLDER`` keeps
the result of a finished ``make lobby`` (``FOLDER/report.json``), without the figures of single receivers.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "benchmarks" / "results"
README = ROOT / "README.md"
MARKERS = ("<!-- results: made by tools/docs/results.py -->", "<!-- /results -->")

NAMES = {
    "bistatic": "**bistatic**",
    "bistatic-quick": "**bistatic, quick fit**",
    "rf3dgs+": "RF-3DGS+",
    "rf3dgs+los": "RF-3DGS+ with line of sight",
    "rf3dgs": "RF-3DGS",
    "rf3dgs+alpha": "RF-3DGS+, opacity trained",
    "rf3dgs-alpha": "RF-3DGS, opacity trained",
    "nerf2": "NeRF2",
    "cgan": "conditional GAN",
    "sionna-calibrated": "Sionna RT, calibrated materials",
    "sionna": "Sionna RT, true mesh, assumed materials",
    "sionna-again": "Sionna RT, the truth under another seed",
    "nearest": "nearest receiver's spectrum",
    "idw": "inverse-distance average",
    "mean": "mean image",
    "constant": "constant image",
    "zero": "our geometry, no spectra",
    "transmitter": "point at the transmitter",
}
TRUTHS = {"exact": "exact engine", "sionna": "Sionna RT, depth 3"}
THREADS = 100 * 16  # of a hundred machines
LINK = 1.25e9  # bytes a second: 10 Gbit/s
Row = dict[str, Any]
TABLES: dict[str, Callable[[], str]] = {}


def table(name: str) -> str:
    """The Markdown of a table.

    Raises:
        KeyError: for a name that no table has.
    """
    if name.startswith("machine-"):
        return _machine(name.removeprefix("machine-"))
    return TABLES[name]()


@cache
def read(name: str) -> Row:
    """A result file."""
    found: Row = json.loads((FOLDER / f"{name}.json").read_text())
    return found


def measured(name: str) -> Row | None:
    """A result file that a checkout may lack; :func:`missing` is then what a page says."""
    return read(name) if (FOLDER / f"{name}.json").is_file() else None


def missing(command: str) -> str:
    """What a page says in the place of a table without a result file."""
    return f"*Not measured here yet: `{command}` makes these figures.*"


def entry(name: str) -> Callable[[Callable[[], str]], Callable[[], str]]:
    """Enters a table under its name."""

    def enter(function: Callable[[], str]) -> Callable[[], str]:
        TABLES[name] = function
        return function

    return enter


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Rows of cells under a head; all but the first column set right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def show(value: Any, form: str = "{:.1f}") -> str:
    """A value in a format, or nothing for None."""
    return "" if value is None else form.format(value)


def _machine(name: str) -> str:
    found = read(name)
    m = found["machine"]
    device = "" if m["device"] == "cpu" else f", {m['device']}"
    versions = m["versions"]
    return (
        f"Measured on {m['processor']}, {m['cores']} cores{device}, Python {m['python']}, Warp {versions['warp-lang']}; "
        f"every figure is in `benchmarks/results/{name}.json`."
    )


# ------------------------------------------------------------------------------------------------- the lobby


@entry("lobby-geometry")
def _lobby_geometry() -> str:
    r = read("lobby")
    g = r["geometry"]
    rows = [
        ("photos posed", f"{g['posed']} of {g['photos']}"),
        ("PSNR of photos held out", f"{r['photo_psnr_db']:.1f} dB"),
        ("the same of two renderings of one photo with other noise", f"{r['photo_noise_psnr_db']:.1f} dB"),
        (
            f"camera positions, rms error, scale from {g['surveyed']} surveyed ones",
            f"{1e3 * r['camera_rms_m']:.1f} mm",
        ),
        (
            "mesh to the true surface where a photo sees it, median",
            f"{1e3 * r['mesh_distance_median_m']:.1f} mm",
        ),
        ("the same, 90th percentile", f"{1e3 * r['mesh_distance_p90_m']:.1f} mm"),
        ("direction of the mesh's normals, median error", f"{r['mesh_normal_median_deg']:.2f}°"),
        ("Gaussians, triangles, planar patches", f"{g['gaussians']}, {g['triangles']}, {g['patches']}"),
    ]
    return markdown(("figure", "value"), rows)


SCORES = (
    ("psnr_db", "PSNR [dB]", "{:.1f}"),
    ("psnr_db_blocked", "blocked", "{:.1f}"),
    ("ssim", "SSIM", "{:.2f}"),
    ("rmse_db", "RMSE [dB]", "{:.1f}"),
    ("direction_within_3deg", "within 3°", "{:.0%}"),
    ("direction_within_3deg_blocked", "blocked", "{:.0%}"),
    ("beam_gain_loss_db", "beam loss [dB]", "{:.1f}"),
    ("tof_error_median_ns", "delay [ns]", "{:.2g}"),
)


def _scored(found: dict[str, Row]) -> str:
    rows = [
        [
            NAMES[m],
            *(show(row[k], f) for k, _, f in SCORES),
            show(1e3 * row["seconds_per_spectrum"], "{:.2g}"),
        ]
        for m, row in found.items()
    ]
    return markdown(("model", *(h for _, h, _ in SCORES), "a spectrum [ms]"), rows)


@entry("lobby-exact")
def _lobby_exact() -> str:
    return _scored(read("lobby")["methods"])


@entry("lobby-sionna")
def _lobby_sionna() -> str:
    return _scored(read("lobby")["methods_sionna"])


@entry("lobby-stages")
def _lobby_stages() -> str:
    r = read("lobby")
    rows = [(name, f"{stage['seconds']:.0f}") for name, stage in r["stages"].items()]
    return markdown(("step", "seconds"), [*rows, ("**all**", f"**{r['pipeline_time_s']:.0f}**")])


@entry("lobby-seeds")
def _lobby_seeds() -> str:
    found = measured("lobby_seeds")
    if found is None:
        return missing("python -m benchmarks lobby-seeds")
    lines = [
        [r["figure"], *(show(r[k], "{:.4g}") for k in ("mean", "spread", "least", "most"))]
        for r in found["rows"]
        if not r["key"].startswith("methods")
        and not r["key"].endswith("time_s")  # what a machine decides, not a seed
        or ("bistatic" in r["key"] or "rf3dgs+" in r["key"])
        and "psnr" in r["key"]
    ]
    return markdown(
        (f"seeds {', '.join(map(str, found['seeds']))}", "mean", "spread", "least", "most"), lines
    )


# ---------------------------------------------------------------------------------------- the bistatic field


def _find(rows: list[Row], **wanted: Any) -> Row | None:
    return next((r for r in rows if all(r.get(k) == v for k, v in wanted.items())), None)


@entry("ablation")
def _ablation() -> str:
    rows = read("bistatic")["ablation"]
    words = {
        "everything": "everything",
        "zero spectra": "the same geometry, no spectra at all",
        "RF-3DGS+ with line of sight": "RF-3DGS+ with an explicit line of sight",
        "no residual per element": "no correction per surface element",
        "true mesh, its materials as groups": "everything, on the true mesh with its materials as groups",
    }
    lines = []
    for model in dict.fromkeys(r["model"] for r in rows):
        lines.append([
            words.get(model, model),
            *(show((found := _find(rows, truth=t, model=model)) and found["psnr_db"]) for t in TRUTHS),
        ])  # fmt: skip
    return markdown(("model, ten spectra", *(f"{n} [dB]" for n in TRUTHS.values())), lines)


@entry("uncertainty")
def _uncertainty() -> str:
    lines = [
        [
            f"{TRUTHS[r['truth']]}, {r['n_train']}", show(r["rms_error_db"]),
            show(r["within_1_sigma"], "{:.0%}"), show(r["within_2_sigma"], "{:.0%}"),
        ]
        for r in read("bistatic")["calibration"]
    ]  # fmt: skip
    return markdown(
        ("truth, training receivers", "rms error [dB]", "within one standard deviation", "within two"), lines
    )


@entry("delays")
def _delays() -> str:
    lines = [
        [
            f"{TRUTHS[r['truth']]}, {r['n_train']}", show(r["mirror"]["found"], "{:.0%}"),
            show(r["mirror"]["median_ns"], "{:.4f}"), show(r["scattering"]["median_by_power_ns"], "{:.3f}"),
        ]
        for r in read("bistatic")["delays"]
    ]  # fmt: skip
    head = ("truth, training receivers", "mirror paths found", "their delay error [ns]", "scattering's [ns]")
    return markdown(head, lines)


@entry("transmitter")
def _transmitter() -> str:
    lines = [
        [
            NAMES[r["method"]], show(r["seen"]["psnr_db"]), show(r["psnr_db"]),
            show(r["direction_within_3deg"], "{:.0%}"), show(r["direction_within_3deg_blocked"], "{:.0%}"),
        ]
        for r in read("bistatic")["second"]
    ]  # fmt: skip
    head = ("model, ten spectra", "fitted transmitter [dB]", "another one [dB]", "within 3°", "blocked")
    return markdown(head, lines)


# ------------------------------------------------------------------------------------------- other methods

PLACES = {
    ("exact", "random"): "exact engine",
    ("sionna", "random"): "Sionna RT, depth 3",
    ("conference", "random"): "conference room, Sionna RT",
    ("exact", "region"): "exact engine, a region held out",
    ("sionna", "region"): "Sionna RT, a region held out",
}
PAPER_TRUTHS = {truth: name for (truth, split), name in PLACES.items() if split == "random"}
PAPER_TRUTHS["paper-law"] = "targets made by the paper's law"


def paper(truth: str, split: str, count: int | None = None) -> list[Row]:
    """Rows of the paper's evaluation of one place, those of ``count`` spectra and of none where it is given."""
    rows = [r for r in read("paper")["rows"] if (r["truth"], r["split"]) == (truth, split)]
    rows = [r for r in rows if count is None or r["count"] in (count, 0)]
    return sorted(rows, key=lambda r: list(NAMES).index(r["method"]))


@entry("paper-psnr")
def _paper_psnr() -> str:
    parts = []
    for place, name in PLACES.items():
        rows = paper(*place)
        counts = sorted({r["count"] for r in rows if r["count"]})
        lines = []
        for method in dict.fromkeys(r["method"] for r in rows):
            own = {r["count"]: r for r in rows if r["method"] == method}
            if 0 in own:
                own = dict.fromkeys(counts[:1], own[0])
            lines.append([NAMES[method], *(_psnr(own.get(count)) for count in counts)])
        if lines:
            parts += [f"**{name}**", markdown(("PSNR [dB], all / blocked", *map(str, counts)), lines)]
    return "\n\n".join(parts)


def _psnr(row: Row | None) -> str:
    if row is None:
        return ""
    spread = "" if row["psnr_db_std"] is None else f" ± {row['psnr_db_std']:.1f}"
    return f"{row['psnr_db']:.1f}{spread} / {show(row['psnr_db_blocked'])}"


def _spread(row: Row | None, figure: str, scale: float, form: str) -> str:
    """A figure of a row with its spread over seeds, where there are several."""
    if row is None or row[figure] is None:
        return ""
    spread = row[f"{figure}_std"]
    unsigned = form.replace("+", "")
    return form.format(scale * row[figure]) + (
        "" if spread is None else f" ± {unsigned.format(scale * spread)}"
    )


@entry("paper-margins")
def _paper_margins() -> str:
    forms = (
        ("PSNR [dB]", "psnr_db", 1.0, "{:+.1f}"), ("SSIM", "ssim", 1.0, "{:+.2f}"), ("RMSE [dB]", "rmse_db", 1.0, "{:+.1f}"),
        ("within 3° [%]", "direction_within_3deg", 100.0, "{:+.0f}"),
        ("beam loss [dB]", "beam_gain_loss_db", 1.0, "{:+.1f}"),
    )  # fmt: skip

    parts = []
    for (truth, split), name in PLACES.items():
        rows = [
            r for r in read("paper")["margins"] if (r["truth"], r["split"], r["count"]) == (truth, split, 100)
        ]
        lines = [
            [
                NAMES[r["method"]],
                *(f"{_spread(r, f, *how)} / {_spread(r, f'{f}_blocked', *how)}" for _, f, *how in forms),
            ]
            for r in sorted(rows, key=lambda r: list(NAMES).index(r["method"]))
        ]
        if lines:
            head = (f"{name}, 100 spectra: ours less", *(f"{label}, all / blocked" for label, *_ in forms))
            parts.append(markdown(head, lines))
    return "\n\n".join(parts)


@entry("paper-behind")
def _paper_behind() -> str:
    better = {"rmse_db": -1.0, "beam_gain_loss_db": -1.0}  # of the others more is better
    words = {
        "psnr_db": "PSNR [dB]", "ssim": "SSIM", "rmse_db": "RMSE [dB]", "direction_within_3deg": "within 3°",
        "beam_gain_loss_db": "beam loss [dB]",
    }  # fmt: skip
    behind: dict[tuple[str, str, str], list[tuple[int, float]]] = {}
    compared = 0
    for r in read("paper")["margins"]:
        for figure, word in words.items():
            for part, who in (("", ""), ("_blocked", ", blocked")):
                margin = r[figure + part]
                compared += margin is not None
                if margin is not None and better.get(figure, 1.0) * margin < 0.0:
                    place = PLACES.get((r["truth"], r["split"]), r["truth"])
                    key = (place, NAMES[r["method"]], word + who)
                    behind.setdefault(key, []).append((r["count"], margin))
    text = f"Of {compared} comparisons the bistatic field is behind in {sum(map(len, behind.values()))}"
    if not behind:
        return text + "."
    lines = []
    for (place, method, figure), found in behind.items():
        counts, margins = zip(*sorted(found), strict=True)
        worst = f"{max(margins, key=abs):+.2g}"
        lines.append([place, method, figure, ", ".join(map(str, counts)), worst])
    return text + ":\n\n" + markdown(("truth", "behind", "in", "spectra", "by at most"), lines)


@entry("paper-detail")
def _paper_detail() -> str:
    parts = []
    for place, name in PLACES.items():
        lines = [
            [
                NAMES[r["method"]], show(r["ssim"], "{:.2f}"), show(r["rmse_db"]),
                f"{r['direction_within_3deg']:.0%} / {show(r['direction_within_3deg_blocked'], '{:.0%}')}",
                f"{r['beam_gain_loss_db']:.1f} / {show(r['beam_gain_loss_db_blocked'])}",
                show(r["tof_error_median_ns"], "{:.2g}"), show(r.get("train_s"), "{:.3g}"),
                show(1e3 * r["seconds_per_spectrum"], "{:.3g}"), show(r.get("peak_memory_gib"), "{:.1f}"),
                show(r.get("model_mib"), "{:.2g}"),
            ]
            for r in paper(*place, 100)
        ]  # fmt: skip
        head = (
            f"{name}, 100 spectra", "SSIM", "RMSE [dB]", "within 3°, all / blocked", "beam loss [dB], all / blocked",
            "delay [ns]", "training [s]", "a spectrum [ms]", "memory [GiB]", "model [MiB]",
        )  # fmt: skip
        if lines:
            parts.append(markdown(head, lines))
    return "\n\n".join(parts)


@entry("paper-statement")
def _paper_statement() -> str:
    lines = [r for r in read("paper")["finding"] if r["split"] == "random" and not r["opacity"]]
    published = {r["method"]: r["psnr_db"] for r in read("paper")["published"]}
    parts = [f"The paper reports RF-3DGS+ {published['rf3dgs+'] - published['rf3dgs']:.1f} dB above RF-3DGS."]
    for truth, name in PAPER_TRUTHS.items():
        own = [r["psnr_db"]["difference"] for r in lines if r["truth"] == truth]
        if own:
            parts.append(f"{name[0].upper()}{name[1:]}: {sum(own) / len(own):+.1f} dB over {len(own)} sizes.")
    return " ".join(parts)


@entry("paper-runs")
def _paper_runs() -> str:
    found = read("paper")
    missing_runs = len(found["missing"])
    data = "; ".join(
        f"{name} {found['data'][f'{truth}/random']['content']}"
        for truth, name in PAPER_TRUTHS.items()
        if f"{truth}/random" in found["data"]
    )
    left = f" {missing_runs} of their runs are missing." if missing_runs else ""
    absent = [name for (t, split), name in PLACES.items() if f"{t}/{split}" not in found["data"]]
    none = f" Not run yet: {', '.join(absent)}." if absent else ""
    return f"Data, by the hash of the file: {data}.{left}{none}"


@entry("paper-networks")
def _paper_networks() -> str:
    effort = read("paper")["effort"]
    lines = [
        [
            NAMES[r["method"]], name, str(r["count"]), show(r["fit_s"] / 60.0, "{:.0f}"), "; ".join(r["devices"]),
            show(r["loss_curve"][-1] / r["loss_curve"][0], "{:.2f}"),
            show(r["loss_curve"][-1] / r["loss_curve"][len(r["loss_curve"]) // 2], "{:.2f}"), show(r["psnr_db"]),
        ]
        for place, name in PLACES.items()
        for r in paper(*place)
        if r["loss_curve"]
    ]  # fmt: skip
    head = (
        "network", "truth", "spectra", "training [min]", "on", "last loss over first", "last loss over that at half time",
        "PSNR [dB]",
    )  # fmt: skip
    text = (
        f"NeRF2 trains for {effort['nerf2_iterations']} steps of {effort['nerf2_rays']} rays with "
        f"{effort['nerf2_samples']} samples each (as published: 30000 of 8192 with 64), the GAN for "
        f"{effort['cgan_iterations']} steps of {effort['cgan_batch']} spectra."
    )
    return f"{text}\n\n{markdown(head, lines)}"


@entry("paper-stage2")
def _paper_stage2() -> str:
    lines = []
    for place, name in PLACES.items():
        for r in paper(*place):
            # Quick fits were timed side by side.
            if r["count"] == 700 and r["method"] in ("bistatic", "rf3dgs+"):
                lines.append(
                    [
                        NAMES[r["method"]],
                        name,
                        show(r["transport_s"], "{:.0f}"),
                        show(r["fit_s"], "{:.0f}"),
                        show(r["train_s"], "{:.0f}"),
                    ]
                )
    for r in read("paper")["published"][:1]:
        lines.append(
            [NAMES[r["method"]], "as published, NVIDIA RTX 4090", "", "", show(r["train_s"], "{:.0f}")]
        )
    return markdown(("stage 2, 700 spectra", "truth", "rays [s]", "fit [s]", "both [s]"), lines)


@entry("published")
def _published() -> str:
    lines = [
        [
            NAMES[r["method"]], show(r["psnr_db"], "{:.2f}"), show(r["ssim"], "{:.3f}"), show(r["train_s"], "{:.0f}"),
            show(1e3 * r["seconds_per_spectrum"], "{:.3g}"),
        ]
        for r in read("paper")["published"]
    ]  # fmt: skip
    return markdown(("as published", "PSNR [dB]", "SSIM", "training [s]", "a spectrum [ms]"), lines)


@entry("law")
def _law() -> str:
    words = {"exact": "power that scatters as it does", "paper-law": "given the paper's factor, path by path"}
    found = [r for r in read("paper")["finding"] if r["split"] == "random" and not r["opacity"]]
    lines = [
        [
            words.get(r["truth"], PLACES.get((r["truth"], "random"), r["truth"])), str(r["count"]),
            show(r["psnr_db"]["rf3dgs+"]), show(r["psnr_db"]["rf3dgs"]), show(r["psnr_db"]["difference"], "{:+.1f}"),
        ]
        for r in found
    ]  # fmt: skip
    return markdown(("truth", "spectra", "RF-3DGS+ [dB]", "RF-3DGS [dB]", "difference [dB]"), lines)


@entry("gap")
def _gap() -> str:
    found = read("gap")
    what = {r["choice"]: r["what"] for r in found["differences"]}
    lines = []
    for r in found["differences"]:
        cells = [what[r["choice"]], str(r["train"])]
        for key in ("psnr_db", "own_psnr_db"):
            cells += [show(r[key][m], "{:.1f}") for m in ("rf3dgs+", "rf3dgs")]
            cells.append(show(r[key]["difference"], "{:+.1f}"))
        lines.append(cells)
    head = (
        "changed", "spectra", "RF-3DGS+, PSNR [dB]", "RF-3DGS", "difference", "RF-3DGS+, each picture by its own range",
        "RF-3DGS", "difference",
    )  # fmt: skip
    return markdown(head, lines)


# ------------------------------------------------------------------------------------------------ the engine


@entry("engine-responses")
def _engine_responses() -> str:
    lines = [
        [
            r["regime"], r["form"], show(r["error_mean"], "{:.1e}"), show(r["error_max"], "{:.1e}"),
            show(r["negative"], "{:.1%}"), show(r["ns_per_pair"]),
        ]
        for r in read("engine")["responses"]
    ]  # fmt: skip
    head = ("Gaussians", "form", "mean error", "largest", "negative squared distances", "ns a pair")
    return markdown(head, lines)


@entry("engine-points")
def _engine_points() -> str:
    lines = [
        [
            r["interaction_point"], show(1e3 * r["length_error_median_m"], "{:.3g}"),
            show(1e3 * r["length_error_p90_m"], "{:.3g}"), show(r["delay_error_median_ns"], "{:.2g}"),
            show(r["milliseconds_per_receiver"]),
        ]
        for r in read("engine")["points"]
    ]  # fmt: skip
    head = (
        "`interaction_point=`", "length error, median [mm]", "90th percentile [mm]", "delay [ns]", "ms a receiver",
    )  # fmt: skip
    return markdown(head, lines)


@entry("engine-knobs")
def _engine_knobs() -> str:
    words = {
        "alpha_min": "least alpha that counts", "alpha_max": "largest alpha", "top_k": "Gaussians kept a pixel",
        "precision": "precision", "resolution": "grid, rows x columns",
    }  # fmt: skip
    lines = []
    for knob, name in words.items():
        for r in read("engine").get(knob, ()):
            value = " x ".join(map(str, r["value"])) if isinstance(r["value"], list) else _short(r["value"])
            lines.append([
                name, value, show(r["error_rms_db"], "{:.2g}"), show(r["error_worst_db"], "{:.2g}"),
                show(1e3 * r["seconds"]),
            ])  # fmt: skip
            name = ""
    return markdown(("setting", "value", "rms error [dB]", "worst pixel [dB]", "ms a receiver"), lines)


def _short(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.3g}"


@entry("engine-times")
def _engine_times() -> str:
    e = read("engine")
    b = e["blend"]
    names = {"torch": "a vectorised torch renderer", "opensplat": "OpenSplat's CPU rasteriser"}
    size = f"{b['gaussians']} Gaussians, {b['shape'][1]} x {b['shape'][0]}"
    lines = []
    for run in b["runs"]:
        threads = "one thread" if run["threads"] == 1 else f"{run['threads']} threads"
        ratios = run["speedup"] if isinstance(run["speedup"], dict) else {"torch": run["speedup"]}
        lines += [[f"forward and backward, {size}, {threads}", f"{1e3 * run['ours']['seconds']:.0f} ms"]]
        lines += [
            [f"the same, speed over {names[peer]}", f"{ratio:.1f} times"] for peer, ratio in ratios.items()
        ]
    lines += [
        ["largest difference of the images", f"{b['image_difference']['largest']:.0e}"],
        ["largest relative difference of the gradients", f"{max(b['gradient_difference'].values()):.0e}"],
    ]
    grid = " x ".join(map(str, e["sizes"]["shape"]))
    lines += [
        [f"panorama of {grid} from {r['gaussians']} Gaussians", f"{1e3 * r['seconds']:.0f} ms"]
        for r in e["growth"]
        if r["gaussians"] >= 10_000
    ]
    return markdown(("figure", "value"), lines)


@entry("engine-rays")
def _engine_rays() -> str:
    lines = [
        [
            "the lobby" if r["mesh"] == "scene" else r["mesh"], str(r["faces"]), r["kind"],
            show(r["chosen"]["rays_per_s"] / 1e6), show(r["warp"]["rays_per_s"] / 1e6),
            show(r["chosen"]["over_bare"], "{:.2f}"),
        ]
        for r in read("engine")["rays"]
        if "over_bare" in r["chosen"]
    ]  # fmt: skip
    head = ("mesh", "faces", "rays", "million a second", "by Warp's hierarchy", "over bare Embree")
    return markdown(head, lines)


@entry("gpu")
def _gpu() -> str:
    files = sorted(FOLDER.glob("gpu-*.json"))
    if not files:
        return missing("make gpu")
    parts = []
    for file in files:
        found = json.loads(file.read_text())
        lines = [[name, f"{value:.4g}"] for name, value in _leaves(found) if "kernels" not in name]
        parts += [f"**{found['machine']['device']}**", markdown(("figure", "value"), lines)]
    return "\n\n".join(parts)


def _leaves(found: Row, prefix: str = "") -> Iterable[tuple[str, float]]:
    for key, value in found.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(value, dict) and key not in ("machine", "sizes", "asked", "tests"):
            yield from _leaves(value, f"{name}: ")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield name, value


# ---------------------------------------------------------------------------------------- beams, maps, effects


EFFECTS = {
    "line_of_sight": "line of sight",
    "mirror_1": "mirror reflections, one",
    "mirror_2": "mirror reflections, two",
    "diffuse_1": "scattering, one bounce",
    "mirror_scatter": "surfaces lit by mirrors",
    "scatter_mirror": "lit surfaces seen in mirrors",
    "diffuse_2": "scattering, two bounces and more",
    "lobe_0": "the widest scattering lobe",
    "lobe_4": "scattering lobe of exponent 4",
    "lobe_10": "scattering lobe of exponent 10",
    "unseen": "surfaces that no receiver sees",
    "gas": "absorption by the air (ITU-R P.676)",
    "diffraction": "diffraction (knife edge, ITU-R P.526)",
    "transmission": "transmission through walls (ITU-R P.2040)",
}


@entry("relevance")
def _relevance() -> str:
    cases = read("relevance")["cases"]
    lines = []
    for effect, words in EFFECTS.items():
        worth = [_find(c["effects"], name=effect) for c in cases]
        if any(worth):
            lines.append([words, *(show(w and w["worth_db"], "{:.2g}") for w in worth)])
    head = [f"{c['frequency_hz'] / 1e9:.0f} GHz, {c['roughness']}" for c in cases]
    return markdown(("effect left out [dB]", *head), lines)


BEAMS = {
    "exhaustive": "exhaustive search, its pilots counted",
    "powers": "true power of every path, no phases",
    "bistatic": "**bistatic field**",
    "zero": "our geometry, no spectra",
    "rf3dgs+": "RF-3DGS+",
    "nearest": "nearest receiver's beam",
    "transmitter": "point at the transmitter",
    "hierarchical": "hierarchical search",
    "random": "random",
}


@entry("beams")
def _beams() -> str:
    found = measured("beams")
    if found is None:
        return missing("python -m benchmarks beams")
    rows = found["truths"]["exact"]["links"]
    ends = [e for e in ("rx 16", "rx 256", "rx 4096", "tx 256", "tx 64, rx 64") if _find(rows, ends=e)]
    last = "rx 4096" if "rx 4096" in ends else ends[-1]
    lines = []
    for method, count in dict.fromkeys((r["method"], r["n_train"]) for r in rows):
        own = [_find(rows, ends=e, method=method, n_train=count) for e in ends]
        best = _find(rows, ends=last, method=method, n_train=count)
        lines.append([
            BEAMS[method], str(count or ""),
            *(show(r and 100 * r["within"], "{:.0f}") + show(r and 100 * r["within_blocked"], " / {:.0f} %") for r in own),
            show(best and best["efficiency_los"], "{:.2f}") + show(best and best["efficiency_blocked"], " / {:.2f}"),
        ])  # fmt: skip
    lines.sort(key=lambda line: list(BEAMS.values()).index(line[0]))
    return markdown(("within 1 dB, all / blocked", "spectra", *ends, f"bit/s/Hz, {last}"), lines)


@entry("beams-users")
def _beams_users() -> str:
    found = measured("beams")
    rows = found["truths"]["exact"].get("users", []) if found else []
    if not rows:
        return missing("python -m benchmarks beams")
    choices = list(dict.fromkeys(r["choice"] for r in rows))
    words = {
        "alone": "own best beams", "together": "beams minding interference", "mr": "maximum ratio", "zf": "zero forcing",
        "slnr": "SLNR",
    }  # fmt: skip
    lines = []
    for users, method, count in dict.fromkeys((r["users"], r["method"], r["n_train"]) for r in rows):
        cells = [_find(rows, users=users, method=method, n_train=count, choice=c) for c in choices]
        if any(cells):
            name = BEAMS.get(method, "true channel of every element")
            values = (show(c and c["efficiency"], "{:.2f}") for c in cells)
            lines.append([f"{users} users: {name}", str(count or ""), *values])
    return markdown(("sum, bit/s/Hz", "spectra", *(words.get(c, c) for c in choices)), lines)


@entry("city-paths")
def _city_paths() -> str:
    found = measured("city_paths")
    if found is None or "machine" not in found:
        return missing("python -m benchmarks city-paths")
    head = (
        "scene", "triangles", "receivers", "of PathSolver's paths", "delay error [s]", "gain error [dB]", "only ours",
        "load [s]", "one receiver [s]", "all [s]", "PathSolver, one [s]", "all [s]",
    )  # fmt: skip
    lines = []
    for r in found["scenes"]:
        gain = f"{r['gain_error_db']:.4f}"
        if r["gain_apart"]:
            gain += f" ({r['gain_apart_near_origin_db']:.4f})"
        times = (r["load_s"], r["patches_s"] + r["one_receiver_s"], r["patches_s"] + r["all_receivers_s"])
        times += (r["sionna_one_receiver_s"], r["sionna_all_receivers_s"])
        lines.append(
            [r["scene"], str(r["faces"]), str(r["receivers"]), f"{r['found']} of {r['paths_of_sionna']}"]
            + [f"{r['delay_error_s']:.0e}", gain, str(r["only_ours"]), *(f"{t:.2g}" for t in times)]
        )
    apart = [
        f"`{r['scene']}`: {r['gain_apart']} of {r['found']} gains differ by more than 0.05 dB, by {r['gain_error_db']:.3f} dB "
        f"at most. It is PathSolver's single precision: solved near the origin they differ by "
        f"{r['gain_apart_near_origin_db']:.4f} dB."
        for r in found["scenes"]
        if r["gain_apart"]
    ]
    return "\n\n".join(
        [markdown(head, lines), *apart, *_roofs([r["roofs"] for r in found["scenes"] if r.get("roofs")])]
    )


def _roofs(cities: list[dict[str, int]]) -> list[str]:
    """What share of places the library takes for places in a building; nothing without cities."""
    if not cities:
        return []
    roofed, indoors, under_sky, wrong = (
        sum(city[key] for city in cities) for key in ("roofed", "roofed_refused", "open", "open_refused")
    )
    return [
        f"Of {roofed} places below a roof in {len(cities)} scenes with streets {100 * indoors / roofed:.1f} % are taken for "
        f"places in a building (others are passages), of {under_sky} under the sky {100 * wrong / under_sky:.2f} %."
    ]


@entry("city-verbs")
def _city_verbs() -> str:
    found = measured("city_paths")
    if found is None or "verbs" not in found:
        return missing("python -m benchmarks city-paths")
    lines = [
        [
            r["scene"],
            f"{r['verb']}",
            f"{r['wall_s']:.2g}",
            show(r["again_wall_s"], "{:.2g}"),
            f"{r['core_s']:.2g}",
        ]
        + [f"{r['peak_bytes'] / 1e9:.2f}"]
        for r in found["verbs"]
    ]
    head = ("scene", "call", "first [s]", "again [s]", "core [s]", "peak memory [GB]")
    busy = f"Load average of the machine when it ended: {found['load_average']:.1f} on {found['machine']['cores']} cores."
    return "\n\n".join([markdown(head, lines), busy])


@entry("bare-mesh")
def _bare_mesh() -> str:
    found = measured("bare_mesh")
    if found is None:
        return missing("python -m benchmarks bare-mesh")
    meshes = {"named": "names", "bare": "no names, no colours", "scan": "the same, scanned"}
    head = ("room", "truth", "spectra", "mesh", "PSNR [dB]", "lost [dB]", "where blocked [dB]")
    lines = []
    for r in found["rows"]:
        figures = (show(r["psnr_db"]), show(r["lost_db"], "{:.2f}"), show(r["psnr_db_blocked"]))
        lines.append([r["room"], TRUTHS[r["truth"]], str(r["n_train"]), meshes[r["mesh"]], *figures])
    return markdown(head, lines)


@entry("filmed")
def _filmed() -> str:
    found = measured("filmed")
    if found is None:
        return missing("python -m benchmarks filmed")
    rows = {
        "distance": "mesh to reference", "back": "reference to mesh", "laid_on_distance": "mesh to reference, laid on it",
        "laid_on_back": "reference to mesh, laid on it",
    }  # fmt: skip
    lines = [
        [
            name,
            *(f"{100 * found[f'{key}_{part}_m']:.1f}" for part in ("median", "p90")),
            f"{100 * found[f'{key}_within_5_cm']:.0f} %",
        ]
        for key, name in rows.items()
    ]
    return markdown(("distance", "median [cm]", "90th percentile [cm]", "within 5 cm"), lines)


@entry("measurements")
def _measurements() -> str:
    found = measured("measurements")
    if found is None:
        return missing("python -m benchmarks measurements")
    columns = (
        ("psnr_db", "PSNR [dB]", "{:.1f}"), ("direction_within_3deg_blocked", "blocked: within 3 degrees", "{:.0%}"),
        ("beam_gain_loss_db", "beam loss [dB]", "{:.2f}"), ("total_rms_db", "total power, rms [dB]", "{:.2f}"),
        ("total_rms_db_blocked", "blocked", "{:.2f}"), ("gain_error_db", "chain's gain off [dB]", "{:+.2f}"),
        ("zero_error_deg", "zero off [degrees]", "{:+.1f}"), ("named", "named", "{}"),
    )  # fmt: skip
    lines = [[r["readings"], *(show(r.get(key), form) for key, _, form in columns)] for r in found["rows"]]
    return markdown(("fitted to", *(title for _, title, _ in columns)), lines)


@entry("suggest")
def _suggest() -> str:
    found = measured("suggest")
    if found is None:
        return missing("python -m benchmarks suggest")
    lines = [
        [
            r["readings"], str(r["draws"]), f"{r['psnr_db']:.2f}", f"{r['psnr_std_db']:.2f}",
            f"{r['direction_within_3deg_blocked']:.0%}", f"{r['beam_gain_loss_db']:.2f}", f"{r['total_rms_db']:.2f}",
        ]
        for r in found["rows"]
    ]  # fmt: skip
    wanted = "blocked: within 3 degrees", "beam loss [dB]", "total power, rms [dB]"
    return markdown(("spectra of", "draws", "PSNR [dB]", "spread", *wanted), lines)


@entry("arrays")
def _arrays() -> str:
    found = measured("arrays")
    if found is None:
        return missing("python -m benchmarks arrays")
    lines = [
        [
            f"{r['carrier_ghz']:g}",
            r["method"],
            *(show(r[key]) for key in ("psnr_db", "gained_db", "psnr_db_blocked")),
        ]
        for r in found["rows"]
    ]
    head = ("carrier [GHz]", "prediction", "PSNR [dB]", "over the nearest [dB]", "where blocked [dB]")
    return markdown(head, lines)


@entry("batches")
def _batches() -> str:
    found = measured("batches")
    if found is None:
        return missing("python -m benchmarks batches")
    columns = (
        ("receivers", "receivers", "{}"), ("wall_ms", "each [ms]", "{:.0f}"), ("core_ms", "core time [ms]", "{:.0f}"),
        ("over", "over one by one", "{:.2f}"), ("faster", "over one worker", "{:.2f}"), ("same_bits", "same bits", "{}"),
        ("gigabytes", "on disk [GB]", "{:.2f}"), ("peak_gb", "peak memory [GB]", "{:.2f}"),
        ("growth_mb", "growth [MB]", "{:.1f}"),
    )  # fmt: skip
    lines = [[r["figure"], *(show(r.get(key), form) for key, _, form in columns)] for r in found["rows"]]
    busy = f"Load average of the machine when it ended: {found['load_average']:.1f} on {found['machine']['cores']} cores."
    return "\n\n".join([markdown(("asked", *(title for _, title, _ in columns)), lines), busy])


@entry("cluster-cost")
def _cluster_cost() -> str:
    found, city = measured("batches"), measured("city_paths")
    if found is None or city is None:
        return missing("python -m benchmarks batches")
    sent, rows = found["sent"], {r["figure"]: r for r in found["rows"]}
    lobby = rows["spectra, exact truth, one worker"]["core_ms"] / 1e3
    response = next(r for r in found["rows"] if "gigabytes" in r)
    (plan,) = (v for v in city["verbs"] if "radio_map" in v["verb"])
    width, cell = (float(n) for n in re.findall(r"([0-9]+) m", plan["verb"]))
    asked = (
        ("spectra of 60 x 120 pixels, lobby", 1e6, lobby, sent["back_bytes"]),
        ("responses, 8 x 8 by 4 x 4, 64 frequencies, lobby", 1e6, response["core_ms"] / 1e3,
         1e9 * response["gigabytes"] / response["receivers"]),
        (f"radio map, 10 km wide, cells of {cell:g} m, at Munich's cost", (10e3 / cell) ** 2,
         plan["core_s"] / (width / cell) ** 2, 32.0),
    )  # fmt: skip
    lines = [
        [what, f"{n:.0e}", f"{1e3 * each:.2g} ms", f"{n * each / 3600:.2g} h", f"{n * each / THREADS:.2g} s",
         f"{n * back / 1e9:.2g} GB", f"{n * back / LINK:.2g} s"]
        for what, n, each, back in asked
    ]  # fmt: skip
    head = (
        "asked", "receivers", "core time each", "all, one core", f"all, {THREADS} threads", "back to the client",
        "on its link",
    )  # fmt: skip
    once = (
        f"Sent once: {sent['once_bytes'] / 1e6:.1f} MB to each worker (the lobby's field); with each part of "
        f"{sent['part_receivers']} receivers {sent['part_bytes'] / 1e3:.1f} kB, of a million receivers "
        f"{1e6 / sent['part_receivers'] * sent['part_bytes'] / 1e6:.0f} MB."
    )
    return "\n\n".join([markdown(head, lines), once])


@entry("map")
def _map() -> str:
    found = read("map")
    lines = []
    for r in found["ours"]:
        mean = ", mean of four places a cell" if r["average"] > 1 else ""
        lines.append([f"field, {r['rays']} rays a cell, up to {r['mirrors']} mirrors{mean}", *_map_errors(r)])
    for r in found["sionna"]:
        lines.append([f"RadioMapSolver, {r['samples']:.0e} samples", *_map_errors(r)])
    return markdown(("map", "rms [dB]", "median [dB]", "line of sight", "blocked", "core seconds"), lines)


def _map_errors(r: Row) -> list[str]:
    keys = ("rms_db", "median_db", "rms_seen_db", "rms_blocked_db")
    return [*(show(r[k], "{:.2f}") for k in keys), show(r["core_s"])]


@entry("channel")
def _channel() -> str:
    found = read("channel")
    names = {
        "friis": "one path over 100 m",
        "two_ray": "two rays over a slab, V and H",
        "images": "four images in a corner",
    }
    lines = [
        [f"closed form: {names[k]}", f"gain {v['gain']:.1e}, phase {v['phase_rad']:.1e} rad"]
        for k, v in found["closed_forms"].items()
    ]
    r, s = found["lobby"], found["small"]
    lines += [
        [
            f"{r['paths']} paths of {r['receivers']} receivers beside Sionna RT's",
            f"gain {r['gain_db']:.3f} dB, delay {r['tau_s']:.1e} s, angles {r['departure_rad']:.0e} rad",
        ],
        [
            "the same, paths with a leg shorter than 0.2 m included (Sionna RT's points are float32)",
            f"gain {r['gain_db_all']:.3f} dB",
        ],
        ["paths that only Sionna RT has / only we have", f"{r['sionna_only']} / {r['ours_only']}"],
        [
            f"response of {s['paths']} paths, 64 x 4 elements, 256 frequencies",
            f"{1e3 * s['grid_seconds']:.0f} ms, error {s['grid_error']:.0e}",
        ],
        ["the same by Sionna RT", f"{1e3 * s['sionna_seconds']:.0f} ms, error {s['sionna_error']:.0e}"],
        [
            "the same, dense sum in float64",
            f"{1e3 * s['dense_seconds']:.0f} ms, error {s['dense_error']:.0e}",
        ],
    ]
    return markdown(("figure", "value"), lines)


@entry("plane-wave")
def _plane_wave() -> str:
    rows = read("channel")["plane_wave"]
    away = sorted({r["distance_m"] for r in rows})
    lines = []
    for elements in sorted({r["elements"] for r in rows}):
        side = round(elements**0.5)
        losses = (_find(rows, elements=elements, distance_m=d) for d in away)
        lines.append([f"{side} x {side}", *(show(r and r["beam_loss_db"], "{:.2g}") for r in losses)])
    return markdown(("elements", *(f"{d:g} m" for d in away)), lines)


@entry("benchmarks")
def _benchmarks() -> str:
    sys.path.append(str(ROOT))
    from benchmarks.__main__ import NAMES as commands

    return markdown(
        ("`python -m benchmarks`", ""), [(f"`{name}`", line) for name, (_, line) in commands.items()]
    )


# ------------------------------------------------------------------------------------------------- the README


def readme() -> str:
    """README's table between its markers: 100 spectra of the lobby by both engines and of the second room."""
    columns = (
        ("PSNR [dB]", "psnr_db", 1.0, "{:.1f}"),
        ("within 3° [%]", "direction_within_3deg", 100.0, "{:.0f}"),
        ("blocked, within 3° [%]", "direction_within_3deg_blocked", 100.0, "{:.0f}"),
    )
    shown = {
        place: columns[:2] if place[0] == "conference" else columns
        for place in PLACES
        if place[1] == "random"
    }

    lines = []
    for method in ("bistatic", "rf3dgs+", "rf3dgs", "nerf2", "cgan", "nearest"):
        cells = [NAMES[method]]
        for place, figures in shown.items():
            row = _find(paper(*place, 100), method=method)
            cells += [_spread(row, *how) for _, *how in figures]
        lines.append(cells)
    head = ["100 spectra", *(f"{PLACES[place]}: {name}" for place, how in shown.items() for name, *_ in how)]
    return f"{MARKERS[0]}\n{markdown(head, lines)}\n{MARKERS[1]}"


def main(arguments: list[str]) -> None:
    """``readme``, or ``keep FOLDER``."""
    if arguments[:1] == ["readme"]:
        between = re.compile(f"{re.escape(MARKERS[0])}.*{re.escape(MARKERS[1])}", re.DOTALL)
        README.write_text(between.sub(readme(), README.read_text()))
    elif arguments[:1] == ["keep"] and len(arguments) == 2:
        report = json.loads((Path(arguments[1]) / "report.json").read_text())
        for part in ("methods", "methods_sionna"):
            for row in report[part].values():
                row.pop("per_receiver", None)
        (FOLDER / "lobby.json").write_text(json.dumps(report, indent=1) + "\n")
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])

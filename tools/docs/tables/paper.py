"""The evaluation of the paper: every method beside every other."""

from __future__ import annotations

from functools import cache

from benchmarks.evaluation import margins, summarise, unpacked
from benchmarks.methods import METHODS
from tables.common import NAMES, Row, entry, find, markdown, read, show

PLACES = {
    ("exact", "random"): "our own engine, single bounces",
    ("sionna", "random"): "Sionna RT, depth 3",
    ("conference", "random"): "conference room, Sionna RT",
    ("exact", "region"): "our own engine, single bounces, a region held out",
    ("sionna", "region"): "Sionna RT, a region held out",
}
PAPER_TRUTHS = {truth: name for (truth, split), name in PLACES.items() if split == "random"}
PAPER_TRUTHS["paper-law"] = "spectra made with the paper's distance law"


@cache
def runs() -> list[Row]:
    """Every run of the paper's evaluation."""
    return unpacked(read("paper"))


def older_runs() -> list[Row]:
    """Those of methods that compute something else today."""
    return [r for r in runs() if r["method"] in METHODS and r["version"] != METHODS[r["method"]].version]


@cache
def summary() -> list[Row]:
    """Means of the runs of a kind, with LPIPS where it was measured."""
    known = read("lpips")["rows"]
    place = ("truth", "split", "count", "method")
    found = [(row, find(known, **{k: row[k] for k in place})) for row in summarise(runs())]
    return [{**row, "lpips": seen and seen["lpips"]} for row, seen in found]


def paper(truth: str, split: str, count: int | None = None) -> list[Row]:
    """Rows of one place, those of ``count`` spectra and of none where it is given."""
    rows = [r for r in summary() if (r["truth"], r["split"]) == (truth, split)]
    rows = [r for r in rows if count is None or r["count"] in (count, 0)]
    return sorted(rows, key=lambda r: (list(NAMES).index(r["method"]), r["count"]))


@entry("headline")
def _headline() -> str:
    columns = (
        ("PSNR [dB]", "psnr_db", 1.0, "{:.1f}"), ("within 3° [%]", "direction_within_3deg", 100.0, "{:.0f}"),
        ("blocked, within 3° [%]", "direction_within_3deg_blocked", 100.0, "{:.0f}"),
    )  # fmt: skip
    shown = {
        ("sionna", "random"): ("lobby", columns),
        ("conference", "random"): ("conference room", columns[:2]),
    }
    lines = []
    for method in ("bistatic", "rf3dgs+", "rf3dgs", "nerf2", "cgan", "nearest"):
        rows = [(find(paper(*place, 100), method=method), own) for place, (_, own) in shown.items()]
        lines.append([NAMES[method], *(with_spread(row, *how) for row, own in rows for _, *how in own)])
    head = [f"{room}: {name}" for room, own in shown.values() for name, *_ in own]
    of_table = [r for r in older_runs() if (r["truth"], r["split"]) in shown and r["count"] in (100, 0)]
    old = {r["method"] for r in of_table}.intersection(("bistatic", "rf3dgs+", "rf3dgs", "nearest"))
    said = "".join(
        f"\n\n*The figures of {NAMES[m].strip('*')} are of an earlier version of the code; today's may differ.*"
        for m in sorted(old)
    )
    return markdown(("trained on 100 spectra", *head), lines) + said


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


def with_spread(row: Row | None, figure: str, scale: float, form: str) -> str:
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
        rows = [r for r in margins(runs()) if (r["truth"], r["split"], r["count"]) == (truth, split, 100)]
        lines = [
            [
                NAMES[r["method"]],
                *(
                    f"{with_spread(r, f, *how)} / {with_spread(r, f'{f}_blocked', *how)}"
                    for _, f, *how in forms
                ),
            ]
            for r in sorted(rows, key=lambda r: list(NAMES).index(r["method"]))
        ]
        if lines:
            first = f"{name}, 100 spectra: bistatic minus ..."
            head = (first, *(f"{label}, all / blocked" for label, *_ in forms))
            parts.append(markdown(head, lines))
    return "\n\n".join(parts)


@entry("paper-behind")
def _paper_behind() -> str:
    better = {"rmse_db": -1.0, "beam_gain_loss_db": -1.0}  # of the others more is better
    words = {
        "psnr_db": "PSNR [dB]", "ssim": "SSIM", "rmse_db": "RMSE [dB]", "direction_within_3deg": "within 3° [%]",
        "beam_gain_loss_db": "beam loss [dB]",
    }  # fmt: skip
    behind: dict[tuple[str, str, str], list[tuple[int, float]]] = {}
    compared = 0
    for r in margins(runs()):
        for figure, word in words.items():
            for part, who in (("", ""), ("_blocked", ", blocked")):
                margin = r[figure + part]
                compared += margin is not None
                if margin is not None and better.get(figure, 1.0) * margin < 0.0:
                    place = PLACES.get((r["truth"], r["split"]), r["truth"])
                    key = (place, NAMES[r["method"]], word + who)
                    behind.setdefault(key, []).append(
                        (r["count"], margin * (100.0 if "[%]" in word else 1.0))
                    )
    text = f"Of {compared} comparisons the bistatic field is behind in {sum(map(len, behind.values()))}"
    if not behind:
        return text + "."
    lines = []
    for (place, method, figure), found in behind.items():
        counts, differences = zip(*sorted(found), strict=True)
        worst = f"{max(differences, key=abs):+.2g}"
        lines.append([place, method, figure, ", ".join(map(str, counts)), worst])
    head = (
        "truth",
        "behind this method",
        "in this score",
        "at these numbers of spectra",
        "largest difference, bistatic minus it",
    )
    return f"{text}:\n\n{markdown(head, lines)}"


@entry("paper-detail")
def _paper_detail() -> str:
    parts = []
    for place, name in PLACES.items():
        lines = [
            [
                NAMES[r["method"]], show(r["ssim"], "{:.2f}"), show(r["lpips"], "{:.3f}"), show(r["rmse_db"]),
                f"{r['direction_within_3deg']:.0%} / {show(r['direction_within_3deg_blocked'], '{:.0%}')}",
                f"{r['beam_gain_loss_db']:.1f} / {show(r['beam_gain_loss_db_blocked'])}",
                show(r["tof_error_median_ns"], "{:.2g}"), show(r["train_s"], "{:.3g}"),
                show(1e3 * r["seconds_per_spectrum"], "{:.3g}"), show(r["peak_memory_gib"], "{:.1f}"),
                show(r["model_mib"], "{:.2g}"),
            ]
            for r in paper(*place, 100)
        ]  # fmt: skip
        head = (
            f"{name}, 100 spectra", "SSIM", "LPIPS", "RMSE [dB]", "within 3°, all / blocked",
            "beam loss [dB], all / blocked", "delay error [ns]", "training [s]", "predicting a spectrum [ms]", "peak memory [GiB]",
            "model [MiB]",
        )  # fmt: skip
        if lines:
            parts.append(markdown(head, lines))
    return "\n\n".join(parts)


@entry("paper-statement")
def _paper_statement() -> str:
    published = {r["method"]: r["psnr_db"] for r in read("published")["rows"]}
    parts = []
    for truth, name in PAPER_TRUTHS.items():
        own = [r["psnr_db"]["difference"] for r in read("law")["sizes"] if r["truth"] == truth]
        parts.append(f"- {name}: {sum(own) / len(own):+.1f} dB (over {len(own)} numbers of spectra)")
    return (
        f"The paper reports that RF-3DGS+ has {published['rf3dgs+'] - published['rf3dgs']:.1f} dB more PSNR than RF-3DGS. Here "
        "the PSNR of RF-3DGS+ minus that of RF-3DGS, as a mean over numbers of training spectra, is:\n\n"
        + "\n".join(parts)
    )


@entry("paper-runs")
def _paper_runs() -> str:
    hashes = {(r["truth"], r["data"]): None for r in runs()} | {("paper-law", read("law")["data"]): None}
    data = "; ".join(
        f"{name}: {', '.join(own for truth, own in hashes if truth == known)}"
        for known, name in PAPER_TRUTHS.items()
    )
    missing_runs = read("paper")["missing"]
    left = f" Planned but not run: {', '.join(map(_run, missing_runs))}." if missing_runs else ""
    rooms = {r["room"] for r in runs() if r["truth"] in ("exact", "sionna")}
    if old := older_runs():
        names = "; ".join(dict.fromkeys(NAMES[r["method"]].strip("*") for r in old))
        left += (
            f" **{len(old)} of {len(runs())} runs ({names}) are of an earlier version of the code; "
            "today's figures may differ.**"
        )
    made = f" Rows of the lobby are of {len(rooms)} reconstructions from the same photos."
    return f"Data files, by the first digits of their SHA-256: {data}.{made}{left}"


def _run(key: str) -> str:
    """A run in words, by its name in the result file."""
    truth, split, count, _, method = key.split("-", 4)
    return f"{NAMES[method].strip('*')} on {count} spectra of {PLACES[truth, split]}"


@entry("paper-networks")
def _paper_networks() -> str:
    found = read("networks")
    effort = found["effort"]
    lines = [
        [
            NAMES[r["method"]], name, str(r["count"]), show(r["fit_s"] / 60.0, "{:.0f}"), "; ".join(r["devices"]),
            show(r["loss_curve"][-1] / r["loss_curve"][0], "{:.2f}"),
            show(r["loss_curve"][-1] / r["loss_curve"][len(r["loss_curve"]) // 2], "{:.2f}"), show(r["psnr_db"]),
            show(r["lpips"], "{:.2f}"),
        ]
        for (truth, split), name in PLACES.items()
        for r in sorted(found["rows"], key=lambda r: (list(NAMES).index(r["method"]), r["count"]))
        if (r["truth"], r["split"]) == (truth, split)
    ]  # fmt: skip
    head = (
        "network", "truth", "training spectra", "training [min]", "on", "last loss / first loss", "last loss / loss at half time",
        "PSNR [dB]", "LPIPS",
    )  # fmt: skip
    text = (
        f"NeRF2 was trained for {effort['nerf2_iterations']} steps of {effort['nerf2_rays']} rays, with "
        f"{effort['nerf2_samples']} samples on a ray. As published it has 30000 steps of 8192 rays, with 64 samples on a ray. "
        f"The GAN was trained for {effort['cgan_iterations']} steps of {effort['cgan_batch']} spectra."
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
    for r in read("published")["rows"][:1]:
        lines.append(
            [NAMES[r["method"]], "the paper's, on an NVIDIA RTX 4090", "", "", show(r["train_s"], "{:.0f}")]
        )
    return markdown(("stage 2, 700 spectra", "truth", "tracing rays [s]", "fit [s]", "both [s]"), lines)


@entry("published")
def _published() -> str:
    lines = [
        [
            NAMES[r["method"]], show(r["psnr_db"], "{:.2f}"), show(r["ssim"], "{:.3f}"), show(r["lpips"], "{:.3f}"),
            show(r["train_s"], "{:.0f}"), show(1e3 * r["seconds_per_spectrum"], "{:.3g}"),
        ]
        for r in read("published")["rows"]
    ]  # fmt: skip
    return markdown(
        ("as published", "PSNR [dB]", "SSIM", "LPIPS", "training [s]", "predicting a spectrum [ms]"), lines
    )


@entry("law")
def _law() -> str:
    words = {"paper-law": "made with the paper's distance law, path by path"}
    lines = [
        [
            words.get(r["truth"], PLACES.get((r["truth"], "random"), r["truth"])), str(r["count"]),
            show(r["psnr_db"]["rf3dgs+"]), show(r["psnr_db"]["rf3dgs"]), show(r["psnr_db"]["difference"], "{:+.1f}"),
        ]
        for r in read("law")["sizes"]
    ]  # fmt: skip
    return markdown(
        ("truth", "training spectra", "RF-3DGS+: PSNR [dB]", "RF-3DGS: PSNR [dB]", "difference [dB]"), lines
    )


@entry("gap")
def _gap() -> str:
    lines = []
    for r in read("gap")["differences"]:
        cells = [r["what"], str(r["train"])]
        for key in ("psnr_db", "own_psnr_db"):
            cells += [show(r[key][m], "{:.1f}") for m in ("rf3dgs+", "rf3dgs")]
            cells.append(show(r[key]["difference"], "{:+.1f}"))
        lines.append(cells)
    head = (
        "changed", "training spectra", "RF-3DGS+: PSNR [dB]", "RF-3DGS: PSNR [dB]", "difference [dB]",
        "RF-3DGS+: PSNR by own range [dB]", "RF-3DGS: PSNR by own range [dB]", "difference [dB]",
    )  # fmt: skip
    return markdown(head, lines)

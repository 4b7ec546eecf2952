"""What the kept runs come to: the better variant of each, means over seeds, and the paper's finding."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from benchmarks.evaluation.protocol import TRUTHS
from benchmarks.evaluation.runs import SPREAD
from benchmarks.report import Row

PAIRS = {"rf3dgs+": "rf3dgs", "rf3dgs+alpha": "rf3dgs-alpha"}
"""What the paper's finding compares: with lengths, and without."""
FIGURES = ("psnr_db", "ssim", "rmse_db", "direction_within_3deg", "beam_gain_loss_db")
COMPARED = (*FIGURES, *(f"{name}_blocked" for name in FIGURES))
"""What has a spread over seeds and a margin, at all test receivers and at the blocked ones."""


def summarise(rows: Iterable[Row]) -> list[Row]:
    """One row a truth, split, count and method: the better variant of each seed, then the mean over seeds.

    Of smallest and largest values the smallest and largest over seeds are kept.
    """
    return [_mean(list(group.values())) for group in _by_seed(rows).values()]


def _by_seed(rows: Iterable[Row]) -> dict[tuple[str, str, int, str], dict[int, Row]]:
    """The better variant of each seed, by truth, split, count and method."""
    found: dict[tuple[str, str, int, str], dict[int, Row]] = {}
    for row in rows:
        seeds = found.setdefault((row["truth"], row["split"], row["count"], row["method"]), {})
        if row["seed"] not in seeds or row["psnr_db"] > seeds[row["seed"]]["psnr_db"]:
            seeds[row["seed"]] = row
    return found


def _mean_and_spread(values: Sequence[float | None]) -> tuple[float | None, float | None]:
    """Mean and standard deviation of what is there; no deviation of fewer than two."""
    given = [float(v) for v in values if v is not None]
    spread = float(np.std(given, ddof=1)) if len(given) > 1 else None
    return float(np.mean(given)) if given else None, spread


def _mean(group: list[Row]) -> Row:
    first = group[0]
    merged: Row = {name: first[name] for name in ("truth", "split", "count", "method", "note")}
    merged |= {
        "rooms": sorted({row["room"] for row in group}),
        "loss_curve": first.get("loss_curve"),
        "variants": sorted({row["variant"] for row in group}),
        "seeds": len(group),
        "keys": [row["key"] for row in group],
        "lpips_reason": first.get("lpips_reason"),
        "receivers": first["receivers"],
        "receivers_blocked": first["receivers_blocked"],
        "devices": sorted({f"{row['device']}, {row['cores']} cores, {row['processor']}" for row in group}),
    }
    ends = {f"{name}_{end}": fold for name in SPREAD for end, fold in (("min", min), ("max", max))}
    for name in first:
        values = [row.get(name) for row in group]
        numbers = [float(v) for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
        if name not in merged and len(numbers) + values.count(None) == len(values):
            whole = len(numbers) == len(values)  # of some seeds alone it would not compare
            merged[name] = ends.get(name, np.mean)(numbers) if whole else None
    for name in COMPARED:
        merged[f"{name}_std"] = _mean_and_spread([row.get(name) for row in group])[1]
    most = max(row["cores"] for row in group)  # runs side by side have fewer, and take longer
    timed = [row for row in group if row["cores"] == most]
    spent = [[row[k] for k in ("transport_s", "fit_s") if row[k] is not None] for row in timed]
    merged["train_s"] = float(np.mean([sum(s) for s in spent])) if any(spent) else None
    merged["peak_memory_gib"] = max(row["peak_memory_bytes"] for row in group) / 2**30
    on_gpu = [row["peak_gpu_bytes"] for row in group if row.get("peak_gpu_bytes") is not None]
    merged["peak_gpu_gib"] = max(on_gpu) / 2**30 if on_gpu else None
    merged["model_mib"] = None if merged.get("model_bytes") is None else merged["model_bytes"] / 2**20
    return {
        k: v
        for k, v in merged.items()
        if k not in ("details", "shown", "seed", "variant", "key", "data", "room")
    }


def margins(rows: Iterable[Row]) -> list[Row]:
    """The bistatic field less every other method: mean and spread over seeds of the differences on the same spectra, or
    against the one run of a method that sees none."""
    runs = _by_seed(rows)
    found = []
    for (truth, split, count, method), ours in runs.items():
        if method != "bistatic":
            continue
        for place, theirs in runs.items():
            if place[:2] != (truth, split) or place[2] not in (count, 0) or place[3] == method:
                continue
            others = theirs if place[2] else dict.fromkeys(ours, theirs[0])
            pairs = [(row, others[seed]) for seed, row in ours.items() if seed in others]
            if not pairs:
                continue
            line: Row = {
                "truth": truth,
                "split": split,
                "count": count,
                "method": place[3],
                "seeds": len(pairs),
            }
            for name in COMPARED:
                both = [(own.get(name), other.get(name)) for own, other in pairs]
                differences = [None if a is None or b is None else a - b for a, b in both]
                line[name], line[f"{name}_std"] = _mean_and_spread(differences)
            found.append(line)
    return found


def paper_finding(rows: Sequence[Row]) -> list[Row]:
    """RF-3DGS+ less RF-3DGS on every subset, a row a truth, split, count and whether opacity was trained."""
    known = {(r["truth"], r["split"], r["count"], r["method"]): r for r in rows}
    found = []
    for (truth, split, count, method), plus in known.items():
        other = known.get((truth, split, count, PAIRS.get(method, "")))
        if other is None:
            continue
        line: Row = {"truth": truth, "split": split, "count": count, "opacity": method != "rf3dgs+"}
        for key in ("psnr_db", "psnr_db_blocked", "ssim", "rmse_db"):
            a, b = plus.get(key), other.get(key)
            difference = None if a is None or b is None else a - b
            line[key] = {"rf3dgs+": a, "rf3dgs": b, "difference": difference}
        found.append(line)
    order = list(TRUTHS)
    return sorted(
        found, key=lambda line: (line["opacity"], order.index(line["truth"]), line["split"], line["count"])
    )

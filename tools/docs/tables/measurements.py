"""What a field is fitted to (readings, arrays, bare meshes, links of measured places), walls, limits, effects of a scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.measured import hall
from benchmarks.measured.office import ARRIVALS, NOISE
from benchmarks.report import cell
from tables.common import TRUTHS, Row, entry, find, markdown, older, read, show


@entry("measurements")
def _measurements() -> str:
    found = read("measurements")
    columns = (
        ("psnr_db", "PSNR [dB]", "{:.1f}"), ("direction_within_3deg_blocked", "blocked: within 3 degrees", "{:.0%}"),
        ("beam_gain_loss_db", "beam loss [dB]", "{:.2f}"), ("total_rms_db", "total power, rms [dB]", "{:.2f}"),
        ("total_rms_db_blocked", "blocked: total power, rms [dB]", "{:.2f}"),
        ("gain_error_db", "error of the chain's gain [dB]", "{:+.2f}"),
        ("zero_error_deg", "error of the azimuths' zero [degrees]", "{:+.1f}"), ("named", "wrong readings named", "{}"),
    )  # fmt: skip
    lines = [
        [r["readings"].replace("asked", "scored"), *(show(r.get(key), form) for key, _, form in columns)]
        for r in found["rows"]
    ]
    return markdown(("fitted to", *(title for _, title, _ in columns)), lines)


WHAT = {"spectrum": "one spectrum", "horn": "readings of a turned horn"}


def _dated(title: str, *names: str) -> str:
    """``title`` of a column, or a figure, which says so if the results ``names`` are older than what they depend on."""
    return f"{title}, by an earlier version of the code" if any(map(older, names)) else title


@entry("headline-less")
def _headline_less() -> str:
    rows = read("measurements")["rows"]
    one, horn, power = (
        next(r for r in rows if r["readings"] == name) for name in ("1 spectrum, mean of 20", "horn", "power")
    )
    at = [r for r in read("locate")["rows"] if r["measured"].startswith(("spectrum", "horn"))]
    fitted = [
        ("one spectrum of 60 x 120 pixels", f"spectra: PSNR {one['psnr_db']:.1f} dB"),
        ("readings of a horn of unknown gain, turned at ten places", f"spectra: PSNR {horn['psnr_db']:.1f} dB"),
        ("total power at 50 places, by a meter of unknown gain", f"total power: error {power['total_rms_db']:.1f} dB rms"),
    ]  # fmt: skip
    located = [
        (f"50 spectra, geometry {', '.join(given)}; at the new receiver {WHAT[seen]}",
         f"position of the receiver: error {r['median_cm']:.0f} cm (median), {r['p90_cm']:.0f} cm (90th percentile)")
        for r, (seen, *given) in ((r, r["measured"].split(", ")) for r in at)
    ]  # fmt: skip
    lines = [(what, _dated(found, "measurements")) for what, found in fitted]
    lines += [(what, _dated(found, "locate")) for what, found in located]
    return markdown(("measured", "predicted for receivers held out"), lines)


@entry("headline-measured")
def _headline_measured() -> str:
    floor_noise = np.sqrt(
        np.mean([r["heights_total_db"] ** 2 for r in read("measured_office_noise")["rows"]])
    )
    flat = read("measured_flat")["noise"]["all"]["halves_by_time"]
    sight = read("measured_hall")["noise"]["rows"][0]
    shown = (
        ("measured_flat", "anchor", "field", "flat, Bluetooth: one anchor held out", flat),
        ("measured_flat", "room", "field", "flat, Bluetooth: one room held out", flat),
        (
            "measured_office",
            "height",
            "field, walls",
            "floor of offices, 3 to 7 GHz: one height held out",
            floor_noise,
        ),
        (
            "measured_office",
            "pair",
            "field, walls",
            "floor of offices: two receivers of four held out",
            floor_noise,
        ),
        (
            "measured_hall",
            "block",
            "field",
            "hall, 60 GHz: nine places of 45 held out",
            sight["gain_db_spread"],
        ),
    )
    lines = []
    for name, held_out, model, said, noise in shown:
        rows = [r for r in read(name)["rows"] if r["held_out"] == held_out]
        ours = find(rows, model=model)
        simple = [r for r in rows if not r["model"].startswith(("field", "traced"))]
        best = min(simple, key=lambda r: r["rms_db"])
        rival = f"{best['rms_db']:.1f} ({best['model']})"
        lines.append([said, show(ours and ours["rms_db"]), rival, show(noise)])
    field = _dated("radio field", "measured_flat", "measured_office", "measured_hall")
    head = "error of power [dB rms]", field, "best simple model (which)", "noise of the measurement"
    return markdown(head, lines)


@entry("suggest")
def _suggest() -> str:
    found = read("suggest")
    lines = [
        [
            r["readings"], str(r["draws"]), f"{r['psnr_db']:.2f}", f"{r['psnr_std_db']:.2f}",
            f"{r['direction_within_3deg_blocked']:.0%}", f"{r['beam_gain_loss_db']:.2f}", f"{r['total_rms_db']:.2f}",
        ]
        for r in found["rows"]
    ]  # fmt: skip
    wanted = "blocked: within 3 degrees", "beam loss [dB]", "total power, rms [dB]"
    return markdown(("spectra of", "draws", "PSNR [dB]", "spread [dB]", *wanted), lines)


@entry("locate")
def _locate() -> str:
    head = (
        "located from, room", "receivers", "error, median [cm]", "90th percentile [cm]", "blocked: median [cm]",
        "blocked: 90th percentile [cm]",
    )  # fmt: skip
    further = (
        "beyond 30 cm", "of these not called known", "within the 95 % ellipsoid", "core seconds each",
        "nearest measurement: median [cm]", "of places", "multilateration: median [cm]",
    )  # fmt: skip
    keys = ("median_cm", "p90_cm", "blocked_median_cm", "blocked_p90_cm")
    lines = [
        [
            r["measured"], str(r["test"]), *(show(r[key], "{:.1f}") for key in keys), f"{r['wrong']:.0%}",
            show(r["wrong_told"], "{:.0%}"), f"{r['covered']:.0%}", show(r["cpu_s"]), show(r["nearest_cm"], "{:.0f}"),
            str(r.get("prints", 60)), show(r.get("lateration_cm"), "{:.0f}"),
        ]
        for r in read("locate")["rows"]
    ]  # fmt: skip
    return markdown((*head, *further), lines)


@entry("place")
def _place() -> str:
    head = (
        "transmitters", "candidates", "best set: worst tenth [dB]", "one added at a time: worst tenth [dB]", "core seconds",
    )  # fmt: skip
    lines = [
        [
            str(r["n"]),
            str(r["candidates"]),
            *(show(r[k], "{:.2f}") for k in ("chosen", "added")),
            show(r["cpu_s"], "{:.0f}"),
        ]
        for r in read("locate")["place"]
    ]
    return markdown(head, lines)


@entry("flat")
def _flat() -> str:
    found = read("measured_flat")
    head = (
        "held out",
        "model",
        "error, rms [dB]",
        "in sight [dB]",
        "behind walls [dB]",
        "worst anchor or room [dB]",
    )
    keys = ("rms_db", "seen_db", "behind_db", "worst_db")
    lines = [
        [
            f"one {r['held_out']}", r["model"].replace("either", "diffraction and transmission"),
            *(show(r[key], "{:.2f}") for key in keys),
        ]
        for r in found["rows"]
    ]  # fmt: skip
    return markdown(head, lines)


@entry("flat-noise")
def _flat_noise() -> str:
    found = read("measured_flat_noise")
    lines = [
        [
            name,
            str(r["links"]),
            *(f"{r[k]:.2f}" for k in ("halves_by_time", "halves_by_chance", "single_reading")),
        ]
        for name, r in ((n, found[n]) for n in ("all", "in sight", "behind walls"))
    ]
    head = (
        "links", "number of means", "noise of a mean, halves by time [dB]", "noise of a mean, random halves [dB]",
        "noise of a single reading [dB]",
    )  # fmt: skip
    return markdown(head, lines)


@entry("floor-noise")
def _floor_noise() -> str:
    return _columns(NOISE, read("measured_office_noise")["rows"])


@entry("floor-heights")
def _floor_heights() -> str:
    rows = read("measured_office")["heights"]
    lines = [[f"{r['height_m']:.1f}", f"{r['later_rms_ns']:.3f}", f"{r['later_most_ns']:.3f}"] for r in rows]
    return markdown(
        ("assumed height of receivers [m]", "change of the direct delay, rms [ns]", "at most [ns]"), lines
    )


@entry("floor-arrivals")
def _floor_arrivals() -> str:
    return _columns(ARRIVALS, read("measured_office")["arrivals"])


def _columns(columns: Sequence[tuple[str, str, str]], rows: Sequence[Row]) -> str:
    lines = [[cell(row[key], form) for key, _, form in columns] for row in rows]
    return markdown([title for _, title, _ in columns], lines)


@entry("floor")
def _floor() -> str:
    said = {"pair": "two receivers", "height": "a height"}
    head = (
        "held out",
        "model",
        "error, rms [dB]",
        "mean error [dB]",
        "links without a path",
        *(f"receiver {k} [dB]" for k in range(1, 5)),
    )
    lines = [
        [
            said[r["held_out"]], r["model"], f"{r['rms_db']:.2f}", f"{r['behind_bias_db']:+.2f}", f"{r['dark']:.0%}",
            *(f"{r['each_db'][str(k)]:.2f}" for k in range(1, 5)),
        ]
        for r in read("measured_office")["rows"]
    ]  # fmt: skip
    return markdown(head, lines)


@entry("hall-sight")
def _hall_sight() -> str:
    return _columns(hall.NOISE, read("measured_hall")["noise"]["rows"])


@entry("hall-paths")
def _hall_paths() -> str:
    return _columns(hall.UNFITTED, read("measured_hall")["paths"])


@entry("hall-bounces")
def _hall_bounces() -> str:
    return _columns(hall.BOUNCES, read("measured_hall")["bounces"])


@entry("hall-pairs")
def _hall_pairs() -> str:
    return _columns(hall.FITTED, read("measured_hall")["pairs"])


@entry("hall")
def _hall() -> str:
    rows = read("measured_hall")["rows"]
    blocks = sorted(rows[0]["each_db"], key=lambda name: int(name.split()[0]))
    head = (
        "model",
        "error, rms [dB]",
        "in sight [dB]",
        "behind walls [dB]",
        "mean error behind walls [dB]",
        *(f"places {name} [dB]" for name in blocks),
    )
    lines = [
        [
            r["model"], *(f"{r[key]:.2f}" for key in ("rms_db", "seen_db", "behind_db")), f"{r['behind_bias_db']:+.2f}",
            *(f"{r['each_db'][name]:.2f}" for name in blocks),
        ]
        for r in rows
    ]  # fmt: skip
    return markdown(head, lines)


@entry("office")
def _office() -> str:
    columns = (
        ("psnr_db", "PSNR [dB]", "{:.1f}"), ("perfect_db", "PSNR of a model without error [dB]", "{:.1f}"),
        ("total_rms_db", "total power, rms [dB]", "{:.2f}"), ("direction_within_3deg", "within 3 degrees", "{:.0%}"),
    )  # fmt: skip
    lines = [
        [
            f"{r['carrier_ghz']:g}",
            str(r["n_train"]),
            r["room"],
            *(show(r[key], form) for key, _, form in columns),
        ]
        for r in read("office")["rows"]
    ]
    return markdown(("carrier [GHz]", "spectra", "receivers", *(title for _, title, _ in columns)), lines)


@entry("reciprocal")
def _reciprocal() -> str:
    rows, lines = read("reciprocal")["rows"], []
    keys = "psnr_db", "psnr_db_reciprocal", "psnr_db_blocked", "psnr_db_blocked_reciprocal"
    for geometry, truth in dict.fromkeys((r["geometry"], r["truth"]) for r in rows):
        cells = []
        for count in (10, 50):
            all_, own, blocked, blocked_own = (
                show(find(rows, geometry=geometry, truth=truth, n_train=count)[k]) for k in keys
            )
            cells.append(f"{all_} / {own} ({blocked} / {blocked_own})")
        lines.append([geometry, truth, *cells])
    return markdown(("geometry", "truth", "10 spectra", "50 spectra"), lines)


@entry("limits")
def _limits() -> str:
    lines = [[r["what"], f"{r['figure']} {r['unit']}", r["date"]] for r in read("limits")["rows"]]
    return markdown(("what", "figure", "first stated on"), lines)


@entry("arrays")
def _arrays() -> str:
    found = read("arrays")
    lines = [
        [
            f"{r['carrier_ghz']:g}",
            r["method"],
            *(show(r[key]) for key in ("psnr_db", "gained_db", "psnr_db_blocked")),
        ]
        for r in found["rows"]
    ]
    head = ("carrier [GHz]", "prediction", "PSNR [dB]", "over the nearest [dB]", "PSNR, blocked [dB]")
    return markdown(head, lines)


@entry("bare-mesh")
def _bare_mesh() -> str:
    found = read("bare_mesh")
    meshes = {"named": "names", "bare": "no names, no colours", "scan": "the same, scanned"}
    head = ("room", "truth", "spectra", "mesh", "PSNR [dB]", "lost [dB]", "PSNR, blocked [dB]")
    lines = []
    for r in found["rows"]:
        figures = (show(r["psnr_db"]), show(r["lost_db"], "{:.2f}"), show(r["psnr_db_blocked"]))
        lines.append([r["room"], TRUTHS[r["truth"]], str(r["n_train"]), meshes[r["mesh"]], *figures])
    return markdown(head, lines)


EFFECTS = {
    "line_of_sight": "line of sight",
    "mirrors_1": "one mirror",
    "mirrors_2": "two mirrors",
    "scatterings_1": "one scattering",
    "mirror_scatter": "mirror, then scattering",
    "scatter_mirror": "scattering, then mirror",
    "scatterings_2": "two scatterings and more",
    "lobe_0": "the widest scattering lobe (Lambertian)",
    "lobe_4": "scattering lobe of exponent 4",
    "lobe_10": "scattering lobe of exponent 10",
    "gas": "absorption by the air (ITU-R P.676)",
    "diffraction": "diffraction at one edge",
    "transmission": "transmission through walls (ITU-R P.2040)",
}


@entry("relevance")
def _relevance() -> str:
    rows = read("relevance")["rows"]
    cases = list(dict.fromkeys((r["ghz"], r["roughness"]) for r in rows))
    lines = []
    for effect, words in EFFECTS.items():
        worth = [find(rows, name=effect, ghz=ghz, roughness=roughness) for ghz, roughness in cases]
        if any(worth):
            lines.append([words, *(show(w and w["worth_db"], "{:.2g}") for w in worth)])
    head = [f"{ghz:.0f} GHz, {roughness}" for ghz, roughness in cases]
    return markdown(("effect left out [dB]", *head), lines)

"""Channels, radio maps, city scenes and beams."""

from __future__ import annotations

from tables.common import Row, entry, find, markdown, measured, missing, read, show


@entry("map")
def _map() -> str:
    found = read("map")
    lines = []
    for r in found["ours"]:
        mean = ", mean of four places a cell" if r["average"] > 1 else ""
        lines.append([f"field, {r['rays']} rays a cell, up to {r['mirrors']} mirrors{mean}", *_map_errors(r)])
    for r in found["sionna"]:
        lines.append([f"RadioMapSolver, {r['samples']:.0e} samples", *_map_errors(r)])
    head = (
        "map", "error, rms [dB]", "median [dB]", "line of sight: rms [dB]", "blocked: rms [dB]", "core seconds",
    )  # fmt: skip
    return markdown(head, lines)


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
        losses = (find(rows, elements=elements, distance_m=d) for d in away)
        lines.append([f"{side} x {side}", *(show(r and r["beam_loss_db"], "{:.2g}") for r in losses)])
    return markdown(("elements", *(f"{d:g} m" for d in away)), lines)


@entry("city-paths")
def _city_paths() -> str:
    found = read("city_paths")
    head = (
        "scene", "triangles", "receivers", "PathSolver's paths found", "largest delay difference [s]",
        "largest gain difference [dB]", "paths only ours", "load [s]", "ours, one receiver [s]", "ours, all [s]",
        "PathSolver, one [s]", "PathSolver, all [s]",
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
        f"at most. The reason is PathSolver's single precision: solved near the origin they differ by "
        f"{r['gain_apart_near_origin_db']:.4f} dB."
        for r in found["scenes"]
        if r["gain_apart"]
    ]
    return "\n\n".join([markdown(head, lines), *apart])


@entry("city-verbs")
def _city_verbs() -> str:
    found = read("city_paths")
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
    busy = f"Load average of the machine at the end: {found['load_average']:.1f} on {found['machine']['cores']} cores."
    return "\n\n".join([markdown(head, lines), busy])


BEAMS = {
    "powers": "true power of every path, no phases",
    "bistatic": "**bistatic field**",
    "zero": "our geometry, no spectra",
    "rf3dgs+": "RF-3DGS+",
    "nearest": "nearest receiver's beam",
    "transmitter": "point at the transmitter",
}


@entry("beams")
def _beams() -> str:
    found = measured("beams")
    if found is None:
        return missing("python -m benchmarks beams")
    rows = sorted(found["rows"], key=lambda r: (list(BEAMS).index(r["method"]), r["n_train"] or 0))
    sizes = sorted({r["elements"] for r in rows})
    lines = []
    for method, count in dict.fromkeys((r["method"], r["n_train"]) for r in rows):
        own = [find(rows, elements=n, method=method, n_train=count) for n in sizes]
        cells = [
            show(r and 100 * r["within"], "{:.0f}") + show(r and 100 * r["within_blocked"], " / {:.0f} %")
            for r in own
        ]
        lines.append([BEAMS[method], str(count or ""), *cells])
    head = ("within 1 dB, all / blocked", "spectra", *(f"{n} elements" for n in sizes))
    return markdown(head, lines)


def _edited(part: str, columns: tuple[tuple[str, str, str], ...]) -> str:
    rows = [[show(row[key], form) for key, _, form in columns] for row in read("edited")[part]]
    return markdown([title for _, title, _ in columns], rows)


@entry("edited-person")
def _person() -> str:
    return _edited(
        "person",
        (
            ("x", "person's distance from the transmitter [m]", "{:g}"), ("deepest_db", "deepest fade [dB]", "{:.1f}"),
            ("screen_db", "by P.526 [dB]", "{:.1f}"),
            ("shadow_rms_db", "difference in the shadow: rms [dB]", "{:.2f}"), ("shadow_most_db", "largest [dB]", "{:.2f}"),
        ),
    )  # fmt: skip


@entry("edited-cabinet")
def _cabinet() -> str:
    return _edited(
        "rows",
        (
            ("field", "field", "{}"), ("n_train", "spectra", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
            ("total_rms_db", "total gain, rms [dB]", "{:.2f}"),
        ),
    )  # fmt: skip


@entry("edited-seconds")
def _steps() -> str:
    return _edited(
        "seconds",
        (
            ("what", "what is computed", "{}"), ("edit_s", "edit [core s]", "{:.2f}"),
            ("step_s", "after the edit [core s]", "{:.2f}"),
            ("whole_s", "in an unchanged room [core s]", "{:.2f}"), ("share", "edited / unchanged", "{:.2f}"),
        ),
    )  # fmt: skip

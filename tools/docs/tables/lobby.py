"""The lobby: its reconstruction and its field by both engines; a room that was filmed."""

from __future__ import annotations

from tables.common import NAMES, TRUTHS, Row, entry, find, markdown, read, show


@entry("lobby-geometry")
def _lobby_geometry() -> str:
    r = read("lobby")
    g = r["geometry"]
    rows = [
        ("photos for which a pose was found", f"{g['posed']} of {g['photos']}"),
        ("PSNR of photos held out", f"{r['photo_psnr_db']:.1f} dB"),
        (
            "PSNR between two renderings of one photo with different noise",
            f"{r['photo_noise_psnr_db']:.1f} dB",
        ),
        (
            f"camera positions, rms error (scale from {g['surveyed']} surveyed ones)",
            f"{1e3 * r['camera_rms_m']:.1f} mm",
        ),
        (
            "distance of the mesh to the true surface, where a photo sees it: median",
            f"{1e3 * r['mesh_distance_median_m']:.1f} mm",
        ),
        ("the same, 90th percentile", f"{1e3 * r['mesh_distance_p90_m']:.1f} mm"),
        ("direction of the mesh's normals, median error", f"{r['mesh_normal_median_deg']:.2f}°"),
        ("Gaussians, triangles, planar patches", f"{g['gaussians']}, {g['triangles']}, {g['patches']}"),
    ]
    return markdown(("figure", "value"), rows)


SCORES = (
    ("psnr_db", "PSNR [dB]", "{:.1f}"),
    ("psnr_db_blocked", "PSNR, blocked [dB]", "{:.1f}"),
    ("ssim", "SSIM", "{:.2f}"),
    ("rmse_db", "RMSE [dB]", "{:.1f}"),
    ("direction_within_3deg", "within 3°", "{:.0%}"),
    ("direction_within_3deg_blocked", "within 3°, blocked", "{:.0%}"),
    ("beam_gain_loss_db", "beam loss [dB]", "{:.1f}"),
    ("tof_error_median_ns", "delay error [ns]", "{:.2g}"),
)


def _scored(found: dict[str, Row]) -> str:
    rows = [
        [
            _name(m),
            *(show(row[k], f) for k, _, f in SCORES),
            show(1e3 * row["seconds_per_spectrum"], "{:.2g}"),
        ]
        for m, row in found.items()
    ]
    return markdown(("model", *(h for _, h, _ in SCORES), "time of a spectrum [ms]"), rows)


def _name(method: str) -> str:
    """Name of a method, or of METHOD-COUNT: one on another number of spectra."""
    name, _, count = method.rpartition("-")
    return NAMES[method] if method in NAMES else f"{NAMES[name]}, {count} spectra"


@entry("lobby-exact")
def _lobby_exact() -> str:
    return _scored(read("lobby")["methods"])


@entry("lobby-sionna")
def _lobby_sionna() -> str:
    return _scored(read("lobby")["methods_sionna"])


@entry("lobby-stages")
def _lobby_stages() -> str:
    r = read("lobby")
    rows = [(_stage(name), f"{stage['seconds']:.0f}") for name, stage in r["stages"].items()]
    return markdown(("step", "seconds"), [*rows, ("**all**", f"**{r['pipeline_time_s']:.0f}**")])


def _stage(name: str) -> str:
    """Name of a stage, in full where it is a METHOD COUNT, TRUTH."""
    work, _, truth = name.partition(", ")
    method, _, count = work.rpartition(" ")
    return f"{NAMES[method].strip('*')}, {count} spectra, {TRUTHS[truth]}" if truth else name


@entry("lobby-seeds")
def _lobby_seeds() -> str:
    found = read("lobby_seeds")
    lines = [
        [
            _seeded(r),
            *(show(r[k], "{:.4g}") for k in ("mean", "spread", "least", "most")),
        ]
        for r in found["rows"]
        if not r["key"].startswith("methods")
        and not r["key"].endswith("time_s")  # what a machine decides, not a seed
        or ("bistatic" in r["key"] or "rf3dgs+" in r["key"])
        and "psnr" in r["key"]
    ]
    return markdown(
        (f"seeds {', '.join(map(str, found['seeds']))}", "mean", "standard deviation", "least", "most"), lines
    )


def _seeded(row: Row) -> str:
    """A figure of several seeds in the words of the other tables."""
    if not row["key"].startswith("methods"):
        return row["figure"]
    group, method, score = row["key"].split(".")
    truth = TRUTHS["sionna" if group == "methods_sionna" else "exact"]
    heading = {key: name for key, name, _ in SCORES}[score]
    return f"{_name(method).replace('**', '')}, truth of {truth}: {heading}"


@entry("ablation")
def _ablation() -> str:
    rows = read("bistatic")["ablation"]
    words = {
        "everything": "all parts",
        "zero spectra": "the field before any fit (no spectra)",
        "RF-3DGS+ with line of sight": "RF-3DGS+ with an explicit line of sight",
        "no residual per element": "no correction per surface element",
        "true mesh, its materials as groups": "all parts, on the true mesh with its named materials",
    }
    lines = []
    for model in dict.fromkeys(r["model"] for r in rows):
        lines.append([
            words.get(model, model),
            *(show((found := find(rows, truth=t, model=model)) and found["psnr_db"]) for t in TRUTHS),
        ])  # fmt: skip
    return markdown(("model, ten spectra", *(f"{n}: PSNR [dB]" for n in TRUTHS.values())), lines)


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
        (
            "truth, training receivers",
            "rms error [dB]",
            "within one standard deviation",
            "within two standard deviations",
        ),
        lines,
    )


@entry("delays")
def _delays() -> str:
    lines = [
        [
            f"{TRUTHS[r['truth']]}, {r['n_train']}", show(r["found"], "{:.0%}"),
            show(r["mirror_ns"], "{:.4f}"), show(r["scattering_ns"], "{:.3f}"),
        ]
        for r in read("bistatic")["delays"]
    ]  # fmt: skip
    head = (
        "truth, training receivers",
        "true mirror paths found",
        "delay error of mirror paths [ns]",
        "delay error of scattering [ns]",
    )
    return markdown(head, lines)


@entry("transmitter")
def _transmitter() -> str:
    lines = [
        [
            NAMES[r["method"]], show(r["seen"]["psnr_db"]), show(r["psnr_db"]),
            show(r["direction_within_3deg"], "{:.0%}"), show(r["direction_within_3deg_blocked"], "{:.0%}"),
        ]
        for r in read("transmitter")["second"]
    ]  # fmt: skip
    head = (
        "model, ten spectra", "fitted transmitter: PSNR [dB]", "other transmitter: PSNR [dB]", "other transmitter: within 3°",
        "other transmitter: within 3°, blocked",
    )  # fmt: skip
    return markdown(head, lines)


FILMS = {"filmed": "kitchen", "filmed-cafe": "café"}


@entry("filmed")
def _filmed() -> str:
    lines = []
    for name, room in FILMS.items():
        found = read(name)
        field = found["field"]
        ours, other = (
            [
                f"{100 * found[f'{mesh}_distance_median_m']:.1f}", f"{100 * found[f'{mesh}_distance_p90_m']:.1f}",
                f"{found[f'{mesh}_f_5_cm']:.2f}", f"{found[f'{mesh}_normal_median_deg']:.1f}",
                f"{1 - found[f'{mesh}_covered']:.0%}", f"{field[fitted]['psnr_db']:.1f}",
            ]
            for mesh, fitted in (("laid_on", "mesh"), ("other_frames", "other_frames"))
        )  # fmt: skip
        posed = f"{found['posed']} of {found['frames']}"
        lines.append([room, posed, *ours, f"{field['reference']['psnr_db']:.1f}"])
        lines.append([f"{room}, depth frames in between", "", *other, ""])
    head = (
        "film", "photos posed", "median [cm]", "90th percentile [cm]", "F at 5 cm", "normals, median [degrees]", "holes",
        "field on this mesh: PSNR [dB]", "on the reference: PSNR [dB]",
    )  # fmt: skip
    return markdown(head, lines)


ROOMS = {
    "lounge-kitchen": "filmed lounge",
    "kitchen": "filmed kitchen",
    "lobby": "lobby",
    "lobby_plain": "lobby, plain",
}
STAGES = {
    "nothing": "all stages",
    "completion": "without completion",
    "segments": "without segments",
    "stereo": "without comparing photos (stereo)",
    "refine": "without refinement of Gaussians",
    "plain": "without plain surfaces",
    "sweep": "without sweep of planes",
}


@entry("stage1")
def _stage1() -> str:
    found = {(r["room"], r["off"]): r for r in read("stage1")["rows"]}

    def cell(row: Row) -> str:
        return f"{row['f_5_cm']:.2f}, {100 * row['distance_p90_m']:.1f} cm, {row['holes']:.0%}"

    lines = [[name, *(cell(found[room, off]) for room in ROOMS)] for off, name in STAGES.items()]
    return markdown(("F at 5 cm, error (90th percentile), holes", *ROOMS.values()), lines)
